"""Steady states that a reference and a disturbance ask for, as a linear map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sb3_yann._validation import Array, ReadOnlyArrays
from sb3_yann.control.model.linear_model import LinearModel


@dataclass(frozen=True, eq=False)
class SteadyStates(ReadOnlyArrays):
    """``x_s = x [r; d]`` and ``u_s = u [r; d]``, of shapes (n, p + d) and (m, p + d)."""

    x: Array
    u: Array


def steady_states(
    model: LinearModel, C: Array, Q: Array, R: Array, x_unit: Array, u_unit: Array
) -> SteadyStates:
    """Return the map from reference and disturbance to the steady state with ``C x_s = r``.

    It solves ``(A - I) x_s + B u_s = -E d`` and ``C x_s = r``. Of several solutions it is the one
    with the smallest ``x_s'Q x_s + u_s'R u_s``, then that of minimum norm in the units given
    (Rawlings, Mayne & Diehl, Model Predictive Control, Section 1.5).

    Parameters
    ----------
    model : LinearModel
        With its E, if it has disturbances.
    C : ndarray, shape (p, n)
        The tracked outputs; p = 0 for none.
    Q, R : ndarray, shapes (n, n) and (m, m)
        The weights that choose among several solutions.
    x_unit, u_unit : ndarray, shapes (n,) and (m,)
        Typical sizes, which make ranks and norms independent of the units of the plant.

    Raises
    ------
    ValueError
        If some reference or disturbance has no steady state, whatever the bounds.
    """
    n, m = model.B.shape
    if len(C) + model.n_disturbances == 0:
        return SteadyStates(np.zeros((n, 0)), np.zeros((m, 0)))
    unit = np.concatenate([x_unit, u_unit])
    equations = np.block([[model.A - np.eye(n), model.B], [C, np.zeros((len(C), m))]]) * unit
    row_unit = np.concatenate([x_unit, np.linalg.norm(equations[n:], axis=1)])
    row_unit[row_unit == 0] = 1.0
    equations = equations / row_unit[:, None]
    right = linalg.block_diag(np.zeros((n, 0)), np.eye(len(C)))
    right = np.hstack([right, np.vstack([-model.E, np.zeros((len(C), model.n_disturbances))])])
    right = right / row_unit[:, None]

    solution = np.linalg.pinv(equations, rcond=1e-10) @ right
    size = np.maximum(np.abs(right).max(axis=0, initial=0.0), np.finfo(float).tiny)
    missed = np.abs(equations @ solution - right).max(axis=0, initial=0.0) > 1e-8 * size
    if np.any(missed):
        raise ValueError(_why_none(model, C, missed, equations))

    free = linalg.null_space(equations, rcond=1e-10)
    weight = linalg.block_diag(Q, R) * np.outer(unit, unit)
    curvature = free.T @ weight @ free
    # What costs nothing leaves the squares of rounding, 1e-32 of the weights: no curvature.
    rounding = 1e-24 * np.abs(weight).max() / max(np.abs(curvature).max(initial=0.0), 1e-300)
    inverse = np.linalg.pinv(curvature, rcond=max(1e-12, rounding), hermitian=True)
    solution = solution - free @ inverse @ (free.T @ weight @ solution)
    solution = solution * unit[:, None]
    return SteadyStates(solution[:n], solution[n:])


def _why_none(model: LinearModel, C: Array, missed: Array, equations: Array) -> str:
    p = len(C)
    which = [f"r[{i}]" if i < p else f"d[{i - p}]" for i in np.flatnonzero(missed)]
    rank = int(np.linalg.matrix_rank(equations, tol=1e-10))
    return (
        f"There is no steady state for {', '.join(which)}: [[A - I, B], [C, 0]] has rank {rank}, "
        f"not {model.n_states + p}. Track fewer outputs, or other ones: at most as many as inputs "
        f"({model.n_inputs}) can be tracked, each moved by an input at steady state."
    )
