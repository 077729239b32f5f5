"""Compiled dual active-set method for the condensed program, and a table of known points.

The program comes in its dual form. With the unconstrained optimum eliminated, the slacks of its
constraints are ``s = d(theta) + gram lam``, where the multipliers ``lam >= 0`` must be zero where s
is not, and ``s >= 0``. Constraints are in units in which the diagonal of ``gram`` is 1.

DAQP's workspace, set up once and called from Python, takes 0.7 to 3.8 times as long for one point,
and 4 to 35 times for each of a batch (2 variables: 20 against 0.8 microseconds; 20 variables, 160
constraints: 67 against 10; 101 and 801: 519 against 53).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_yann._numba import Integers, compiled
from sb3_yann._validation import Array

INFEASIBLE = 0
SOLVED = 1
UNCERTIFIED = 2
"""What comes of a point. What is UNCERTIFIED has no certificate, and another solver is asked."""


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
def _solve_upper(factor: Array, size: int, solution: Array) -> None:
    """Solve with the transposed factor, in place."""
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            solution[i] -= factor[k, i] * solution[k]
        solution[i] /= factor[i, i]


@compiled()
def _solve_lower(factor: Array, size: int, solution: Array) -> None:
    """Solve with the factor, in place."""
    for i in range(size):
        for k in range(i):
            solution[i] -= factor[i, k] * solution[k]
        solution[i] /= factor[i, i]


@compiled()
def _slacks(d: Array, gram: Array, active: Integers, lam: Array, size: int, slack: Array) -> None:
    """Write the slacks; those of the active set are 0."""
    slack[:] = d
    for i in range(size):
        row = active[i]
        for j in range(len(d)):
            slack[j] += lam[i] * gram[row, j]
    for i in range(size):
        slack[active[i]] = 0.0


@compiled()
def _most_violated(d: Array, slack: Array, rounding: float) -> int:
    """Return the constraint that is violated most, -1 if none is.

    Each may be by ``rounding``; where that is 0, by 1e-10, relative to 1 + |d|.
    """
    worst = -1
    lowest = 0.0
    for j in range(len(d)):
        room = rounding if rounding > 0 else 1e-10 * (1 + abs(d[j]))
        if slack[j] < lowest and slack[j] < -room:
            worst = j
            lowest = slack[j]
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

    This is the step of Goldfarb & Idnani (Math. Programming 27, 1983), Section 3. -2 is a failure.
    """
    # A constraint whose part beyond the span of others is smaller depends on them.
    dependence_tol = 1e-11
    own = 0.0
    while True:
        for i in range(size):
            step[i] = gram[entering, active[i]]
        _solve_lower(factor, size, step)
        rest = 1.0 + extra[entering]
        for i in range(size):
            rest -= step[i] * step[i]
        column[:size] = step[:size]
        _solve_upper(factor, size, step)
        most = np.inf
        leaving = -1
        for i in range(size):
            if step[i] > 0 and lam[i] < most * step[i]:
                most = lam[i] / step[i]
                leaving = i
        full = violation / rest if rest > dependence_tol else np.inf
        length = min(most, full)
        if length == np.inf:
            return -1
        if size == len(factor) and full <= most:
            return -2
        for i in range(size):
            lam[i] = max(lam[i] - length * step[i], 0.0)
        own += length
        if full <= most:
            factor[size, :size] = column[:size]
            factor[size, size] = np.sqrt(rest)
            active[size] = entering
            lam[size] = own
            return size + 1
        if rest > dependence_tol:
            violation -= length * rest
        for i in range(leaving, size - 1):
            active[i] = active[i + 1]
            lam[i] = lam[i + 1]
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
    tolerance: float,
    least: float,
) -> bool:
    """Solve anew for an active set in ascending order, and tell whether it is optimal.

    What is written then depends on the set alone, not on the way there. Slacks may be off by
    ``tolerance (1 + |d|)``, with ``least`` for |d| where that is above zero.
    """
    for i in range(1, size):
        own = active[i]
        k = i
        while k > 0 and active[k - 1] > own:
            active[k] = active[k - 1]
            k -= 1
        active[k] = own
    if not _factorize(gram, extra, active, 0, size, factor):
        return False
    for i in range(size):
        lam[i] = -d[active[i]]
    _solve_lower(factor, size, lam)
    _solve_upper(factor, size, lam)
    largest = 0.0
    for i in range(size):
        largest = max(largest, abs(lam[i]))
    for i in range(size):
        if not lam[i] >= -tolerance * (1 + largest):
            return False
        lam[i] = max(lam[i], 0.0)
    for i in range(size):  # near the border of the domain a factor may be all rounding
        row = active[i]
        rest = d[row] + extra[row] * lam[i]
        for k in range(size):
            rest += gram[row, active[k]] * lam[k]
        if not abs(rest) <= tolerance * (1 + (least if least > 0 else abs(d[row]))):
            return False
    _slacks(d, gram, active, lam, size, slack)
    for j in range(len(d)):
        if not slack[j] >= -tolerance * (1 + (least if least > 0 else abs(d[j]))):
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

    ``d = d0 + theta D`` with D (n, rows), gram (rows, rows); ``extra`` (rows,) softens constraints.
    Written are multipliers and active sets (batch, most), which hold ``most`` constraints at most,
    their sizes and the status (batch,).
    """
    rows = len(d0)
    soft = bool(np.any(extra > 0))
    # An answer may violate a constraint by 1e-9 of 1 + |d|, and multipliers by as much of 1 + the
    # largest. Where constraints give way it is 1e-6, of 1 + the largest |d|: multipliers are
    # violations over softness, a million times as large as d, and sums of them round.
    tolerance = 1e-6 if soft else 1e-9
    factor = np.empty((most, most))
    step = np.empty(most)
    column = np.empty(most)
    d = np.empty(rows)
    slack = np.empty(rows)
    for at in range(len(theta)):
        d[:] = d0
        for i in range(theta.shape[1]):
            own = theta[at, i]
            for j in range(rows):
                d[j] += own * D[i, j]
        slack[:] = d
        least = np.abs(d).max() if soft else 0.0
        # Beside the largest violation: multipliers are a million times as large where it gives way.
        rounding = 1e-8 * (1 + max(-d.min(), 0.0)) if soft else 0.0
        size = 0
        status[at] = UNCERTIFIED
        own_set = active[at]
        lam = multipliers[at]
        for _ in range(10 * (rows + 10)):
            entering = _most_violated(d, slack, rounding)
            if entering < 0:
                if _certified(d, gram, extra, own_set, lam, size, factor, slack, tolerance, least):
                    status[at] = SOLVED
                break
            found = _add(
                gram, extra, entering, -slack[entering], own_set, lam, size, factor, step, column
            )
            if found < 0:
                status[at] = INFEASIBLE if found == -1 else UNCERTIFIED
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


@compiled()
def _slot(theta: Integers, at: int, keys: Integers) -> tuple[Any, Any, Any, bool]:
    """Return two 64-bit keys of a row of theta, its place in the table, and whether it is there.

    A row that is new gets a free place of its own, or another one's.
    """
    probes = 8  # Places of the table in which a point may lie.
    first = np.int64(-7046029254386353131)
    second = np.int64(1609587929392839161)
    for j in range(theta.shape[1]):
        first = (first ^ theta[at, j]) * np.int64(-4417276706812531889)
        first ^= (first >> 29) & np.int64(0x7FFFFFFFF)
        second = (second + theta[at, j]) * np.int64(-8796714831421723037)
        second ^= (second >> 32) & np.int64(0xFFFFFFFF)
    first ^= first >> 31
    second |= 1  # 0 is no point
    mask = len(keys) - 1
    for probe in range(probes):
        place = (first + probe) & mask
        if keys[place, 1] == second and keys[place, 0] == first:
            return first, second, place, True
        if keys[place, 1] == 0:
            return first, second, place, False
    return first, second, (first + ((second >> 7) & (probes - 1))) & mask, False


@compiled("int64(int64[:, ::1], int64[:, ::1], float64[:, ::1], float64[:, ::1], int64[::1])")
def recall(theta: Integers, keys: Integers, values: Array, u: Array, missing: Integers) -> int:
    """Write the inputs of known rows, and which rows are not known; return how many these are.

    ``keys`` (size, 2) and ``values`` (size, m) are a table whose size is a power of 2.
    """
    count = 0
    for at in range(len(theta)):
        _, _, place, known = _slot(theta, at, keys)
        if known:
            u[at] = values[place]
        else:
            missing[count] = at
            count += 1
    return count


@compiled("void(int64[:, ::1], int64[:, ::1], float64[:, ::1], float64[:, ::1], int64[::1])")
def remember(theta: Integers, keys: Integers, values: Array, u: Array, rows: Integers) -> None:
    """Put some rows into the table, in place of others if need be."""
    for at in rows:
        first, second, place, _ = _slot(theta, at, keys)
        keys[place, 0] = first
        keys[place, 1] = second
        values[place] = u[at]
