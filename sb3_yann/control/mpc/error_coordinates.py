"""The problem seen from its steady state: the coordinates in which its cost is quadratic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sb3_yann._validation import Array, ReadOnlyArrays
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc.steady_state import SteadyStates
from sb3_yann.control.mpc.theta_layout import ThetaLayout


@dataclass(frozen=True, eq=False)
class ErrorSystem(ReadOnlyArrays):
    """The problem in ``z = to_error theta`` and ``v = u - to_input theta``: ``z+ = A z + B v``.

    z is ``x - x_s``, followed by ``u_prev - u_s`` where the rate has a weight. The constant r and
    d, modes on the unit circle that no Riccati equation without discount allows, are gone.

    Attributes
    ----------
    model : LinearModel
    to_error : ndarray, shape (n_z, n_theta)
    to_input : ndarray, shape (m, n_theta)
        ``u_s = to_input theta``.
    Q : ndarray, shape (n_z, n_z)
    R : ndarray, shape (m, m)
    cross : ndarray, shape (n_z, m), or None
        The stage cost is ``z'Qz + 2 z' cross v + v'Rv``.
    """

    model: LinearModel
    to_error: Array
    to_input: Array
    Q: Array
    R: Array
    cross: Array | None

    @property
    def stage_matrix(self) -> Array:
        """W (n_theta + m, n_theta + m): the stage cost is ``[theta; u]' W [theta; u]``."""
        weight = linalg.block_diag(self.Q, self.R)
        if self.cross is not None:
            k = len(self.Q)
            weight[:k, k:], weight[k:, :k] = self.cross, self.cross.T
        zeros, eye = np.zeros((len(self.to_error), len(self.R))), np.eye(len(self.R))
        coordinates = np.block([[self.to_error, zeros], [-self.to_input, eye]])
        return np.asarray(coordinates.T @ weight @ coordinates)


def error_system(
    model: LinearModel, layout: ThetaLayout, steady: SteadyStates, Q: Array, R: Array, R_du: Array
) -> ErrorSystem:
    """Return the coordinates of a problem with weights Q (n, n), R (m, m) and R_du (m, m).

    The stage cost is ``e'Qe + v'Rv + (u - u_prev)'R_du(u - u_prev)``, with ``e = x - x_s`` and
    ``v = u - u_s``.

    Parameters
    ----------
    model, layout, steady, Q, R, R_du : LinearModel, ThetaLayout, SteadyStates, ndarray
        Of the problem.
    """
    n, m = model.B.shape
    to_error, to_input = np.zeros((n, layout.size)), np.zeros((m, layout.size))
    to_error[:, layout.state] = np.eye(n)
    to_error[:, layout.constant] = -steady.x
    to_input[:, layout.constant] = steady.u
    if not np.any(R_du):
        plain = LinearModel(model.A, model.B, model.dt)
        return ErrorSystem(plain, to_error, to_input, Q, R, None)
    # v_prev+ = v, and (v - v_prev)'R_du(v - v_prev) couples the two
    previous = -to_input
    previous[:, layout.previous] = np.eye(m)
    A, B = linalg.block_diag(model.A, np.zeros((m, m))), np.vstack([model.B, np.eye(m)])
    weights = linalg.block_diag(Q, R_du), R + R_du, np.vstack([np.zeros((n, m)), -R_du])
    to_z = np.vstack([to_error, previous])
    return ErrorSystem(LinearModel(A, B, model.dt), to_z, to_input, *weights)
