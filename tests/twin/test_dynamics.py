"""Dynamics of a twin step as plain loops in numpy do; residuals, and angles that jump."""

import numpy as np
import pytest

from general_problems import solved
from sb3_yann import DisturbanceBounds, LinearModel, LinearMPC, RateLimits, Tracking
from sb3_yann.twin.dynamics import Coordinates, Dynamics, Residual
from sb3_yann.twin.log import Episode, as_episodes, without_copies
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.twin.selection import fit_ensemble
from twin_samples import problem
from twin_samples import random_episode as episode

K = 3
N = 2


def network(seed: int, hidden: int) -> Residual:
    rng = np.random.default_rng(seed)
    Q = rng.normal(size=(K, K, N))
    Q = (Q + np.swapaxes(Q, 0, 1)).reshape(K, K * N)
    shapes = (K, hidden), (1, hidden), (hidden, hidden), (1, hidden), (hidden, N), (1, N), (K, N)
    return Residual([*(rng.normal(size=each) for each in shapes), Q])


@pytest.mark.parametrize("hidden", [0, 4])
def test_it_is_the_sum_of_a_network_and_a_polynomial(hidden: int) -> None:
    found = network(1, hidden)
    z = np.random.default_rng(0).uniform(-1, 1, (9, K))
    W1, b1, W2, b2, W3, b3, L, Q = found.weights
    expected = np.tanh(np.tanh(z @ W1 + b1) @ W2 + b2) @ W3 + b3 + z @ L
    expected += np.einsum("bi,ijn,bj->bn", z, Q.reshape(K, K, N), z)
    np.testing.assert_allclose(found.predict(z), expected, rtol=1e-12)
    moves = 1e-6 * np.eye(K)
    slopes = [(found.predict(z + e) - found.predict(z - e)) / 2e-6 for e in moves]
    np.testing.assert_allclose(found.jacobian(z), np.stack(slopes, -1), atol=1e-8)


DT = 0.1


def rotor() -> LinearMPC:
    model = LinearModel([[1.0, DT], [0.0, 1.0]], [[0.0], [DT]], DT)
    return LinearMPC(model, Q=np.eye(2), R=[[1.0]], horizon=2, u_min=-1, u_max=1)


