"""Compiled dual active-set method for the condensed program.

The program comes in its dual form. With the unconstrained optimum eliminated, the slacks of its
constraints are ``s = d(theta) + gram lam``, where the multipliers ``lam >= 0`` must be zero where s
is not, and ``s >= 0``. Constraints are in units in which the diagonal of ``gram`` is 1.
"""

from __future__ import annotations

import numpy as np

from sb3_yann._numba import Integers, compiled
from sb3_yann._validation import Array

INFEASIBLE, SOLVED, UNKNOWN = 0, 1, 2
"""What comes of a point. What is UNKNOWN has no certificate, and another solver is asked."""

PRIMAL = 1e-10  # relative to 1 + |d|: so far beyond a constraint is on it
CERTAIN = 1e-9  # the same, for what counts as an answer
DUAL = 1e-9  # relative to 1 + the largest multiplier
DEPENDENT = 1e-11  # a constraint whose part beyond the span of others is shorter depends on them


@compiled()
def _factorize(
    gram: Array, extra: Array, active: Integers, first: int, size: int, factor: Array
) -> bool:
    """Write rows first to size of the Cholesky factor of ``gram + diag(extra)`` of a set."""
    for i in range(first, size):
        for j in range(i + 1):
            total = gram[active[i], active[j]]
            if i == j:
                total += extra[active[i]]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            elif total > 0:
                factor[i, i] = np.sqrt(total)
            else:
                return False
    return True


@compiled()
def _backward(factor: Array, size: int, solution: Array) -> None:
    """Solve with the transposed factor, in place."""
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            solution[i] -= factor[k, i] * solution[k]
        solution[i] /= factor[i, i]


@compiled()
def _forward(factor: Array, size: int, solution: Array) -> None:
    """Solve with the factor, in place."""
    for i in range(size):
        for k in range(i):
            solution[i] -= factor[i, k] * solution[k]
        solution[i] /= factor[i, i]


@compiled()
def _slacks(d: Array, gram: Array, active: Integers, lam: Array, size: int, slack: Array) -> None:
    """Write the slacks; those of the active set are 0."""
    for j in range(len(d)):
        slack[j] = d[j]
    for i in range(size):
        row, own = active[i], lam[i]
        for j in range(len(d)):
            slack[j] += own * gram[row, j]
    for i in range(size):
        slack[active[i]] = 0.0


@compiled()
def _most_violated(d: Array, slack: Array) -> int:
    """Return the constraint that is violated most, -1 if none is."""
    worst, lowest = -1, 0.0
    for j in range(len(d)):
        if slack[j] < lowest and slack[j] < -PRIMAL * (1 + abs(d[j])):
            worst, lowest = j, slack[j]
    return worst


@compiled()
def _add(
    gram: Array,
    extra: Array,
    entering: int,
    violation: float,
    active: Integers,
    lam: Array,
    size: int,
    factor: Array,
    step: Array,
    column: Array,
) -> int:
    """Take a constraint into the active set, others out; return its size, -1 if infeasible.

    This is the step of Goldfarb & Idnani (Math. Programming 27, 1983), Section 3.
    """
    own = 0.0
    while True:
        for i in range(size):
            step[i] = gram[entering, active[i]]
        _forward(factor, size, step)
        rest = 1.0 + extra[entering]
        for i in range(size):
            rest -= step[i] * step[i]
        for i in range(size):
            column[i] = step[i]
        _backward(factor, size, step)
        most, leaving = np.inf, -1
        for i in range(size):
            if step[i] > 0 and lam[i] < most * step[i]:
                most, leaving = lam[i] / step[i], i
        full = violation / rest if rest > DEPENDENT else np.inf
        length = min(most, full)
        if length == np.inf or (size == len(factor) and full <= most):
            return -1 if length == np.inf else -2
        for i in range(size):
            lam[i] = max(lam[i] - length * step[i], 0.0)
        own += length
        if full <= most:
            for i in range(size):
                factor[size, i] = column[i]
            factor[size, size] = np.sqrt(rest)
            active[size], lam[size] = entering, own
            return size + 1
        if rest > DEPENDENT:
            violation -= length * rest
        for i in range(leaving, size - 1):
            active[i], lam[i] = active[i + 1], lam[i + 1]
        size -= 1
        if not _factorize(gram, extra, active, leaving, size, factor):
            return -2


