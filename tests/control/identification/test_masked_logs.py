"""A mask says that an entry is no reading: it is never read as the number under it."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")
from sb3_yann import LinearModel, LinearMPC, PlantTwin

MODEL = LinearModel([[0.9, 0.1], [0, 0.8]], [[0], [1]], 1.0)


def log(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (80, 1))
    x = np.zeros((81, 2))
    for k in range(80):
        x[k + 1] = MODEL.A @ x[k] + MODEL.B @ u[k]
    return x, u


def masked(values: np.ndarray) -> Any:
    mask = np.zeros(values.shape, bool)
    mask[7, 0] = True
    return np.ma.array(np.where(mask, 1e3, values), mask=mask)  # a sensor that failed


@pytest.mark.parametrize("which", ["states", "actions"])
@pytest.mark.parametrize("several", [False, True])
def test_from_data_refuses_masked_entries(which: str, several: bool) -> None:
    x, u = log()
    x, u = (masked(x), u) if which == "states" else (x, masked(u))
    given = ([x, log(1)[0]], [u, log(1)[1]]) if several else (x, u)
    with pytest.raises(ValueError, match=rf"{which}.* has masked entries.*Leave their rows out"):
        LinearModel.from_data(*given, dt=1.0)


@pytest.mark.parametrize("which", ["states", "actions"])
def test_a_twin_refuses_masked_entries(which: str) -> None:
    mpc = LinearMPC(MODEL, Q=np.eye(2), R=[[1]], horizon=2, x_min=-9, x_max=9, u_min=-1, u_max=1)
    x, u = log()
    first = (masked(x), u) if which == "states" else (x, masked(u))
    with pytest.raises(ValueError, match=rf"episode 0: {which} has masked entries"):
        PlantTwin.fit(mpc, [first, log(1)])


def test_a_mask_that_hides_nothing_is_as_good_as_none() -> None:
    x, u = log()
    plain = LinearModel.from_data(x, u, dt=1.0)
    assert LinearModel.from_data(np.ma.array(x), np.ma.array(u), dt=1.0) == plain