def episodes(turn: float, low: float) -> list[Episode]:
    """Return episodes of a rotor with a little friction, its angle shown from ``low`` on."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(6):
        x = np.array([turn * rng.uniform(), rng.uniform(-1, 1) * turn / 4])
        thetas = []
        inputs = rng.uniform(-1, 1, (60, 1))
        for u in [*inputs, [0.0]]:
            thetas.append([low + (x[0] - low) % turn, x[1]])
            x = x + DT * np.array([x[1], u[0] - 0.1 * x[1]])
        found.append(Episode(np.array(thetas), inputs))
    return found


@pytest.mark.parametrize(("turn", "low"), [(2 * np.pi, -np.pi), (2 * np.pi, 0.0), (360.0, -180.0)])
def test_a_wrapped_angle_is_found_and_its_jumps_are_not_learnt(turn, low) -> None:
    mpc = rotor()
    log = episodes(turn, low)
    coordinates = Coordinates.of(RowLayout(mpc), log)
    np.testing.assert_allclose(coordinates.turn, [turn, 0.0])
    (network,) = fit_ensemble(coordinates, [log], 0, updates=500)
    model = Dynamics(mpc, coordinates, (network,))
    for each in log:
        after = model.step(each.thetas[None, :-1], each.actions[None])[0]
        error = coordinates.nearest(after, each.thetas[1:]) - each.thetas[1:]
        assert np.abs(error).max() < 2e-3 * turn
        assert np.ptp(after[:, 0]) <= 1.001 * turn


def bent(mpc: LinearMPC, members: int = 2) -> tuple[Dynamics, Episode]:
    """Return dynamics with quadratic residuals, and the episode that scales them."""
    log = episode(mpc)
    found = []
    coordinates = Coordinates.of(RowLayout(mpc), [log])
    for seed in range(members):
        rng = np.random.default_rng(seed)
        k = len(coordinates.scale)
        Q = 0.02 * rng.normal(size=(k, k, 2))
        L = 0.02 * rng.normal(size=(k, 2))
        b = 0.02 * rng.normal(size=2)
        found.append(Residual.polynomial(L, b, Q + np.swapaxes(Q, 0, 1)))
    return Dynamics(mpc, coordinates, tuple(found)), log


def stepped(dynamics: Dynamics, member: int, theta: np.ndarray, u: np.ndarray) -> np.ndarray:
    """One row after another: the model, and the residual in scaled, clipped coordinates."""
    mpc = dynamics.problem
    box = dynamics.coordinates
    n = mpc.model.n_states
    d = mpc.layout.disturbance
    features = np.concatenate([theta[:n], theta[d], u])
    z = np.clip(features, box.low, box.high) / box.scale
    after = theta.copy()
    after[:n] = mpc.model.A @ theta[:n] + mpc.model.B @ u + mpc.model.E @ theta[d]
    after[:n] += dynamics.members[member].predict(z[None])[0]
    after[mpc.layout.previous] = u[: mpc.layout.n_previous]
    return after


@pytest.mark.parametrize("name", ["servo with all of it", "regulator with rates"])
def test_a_step_is_the_model_with_its_disturbance_and_the_residual_inside_the_box(name) -> None:
    mpc = solved(name)
    dynamics, _ = bent(mpc)
    rng = np.random.default_rng(3)
    theta = rng.uniform(mpc.theta_min, mpc.theta_max, (2, 30, mpc.n_theta))
    u = rng.uniform(mpc.u_min, mpc.u_max, (2, 30, 1))
    after = dynamics.step(theta, u)
    for member in range(2):
        for i in range(30):
            expected = stepped(dynamics, member, theta[member, i], u[member, i])
            np.testing.assert_allclose(after[member, i], expected, rtol=1e-10, atol=1e-10)


X = np.zeros((11, 2))
U = np.full((10, 1), 0.1)
HOLED = np.where(np.arange(11)[:, None] == 4, np.nan, X)


@pytest.mark.parametrize(
    ("episodes", "error", "message"),
    [
        ([], ValueError, "episodes is empty"),
        ([X], TypeError, r"episode 0 must be a pair \(states, actions\)"),
        ([(X, U), (X, U[1:])], ValueError, "actions of episode 1 has 9 rows, states has 11"),
        ([(X[:, :1], U)], ValueError, "states have 1 columns, the problem 2 states, and theta 2"),
        ([(X, np.hstack([U, U]))], ValueError, "actions have 2 columns, the problem 1 inputs"),
        ([(HOLED, U)], ValueError, "NaN or infinite entries in 1 rows, first in row 4"),
        ([(X, 30 * U)], ValueError, "action 0 is 3 in row 0, beyond the bounds -1 and 1"),
        ([(X[:4], U[:3])], ValueError, "episode 0 has 3 steps; 5 are the least"),
    ],
)
def test_what_is_no_log_is_refused_by_name(episodes, error, message) -> None:
    with pytest.raises(error, match=message):
        as_episodes(problem(), episodes)


def test_a_log_is_in_plant_units() -> None:
    model = LinearModel([[0.9]], [[1.0]], 1.0, E=[[0.5]], x_ss=[300.0], u_ss=[40.0])
    mpc = LinearMPC(
        model, Q=[[1]], R=[[1]], horizon=2, u_min=39, u_max=41, theta_min=295, theta_max=305,
        tracking=Tracking([0], 299, 301), disturbances=DisturbanceBounds(-1, 1),
        rate=RateLimits(-0.5, 0.5),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    u = np.linspace(-0.3, 0.3, 7)[:, None]
    x, r, d = (rng.uniform(-1, 1, (8, 1)) for _ in range(3))
    (expected,) = as_episodes(mpc.deviations, [(x, u)], [r], [d])
    (found,) = as_episodes(mpc, [(x + 300, u + 40)], [r + 300], [d])
    (same,) = as_episodes(mpc, [(expected.thetas + mpc.theta_ss, u + 40)])
    for each in (found, same):
        np.testing.assert_allclose(each.thetas, expected.thetas, atol=1e-12)
        np.testing.assert_allclose(each.actions, expected.actions, atol=1e-12)
    with pytest.raises(ValueError, match=r"action 0 is -0.3 .* 39 and 41 .* is in plant units"):
        as_episodes(mpc, [(x, u)], [r], [d])
    with pytest.raises(ValueError, match="actions of episode 0 has 7 rows, states has 7"):
        as_episodes(mpc, [(x[1:] + 300, u + 40)], [r[1:] + 300], [d[1:]])


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


def test_what_theta_holds_besides_the_states_is_asked_for() -> None:
    x = np.zeros((8, 1))
    u = np.linspace(-0.3, 0.3, 7)[:, None]
    (episode,) = as_episodes(loaded(), [(x, u)], [0.5], [[7.0, 8.5]])
    known = np.column_stack([x, np.full(8, 0.5), np.tile([0.0, 0.5], (8, 1)), np.r_[0.0, u[:, 0]]])
    np.testing.assert_array_equal(episode.thetas, known)
    with pytest.raises(ValueError, match=r"theta holds 2 disturbances: pass disturbances=, shape"):
        as_episodes(loaded(), [(x, u)], [0.5])
    with pytest.raises(ValueError, match="theta holds 1 references"):
        as_episodes(loaded(), [(x, u)], disturbances=[[7.0, 8.0]])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"references": [np.zeros((7, 1))]}, r"episode 0 have shape \(7, 1\), expected \(8, 1\)"),
        ({"disturbances": [np.zeros(8)]}, r"episode 0 have shape \(1, 8\), expected \(8, 2\)"),
        ({"disturbances": [np.full((8, 2), np.nan)]}, "entries that are no finite numbers"),
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
    with pytest.raises(ValueError, match="states have 3 columns, the problem 1 states, and theta"):
        as_episodes(loaded(), [(np.zeros((8, 3)), np.zeros((7, 1)))])


def test_a_copy_is_left_out_and_what_differs_in_its_inputs_alone_is_not() -> None:
    given = as_episodes(problem(), [(X, U), (X, 2 * U), (X, U), (X + 1, U), (X, U)])
    kept, notes = without_copies(given)
    assert [each is other for each, other in zip(kept, (given[4], given[1], given[3]), strict=True)]
    assert len(kept) == 3 and notes == ("Left out 2 copies of other episodes.",)
    assert without_copies(kept) == (kept, ())
