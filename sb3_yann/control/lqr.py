"""Discounted linear-quadratic control: value, gain, and the state-action value matrix.

Costs are ``sum_k gamma^k (x' Q x + 2 x' N u + u' R u)``. With ``sqrt(gamma) A`` and
``sqrt(gamma) B`` in place of A and B, the undiscounted equations hold.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from sb3_yann._validation import Array
from sb3_yann.control.linear_system import LinearSystem


def riccati(
    model: LinearSystem, Q: Array, R: Array, gamma: float = 1.0, cross: Array | None = None
) -> Array:
    """Return P (n, n) with ``x' P x`` the smallest discounted cost from x, without constraints.

    It solves ``P = Q + g A'PA - (g A'PB + N) (R + g B'PB)^-1 (g B'PA + N')`` for ``g = gamma`` in
    (0, 1] and the weights Q (n, n), R (m, m) and N (n, m), ``cross``. A model without a stabilizing
    solution raises ValueError with the reason.
    """
    A = np.sqrt(gamma) * model.A
    B = np.sqrt(gamma) * model.B
    # Inputs that cost their moves alone may rest anywhere: no more than rounding holds them.
    # Where there is no solution, all inputs are given 1e-12 of the largest weight.
    for nudge in (0.0, 1e-12):
        weight = R + nudge * np.max(np.abs(R)) * np.eye(len(R))
        try:
            with np.errstate(all="ignore"):
                P = linalg.solve_discrete_are(A, B, Q, weight, s=cross)
            radius = spectral_radius(A - B @ gain(model, weight, P, gamma, cross))
        except (np.linalg.LinAlgError, ValueError):
            radius = np.inf
        # SciPy also returns matrices that do not stabilize a mode on the unit circle.
        if radius < 1 - 1e-9:
            break
    else:
        raise ValueError(_why_no_solution(A, B))
    return np.asarray((P + P.T) / 2)


def gain(
    model: LinearSystem, R: Array, P: Array, gamma: float = 1.0, cross: Array | None = None
) -> Array:
    """Return K (m, n): ``u = -K x`` minimizes ``2x'Nu + u'Ru + gamma (Ax + Bu)' P (Ax + Bu)``.

    R (m, m) weighs the input, P (n, n) the state after one step, and N (n, m) is ``cross``.
    """
    PB = P @ model.B
    factor = linalg.cho_factor(R + gamma * model.B.T @ PB)
    slope = gamma * PB.T @ model.A
    return np.asarray(linalg.cho_solve(factor, slope if cross is None else slope + cross.T))


def policy_value(
    model: LinearSystem, Q: Array, R: Array, K: Array, gamma: float, cross: Array | None = None
) -> Array:
    """Return P (n, n) with ``x' P x`` the discounted cost of the law ``u = -K x``, for any K.

    It solves ``P = Q - NK - K'N' + K'RK + gamma (A - BK)' P (A - BK)``, a Lyapunov equation, with
    N ``cross``. Only this P makes the value ``x'Qx + u'Ru + gamma (Ax + Bu)' P (Ax + Bu)`` of
    Braniff & Tian, Section 4.2, satisfy Bellman's equation along the law; theirs, without a
    discount, does for gamma = 1. An unstable discounted closed loop, of infinite cost, raises
    ValueError.
    """
    closed = np.sqrt(gamma) * (model.A - model.B @ K)
    radius = spectral_radius(closed)
    if radius >= 1:
        raise ValueError(
            f"The law u = -K x, K = {K.tolist()}, has infinite cost: the spectral radius of "
            f"sqrt(gamma) (A - BK) is {radius:.6g}, it must be below 1. Lengthen the horizon, use "
            "the default terminal cost, or a smaller gamma."
        )
    stage = Q + K.T @ R @ K
    if cross is not None:
        stage = stage - cross @ K - K.T @ cross.T
    # In units in which the states are of like size: else the equation is singular to rounding.
    closed, (unit, _) = linalg.matrix_balance(closed, permute=False, separate=True)
    P = linalg.solve_discrete_lyapunov(closed.T, stage * np.outer(unit, unit))
    return np.asarray((P + P.T) / 2 / np.outer(unit, unit))


def spectral_radius(matrix: Array) -> float:
    """Return the largest modulus of an eigenvalue of a square matrix."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix))))


def long_horizon(A: Array, horizon: int) -> str:
    """Return in words what loses digits: a horizon and the fastest pole."""
    poles = np.linalg.eigvals(A)
    pole = np.real_if_close(poles[np.argmax(np.abs(poles))])
    return f"With horizon = {horizon} and the pole {pole:.6g} of the model"


def unreached(A: Array, B: Array) -> complex | None:
    """Return a pole that does not decay and that no input reaches (Hautus' test), None for none."""
    for pole in np.linalg.eigvals(A):
        hautus = np.hstack([pole * np.eye(len(A)) - A, B])
        smallest = np.linalg.svd(hautus, compute_uv=False)[-1]
        if abs(pole) > 1 - 1e-9 and smallest < 1e-10 * max(1.0, np.abs(hautus).max()):
            return complex(pole)
    return None


def _why_no_solution(A: Array, B: Array) -> str:
    """Return which condition of the Riccati equation fails."""
    fastest = np.abs(np.linalg.eigvals(A)).max()
    # 1e6: times that a mode may grow in a sample: its feedback cancels all but ten digits
    if fastest > 1e6:
        return (
            f"The model grows {fastest:.2g} times in a sample, and float64 holds no feedback for "
            "that. Is dt in the unit of the model's time? Else sample faster."
        )
    pole = unreached(A, B)
    if pole is not None:
        return (
            "The model has an unstable mode that no input reaches: eigenvalue "
            f"{np.real_if_close(pole):.6g} of "
            "sqrt(gamma) A. Remove the mode from the model, add an input, lower gamma, or take "
            "another steady state: model.report() names those that were found."
        )
    # 1e-3: distance from the unit circle at which rounding may put the poles of a chain of
    # integrators.
    if np.any(np.abs(np.abs(np.linalg.eigvals(A)) - 1) < 1e-3):
        return (
            "The Riccati equation has no stabilizing solution: a mode on the unit circle carries "
            "no weight in Q. Give it a positive weight, use gamma < 1, or pass a Terminal(cost)."
        )
    sizes = np.abs(np.hstack([A, B]))
    return (
        "Rounding leaves no stabilizing solution of the Riccati equation. Either an input costs "
        "its moves alone: give it a weight in R, or take gamma < 1. Or the model is badly scaled, "
        f"with entries of A and B from {sizes[sizes > 0].min():.2g} to {sizes.max():.2g} in size: "
        "give states and inputs units in which they move alike."
    )
