"""The value of a problem's law near where it rests, which a critic starts from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import linalg

from sb3_yann._validation import Array
from sb3_yann.control import lqr
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc.choice import Law
from sb3_yann.control.mpc.problem import MPCProblem

REST_STEPS = 100_000
"""After so many a law that does not rest is given up."""


class Value(NamedTuple):
    """``theta' P theta + slope' theta + constant``, of theta in deviations."""

    P: Array
    slope: Array
    constant: float

    def at(self, theta: Array) -> Array:
        """Return it at theta (..., n_theta)."""
        return np.asarray(np.sum((theta @ self.P + self.slope) * theta, axis=-1) + self.constant)

    @property
    def form(self) -> Array:
        """The matrix of the same as a form of ``[theta; 1]``."""
        half = self.slope[:, None] / 2
        return np.block([[self.P, half], [half.T, np.full((1, 1), self.constant)]])


def value(problem: MPCProblem, law: Law, gamma: float) -> Value:
    """Return what :meth:`LinearMPC.value_terms` does; without a price it is solved for in z."""
    if problem.price.counts:
        return _priced_value(problem, law, gamma)
    errors, K = problem.error_system, gain_at_rest(problem, law)
    P = lqr.policy_value(errors.model, errors.Q, errors.R, K, gamma, errors.cross)
    P = np.asarray(errors.to_error.T @ P @ errors.to_error)
    return Value(P, np.zeros(len(P)), 0.0)


def state_action_value(problem: MPCProblem, law: Law, gamma: float) -> Value:
    """Return the same of ``[theta; u]``: the cost of u now, the law ever after."""
    after, AB = value(problem, law, gamma), np.hstack(problem.prediction)
    return Value(
        np.asarray(problem.stage_matrix + gamma * AB.T @ after.P @ AB),
        problem.stage_slope + gamma * AB.T @ after.slope,
        problem.price.constant + gamma * after.constant,
    )


def _priced_value(problem: MPCProblem, law: Law, gamma: float) -> Value:
    """Return the value of the affine law at the point where the model rests under it.

    That point is reached from the operating point, with r and d at zero.
    """
    if gamma >= 1:
        raise ValueError(
            "With a price the law pays at rest too: its cost for good is infinite without a "
            "discount. Pass a gamma below 1."
        )
    A, B = problem.prediction
    theta = problem.theta_rest
    for _ in range(REST_STEPS):
        u = law(theta)
        before, theta = theta, A @ theta + B @ u
        if np.all(np.abs(theta - before) <= 1e-13 * problem.theta_half):
            break
    else:
        raise ValueError(
            f"The law comes to no rest in {REST_STEPS} steps from the operating point, so that "
            "no quadratic form is its value there. Lengthen the horizon, or give states and "
            "inputs weights."
        )
    K = law.gain(theta)
    held = law(theta) - K @ theta
    # On [theta; 1]: a price is a quadratic form of it.
    n, one = problem.n_theta, np.ones((1, 1))
    stage = Value(problem.stage_matrix, problem.stage_slope, problem.price.constant).form
    play = np.block([[np.eye(n), np.zeros((n, 1))], [K, held[:, None]], [np.zeros((1, n)), one]])
    closed = linalg.block_diag(A + B @ K, one)
    closed[:n, n] = B @ held
    own = play.T @ stage @ play
    still = np.zeros((n + 1, 1))
    model = LinearModel(closed, still, problem.model.dt)
    P = lqr.policy_value(model, own, one, still.T, gamma)
    return Value(P[:n, :n], 2 * P[:n, n], float(P[n, n]))


def gain_at_rest(problem: MPCProblem, law: Law) -> Array:
    """Return K (m, n_z) with ``v = -K z`` near rest.

    Raises
    ------
    ValueError
        If the law does not rest there, or, near it, at the steady states of r and d.
    """
    errors = problem.error_system
    rest, unit = problem.theta_rest, 2 * problem.u_half
    if not law.in_domain(rest) or np.any(np.abs(law(rest)) > 1e-9 * unit):
        raise ValueError(
            "The law does not rest at the origin: theta = 0 must be feasible with u = 0. "
            "Choose an operating point inside the bounds, and boxes of parameters that hold 0."
        )
    gains = law.gain(rest)
    K = -gains @ errors.to_theta
    box = np.maximum(np.abs(problem.theta_min), np.abs(problem.theta_max))
    if np.any(np.abs(gains - (errors.to_input - K @ errors.to_error)) @ box > 1e-6 * unit):
        raise ValueError(
            "The law does not rest at the steady states near theta = 0: a constraint acts there. "
            "Choose an operating point inside the bounds."
        )
    return K
