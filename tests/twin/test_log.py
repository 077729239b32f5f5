"""Episodes of a log: what is read from them, and what is refused by name."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann import DisturbanceBounds, LinearModel, LinearMPC, RateLimits, Tracking
from sb3_yann.twin.log import as_episodes, pieces
from twin_samples import log, problem

X, U = np.zeros((11, 2)), np.full((10, 1), 0.1)
HOLED = np.where(np.arange(11)[:, None] == 4, np.nan, X)


@pytest.mark.parametrize(
    ("episodes", "error", "message"),
    [
        ([], ValueError, "episodes is empty"),
        ([X], TypeError, r"episode 0 must be a pair \(states, actions\)"),
        ([(X, U), (X, U[1:])], ValueError, "episode 1: 11 states and 9 actions"),
        ([(X[:, :1], U)], ValueError, r"episode 0: states have shape \(11, 1\), expected \(T \+ 1"),
        ([(X, np.hstack([U, U]))], ValueError, r"actions have shape \(10, 2\), expected \(T, 1\)"),
        ([(HOLED, U)], ValueError, "not finite, or too large, in row 4.* Cut the episode there"),
        ([(X, 30 * U)], ValueError, "action 0 is 3 in row 0, beyond the bounds -1 and 1"),
        ([(X[:4], U[:3])], ValueError, "episode 0 has 3 steps; 5 are the least"),
    ],
)
def test_what_is_no_log_is_refused_by_name(episodes, error, message) -> None:
    with pytest.raises(error, match=message):
        as_episodes(problem(), episodes)


def test_the_parts_of_theta_come_from_beside_the_states_or_with_them() -> None:
    model = LinearModel([[0.9]], [[1.0]], 1.0, E=[[0.5]])
    mpc = LinearMPC(
        model, Q=[[1]], R=[[1]], horizon=2, u_min=-1, u_max=1, theta_min=-5, theta_max=5,
        tracking=Tracking([0], -1, 1), disturbances=DisturbanceBounds(-1, 1),
        rate=RateLimits(-0.5, 0.5),
    )  # fmt: skip
    x, u, rng = np.zeros((8, 1)), np.linspace(-0.3, 0.3, 7)[:, None], np.random.default_rng(0)
    r, d = 0.5, rng.uniform(-1, 1, (8, 1))
    (episode,) = as_episodes(mpc, [(x, u)], [r], [d], [[0.2]])
    expected = np.column_stack([x, np.full(8, r), d, np.r_[0.2, u[:, 0]]])
    np.testing.assert_array_equal(episode.thetas, expected)
    (same,) = as_episodes(mpc, [(expected, u)])
    np.testing.assert_array_equal(same.thetas, expected)
    with pytest.raises(ValueError, match="theta holds 1 references: pass references="):
        as_episodes(mpc, [(x, u)])
    with pytest.raises(ValueError, match="references has 2 entries for 1 episodes"):
        as_episodes(mpc, [(x, u)], [r, r], [d])


@pytest.mark.parametrize("previous", [None, [[0.2]]])
def test_an_absolute_log_is_read_from_the_operating_point_on(previous) -> None:
    model = LinearModel([[0.9]], [[1.0]], 1.0, E=[[0.5]], x_ss=[300.0], u_ss=[40.0])
    mpc = LinearMPC(
        model, Q=[[1]], R=[[1]], horizon=2, u_min=-1, u_max=1, theta_min=-5, theta_max=5,
        tracking=Tracking([0], -1, 1), disturbances=DisturbanceBounds(-1, 1),
        rate=RateLimits(-0.5, 0.5),
    )  # fmt: skip
    rng, u = np.random.default_rng(0), np.linspace(-0.3, 0.3, 7)[:, None]
    x, r, d = (rng.uniform(-1, 1, (8, 1)) for _ in range(3))
    (expected,) = as_episodes(mpc, [(x, u)], [r], [d], previous)
    shown = None if previous is None else [[40.2]]
    own = [(x + 300, u + 40)]
    (found,) = as_episodes(mpc, own, [r + 300], [d], shown, absolute=True)
    whole = [(expected.thetas + mpc.theta_ss, u + 40)]
    (same,) = as_episodes(mpc, whole, absolute=True)
    for each in (found, same):
        np.testing.assert_allclose(each.thetas, expected.thetas, atol=1e-12)
        np.testing.assert_allclose(each.actions, expected.actions, atol=1e-12)
    with pytest.raises(ValueError, match=r"action 0 is 39.7 .* -1 and 1 .* needs absolute=True"):
        as_episodes(mpc, own, [r + 300], [d], shown)
    with pytest.raises(ValueError, match=r"action 0 is 42.7 in row 0, beyond the bounds 39 and 41"):
        as_episodes(mpc, [(x + 300, u + 43)], [r + 300], [d], absolute=True)


def test_inputs_that_round_beyond_their_bounds_are_clipped() -> None:
    (episode,) = as_episodes(problem(), [(X, 10.000001 * U)])
    assert np.all(episode.actions == 1) and len(log(1)[0][1]) == 60


def test_few_episodes_are_cut_into_pieces_that_follow_each_other() -> None:
    whole = as_episodes(problem(), log(2))
    parts = pieces(whole, 5)
    assert len(parts) == 6 and sum(map(len, parts)) == 120
    np.testing.assert_array_equal(parts[0].thetas[-1], parts[1].thetas[0])
    assert pieces(whole, 2) == whole and pieces(whole[:1], 5) == whole[:1]
