"""Delays of inputs in the residuals of a fit, and the criterion of dead time, by their formulas."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sb3_yann.control import LinearModel
from sb3_yann.control.identification.dead_time import (
    ENOUGH,
    _chosen,
    _correlations,
    _delays,
    _first,
    _left,
    exact_memory,
    found_delays,
    input_notes,
    with_memory_point,
)
from sb3_yann.control.identification.least_squares import Regression, regress
from sb3_yann.log import Episode

SIZES = (1, 2, 0)


def test_a_correlation_is_of_what_the_known_part_leaves_and_weighted() -> None:
    rng = np.random.default_rng(0)
    known, residuals, past = (rng.standard_normal((80, k)) for k in (3, 2, 2))
    residuals[:, 0] += past[:, 1] + known[:, 0]
    past[:, 1] += 0.5 * known[:, 2] + 7
    basis = np.column_stack([np.ones(80), known])

    def rest(values: np.ndarray) -> np.ndarray:
        return values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]

    whole = np.corrcoef(np.hstack([rest(residuals), rest(past)]).T)[:2, 2:]
    for weights in (np.ones(2), np.array([0.2, 1.0])):
        expected = np.max(weights[:, None] * np.abs(whole), axis=0)
        np.testing.assert_allclose(_correlations(known, residuals, past, weights), expected)
    tied = np.column_stack([known @ [1.0, 2.0, 3.0], past[:, 0]])  # the known part says it all
    assert _correlations(known, residuals, tied, np.ones(2))[0] == 0
    still = np.column_stack([known, np.full(80, 4.0)])
    np.testing.assert_allclose(
        _correlations(still, residuals, past, np.ones(2)), np.abs(whole).max(axis=0)
    )


def test_five_thousand_steps_are_looked_at_and_no_more() -> None:
    def steps(*lengths: int) -> list[int]:
        episodes = [Episode(np.zeros((n + 1, 1)), np.zeros((n, 1))) for n in lengths]
        return [len(each) for each in _first(episodes)]

    assert ENOUGH == 5000 and steps(30, 40) == [30, 40] and steps(6000) == [5000]
    assert steps(3000, 1999, 500, 7) == [3000, 1999, 1]
    assert steps(3000, 2000, 7) == [3000, 2000]


def late(lag: int, share: float, steps: int = 400, seed: int = 0) -> tuple[Regression, Episode]:
    """Return the fit of a log whose residuals correlate so much with an input so long ago."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((steps, 2))
    past = np.roll(u[:, 1], lag)
    past[:lag] = rng.standard_normal(lag)
    own = rng.standard_normal(steps)
    own -= past * (own @ past) / (past @ past)  # so that the share is what it is
    driven = share * past / np.std(past) + np.sqrt(1 - share**2) * own / np.std(own)
    x = np.zeros((steps + 1, 1))
    for k in range(steps):
        x[k + 1] = 0.5 * x[k] + u[k, 0] + 0.5 * u[k, 1] + driven[k]
    episode = Episode(x, u)
    return regress([episode], SIZES, None, 0.0), episode


@pytest.mark.parametrize("lag", [1, 2, 10])
def test_the_lag_of_the_largest_correlation_is_named_with_it(lag: int) -> None:
    found, episode = late(lag, 0.6)
    (first, _), (best, size) = _delays(found, [episode], SIZES)
    assert (first, best) == (0, lag) and size == pytest.approx(0.6, abs=0.1)
    note, advice = input_notes(found, [episode], SIZES)
    assert note.startswith(f"The residuals follow u[1] of {lag} steps before (")
    assert f"(correlation {size:.2f})" in note and f"acts {lag} samples late." in note
    assert advice.startswith(f"Pass delay=[0, {lag}], ")


def test_a_lag_beyond_ten_and_a_faint_one_are_none() -> None:
    none = [(0, 0.0), (0, 0.0)]
    for lag, share in ((11, 0.6), (2, 0.15)):
        found, episode = late(lag, share)
        assert _delays(found, [episode], SIZES) == none
    found, episode = late(2, 0.35)
    assert _delays(found, [episode], SIZES)[1][0] == 2
    # Of few steps chance correlates as much: 5 / sqrt(steps) is wanted.
    found, episode = late(2, 0.55, steps=60)
    assert _delays(found, [episode], SIZES) == none
    found, episode = late(2, 0.85, steps=60)
    assert _delays(found, [episode], SIZES)[1][0] == 2


def test_an_input_without_effect_is_told_with_its_lag_or_alone() -> None:
    rng = np.random.default_rng(0)
    u, x = rng.standard_normal((300, 2)), np.zeros((301, 1))
    for k in range(300):
        x[k + 1] = 0.5 * x[k] + u[k, 0] + 0.1 * rng.standard_normal()
    idle = Episode(x, u)
    (note,) = input_notes(regress([idle], SIZES, None, 0.0), [idle], SIZES)
    assert note.startswith("u[1] has no effect on the next state that can be told from 0. Is it")
    for k in range(300):
        x[k + 1] = 0.5 * x[k] + u[k, 0] + (u[k - 3, 1] if k > 2 else 0)
    found = regress([idle], SIZES, None, 0.0)
    note, advice = input_notes(found, [idle], SIZES)
    assert note.startswith("u[1] has no effect that can be told from 0, and the residuals follow")
    assert advice == "Pass delay=[0, 3], or delay='auto'."
    little = dataclasses.replace(found, degrees_of_freedom=0)  # no verdict
    assert input_notes(little, [idle], SIZES)[0].startswith("The residuals follow u[1] of 3")


