"""Trials go on as the log's episodes do, and what passes gains surely."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann.improvement.confirmation import Trial
from sb3_yann.twin.dynamics import law_of
from twin_samples import observed


def trial() -> Trial:
    """Return one of a plant whose set-points change amid an episode."""
    return Trial.draw(observed(), 12, np.random.default_rng([0, 1]))


def test_every_other_start_goes_on_with_the_set_points_of_a_logged_episode() -> None:
    found = trial()
    part = observed().dynamics.row.given
    assert (found.follow >= 0).tolist() == [False, True] * 6 + [False] * 12
    assert set(found.follow[found.follow >= 0]) == set(range(5))  # all of them
    for given, number, start in zip(
        np.swapaxes(found.given, 0, 1), found.follow, found.starts[0], strict=True
    ):
        if number < 0:
            np.testing.assert_array_equal(given, np.tile(start[part], (60, 1)))
        else:
            np.testing.assert_array_equal(given, observed().episodes[number].thetas[:-1, part])
            assert np.ptp(given) > 0
    rows, _ = found._run(law_of(observed().problem))
    np.testing.assert_array_equal(rows[:-1, 2][..., part], found.given)


def test_what_loses_on_episodes_like_the_logs_is_refused() -> None:
    found = trial()
    costs, unsafe = found.mpc
    follow = np.tile(found.follow, len(found.starts))
    room = 4e-4 * found.mean
    held = found.known & (follow < 0)
    loses = costs + np.where(held, -2 * room, room * found.known)
    assert loses[found.known].mean() < costs[found.known].mean()
    said = found.check(1, (loses, unsafe))
    assert not said.accepted and said.reason.startswith("episodes like the log's cost 0.04 % more")
    gains = found.check(1, (costs - room * found.known, unsafe))
    assert gains.accepted and gains.logged == pytest.approx(-4e-4)
    assert gains.error == pytest.approx(0, abs=1e-12)
