"""A sensor that stands still while the plant moves, and what only looks like one."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann import LinearModel
from sb3_yann.control import identify
from sb3_yann.control.identification.fit import frozen_rows


def log(steps: int = 200, noise: float = 0.0, hold: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, (-(-steps // hold), 1)), hold, axis=0)[:steps]
    x = [np.array([1.0, -1.0])]
    for each in u:
        x.append(np.array([[0.9, 0.1], [0.0, 0.8]]) @ x[-1] + [0.0, 0.2] * each)
    return np.array(x) + noise * rng.normal(size=(steps + 1, 2)), u


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("state", [0, 1])
@pytest.mark.parametrize("first", [0, 60, 151])
def test_a_frozen_sensor_is_refused_by_column_and_rows(noise, state, first) -> None:
    x, u = log(noise=noise)
    x[first : first + 50, state] = x[first, state]
    wanted = rf"x\[{state}\] reads exactly .* in rows {first} to {first + 49} of episode 0"
    with pytest.raises(ValueError, match=wanted):
        identify(x, u, dt=1)
    with pytest.raises(ValueError, match=wanted):
        LinearModel.from_data(x, u, dt=1)


def test_a_short_run_is_no_frozen_sensor() -> None:
    x, u = log(noise=0.02)
    x[60:69, 0] = x[60, 0]
    assert frozen_rows([x], [u]) == []


@pytest.mark.parametrize("levels", [0.01, 0.1, 0.5])
def test_a_sensor_that_counts_in_steps_is_not_frozen(levels) -> None:
    for hold in (1, 20):
        x, u = log(hold=hold)
        assert frozen_rows([levels * np.round(x / levels)], [u]) == []


def test_a_plant_at_rest_a_state_at_rest_and_a_clipped_one_are_not_frozen() -> None:
    x, u = log()
    rests = np.vstack([x, np.tile(x[-1], (80, 1))]), np.vstack([u, np.tile(u[-1], (80, 1))])
    assert frozen_rows([rests[0]], [rests[1]]) == []
    beside = np.hstack([x, np.concatenate([0.5 ** np.arange(101), np.zeros(100)])[:, None]])
    beside[60:, 2] = 0.0  # it decays to nothing, and stays there
    assert frozen_rows([beside], [u]) == []
    still = np.hstack([x, np.full((201, 1), 3.0)])
    assert frozen_rows([still], [u]) == []
    clipped = np.maximum(log(hold=25)[0], -0.2)
    assert frozen_rows([clipped], [log(hold=25)[1]]) == []