@compiled()
def _certified(
    d: Array,
    gram: Array,
    extra: Array,
    active: Integers,
    lam: Array,
    size: int,
    factor: Array,
    slack: Array,
) -> bool:
    """Solve anew for an active set in ascending order, and tell whether it is optimal.

    What is written then depends on the set alone, not on the way there.
    """
    for i in range(1, size):
        own, k = active[i], i
        while k > 0 and active[k - 1] > own:
            active[k] = active[k - 1]
            k -= 1
        active[k] = own
    if not _factorize(gram, extra, active, 0, size, factor):
        return False
    for i in range(size):
        lam[i] = -d[active[i]]
    _forward(factor, size, lam)
    _backward(factor, size, lam)
    largest = 0.0
    for i in range(size):
        largest = max(largest, abs(lam[i]))
    for i in range(size):
        if not lam[i] >= -DUAL * (1 + largest):
            return False
        lam[i] = max(lam[i], 0.0)
    for i in range(size):  # near the border of the domain a factor may be all rounding
        row = active[i]
        rest = d[row] + extra[row] * lam[i]
        for k in range(size):
            rest += gram[row, active[k]] * lam[k]
        if not abs(rest) <= CERTAIN * (1 + abs(d[row])):
            return False
    _slacks(d, gram, active, lam, size, slack)
    for j in range(len(d)):
        if not slack[j] >= -CERTAIN * (1 + abs(d[j])):
            return False
    return True


@compiled(
    "void(float64[:, ::1], float64[:, ::1], float64[::1], float64[:, ::1], float64[::1], int64, "
    "float64[:, ::1], int64[:, ::1], int64[::1], int64[::1])"
)
def solve_batch(
    theta: Array,
    D: Array,
    d0: Array,
    gram: Array,
    extra: Array,
    most: int,
    multipliers: Array,
    active: Integers,
    sizes: Integers,
    status: Integers,
) -> None:
    """Solve the program at the rows of theta (batch, n), each from no active constraint.

    Parameters
    ----------
    theta, D, d0, gram, extra : ndarray
        ``d = d0 + theta D`` with D (n, rows); gram (rows, rows); extra (rows,) is what softens a
        constraint.
    most : int
        The largest active set, that of the linearly independent constraints.
    multipliers, active, sizes, status : ndarray
        What is written: (batch, most), (batch, most), (batch,), (batch,).
    """
    rows = len(d0)
    factor, step, column = np.empty((most, most)), np.empty(most), np.empty(most)
    d, slack = np.empty(rows), np.empty(rows)
    for at in range(len(theta)):
        for j in range(rows):
            d[j] = d0[j]
        for i in range(theta.shape[1]):
            own = theta[at, i]
            for j in range(rows):
                d[j] += own * D[i, j]
        for j in range(rows):
            slack[j] = d[j]
        size, status[at], own_set, lam = 0, UNKNOWN, active[at], multipliers[at]
        for _ in range(10 * (rows + 10)):
            entering = _most_violated(d, slack)
            if entering < 0:
                if _certified(d, gram, extra, own_set, lam, size, factor, slack):
                    status[at] = SOLVED
                break
            found = _add(
                gram, extra, entering, -slack[entering], own_set, lam, size, factor, step, column
            )
            if found < 0:
                status[at] = INFEASIBLE if found == -1 else UNKNOWN
                break
            size = found
            _slacks(d, gram, own_set, lam, size, slack)
        sizes[at] = size


@compiled(
    "void(float64[:, ::1], float64[:, ::1], float64[::1], float64[:, ::1], float64[:, ::1], "
    "int64[:, ::1], int64[::1], float64[:, ::1], float64[:, ::1])"
)
def inputs_of_batch(
    theta: Array,
    K: Array,
    k0: Array,
    E: Array,
    multipliers: Array,
    active: Integers,
    sizes: Integers,
    bounds: Array,
    u: Array,
) -> None:
    """Write ``u = k0 + K theta - E lam`` (batch, m), clipped to bounds (2, m).

    K is (m, n), E (rows, m). Sums that overflow, far from everything, are 0 before.
    """
    for at in range(len(theta)):
        for k in range(len(k0)):
            total = k0[k]
            for i in range(theta.shape[1]):
                total += K[k, i] * theta[at, i]
            for i in range(sizes[at]):
                total -= E[active[at, i], k] * multipliers[at, i]
            total = total if np.isfinite(total) else 0.0
            u[at, k] = min(max(total, bounds[0, k]), bounds[1, k])