def test_a_late_input_that_auto_leaves_out_gets_other_advice_than_auto() -> None:
    found, episode = late(2, 0.35)
    assert found_delays([episode], 2) == [0, 0]  # it explains too little
    advice = input_notes(found, [episode], SIZES)[-1]
    assert advice.startswith("Pass delay=[0, 2], and keep it where the fit of held-out data")
    assert "delay='auto' takes none" in advice and "or delay='auto'." not in advice
    with pytest.warns(UserWarning, match="delay='auto' takes none: .* less than 30 %"):
        LinearModel.from_data(episode.states, episode.driven, dt=1.0, delay="auto")


def test_a_late_disturbance_gets_no_delay_of_the_inputs() -> None:
    found, episode = late(3, 0.6)
    (note,) = input_notes(found, [episode], (1, 1, 1))
    assert note.startswith("The residuals follow d[0] of 3 steps") and "delay=" not in note
    assert note.endswith("Move its measurements 3 samples down, in the log and on the plant.")


def test_what_past_inputs_leave_of_a_target_is_that_of_least_squares() -> None:
    rng = np.random.default_rng(0)
    targets, taps = rng.standard_normal((90, 2)), rng.standard_normal((90, 6))  # three lags of two
    targets[:, 0] += taps[:, 2]
    whole = np.hstack([targets, taps])
    gram = whole.T @ whole / 90
    for delays, columns in (([0, 0], []), ([2, 0], [0, 2]), ([1, 3], [0, 1, 3, 5])):
        basis = taps[:, columns]
        left = targets - basis @ np.linalg.lstsq(basis, targets, rcond=None)[0]
        np.testing.assert_allclose(_left(gram, delays, 2), np.mean(left**2, axis=0), atol=1e-12)


def test_the_dead_time_is_the_shortest_that_explains_nearly_as_much_as_the_best() -> None:
    """By Schwarz's criterion, n parameters more for each sample; then 30 % of the variance."""
    steps, lags = 200, np.arange(5)
    left = np.array([[1.0, 1.0], [1.0, 0.6], [0.9, 0.5], [0.5, 0.45], [0.498, 0.449]])
    criterion = steps * np.log(left).sum(axis=1) + np.log(steps) * 2 * lags
    assert np.argmin(criterion) == 3
    assert _chosen(left, steps, 2) == 3  # the first state's 0.9 is more than 0.5 / 0.7
    left[2, 0] = 0.71
    assert _chosen(left, steps, 2) == 2
    left[2, 0] = 0.72
    assert _chosen(left, steps, 2) == 3
    assert _chosen(np.ones((5, 2)), steps, 2) == 0
    free = np.array([[1.0], [0.998]])  # not worth a parameter
    assert _chosen(free, steps, 1) == 0 and _chosen(free**200, steps, 1) == 1


def test_too_short_a_log_tells_no_dead_time() -> None:
    def log(steps: int) -> Episode:
        rng = np.random.default_rng(0)
        u, x = rng.standard_normal((steps, 1)), np.zeros((steps + 1, 1))
        for k in range(2, steps):
            x[k + 1] = 0.5 * x[k] + u[k - 2]
        return Episode(x, u)

    assert found_delays([log(62)], 1) == [0]  # 52 steps, four for each of 13 parameters
    assert found_delays([log(63)], 1) == [2]
    assert found_delays([log(63), log(11)], 1) == [2] and found_delays([log(11)] * 90, 1) == [0]


def test_memory_shifts_by_a_sample_and_rests_where_its_input_does() -> None:
    A, B = exact_memory(np.full((5, 5), 0.3), np.full((5, 2), 0.4), [2, 1], 2)
    np.testing.assert_array_equal(A[:2], np.full((2, 5), 0.3))
    np.testing.assert_array_equal(B[:2], np.full((2, 2), 0.4))
    np.testing.assert_array_equal(A[2:], [[0] * 5, [0, 0, 1, 0, 0], [0] * 5])
    np.testing.assert_array_equal(B[2:], [[1, 0], [0, 0], [0, 1]])
    assert with_memory_point([1.0, 2.0], [7.0, 8.0], [2, 1]).tolist() == [1, 2, 7, 7, 8]
    assert with_memory_point([1.0], None, [0, 0]) == [1.0]
    assert with_memory_point(None, None, [1]) is None


def test_a_measured_disturbance_does_not_move_the_memory() -> None:
    rng = np.random.default_rng(0)
    u, d, x = rng.standard_normal((200, 1)), rng.standard_normal((200, 1)), np.zeros((201, 1))
    for k in range(200):
        x[k + 1] = 0.5 * x[k] + (u[k - 1] if k else 0) + 0.3 * d[k] + 0.01 * rng.standard_normal()
    system = LinearModel.from_data(x, u, dt=1.0, disturbances=d, delay=1)
    assert system.E[1, 0] == 0.0 and system.E[0, 0] == pytest.approx(0.3, abs=0.01)
    np.testing.assert_allclose(system.A, [[0.5, 1.0], [0.0, 0.0]], atol=0.01)
    assert system.state_names == ("x[0]", "u[0](k-1)")
    with pytest.raises(ValueError, match="delay = 200, but no episode has more than 200 steps"):
        LinearModel.from_data(x, u, dt=1.0, disturbances=d, delay=200)
