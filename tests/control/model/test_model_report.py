"""The report of a model says in words what its matrices mean, with numbers that are right."""

import numpy as np
import pytest

from sb3_yann import LinearModel
from sb3_yann.control.gains import Gains, count_integrators
from sb3_yann.control.model.report import reach


def of_poles(*poles: float, dt: float = 0.1) -> LinearModel:
    return LinearModel(np.diag(poles), np.ones((len(poles), 1)), dt)


def rotating(size: float, period: float) -> LinearModel:
    """Return a model whose pair of poles has this magnitude and period in samples."""
    c = size * np.cos(2 * np.pi / period)
    s = size * np.sin(2 * np.pi / period)
    return LinearModel([[c, s], [-s, c]], [[0], [1]], 0.1)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (of_poles(np.exp(-1 / 20)), "0.9512: decays, time constant 2 (20 samples)"),
        (of_poles(np.exp(1 / 20)), "1.0513: grows, time constant 2 (20 samples)"),
        (of_poles(1.0), "1.0000: integrates"),
        (of_poles(0.0), "0.0000: gone within one sample"),
        (of_poles(-0.5), "decays, time constant 0.1443 (1.44 samples), oscillates with period 0.2"),
        (rotating(1.0, 40), "neither grows nor decays, oscillates with period 4 (40 samples)"),
        (rotating(np.exp(-0.1), 40), "decays, time constant 1 (10 samples), oscillates with"),
        (of_poles(0.5, 0.9), "Stable: the largest magnitude of a pole is 0.9."),
        (of_poles(0.5, 1.0), "On the border of stability"),
        (of_poles(0.5, 1.1), "Unstable: 1 of 2 poles grow, the largest magnitude of a pole is 1.1"),
    ],
)
def test_modes_are_told_in_time_and_in_samples(model: LinearModel, words: str) -> None:
    assert words in model.report()


def test_what_no_input_moves_is_named() -> None:
    # both states have the same pole and the same input: their difference stays on its own
    report = of_poles(0.9, 0.9).report()
    assert "the inputs reach 1 of 2 directions" in report
    assert "Nothing moves 1 x[0] -1 x[1]." in report


def test_what_the_inputs_hardly_move_is_named() -> None:
    report = of_poles(0.9, 0.9001).report()
    assert "the inputs reach 2 of 2 directions" in report
    assert "x[0] -1 x[1] is moved" in report


def test_short_samples_are_not_taken_for_a_lack_of_control() -> None:
    A = np.diag(np.ones(3), 1) - np.diag([1.0, 2, 3, 4])
    fast = LinearModel.from_continuous(A, [[0], [0], [0], [1]], 1e-3)
    ctrb = np.hstack([np.linalg.matrix_power(fast.A, k) @ fast.B for k in range(4)])
    assert np.linalg.matrix_rank(ctrb, tol=1e-6 * np.linalg.norm(ctrb)) < 4  # the usual test
    assert "the inputs reach 4 of 4 directions" in fast.report()
    assert "is moved" not in fast.report()


def test_units_do_not_count_in_what_is_reached() -> None:
    model = LinearModel([[0.9, 0.1], [0, 0.5]], [[0], [1]], 1)
    T = np.diag([1e6, 1e-3])
    other = LinearModel(T @ model.A @ np.linalg.inv(T), T @ model.B * 1e4, 1)
    np.testing.assert_allclose(reach(model)[0], reach(other)[0], rtol=1e-9)


def test_an_input_without_effect_is_named() -> None:
    assert "u[1] has no effect." in LinearModel([[0.5]], [[1, 0]], 1).report()


@pytest.mark.parametrize("pole", [0.5, 0.9])  # the latter repeats, as of equal tanks in series
def test_the_gain_of_an_input_is_that_of_a_long_run(pole: float) -> None:
    model = LinearModel([[0.9, 0.1], [0, pole]], [[0], [1]], 1)
    x = np.linalg.matrix_power(np.block([[model.A, model.B], [0, 0, 1]]), 1000)[:2, 2]
    assert f"  u[0]: x[0] {x[0]:+.4g}, x[1] {x[1]:+.4g}." in model.report()


def test_what_integrates_has_a_rate_in_its_own_units_and_no_gain() -> None:
    cart = LinearModel(
        [[1, 0.1], [0, 1]],
        [[0.005], [0.1]],
        0.1,
        time_unit="s",
        state_names=["position", "speed"],
        input_names=["force"],
        units=["m", "m/s", "N"],
    )
    assert "  force (N): position +1 m per s², speed +1 m/s per s.\n" in cart.report()
    tank = LinearModel([[1, 0], [0.2, 0.5]], [[0.3, 0], [0, 1]], 1)
    assert "  u[0]: x[0] +0.3 per sample, x[1] +0.12 per sample.\n" in tank.report()
    assert "  u[1]: x[0] 0, x[1] +2.\n" in tank.report()
    beside = LinearModel([[1, 0], [1e-6, 1]], [[0.2], [-3.2]], 1)  # hardly two in a row
    assert "  u[0]: x[0] +0.2 per sample, x[1] -3.2 per sample.\n" in beside.report()
    # A pole that may be 1, which no input surely moves: first the gain of the model as it is.
    A = np.array([[0.95, 0.1], [0.02, 0.8]])
    gains = Gains.of(A, np.ones((2, 1)), 1, [np.full((2, 1), each) for each in (2, 9, 9, 1)])
    told = LinearModel(A, np.ones((2, 1)), 1, gains=gains).report()
    assert "  u[0]: x[0] +37.5 ± 3.9, x[1] +8.75 ± 3.9.\n  A pole that may be 1 may be" in told
    assert "about:\n  u[0]: x[0] -2.365 ± 2, x[1] +3.838 ± 2.\n" in told
    # By its own error too: those of others, farther away, do not make it integrate.
    errors = np.diag([0.008, 0.006, 0.02])
    assert count_integrators(np.diag([0.97, 0.94, 0.9]), lambda R: np.trace(R @ errors)) == 1


def test_units_far_apart_are_reported() -> None:
    assert "Consider other units" in LinearModel([[0.5, 1e8], [1e-8, 0.5]], [[1], [1]], 1).report()


@pytest.mark.parametrize(
    ("model", "word"),
    [
        (of_poles(0.2, 0.9), "Slow:"),
        (rotating(0.99, 4), "Slow:"),
        (of_poles(0.995, 0.99), "Fast:"),
        (of_poles(0.8, 0.9), ""),
        (of_poles(1.0, 0.0), "no time scale to compare"),
    ],
)
def test_sampling_is_compared_with_the_plant(model: LinearModel, word: str) -> None:
    report = model.report()
    assert word in report
    assert word in ("Slow:", "Fast:") or not ("Slow:" in report or "Fast:" in report)


def test_operating_point_and_disturbances_are_reported() -> None:
    model = LinearModel([[0.5]], [[1]], 0.25, [3], [4], [[1, 2]], [5, 6])
    assert model.report().splitlines()[:2] == [
        "Linear model: 1 state, 1 input, 2 disturbances, sampled every 0.25.",
        "Operating point: x_ss = (3), u_ss = (4), d_ss = (5, 6).",
    ]
