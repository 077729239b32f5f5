"""A weakly excited log is regularized by free runs, or refused; poles come with their errors."""

import numpy as np
import pytest

from sample_plants import played
from sb3_yann import LinearModel, identify
from sb3_yann.control import lqr
from sb3_yann.control.identification.fit import frozen_rows

LIQUID = 50.0
GAS = 100.0
DT = 0.02


def column(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the next state of an extraction column of five stages, by small Runge-Kutta steps.

    Its ten concentrations move together: ten states that hardly differ in what they say.
    """

    def rate(x: np.ndarray) -> np.ndarray:
        liquid = x[:5]
        gas = x[5:]
        passed = 5 * (liquid - gas**2)
        dl = u[0] / 5 * (np.r_[0.6, liquid[:-1]] - liquid) - passed
        return np.r_[dl, u[1] / 5 * (np.r_[gas[1:], 0.05] - gas) + passed]

    h = DT / 4
    for _ in range(4):
        a = rate(x)
        b = rate(x + h / 2 * a)
        c = rate(x + h / 2 * b)
        x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c))
    return x


U_SS = np.array([LIQUID, GAS])


def rest() -> np.ndarray:
    x = np.full(10, 0.3)
    for _ in range(300):
        x = column(x, U_SS)
    return x


X_SS = rest()
Q = np.eye(10) / 0.02**2
R = 0.09 * np.diag(1 / U_SS**2)


def weak_log(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a log in which the liquid moves by 30 %, and the gas by 2 %."""
    rng = np.random.default_rng(seed)
    moves = np.repeat(rng.uniform(-1, 1, (20, 2)), 10, axis=0)
    u = U_SS * (1 + moves * [0.3, 0.02])
    return played(column, u, X_SS), u


def closed_loop_cost(K: np.ndarray) -> float:
    x = X_SS + 0.02 * np.random.default_rng(9).normal(size=10)
    total = 0.0
    for _ in range(60):
        u = np.clip(U_SS + K @ (x - X_SS), 0.2 * U_SS, 3 * U_SS)
        total += float((x - X_SS) @ Q @ (x - X_SS) + (u - U_SS) @ R @ (u - U_SS))
        x = column(x, u)
    return total


def gain(model: LinearModel) -> np.ndarray:
    P = lqr.riccati(model, Q, R, 1.0)
    return -np.linalg.solve(R + model.B.T @ P @ model.B, model.B.T @ P @ model.A)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_weak_log_of_a_column_gives_a_law_as_good_as_its_equations(seed: int) -> None:
    x, u = weak_log(seed)
    idle = closed_loop_cost(np.zeros((2, 10)))
    plain = identify(x, u, dt=DT, x_ss=X_SS, u_ss=U_SS, ridge=0)
    found = identify(x, u, dt=DT, x_ss=X_SS, u_ss=U_SS)
    assert plain.ten_step_fit.min() > 80  # and yet the law of it is worse than none
    assert closed_loop_cost(gain(plain.model)) > 1.5 * idle
    assert closed_loop_cost(gain(found.model)) < 0.8 * idle
    assert "was chosen by free runs" in found.model.report()
    assert "Curvature" in found.model.report()


def test_a_log_that_says_nothing_is_refused_with_what_did_not_move() -> None:
    rng = np.random.default_rng(0)
    x = np.zeros((101, 1))
    u = np.zeros((100, 1))
    for k in range(100):  # feedback alone ties the input to the state, until it is opened
        u[k] = -0.9 * x[k] + 1e-4 * rng.normal() if k < 80 else 1.0
        x[k + 1] = 0.99 * x[k] + u[k] + 0.1 * rng.normal()
    with pytest.raises(ValueError, match=r"too weakly excited: .* moved .*test signal.*ridge=0"):
        identify(x, u, dt=1)
    with pytest.warns(UserWarning, match="no effect on the next state"):
        assert identify(x, u, dt=1, ridge=0).excitation < 0.01


def test_a_perfect_log_that_is_weak_is_left_as_it_is() -> None:
    plant = LinearModel.from_continuous([[0, 1], [-2, -0.3]], [[0], [1]], 0.001)
    u = np.random.default_rng(0).normal(size=(300, 1))
    found = identify(played(plant.step, u, [0, 0]), u, dt=0.001)
    np.testing.assert_allclose(found.model.A, plant.A, atol=1e-7)


def test_intervals_of_the_poles_hold_the_truth() -> None:
    A = np.array([[0.9, 0.2], [0.0, 0.7]])
    inside = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=(300, 1))
        driven = np.hstack([u, 0.1 * rng.normal(size=(300, 2))])
        x = played(lambda x, v: A @ x + [0, v[0]] + v[1:], driven, [0, 0])
        note = next(n for n in identify(x, u, dt=1).model.notes if n.startswith("Poles with 95 %"))
        first = note.partition(": ")[2].partition(";")[0]
        value, _, width = first.partition(" within ")
        inside += abs(float(value) - 0.9) <= float(width)
    assert 25 <= inside <= 30


def test_a_pole_that_may_be_unstable_is_reported() -> None:
    rng = np.random.default_rng(0)
    u = rng.normal(size=(60, 1))
    x = played(lambda x, u: 0.999 * x + u + 0.5 * rng.normal(), u, [0])
    assert "may be unstable in the plant" in LinearModel.from_data(x, u, dt=1).report()


def log(steps: int = 200, noise: float = 0.0, hold: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, (-(-steps // hold), 1)), hold, axis=0)[:steps]
    plant = LinearModel([[0.9, 0.1], [0.0, 0.8]], [[0.0], [0.2]], 1)
    return played(plant.step, u, [1, -1]) + noise * rng.normal(size=(steps + 1, 2)), u


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


def test_a_rounded_law_of_the_states_is_refused_and_a_test_signal_is_not() -> None:
    rng = np.random.default_rng(0)
    for push in (0.3, 0.0):
        x = np.ones((801, 1))
        u = np.zeros((800, 1))
        for k in range(800):
            u[k] = np.round(-0.5 * x[k] + push * rng.choice([-1, 1]), 2)
            x[k + 1] = 0.97 * x[k] + 0.1 * u[k] + 0.05 * rng.normal()
        if push:
            identify(x, u, dt=1)
    with pytest.raises(ValueError, match="within their rounding"):
        identify(x, u, dt=1)


def test_a_ridge_takes_a_state_that_rests() -> None:
    u = np.random.default_rng(0).normal(size=(100, 1))
    x = np.zeros((101, 2))
    for k in range(100):
        x[k + 1, 0] = 0.8 * x[k, 0] + u[k, 0]
    found = identify(x, u, dt=1, ridge=0.1)
    assert not found.model.A[1].any() and not any("u[0] has no" in n for n in found.model.notes)
