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
    """``z = T theta`` and ``v = u - U theta``, with ``z+ = A z + B v`` and a quadratic stage cost.

    z is ``x - x_s``, followed by ``u_prev - u_s`` where the rate of the input has a weight. The
    reference and the disturbance are constant, so they are modes on the unit circle of
    ``theta+ = A_bar theta + B_bar u``: no Lyapunov or Riccati equation has a solution there without
    a discount. In z they are gone.

    Attributes
    ----------
    model : LinearModel
        Of z and v.
    T : ndarray, shape (n_z, n_theta)
    U : ndarray, shape (m, n_theta)
        ``u_s = U theta``.
    Q : ndarray, shape (n_z, n_z)
    R : ndarray, shape (m, m)
    cross : ndarray, shape (n_z, m), or None
        The stage cost is ``z'Qz + 2 z' cross v + v'Rv``.
    """

    model: LinearModel
    T: Array
    U: Array
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
        m = len(self.R)
        to_error = np.block([[self.T, np.zeros((len(self.T), m))], [-self.U, np.eye(m)]])
        return np.asarray(to_error.T @ weight @ to_error)


def error_system(
    model: LinearModel, parameters: ThetaLayout, steady: SteadyStates, Q: Array, R: Array, S: Array
) -> ErrorSystem:
    """Return the coordinates of a problem with weights Q (n, n), R (m, m) and S (m, m).

    The stage cost is ``(x - x_s)'Q(x - x_s) + (u - u_s)'R(u - u_s) + (u - u_prev)'S(u - u_prev)``.
    """
    n, m = model.B.shape
    T, U = np.zeros((n, parameters.size)), np.zeros((m, parameters.size))
    T[:, parameters.state] = np.eye(n)
    T[:, parameters.constant] = -steady.x
    U[:, parameters.constant] = steady.u
    if not np.any(S):
        plain = LinearModel(model.A, model.B, model.dt)
        return ErrorSystem(plain, T, U, Q, R, None)
    # v_prev+ = v, and (v - v_prev)'S(v - v_prev) couples the two
    previous = -U
    previous[:, parameters.previous] = np.eye(m)
    return ErrorSystem(
        model=LinearModel(
            linalg.block_diag(model.A, np.zeros((m, m))),
            np.vstack([model.B, np.eye(m)]),
            model.dt,
        ),
        T=np.vstack([T, previous]),
        U=U,
        Q=linalg.block_diag(Q, S),
        R=R + S,
        cross=np.vstack([np.zeros((n, m)), -S]),
    )
