"""Logs are cut where time is missing, and nothing else is lost."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann.control.identification.logs import Episode, as_episodes, split, without_gaps


def numbered(steps: int) -> Episode:
    return Episode(np.arange(steps + 1.0)[:, None], np.arange(steps) + np.zeros((1, steps)).T)


def test_every_step_but_those_of_another_length_is_kept() -> None:
    time = np.array([0, 1, 2, 5, 6, 7, 9, 10], float)  # steps 2 and 5 are gaps
    parts, lost = without_gaps([numbered(7)], [time], 1.0)
    assert lost == 2
    assert [each.states[:, 0].tolist() for each in parts] == [[0, 1, 2], [3, 4, 5], [6, 7]]
    assert all(len(each) == len(each.states) - 1 for each in parts)


def test_gaps_at_both_ends_leave_what_is_between() -> None:
    (part,), lost = without_gaps([numbered(4)], [np.array([0, 3, 4, 5, 9], float)], 1.0)
    assert lost == 2 and part.states[:, 0].tolist() == [1, 2, 3]


def test_the_last_steps_of_all_are_held_out_and_none_is_in_both_parts() -> None:
    fitted, tested = split([numbered(6), numbered(4)], 0.5)
    assert [len(each) for each in fitted] == [5] and [len(each) for each in tested] == [1, 4]
    assert fitted[0].states[-1] == tested[0].states[0] == 5


@pytest.mark.parametrize(("longer", "lost"), [(0.099, 0), (-0.099, 0), (0.101, 1), (-0.101, 1)])
def test_a_step_a_tenth_of_dt_too_long_or_too_short_is_none(longer: float, lost: int) -> None:
    time = 2.0 * np.arange(10)
    time[4:] += 2.0 * longer
    parts, gone = without_gaps([numbered(9)], [time], 2.0)
    assert gone == lost and sum(map(len, parts)) == 9 - lost


def test_where_more_than_half_of_the_steps_are_none_the_unit_is_another() -> None:
    def times(gaps: int) -> np.ndarray:
        return np.cumsum([0.0, *[3.0] * gaps, *[1.0] * (8 - gaps)])

    parts, lost = without_gaps([numbered(8)], [times(4)], 1.0)
    assert lost == 4 and [len(each) for each in parts] == [4]
    with pytest.raises(ValueError, match=r"dt = 1, but a step of the log takes 3 \(the median\)"):
        without_gaps([numbered(8)], [times(5)], 1.0)
    with pytest.raises(ValueError, match="time has 2 episodes, states has 1"):
        without_gaps([numbered(8)], [times(0), times(0)], 1.0)


@pytest.mark.parametrize(
    ("share", "fitted", "tested"),
    [(0.0, [6, 4], []), (0.01, [6, 3], [1]), (0.14, [6, 3], [1]), (0.16, [6, 2], [2]),
     (0.4, [6], [4]), (0.45, [6], [4]), (0.9, [1], [5, 4])],
)  # fmt: skip
def test_what_is_held_out_is_rounded_and_one_step_at_least(share, fitted, tested) -> None:
    parts = split([numbered(6), numbered(4)], share)
    assert [[len(each) for each in part] for part in parts] == [fitted, tested]


def test_disturbances_are_columns_behind_the_inputs_and_one_step_is_no_log() -> None:
    x, u, d = np.zeros((4, 2)), np.ones((3, 1)), np.full((3, 2), 5.0)
    (episode,), sizes = as_episodes(x, u, d)
    assert sizes == (2, 1, 2)
    np.testing.assert_array_equal(episode.regressors, np.tile([0, 0, 1, 5, 5], (3, 1)))
    (two, other), sizes = as_episodes(np.zeros((2, 4, 2)), np.ones((2, 3, 1)), None)
    assert sizes == (2, 1, 0) and len(two) == len(other) == 3
    assert as_episodes(x[:3], u[:2], None)[1] == (2, 1, 0)
    with pytest.raises(ValueError, match="one step tells nothing"):
        as_episodes(x[:2], u[:1], None)
    as_episodes([x[:2], x[:2]], [u[:1], u[:1]], None)
    part = episode.part(1, 3)
    assert len(part) == 2 and part.states.shape == (3, 2)
