"""The discounted linear-quadratic formulas satisfy the equations they stand for."""

from dataclasses import replace

import numpy as np
import pytest

from sample_problems import DOUBLE_INTEGRATOR, input_bounds_only
from sb3_yann import LinearModel
from sb3_yann.control import lqr
from sb3_yann_envs import problems

GAMMAS = [0.9, 0.99, 1 - 1e-3]
TWO_BY_TWO = LinearModel([[1.1, 0.3], [-0.2, 0.8]], [[1, 0.2], [0.1, 0.7]], 1.0)
Q = np.array([[2.0, 0.3], [0.3, 1.0]])
R = np.array([[1.0, 0.2], [0.2, 0.5]])
MPCS = {
    "pendulum": problems.clipped_pendulum,
    "reactor": problems.cstr,
    "two inputs": lambda: input_bounds_only(TWO_BY_TWO, Q=Q, R=R),
}


@pytest.mark.parametrize("gamma", [*GAMMAS, 1.0])
def test_riccati_solution_satisfies_the_discounted_equation(gamma: float) -> None:
    A = TWO_BY_TWO.A
    B = TWO_BY_TWO.B
    P = lqr.riccati(TWO_BY_TWO, Q, R, gamma)
    inner = np.linalg.inv(R + gamma * B.T @ P @ B)
    right = Q + gamma * A.T @ P @ A - gamma**2 * A.T @ P @ B @ inner @ B.T @ P @ A
    np.testing.assert_allclose(P, right, atol=1e-12)


@pytest.mark.parametrize("gamma", GAMMAS)
def test_policy_value_is_the_simulated_discounted_sum(gamma: float) -> None:
    K = np.array([[0.6, 0.1], [0.0, 0.4]])  # stabilizing, and optimal for no weights in use
    x = np.array([1.0, -2.0])
    P = lqr.policy_value(TWO_BY_TWO, Q, R, K, gamma)
    total = 0.0
    state = x
    for k in range(2000):
        u = -K @ state
        total += gamma**k * float(state @ Q @ state + u @ R @ u)
        state = TWO_BY_TWO.step(state, u)
    assert x @ P @ x == pytest.approx(total, rel=1e-12)


def test_a_law_that_does_not_stabilize_has_no_value() -> None:
    with pytest.raises(ValueError, match=r"infinite cost: the spectral radius .* below 1"):
        lqr.policy_value(DOUBLE_INTEGRATOR, np.eye(2), np.eye(1), np.zeros((1, 2)), 1.0)


@pytest.mark.parametrize("gamma", GAMMAS)
@pytest.mark.parametrize("name", MPCS)
def test_with_equal_discounts_the_law_maximizes_its_own_critic(name: str, gamma: float) -> None:
    mpc = replace(MPCS[name](), gamma=gamma, terminal=None)
    M = mpc.state_action_terms(gamma).P
    n = mpc.n_theta
    law = mpc.explicit()
    gain = law.gains[law.locate(np.zeros(n))]
    np.testing.assert_allclose(-np.linalg.solve(M[n:, n:], M[n:, :n]), gain, rtol=1e-9, atol=1e-12)


@pytest.mark.filterwarnings("ignore:u_min")  # it says so
def test_state_action_terms_need_a_law_that_rests_at_the_origin() -> None:
    mpc = input_bounds_only(LinearModel([[0.9]], [[1]], 1.0), u_min=0.2)
    with pytest.raises(ValueError, match="does not rest at the operating point: x_ss and u_ss"):
        mpc.state_action_terms(0.9)
