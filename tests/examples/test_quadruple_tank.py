"""The quadruple tank of the examples is Johansson's plant, and a proper environment."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from quadruple_tank import (
    DT,
    FULL,
    LEVELS_SS,
    VOLTAGES_SS,
    QuadrupleTank,
    advance,
    derivative,
    write_log,
)
from sb3_yann import LinearModel


def rest(wear: float = 0.0) -> np.ndarray:
    """Return where the levels come to rest with 3 V at both pumps."""
    levels = LEVELS_SS
    for _ in range(300):
        levels = advance(levels, VOLTAGES_SS, wear=wear)
    return np.array(levels)


def test_it_rests_at_the_published_operating_point() -> None:
    # Table I of the paper prints (12.4, 12.7, 1.8, 1.4) cm; from its equations follow
    # (12.26, 12.78, 1.63, 1.41).
    assert np.max(np.abs(rest() - LEVELS_SS)) < 0.2
    np.testing.assert_allclose(derivative(rest(), VOLTAGES_SS), 0, atol=1e-12)


def test_its_time_constants_are_the_published_ones() -> None:
    def dynamics(x, u, d):
        return derivative(x, u, d[0])

    model = LinearModel.from_dynamics(dynamics, rest(), VOLTAGES_SS, DT, [0.0])
    found = -DT / np.log(np.diag(model.A))  # A is upper triangular: tanks 3, 4 flow into 1, 2
    assert found == pytest.approx([62, 90, 23, 30], abs=0.7)  # T1 to T4 at P-


def test_its_steady_gains_are_the_published_ones() -> None:
    model = LinearModel.from_env(QuadrupleTank, rest(), VOLTAGES_SS)
    gains = np.linalg.solve(np.eye(4) - model.A, model.B)[:2]
    # G-(0) in V/V, printed as [2.6, 1.5; 1.4, 2.8]; the sensors give 0.5 V for each cm
    np.testing.assert_allclose(0.5 * gains, [[2.6, 1.5], [1.4, 2.8]], atol=0.15)


def test_worn_pumps_leave_less_water_in_every_tank() -> None:
    assert np.all(rest(wear=0.1) < rest())


@pytest.mark.filterwarnings("ignore:.*")  # the checker recommends actions in [-1, 1]
def test_gymnasium_s_checker_finds_nothing_wrong() -> None:
    check_env(QuadrupleTank(noise=0.02), skip_render_check=True)


def test_a_seed_reproduces_an_episode_and_the_plant_s_luck_is_not_the_policy_s() -> None:
    def disturbances(voltage: float) -> list[float]:
        env = QuadrupleTank(noise=0.02)
        env.reset(seed=7)
        return [env.step(np.full(2, voltage))[4]["disturbance"] for _ in range(200)]

    assert disturbances(3.0) == disturbances(3.0) == disturbances(0.0)
    assert len(set(disturbances(3.0))) > 1


def test_a_tank_that_overflows_is_a_violation_and_stays_full() -> None:
    env = QuadrupleTank()
    env.reset(options={"state": [19.9, 10, 5, 5]})
    levels, reward, terminated, _, info = env.step(np.array([10, 10]))
    assert info["violation"]
    assert levels[0] == FULL
    assert reward == -1
    assert not terminated


def test_an_empty_tank_stays_empty() -> None:
    env = QuadrupleTank()
    env.reset(options={"state": [0.1, 0.1, 0, 0]})
    for _ in range(10):
        levels, *_ = env.step(np.zeros(2))
    assert levels.tolist() == pytest.approx([0, 0, 0, 0], abs=1e-3)


@pytest.mark.parametrize("state", [[1, 2, 3], [1, 2, 3, 21], [-1, 2, 3, 4]])
def test_levels_that_no_tank_has_are_named(state) -> None:
    with pytest.raises(ValueError, match="must be four levels from 0 to 20 cm"):
        QuadrupleTank().reset(options={"state": state})


def test_the_log_is_the_same_each_time_and_gives_the_model(tmp_path) -> None:
    for name in ("one.csv", "two.csv"):
        write_log(tmp_path / name)
    assert (tmp_path / "one.csv").read_text() == (tmp_path / "two.csv").read_text()
    log = np.loadtxt(tmp_path / "one.csv", delimiter=",", skiprows=1)
    x = log[:, 1:5]
    u = log[:-1, 5:7]
    d = log[:-1, 7:]
    found = LinearModel.from_data(x, u, disturbances=d, dt=DT, u_ss=VOLTAGES_SS, d_ss=[0])
    true = LinearModel.from_env(QuadrupleTank, rest(), VOLTAGES_SS)
    assert np.max(np.abs(found.A - true.A)) < 0.06
    assert np.max(np.abs(found.B - true.B)) < 0.06
    assert np.max(np.abs(found.x_ss - rest())) < 0.2
