"""Logs are cut where time is missing, and nothing else is lost."""

from __future__ import annotations

import numpy as np

from sb3_yann.control.identification.logs import Episode, split, without_gaps


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
