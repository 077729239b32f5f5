"""Where a twin's episodes begin, and where it holds."""

from __future__ import annotations

import numpy as np

from general_problems import solved
from sb3_yann import PlantTwin
from sb3_yann.twin.log import Episode
from sb3_yann.twin.starts import Starts
from twin_samples import log, problem, twin


def test_the_box_of_starts_is_on_average_that_of_the_plant() -> None:
    widths = []
    for k in range(40):
        starts = PlantTwin.fit(problem(), log(5, first=10 * k), residuals=["none"]).starts
        widths.append(starts.high - starts.low)
    np.testing.assert_allclose(np.mean(widths, axis=0), [3.0, 1.0], rtol=0.1)


def test_draws_lie_where_they_should_and_have_the_log_s_rest() -> None:
    starts, rng = twin().starts, np.random.default_rng(0)
    drawn = starts.draw(200, rng)
    assert np.all((drawn >= starts.low) & (drawn <= starts.high))
    around = starts.draw_around(2000, rng)
    assert np.ptp(around[:, 0]) > 1.5 * (starts.high - starts.low)[0]
    assert np.all((around >= problem().theta_min) & (around <= problem().theta_max))
    logged = {row.tobytes() for each in twin().episodes for row in each.thetas}
    assert all(row.tobytes() in logged for row in starts.draw_logged(50, rng))
    assert starts.draw_anywhere(50, rng).shape == (50, 2)


def test_the_log_and_the_starts_lie_within_the_limits_and_nan_does_not() -> None:
    found = twin()
    for episode in found.episodes:
        assert not found.limits.violated(episode.thetas).any()
    rng = np.random.default_rng(0)
    assert not found.limits.violated(found.starts.draw(500, rng)).any()
    assert found.limits.violated(np.array([[np.nan, 0.0], [100.0, 0.0]])).all()


def test_a_start_is_the_rarer_the_farther_it_lies_outside_the_range_of_the_log() -> None:
    starts, rng, k = twin().starts, np.random.default_rng(0), len(twin().episodes)
    middle, half = (starts.high + starts.low) / 2, np.ptp(starts.first[:, :2], axis=0) / 2
    at = middle + half * np.array([[0.0, 0.0], [0.9, -1.0], [0.0, 2.0], [-3.0, 0.5]])
    expected = 2 / (k + 1) * np.array([1, 1, 1.5 ** (1 - k), 2.0 ** (1 - k)])
    np.testing.assert_allclose(starts.chance_beyond(at), expected)
    # That is how often it happens, in each coordinate alone.
    drawn = rng.uniform(-1, 1, (20_000, k + 1))
    seen, new = drawn[:, :k], drawn[:, k]
    middle, half = (seen.max(1) + seen.min(1)) / 2, np.ptp(seen, axis=1) / 2
    for rho in (1.0, 1.5, 2.0):
        often = np.mean(np.abs(new - middle) > rho * half)
        assert abs(often - 2 / (k + 1) * ((1 + rho) / 2) ** (1.0 - k)) < 0.01


def test_what_a_log_shows_are_its_rows_and_where_it_may_begin() -> None:
    starts = twin().starts
    low, high = starts.shown
    assert np.all((starts.rows >= low) & (starts.rows <= high))
    k, half = len(starts.first), np.ptp(starts.first, axis=0) / 2
    middle = (starts.first.max(0) + starts.first.min(0)) / 2
    assert 2 / (k + 1) > 0.05  # so many starts lie beyond the range of the log itself
    beyond = middle + half * (2 * (40 / (k + 1)) ** (1 / (k - 1)) - 1) * np.eye(2)
    np.testing.assert_allclose(starts.chance_beyond(beyond), 0.05)
    further = beyond.max(0) - middle
    np.testing.assert_allclose(low, np.minimum(starts.rows.min(0), middle - further))
    np.testing.assert_allclose(high, np.maximum(starts.rows.max(0), middle + further))


def test_half_of_the_starts_have_set_points_between_those_of_the_log() -> None:
    mpc, rng = solved("servo with rates"), np.random.default_rng(0)
    held = mpc.layout.reference
    thetas = 0.2 * mpc.theta_half * rng.uniform(-1, 1, (4, mpc.n_theta))
    episodes = (
        Episode(np.tile(each, (7, 1)), np.zeros((6, mpc.model.n_inputs))) for each in thetas
    )
    starts = Starts.of(mpc, tuple(episodes))
    low, high = starts.shown
    for draw in (starts.draw_between, starts.draw_around):
        drawn = draw(200, rng)[:, held]
        assert np.all((drawn >= low[held]) & (drawn <= high[held]))
        logged = np.isin(drawn, thetas[:, held]).all(axis=1)
        assert 0.4 < logged.mean() < 0.7
    assert not np.isin(starts.draw_anywhere(200, rng)[:, held], thetas[:, held]).all()
    assert np.isin(starts.draw(200, rng)[:, held], thetas[:, held]).all()
    never_moved = Starts(mpc, starts.low, starts.high, thetas[:1], thetas[:1])
    assert np.isin(never_moved.draw_between(50, rng)[:, held], thetas[0, held]).all()
