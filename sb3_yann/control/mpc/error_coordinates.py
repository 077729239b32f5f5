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

    z is ``x - x_s``, followed by ``u_prev - u_s`` where the rate has a weight, and by what r and d
    of a preview differ from the last of them, whose steady state x_s and u_s are. The constant r
    and d, modes on the unit circle that no Riccati equation without discount allows, are gone.

    Attributes
    ----------
    model : LinearModel
    to_error : ndarray, shape (n_z, n_theta)
    to_input : ndarray, shape (m, n_theta)
        ``u_s = to_input theta``.
    to_theta : ndarray, shape (n_theta, n_z)
        To a theta with this z, whose last r and d are zero.
    Q : ndarray, shape (n_z, n_z)
    R : ndarray, shape (m, m)
    cross : ndarray, shape (n_z, m), or None
        The stage cost is ``z'Qz + 2 z' cross v + v'Rv``.
    stage_matrix : ndarray, shape (n_theta + m, n_theta + m)
        W: it is ``[theta; u]' W [theta; u]`` too.
    """

    model: LinearModel
    to_error: Array
    to_input: Array
    to_theta: Array
    Q: Array
    R: Array
    cross: Array | None
    stage_matrix: Array


def error_system(
    model: LinearModel,
    layout: ThetaLayout,
    steady: SteadyStates,
    prediction: tuple[Array, Array],
    weights: tuple[Array, Array, Array],
) -> ErrorSystem:
    """Return the coordinates of a problem with weights Q (n, n), R (m, m) and R_du (m, m).

    The stage cost is ``e'Qe + v'Rv + (u - u_prev)'R_du(u - u_prev)``, with ``e = x - x_s`` and
    ``v = u - u_s`` of the present r and d.

    Parameters
    ----------
    model, layout, steady, prediction : LinearModel, ThetaLayout, SteadyStates, pair of ndarray
        Of the problem.
    weights : tuple of ndarray
        Q, R and R_du.
    """
    n, m = model.B.shape
    every = np.eye(layout.size)
    x, previous = every[layout.state], every[layout.previous]
    is_rated = bool(np.any(weights[2]))
    from_now = np.block([[x - steady.x @ every[layout.now], np.zeros((n, m))],
                         [-steady.u @ every[layout.now], np.eye(m)]])  # fmt: skip
    if is_rated:
        from_now = np.vstack([from_now, np.hstack([-previous, np.eye(m)])])
    weight = linalg.block_diag(*weights[: 2 + is_rated])
    W = from_now.T @ weight @ from_now

    to_input = steady.u @ every[layout.last]
    changes = np.flatnonzero(layout.next != np.arange(layout.size))
    final = layout.lift @ every[layout.settles]  # all r and d are the last ones
    to_error = [x - steady.x @ every[layout.last]]
    to_theta = [x]
    if is_rated:
        to_error.append(previous - to_input)
        to_theta.append(previous)
    to_error.append((every - final)[changes])
    to_theta.append(every[changes])
    E, T = np.vstack(to_error), np.vstack(to_theta).T
    A, B = prediction
    cross = T.T @ W[: layout.size, layout.size :]
    return ErrorSystem(
        model=LinearModel(E @ A @ T, E @ B, model.dt),
        to_error=E,
        to_input=to_input,
        to_theta=T,
        Q=T.T @ W[: layout.size, : layout.size] @ T,
        R=W[layout.size :, layout.size :],
        cross=cross if np.any(cross) else None,
        stage_matrix=W,
    )
