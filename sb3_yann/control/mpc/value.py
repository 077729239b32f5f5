"""The quadratic value of a problem's law near its steady states, which a critic starts from."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sb3_yann._validation import Array, as_discount
from sb3_yann.control import lqr

if TYPE_CHECKING:
    from sb3_yann.control.mpc.linear_mpc import LinearMPC


def value_matrix(problem: LinearMPC, gamma: float) -> Array:
    """Return P (n_theta, n_theta), see :meth:`LinearMPC.value_matrix`.

    The Lyapunov equation is solved in the error coordinates z, which exist for any discount, and
    ``z'Pz`` is mapped back by ``z = T theta``.
    """
    gamma, errors = as_discount(gamma), problem.error_system
    K = gain_at_rest(problem)
    P = lqr.policy_value(errors.model, errors.Q, errors.R, K, gamma, errors.cross)
    return np.asarray(errors.T.T @ P @ errors.T)


def state_action_matrix(problem: LinearMPC, gamma: float) -> Array:
    """Return M (n_theta + m, n_theta + m), see :meth:`LinearMPC.state_action_matrix`."""
    P = problem.value_matrix(gamma)
    AB = np.hstack(problem.prediction)
    return np.asarray(problem.stage_matrix + gamma * AB.T @ P @ AB)


def gain_at_rest(problem: LinearMPC) -> Array:
    """Return K (m, n_z) with ``v = -K z`` in the region of the law that holds the origin.

    Raises
    ------
    ValueError
        If the law does not rest at the origin, or, near it, at the steady states of r and d.
    """
    if any(np.any(part) for part in problem.linear_cost):
        raise ValueError(
            "A problem with a linear_cost has no quadratic value about the origin, so no policy "
            "can start from it. Take the state and input where its law rests as the operating "
            "point, and leave linear_cost out."
        )
    law, errors, parts = problem.explicit(), problem.error_system, problem.layout
    origin = np.zeros(problem.n_theta)
    width = problem.u_max - problem.u_min
    unit = np.where(np.isfinite(width), width, 1.0)
    if not law.in_domain(origin) or np.any(np.abs(law(origin)) > 1e-9 * unit):
        raise ValueError(
            "The law does not rest at the origin: theta = 0 must be feasible with u = 0. "
            "Choose an operating point inside the bounds, and boxes of parameters that hold 0."
        )
    gains = law.gains[law.locate(origin)]
    columns = [gains[:, parts.state]]
    if errors.cross is not None:
        columns.append(gains[:, parts.previous])
    K = -np.hstack(columns)
    box = np.maximum(np.abs(problem.theta_min), np.abs(problem.theta_max))
    if np.any(np.abs(gains - (errors.U - K @ errors.T)) @ box > 1e-6 * unit):
        raise ValueError(
            "The law does not rest at the steady states near theta = 0: a constraint acts there. "
            "Choose an operating point inside the bounds."
        )
    return K
