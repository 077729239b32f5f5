"""The backward sweep of the planner, compiled: each start's steps and feedback, the last first."""

from __future__ import annotations

import numpy as np

from sb3_yann._numba import compiled
from sb3_yann._validation import Array, Mask


@compiled()
def _solve(H: Array, held: Mask, right: Array) -> None:
    """Write ``x`` with ``H x = right`` to right (m, r), where rows are not held: those stay.

    H (m, m) is positive definite. A row that is held counts as one of the identity.
    """
    m = len(H)
    A = H.copy()
    for i in np.flatnonzero(held):
        A[i] = 0.0
        A[:, i] = 0.0
        A[i, i] = 1.0
    for i in range(m):
        for j in range(i + 1, m):
            factor = A[j, i] / A[i, i]
            A[j] -= factor * A[i]
            right[j] -= factor * right[i]
    for i in range(m - 1, -1, -1):
        for j in range(i + 1, m):
            right[i] -= A[i, j] * right[j]
        right[i] /= A[i, i]


@compiled()
def _bounded_step(H: Array, g: Array, low: Array, high: Array, held: Mask, move: Array) -> None:
    """Write the minimizer (m,) of ``u'Hu / 2 + g'u`` in a box, for H (m, m), g (m,).

    Projected Newton steps: an input on its bound is held there while the slope presses it on.
    """
    m = len(g)
    move[:] = np.minimum(np.maximum(0.0, low), high)
    step = np.empty((m, 1))
    for _ in range(2 * m + 1):
        slope = g + H @ move
        for j in range(m):
            held[j] = (move[j] <= low[j] and slope[j] > 0) or (move[j] >= high[j] and slope[j] < 0)
            step[j, 0] = 0.0 if held[j] else slope[j]
        _solve(H, held, step)
        same = True
        for j in range(m):
            before = move[j]
            move[j] = min(max(before - step[j, 0], low[j]), high[j])
            same = same and move[j] == before
        if same:
            break


@compiled(
    "void(float64[:, :, :, ::1], float64[:, :, :], float64[:, :, :, :], float64[:, :, :, :], "
    "boolean[:, :, :, :], float64[:, :, ::1], float64[:, ::1], float64[:, :, ::1], "
    "float64[:, :, ::1], float64[:, :, :, ::1], float64[::1])"
)
def sweep(
    F: Array,
    slopes: Array,
    curved: Array,
    sides: Array,
    moving: Mask,
    damping: Array,
    v: Array,
    V: Array,
    corrections: Array,
    gains: Array,
    saved: Array,
) -> None:
    """Write corrections (T, k, m), gains (T, k, m, n), and what those should save (k,).

    Steps are linear, F (T, k, n, n + m), costs quadratic: ``slopes`` (T, k, n + m) and ``curved``
    (T, k, n + m, n + m) of a step, v (k, n) and V (k, n, n) of the end, which are overwritten.
    Corrections stay between two ``sides`` (T, 2, k, m); ``moving`` (T, 2, k, m) says which of them
    move with the previous input, theta's last entries. ``damping`` (k, m, m) is added to the
    curvature by the inputs.
    """
    steps, k, m = corrections.shape
    n = V.shape[1]
    held = np.zeros(m, np.bool_)
    for row in range(k):
        for t in range(steps - 1, -1, -1):
            Ft = F[t, row]
            q = slopes[t, row] + np.dot(v[row], Ft)
            H = curved[t, row] + np.dot(Ft.T, np.dot(V[row], Ft))
            Huu = np.ascontiguousarray(H[n:, n:])
            Hux = np.ascontiguousarray(H[n:, :n])
            damped = Huu + damping[row]
            move = corrections[t, row]
            low = sides[t, 0, row]
            high = sides[t, 1, row]
            _bounded_step(damped, q[n:], low, high, held, move)
            K = gains[t, row]
            K[:] = 0.0
            for j in range(m):
                at_low = move[j] <= low[j]
                at_high = move[j] >= high[j]
                held[j] = at_low or at_high
                if (at_low and moving[t, 0, row, j]) or (at_high and moving[t, 1, row, j]):
                    K[j, n - m + j] = 1.0
            right = -Hux - damped @ K
            for j in range(m):
                if not held[j]:
                    K[j] = right[j]
            _solve(damped, held, K)
            pulled = Huu @ move
            saved[row] -= np.sum((q[n:] + pulled / 2) * move)
            v[row] = q[:n] + np.dot(q[n:] + pulled, K) + np.dot(move, Hux)
            both = np.dot(K.T, Huu @ K + Hux) + np.dot(Hux.T, K) + H[:n, :n]
            V[row] = (both + both.T) / 2
