"""The quadratic value of a problem's law near its steady states, which a critic starts from."""

from __future__ import annotations

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import lqr
from sb3_yann.control.mpc.choice import Law
from sb3_yann.control.mpc.problem import MPCProblem


def value_matrix(problem: MPCProblem, law: Law, gamma: float) -> Array:
    """Return P (n_theta, n_theta) of :meth:`LinearMPC.value_matrix`, solved for in z."""
    errors, K = problem.error_system, gain_at_rest(problem, law)
    P = lqr.policy_value(errors.model, errors.Q, errors.R, K, gamma, errors.cross)
    return np.asarray(errors.to_error.T @ P @ errors.to_error)


def state_action_matrix(problem: MPCProblem, law: Law, gamma: float) -> Array:
    """Return M (n_theta + m, n_theta + m) of :meth:`LinearMPC.state_action_matrix`."""
    P, AB = value_matrix(problem, law, gamma), np.hstack(problem.prediction)
    return np.asarray(problem.stage_matrix + gamma * AB.T @ P @ AB)


def gain_at_rest(problem: MPCProblem, law: Law) -> Array:
    """Return K (m, n_z) with ``v = -K z`` near the origin.

    Raises
    ------
    ValueError
        If the law does not rest at the origin, or, near it, at the steady states of r and d.
    """
    errors, parts = problem.error_system, problem.layout
    origin, unit = np.zeros(problem.n_theta), 2 * problem.u_half
    if not law.in_domain(origin) or np.any(np.abs(law(origin)) > 1e-9 * unit):
        raise ValueError(
            "The law does not rest at the origin: theta = 0 must be feasible with u = 0. "
            "Choose an operating point inside the bounds, and boxes of parameters that hold 0."
        )
    gains = law.gain(origin)
    previous = slice(0, 0) if errors.cross is None else parts.previous
    K = -np.hstack([gains[:, parts.state], gains[:, previous]])
    box = np.maximum(np.abs(problem.theta_min), np.abs(problem.theta_max))
    if np.any(np.abs(gains - (errors.to_input - K @ errors.to_error)) @ box > 1e-6 * unit):
        raise ValueError(
            "The law does not rest at the steady states near theta = 0: a constraint acts there. "
            "Choose an operating point inside the bounds."
        )
    return K
