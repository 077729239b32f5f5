"""Dynamics of a twin step as plain loops in numpy do; residuals, and angles that jump."""

from __future__ import annotations

import numpy as np
import pytest

from general_problems import solved
from sb3_yann import LinearModel, LinearMPC
from sb3_yann.twin.dynamics import Coordinates, Dynamics, Residual
from sb3_yann.twin.log import Episode
from sb3_yann.twin.selection import fit_ensemble
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
    coordinates = Coordinates.of(mpc, log)
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
    coordinates = Coordinates.of(mpc, [log])
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


def test_a_replay_takes_inputs_set_points_and_disturbances_of_the_log_and_nothing_else() -> None:
    mpc = solved("servo with all of it")
    dynamics, log = bent(mpc)
    starts = np.array([0, 3, 7])
    given = mpc.layout.constant
    found = dynamics.replay(log, starts, 5)
    assert found.shape == (2, 3, 6, 2)
    for member in range(2):
        for i, start in enumerate(starts):
            theta = log.thetas[start].copy()
            for k in range(6):
                np.testing.assert_allclose(found[member, i, k], theta[:2], rtol=1e-10, atol=1e-12)
                if k < 5:
                    theta[given] = log.thetas[start + k, given]
                    theta = stepped(dynamics, member, theta, log.actions[start + k])


def test_in_a_closed_loop_the_logged_inputs_are_corrected_by_the_law() -> None:
    mpc = solved("servo with all of it")
    dynamics, log = bent(mpc)
    law = mpc.explicit()
    given = mpc.layout.constant
    expected = np.zeros(2)
    corrected = 0
    for member in range(2):
        theta = log.thetas[0].copy()
        for k, logged in enumerate(log.actions):
            theta[given] = log.thetas[k, given]
            wanted = logged + law(theta) - law(log.thetas[k])
            u = np.clip(wanted, mpc.u_min, mpc.u_max)
            corrected += int(np.any(u != wanted))
            expected[member] += mpc.stage_cost(theta, u)
            theta = stepped(dynamics, member, theta, u)
    assert corrected  # on a bound, at times
    np.testing.assert_allclose(dynamics.replay_in_closed_loop(log), expected, rtol=1e-9)
