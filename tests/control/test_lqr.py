"""The discounted linear-quadratic formulas satisfy the equations they stand for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

from sample_problems import DOUBLE_INTEGRATOR, input_bounds_only
from sb3_yann import LinearModel
from sb3_yann.control import lqr
from sb3_yann_envs import problems

GAMMAS = [0.9, 0.99, 1 - 1e-3]
TWO_BY_TWO = LinearModel([[1.1, 0.3], [-0.2, 0.8]], [[1, 0.2], [0.1, 0.7]], 1.0)
Q, R = np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([[1.0, 0.2], [0.2, 0.5]])
MPCS = {
    "pendulum": problems.clipped_pendulum,
    "reactor": problems.cstr,
    "two inputs": lambda: input_bounds_only(TWO_BY_TWO, Q=Q, R=R),
}


@pytest.mark.parametrize("gamma", [*GAMMAS, 1.0])
def test_riccati_solution_satisfies_the_discounted_equation(gamma: float) -> None:
    A, B = TWO_BY_TWO.A, TWO_BY_TWO.B
    P = lqr.riccati(TWO_BY_TWO, Q, R, gamma)
    inner = np.linalg.inv(R + gamma * B.T @ P @ B)
    right = Q + gamma * A.T @ P @ A - gamma**2 * A.T @ P @ B @ inner @ B.T @ P @ A
    np.testing.assert_allclose(P, right, atol=1e-12)


@pytest.mark.parametrize("gamma", [*GAMMAS, 1.0])
def test_gain_minimizes_cost_plus_discounted_value(gamma: float) -> None:
    P = lqr.riccati(TWO_BY_TWO, Q, R, gamma)
    x = np.array([0.7, -1.3])

    def cost(u: np.ndarray) -> float:
        after = TWO_BY_TWO.step(x, u)
        return float(u @ R @ u + gamma * after @ P @ after)

    best = optimize.minimize(cost, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-9})
    np.testing.assert_allclose(-lqr.gain(TWO_BY_TWO, R, P, gamma) @ x, best.x, atol=1e-6)


def test_golden_ratio_is_the_riccati_solution_of_the_unit_integrator() -> None:
    # x+ = x + u, Q = R = 1: P = 1 + P - P^2 / (1 + P), so P^2 = 1 + P.
    P = lqr.riccati(LinearModel([[1]], [[1]], 1.0), np.eye(1), np.eye(1))
    assert P[0, 0] == pytest.approx((1 + np.sqrt(5)) / 2, rel=1e-14)


@pytest.mark.parametrize("gamma", GAMMAS)
def test_policy_value_is_the_simulated_discounted_sum(gamma: float) -> None:
    K = np.array([[0.6, 0.1], [0.0, 0.4]])  # stabilizing, and optimal for no weights in use
    x = np.array([1.0, -2.0])
    P, total, state = lqr.policy_value(TWO_BY_TWO, Q, R, K, gamma), 0.0, x
    for k in range(2000):
        u = -K @ state
        total += gamma**k * float(state @ Q @ state + u @ R @ u)
        state = TWO_BY_TWO.step(state, u)
    assert x @ P @ x == pytest.approx(total, rel=1e-12)


@pytest.mark.parametrize("gamma", GAMMAS)
def test_policy_value_of_the_optimal_gain_is_the_riccati_solution(gamma: float) -> None:
    P = lqr.riccati(TWO_BY_TWO, Q, R, gamma)
    K = lqr.gain(TWO_BY_TWO, R, P, gamma)
    np.testing.assert_allclose(lqr.policy_value(TWO_BY_TWO, Q, R, K, gamma), P, rtol=1e-12)


def test_a_law_that_does_not_stabilize_has_no_value() -> None:
    with pytest.raises(ValueError, match=r"infinite cost: the spectral radius .* below 1"):
        lqr.policy_value(DOUBLE_INTEGRATOR, np.eye(2), np.eye(1), np.zeros((1, 2)), 1.0)


@pytest.mark.parametrize("gamma", GAMMAS)
@pytest.mark.parametrize("name", MPCS)
def test_with_equal_discounts_the_law_maximizes_its_own_critic(name: str, gamma: float) -> None:
    mpc = replace(MPCS[name](), gamma=gamma, terminal=None)
    M, n = mpc.state_action_matrix(gamma), mpc.n_theta
    law = mpc.explicit()
    gain = law.gains[law.locate(np.zeros(n))]
    np.testing.assert_allclose(-np.linalg.solve(M[n:, n:], M[n:, :n]), gain, rtol=1e-9, atol=1e-12)


@pytest.mark.filterwarnings("ignore:u_min")  # it says so
def test_state_action_matrix_needs_a_law_that_rests_at_the_origin() -> None:
    mpc = input_bounds_only(LinearModel([[0.9]], [[1]], 1.0), u_min=0.2)
    with pytest.raises(
        ValueError, match="does not rest at the operating point: x_ss and u_ss must keep all bounds"
    ):
        mpc.state_action_matrix(0.9)


def test_state_action_matrix_does_not_depend_on_the_units_of_the_input() -> None:
    # Bounds about 0 that are not symmetric leave a rounding offset of the size of the unit.
    unit = 1e9
    model = LinearModel(DOUBLE_INTEGRATOR.A, DOUBLE_INTEGRATOR.B / unit, 1.0)
    mpc = input_bounds_only(
        model, R=[[1 / unit**2]], u_min=-0.3 * unit, u_max=unit, theta_min=-1, theta_max=7
    )
    scale = np.array([1, 1, unit])
    plain = input_bounds_only(u_min=-0.3, u_max=1, theta_min=-1, theta_max=7)
    np.testing.assert_allclose(
        mpc.state_action_matrix(0.9) * np.outer(scale, scale),
        plain.state_action_matrix(0.9),
        rtol=1e-9,
    )


def test_riccati_solution_does_not_depend_on_the_units_of_the_states() -> None:
    units = np.array([1e-9, 1e7])
    model = LinearModel(
        np.diag(units) @ DOUBLE_INTEGRATOR.A @ np.diag(1 / units),
        np.diag(units) @ DOUBLE_INTEGRATOR.B,
        1.0,
    )
    P = lqr.riccati(model, np.diag(units**-2.0), np.eye(1))
    expected = lqr.riccati(DOUBLE_INTEGRATOR, np.eye(2), np.eye(1))
    np.testing.assert_allclose(P * np.outer(units, units), expected, rtol=1e-9)
