"""Episodes of a log: what is read from them, and what is refused by name."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann import DisturbanceBounds, LinearModel, LinearMPC, RateLimits, Tracking
from sb3_yann.twin.log import Episode, as_episodes, pieces, without_copies
from twin_samples import problem

X = np.zeros((11, 2))
U = np.full((10, 1), 0.1)
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
    x = np.zeros((8, 1))
    u = np.linspace(-0.3, 0.3, 7)[:, None]
    rng = np.random.default_rng(0)
    r = 0.5
    d = rng.uniform(-1, 1, (8, 1))
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
def test_a_log_is_in_plant_units(previous) -> None:
    model = LinearModel([[0.9]], [[1.0]], 1.0, E=[[0.5]], x_ss=[300.0], u_ss=[40.0])
    mpc = LinearMPC(
        model, Q=[[1]], R=[[1]], horizon=2, u_min=39, u_max=41, theta_min=295, theta_max=305,
        tracking=Tracking([0], 299, 301), disturbances=DisturbanceBounds(-1, 1),
        rate=RateLimits(-0.5, 0.5),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    u = np.linspace(-0.3, 0.3, 7)[:, None]
    x, r, d = (rng.uniform(-1, 1, (8, 1)) for _ in range(3))
    (expected,) = as_episodes(mpc.deviations, [(x, u)], [r], [d], previous)
    shown = None if previous is None else [[40.2]]
    (found,) = as_episodes(mpc, [(x + 300, u + 40)], [r + 300], [d], shown)
    (same,) = as_episodes(mpc, [(expected.thetas + mpc.theta_ss, u + 40)])
    for each in (found, same):
        np.testing.assert_allclose(each.thetas, expected.thetas, atol=1e-12)
        np.testing.assert_allclose(each.actions, expected.actions, atol=1e-12)
    with pytest.raises(ValueError, match=r"action 0 is -0.3 .* 39 and 41 .* is in plant units"):
        as_episodes(mpc, [(x, u)], [r], [d])
    with pytest.raises(ValueError, match="episode 0: 7 states and 7 actions; there is one state m"):
        as_episodes(mpc, [(x[1:] + 300, u + 40)], [r[1:] + 300], [d[1:]], shown)


def test_an_input_a_thousandth_beyond_its_bound_is_rounding_and_more_is_not() -> None:
    for sign in (-1, 1):
        (episode,) = as_episodes(problem(), [(X, sign * 10.009 * U)])
        np.testing.assert_array_equal(episode.actions, sign)
        with pytest.raises(ValueError, match="beyond the bounds -1 and 1 of the problem"):
            as_episodes(problem(), [(X, sign * 10.011 * U)])


def loaded() -> LinearMPC:
    """A problem whose theta holds a state, a reference, two disturbances and the input before."""
    return LinearMPC(
        LinearModel([[0.9]], [[1.0]], 1.0, E=[[0.5, 0.2]], d_ss=[7.0, 8.0]), Q=[[1]], R=[[1]],
        horizon=2, u_min=-1, u_max=1, theta_min=-5, theta_max=5, tracking=Tracking([0], -1, 1),
        disturbances=DisturbanceBounds([6, 7], [8, 9]), rate=RateLimits(-0.5, 0.5),
    )  # fmt: skip


def test_an_observer_s_disturbances_are_not_known_where_they_are_not_given() -> None:
    x = np.zeros((8, 1))
    u = np.linspace(-0.3, 0.3, 7)[:, None]
    r = 0.5
    (episode,) = as_episodes(loaded(), [(x, u)], [r], observed=True)
    assert np.isnan(episode.thetas[:, 2:4]).all()
    known = np.column_stack([x, np.full(8, 0.5), np.r_[0.0, u[:, 0]]])
    np.testing.assert_array_equal(episode.thetas[:, [0, 1, 4]], known)
    with pytest.raises(ValueError, match=r"theta holds 2 disturbances: pass disturbances=, shape"):
        as_episodes(loaded(), [(x, u)], [r])
    with pytest.raises(ValueError, match="theta holds 1 references"):
        as_episodes(loaded(), [(x, u)], observed=True)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"references": [np.zeros((7, 1))]}, r"references have shape \(7, 1\), expected \(8, 1\)"),
        ({"disturbances": [np.zeros(8)]}, r"disturbances have shape \(1, 8\), expected \(8, 2\)"),
        ({"disturbances": [np.full((8, 2), np.nan)]}, "episode 0: disturbances are not finite"),
        ({"previous": [[0.1, 0.2]]}, r"previous has shape \(2,\), expected \(1,\)"),
        ({"previous": [[np.inf]]}, "episode 0: previous are not finite"),
    ],
)  # fmt: skip
def test_what_stands_beside_the_states_is_refused_by_name(given, message) -> None:
    whole = {"references": [0.0], "disturbances": [[0.0, 0.0]]} | given
    with pytest.raises(ValueError, match=message):
        as_episodes(loaded(), [(np.zeros((8, 1)), np.zeros((7, 1)))], **whole)


def test_all_of_theta_and_something_beside_it_is_too_much() -> None:
    whole = [(np.zeros((8, 5)), np.zeros((7, 1)))]
    as_episodes(loaded(), whole)
    with pytest.raises(ValueError, match=r"\['references'\] is given, but states are all of theta"):
        as_episodes(loaded(), whole, [0.0])
    with pytest.raises(ValueError, match=r"expected \(T \+ 1, 1\) or \(T \+ 1, 5\)"):
        as_episodes(loaded(), [(np.zeros((8, 3)), np.zeros((7, 1)))])


def test_a_copy_is_left_out_and_what_differs_in_its_inputs_alone_is_not() -> None:
    given = as_episodes(problem(), [(X, U), (X, 2 * U), (X, U), (X + 1, U), (X, U)])
    kept, notes = without_copies(given)
    assert [each is other for each, other in zip(kept, (given[4], given[1], given[3]), strict=True)]
    assert len(kept) == 3 and notes == ("Left out 2 copies of other episodes.",)
    assert without_copies(kept) == (kept, ())


@pytest.mark.parametrize(
    ("lengths", "least", "parts"),
    [
        ((60, 60), 5, [20, 20, 20] * 2),  # a piece has twenty steps at least
        ((60, 60), 4, [30, 30] * 2),
        ((200, 59, 19), 5, [100, 100, 29, 30, 19]),
        ((200, 200), 40, [20] * 20),
        ((60, 60, 60), 3, [60, 60, 60]),
        ((60,), 5, [60]),
    ],
)  # fmt: skip
def test_pieces_are_as_many_as_are_asked_for_and_none_is_too_short(lengths, least, parts) -> None:
    rng = np.random.default_rng(0)
    whole = tuple(
        Episode(rng.uniform(-1, 1, (n + 1, 2)), rng.uniform(-1, 1, (n, 1))) for n in lengths
    )
    found = pieces(whole, least)
    assert [len(each) for each in found] == parts
    actions = np.concatenate([each.actions for each in found])
    np.testing.assert_array_equal(actions, np.concatenate([each.actions for each in whole]))
    assert all(len(each.thetas) == len(each) + 1 for each in found)
