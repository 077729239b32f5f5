"""The report of a model says in words what its matrices mean, with numbers that are right."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sb3_yann import LinearModel
from sb3_yann.control.model.report import reach


def of_poles(*poles: float, dt: float = 0.1) -> LinearModel:
    return LinearModel(np.diag(poles), np.ones((len(poles), 1)), dt)


def rotating(size: float, period: float) -> LinearModel:
    """Return a model whose pair of poles has this magnitude and period in samples."""
    c, s = size * np.cos(2 * np.pi / period), size * np.sin(2 * np.pi / period)
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
    ],
    ids=["decays", "grows", "integrates", "delay", "alternates", "swings", "spirals"],
)
def test_a_mode_is_told_in_time_and_in_samples(model: LinearModel, words: str) -> None:
    assert words in model.report()


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (of_poles(0.5, 0.9), "Stable: the largest magnitude of a pole is 0.9."),
        (of_poles(0.5, 1.0), "On the border of stability"),
        (
            of_poles(0.5, 1.1),
            "Unstable: 1 of 2 poles grow, the largest magnitude of a pole is 1.1.",
        ),
    ],
    ids=["stable", "border", "unstable"],
)
def test_stability_is_told(model: LinearModel, words: str) -> None:
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


def test_unstable_modes_that_no_input_moves_are_found() -> None:
    model = LinearModel([[1.2, 0], [0, 0.5]], [[0], [1]], 1)
    assert "Nothing moves x[0]." in model.report()


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


def test_the_gain_of_an_input_is_that_of_a_long_run() -> None:
    model = LinearModel([[0.9, 0.1], [0, 0.5]], [[0], [1]], 1)
    x = np.zeros(2)
    for _ in range(1000):
        x = model.step(x, [1.0])
    assert f"u[0] moves the state to ({x[0]:.4g}, {x[1]:.4g})" in model.report()


def test_units_far_apart_are_told() -> None:
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
    ids=["slow", "slow swing", "fast", "fits", "none"],
)
def test_sampling_is_compared_with_the_plant(model: LinearModel, word: str) -> None:
    report = model.report()
    assert word in report
    assert word in ("Slow:", "Fast:") or not ("Slow:" in report or "Fast:" in report)


def test_operating_point_and_disturbances_are_told() -> None:
    model = LinearModel([[0.5]], [[1]], 0.25, [3], [4], [[1, 2]], [5, 6])
    assert model.report().splitlines()[:2] == [
        "Linear model: 1 state, 1 input, 2 disturbances, sampled every 0.25.",
        "Operating point: x_ss = (3), u_ss = (4), d_ss = (5, 6).",
    ]


def test_notes_end_the_report() -> None:
    noted = LinearModel([[0.5]], [[1]], 0.1, notes=["D was dropped."])
    assert noted.report().endswith("\nNote: D was dropped.")


def test_fit_of_an_identified_model_is_told() -> None:
    rng = np.random.default_rng(0)
    u, x = rng.normal(size=(200, 1)), np.zeros((201, 1))
    for k in range(200):
        x[k + 1] = 0.8 * x[k] + u[k]
    report = LinearModel.from_data(x, u, dt=1).report()
    assert "Fit over 40 steps held out, 100 % is perfect: 100 % one step ahead, 100 % 10" in report


@pytest.mark.parametrize("name", ["cstr", "clipped_pendulum"])
def test_every_shipped_problem_has_a_report(name: str) -> None:
    from sb3_yann_envs import problems

    problem: Any = getattr(problems, name)()
    assert "Poles:" in problem.model.report()


def test_a_mode_a_millionth_from_the_circle_neither_grows_nor_decays() -> None:
    for pole, words in (
        (1 + 0.9e-6, "integrates"), (1 + 1.1e-6, "grows"), (1 - 1.1e-6, "decays"),
        (-(1 - 0.9e-6), "neither grows nor decays"),
    ):  # fmt: skip
        report = of_poles(pole).report()
        assert f": {words}" in report
        growing = words == "grows"
        assert ("Unstable: 1 of 1 poles grow" in report) == growing
        border = words in ("integrates", "neither grows nor decays")
        assert ("On the border of stability" in report) == border
        # Where something integrates there is no steady state to tell.
        assert ("u[0] moves the state to" in report) == (words == "decays")


def test_a_mode_within_a_tenth_of_a_sample_is_a_delay() -> None:
    assert "gone within one sample" in of_poles(np.exp(-1 / 0.099)).report()
    assert "decays, time constant 0.0101 (0.101 samples)" in of_poles(np.exp(-1 / 0.101)).report()


def test_poles_are_told_largest_first_and_one_of_a_pair() -> None:
    A = np.diag([0.3, -0.95, 0.0, 0.0])
    A[2:, 2:] = rotating(0.6, 8).A
    lines = LinearModel(A, np.ones((4, 1)), 0.1).report().splitlines()
    at = lines.index("Poles:")
    told = [line.strip().partition(":")[0] for line in lines[at + 1 : at + 4]]
    real, imaginary = 0.6 * np.cos(np.pi / 4), 0.6 * np.sin(np.pi / 4)
    assert told == ["-0.9500", f"{real:.4f} ± {imaginary:.4f}i", "0.3000"]
    assert lines[at + 4].startswith("Stable")


def test_reach_is_that_of_the_scaled_gramian() -> None:
    A, B = np.array([[0.9, 0.2], [-0.1, 0.7]]), np.array([[0.0, 2.0], [3.0, 1.0]])
    B_unit = B / np.linalg.norm(B, axis=0)
    W = sum(
        np.linalg.matrix_power(A, k) @ B_unit @ B_unit.T @ np.linalg.matrix_power(A, k).T
        for k in range(500)
    )
    unit = np.sqrt(np.diag(W))
    sizes, axes = np.linalg.eigh(W / np.outer(unit, unit))
    found, directions = reach(LinearModel(A, B, 1))
    np.testing.assert_allclose(found, np.sqrt(sizes[::-1] / sizes[-1]))
    for ours, axis in zip(directions, axes.T[::-1] / unit, strict=True):
        np.testing.assert_allclose(np.abs(ours @ axis), np.linalg.norm(axis) ** 2)


def test_of_an_unstable_plant_the_reach_is_that_of_its_directions() -> None:
    found, _ = reach(LinearModel([[1.5, 1.0], [0.0, 1.2]], [[0], [1]], 1))
    assert found[0] == 1 and found[1] > 1e-3
    nowhere, _ = reach(LinearModel([[0.5]], [[0.0]], 1))
    assert nowhere.tolist() == [0.0]


@pytest.mark.parametrize("apart", [4e-4, 3.4e-4, 4e-7, 3.4e-7])
def test_a_direction_is_hardly_moved_below_a_thousandth_and_not_below_a_millionth(
    apart: float,
) -> None:
    model = of_poles(0.9, 0.9 + apart)
    size = reach(model)[0][-1]
    assert size == pytest.approx(2.75 * apart, rel=0.05)
    report, nothing = model.report(), size < 1e-6
    assert f"the inputs reach {1 if nothing else 2} of 2 directions" in report
    assert ("Nothing moves" in report) == nothing
    told = f"is moved {size:.1e} times as far as the most" in report
    assert told == (1e-6 < size < 1e-3)


def test_scaling_tells_the_entries_of_b_and_what_balances_a() -> None:
    report = LinearModel([[0.5, 64.0], [1 / 64, 0.5]], [[0.0, 0.25], [-8.0, 0.5]], 1).report()
    assert "Scaling: entries of B from 0.25 to 8; balancing" in report
    assert "rescale its states by up to 64 against each other.\n" in report
    near = LinearModel([[0.5, 2.0**20], [2.0**-20, 0.5]], [[1.0], [1.0]], 1).report()
    assert "by up to 1.05e+06 against each other. Consider other units." in near
    nothing = LinearModel([[0.5]], [[0.0]], 1).report()
    assert "entries of B" not in nothing


def test_gains_are_told_from_the_operating_point_of_a_plant_that_approaches_them() -> None:
    plain = LinearModel([[0.5, 0.0], [0.0, 0.8]], [[1.0, 0.0], [0.0, 3.0]], 1)
    report = plain.report()
    assert "  Held at 1, u[0] moves the state to (2, 0)." in report
    assert "  Held at 1, u[1] moves the state to (0, 15)." in report
    for point in ({"x_ss": [1.0, 0.0]}, {"u_ss": [0.0, 2.0]}):
        there = LinearModel(plain.A, plain.B, 1, **point).report()
        assert "  Held at u_ss + 1, u[1] moves the state to x_ss + (0, 15)." in there
    unstable = LinearModel([[1.5]], [[1.0]], 1).report()
    assert "Held at 1, u[0] would balance the state at (-2)." in unstable


def test_an_idle_gain_is_zero_and_not_rounding() -> None:
    model = LinearModel([[0.5, 1e-12], [0.0, 0.8]], [[1.0, 0.0], [0.0, 1.0]], 1)
    assert "u[1] moves the state to (0, 5)" in model.report()


@pytest.mark.parametrize(
    ("model", "word"),
    [
        (of_poles(np.exp(-1 / 0.99), 0.9), "Slow:"),
        (of_poles(np.exp(-1 / 1.01), 0.9), ""),
        (of_poles(np.exp(-1 / 50.5), np.exp(-1 / 80)), "Fast:"),
        (of_poles(np.exp(-1 / 49.5), np.exp(-1 / 80)), ""),
        (rotating(0.99, 5.9), "Slow:"),
        (rotating(0.99, 6.1), ""),
        (rotating(np.exp(-1 / 60), 2 * np.pi * 51), "Fast:"),
        (rotating(np.exp(-1 / 60), 2 * np.pi * 49), ""),
        (rotating(1.0, 5.9), "Slow:"),
        (rotating(1.0, 400), ""),
    ],
)
def test_sampling_is_slow_or_fast_from_these_edges_on(model: LinearModel, word: str) -> None:
    report = model.report()
    assert [each for each in ("Slow:", "Fast:") if each in report] == [word] * bool(word)


def test_sampling_tells_the_fastest_and_the_slowest_mode() -> None:
    report = of_poles(np.exp(-1 / 4), np.exp(-1 / 20), 1.0, 1e-9).report()
    assert "the fastest time constant is 4 samples, the slowest 20. A horizon of" in report
    assert "Sampling: the shortest oscillation takes 40 samples." in rotating(1.0, 40).report()


def test_names_and_units_stand_in_the_report() -> None:
    model = LinearModel([[0.5]], [[1.0, 0.0]], 1).named(
        ["level"], ["feed", "steam"], {"level": "m"}
    )
    report = model.report()
    assert "States: level (m). Inputs: feed, steam." in report.splitlines()[1]
    assert "  steam has no effect." in report and "Held at 1, feed moves" in report
