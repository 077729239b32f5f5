"""Compiled linear programs over polyhedra ``A x <= b`` of few dimensions and any thickness.

From a point inside, an active-set method climbs along the edges. It compares directions with zero,
never distances: a polyhedron of width 1e-9 is as good as a round one. A region asks for dozens of
such programs.
"""

from __future__ import annotations

import numpy as np

from sb3_yann._numba import Integers, compiled
from sb3_yann._validation import Array

OPTIMAL = 0
PASSED = 1
UNBOUNDED = 2
STUCK = 3
SAME = 1e-9
"""Rows that differ by less, their distances relative to the polyhedron's radius, are equal."""
SLACK_ROUNDING = 1e-14
"""Distances differ by so much from rounding alone."""


@compiled()
def _dot(one: Array, other: Array) -> float:
    """Return the product of two short vectors, for which calling a library takes longer."""
    total = 0.0
    for j in range(len(one)):
        total += one[j] * other[j]
    return total


@compiled()
def _hold(A: Array, W: Integers, first: int, k: int, Q: Array, R: Array) -> None:
    """Orthonormalize rows W[first:k] of A into Q, twice against rounding: A[W]' = Q'R."""
    n = A.shape[1]
    for j in range(first, k):
        for i in range(n):
            Q[j, i] = A[W[j], i]
        for i in range(j):
            R[i, j] = 0.0
        for _ in range(2):
            for i in range(j):
                part = _dot(Q[i], Q[j])
                R[i, j] += part
                for each in range(n):
                    Q[j, each] -= part * Q[i, each]
        R[j, j] = np.sqrt(_dot(Q[j], Q[j]))
        for each in range(n):
            Q[j, each] /= R[j, j]


@compiled()
def _leaving(g: Array, W: Integers, first: int, k: int, R: Array, least: float, rule: int) -> int:
    """Return which held row the cost pulls away from, -1 for none; g are its parts along Q.

    It is the strongest, or under rule 1, against circles, the one with the smallest number.
    """
    which = -1
    for j in range(k - 1, -1, -1):
        for i in range(j + 1, k):
            g[j] -= R[j, i] * g[i]
        g[j] /= R[j, j]
    for j in range(first, k):
        if g[j] < -least:
            if which < 0 or (rule == 1 and W[j] < W[which]) or (rule == 0 and g[j] < g[which]):
                which = j
    return which


@compiled()
def _blocking(A: Array, slack: Array, d: Array, length: float, free: Integers) -> tuple[int, float]:
    """Return the first row on the way in direction d, -1 for none, and how far it is.

    A row along which d runs, to 1e-11 of its length, is not on the way.
    """
    best = -1
    nearest = np.inf
    steepest = 0.0
    for i in range(len(A)):
        speed = _dot(A[i], d) if free[i] else 0.0
        if speed > 1e-11 * length:
            step = max(slack[i], 0.0) / speed
            if step < nearest * (1 - 1e-14) or (step <= nearest and speed > steepest):
                best = i
                nearest = step
                steepest = speed
    return best, nearest


@compiled()
def _climb(
    cost: Array, A: Array, b: Array, equal: int, stop: float, x: Array, free: Integers
) -> int:
    """Move x to the highest point of ``A x <= b``, or no further than where the cost is ``stop``.

    x has to be inside, and on row ``equal`` unless that is -1. Rows whose ``free`` is 0 do not
    count.
    """
    m, n = A.shape
    W = np.empty(n, np.int64)
    Q = np.empty((n, n))
    R = np.zeros((n, n))
    d = np.empty(n)
    g = np.empty(n)
    slack = np.empty(m)
    free = free.copy()
    k = 0
    pinned = 0
    size = np.sqrt(_dot(cost, cost))
    if equal >= 0:
        W[0] = equal
        free[equal] = 0
        k = 1
        pinned = 1
        _hold(A, W, 0, 1, Q, R)
    for turn in range(50 * (m + n)):
        d[:] = cost
        for again in range(2):
            for j in range(k):
                part = _dot(Q[j], d)
                g[j] = part if again == 0 else g[j] + part
                for i in range(n):
                    d[i] -= part * Q[j, i]
        length = np.sqrt(_dot(d, d))
        if k == n or length <= 1e-10 * size:
            j = _leaving(g, W, pinned, k, R, 1e-10 * size, 1 if turn > 5 * (m + n) else 0)
            if j < 0:
                _settle(A, b, W, k, Q, R, x)
                return OPTIMAL
            free[W[j]] = 1
            k -= 1
            for i in range(j, k):
                W[i] = W[i + 1]
            _hold(A, W, j, k, Q, R)
            continue
        for i in range(m):
            slack[i] = b[i] - _dot(A[i], x) if free[i] else 0.0
        row, step = _blocking(A, slack, d, length, free)
        height = _dot(cost, x)
        rise = _dot(cost, d)
        passed = height + step * rise > stop
        if passed:
            step = max(stop - height, 0.0) / rise
        elif row < 0:
            return UNBOUNDED
        for i in range(n):
            x[i] += step * d[i]
        if passed:
            return PASSED
        W[k] = row
        free[row] = 0
        k += 1
        _hold(A, W, k - 1, k, Q, R)
    return STUCK


@compiled()
def _settle(A: Array, b: Array, W: Integers, k: int, Q: Array, R: Array, x: Array) -> None:
    """Move x onto the rows that it is held to: steps have left it off by rounding."""
    part = np.empty(k)
    for j in range(k):
        part[j] = b[W[j]] - _dot(A[W[j]], x)
        for i in range(j):
            part[j] -= R[i, j] * part[i]
        part[j] /= R[j, j]
    for j in range(k):
        for i in range(len(x)):
            x[i] += part[j] * Q[j, i]


@compiled()
def _ball(A: Array, b: Array, facet: int, out: Array) -> int:
    """Write the center of the largest ball, or of that in a facet, and its radius (n + 1,)."""
    m, n = A.shape
    rows = np.ones((m, n + 1))
    rows[:, :n] = A
    cost = np.zeros(n + 1)
    cost[n] = 1.0
    out[:] = 0.0
    if facet >= 0:
        rows[facet, n] = 0.0
        out[:n] = b[facet] * A[facet] / np.dot(A[facet], A[facet])
    out[n] = np.inf
    for i in range(m):
        if i != facet:
            out[n] = min(out[n], b[i] - np.dot(A[i], out[:n]))
    return _climb(cost, rows, b, facet, np.inf, out, np.ones(m, np.int64))


@compiled()
def _facets(A: Array, b: Array, inside: Array, radius: float, kept: Integers, mean: Array) -> int:
    """Tell which rows bound a polyhedron, 2 for equal ones; write the mean of points on them."""
    m, n = A.shape
    slack = b - np.dot(A, inside)
    x = np.empty(n)
    mean[:] = 0.0
    count = 0
    room = SAME * radius + 10 * SLACK_ROUNDING
    free = np.empty(m, np.int64)
    for k in range(m):
        twins = 1
        for i in range(m):
            same = abs(slack[i] - slack[k]) <= SAME * radius + SLACK_ROUNDING
            for j in range(n):
                same = same and abs(A[i, j] - A[k, j]) <= SAME
            twins = 2 if same and i != k and kept[i] else twins
            free[i] = 0 if same else kept[i]
        x[:] = 0.0
        done = _climb(A[k], A, slack, -1, slack[k] + room, x, free)
        if done == STUCK:
            return STUCK
        kept[k] = 0 if done == OPTIMAL else twins
        if kept[k]:
            mean += x
            count += 1
    mean[:] = inside + mean / max(count, 1)
    return OPTIMAL


@compiled("int64(float64[:, ::1], float64[::1], int64, float64, float64[::1], int64[::1])")
def bounded_region(
    A: Array, b: Array, facet: int, thinnest: float, out: Array, kept: Integers
) -> int:
    """Write the center of the largest ball and its radius (n + 1,), of a facet unless that is -1.

    If the radius is more than ``thinnest``, ``kept`` (q,), ones before, says which rows bound a
    facet: 0 for none, 2 where others are equal. The center is then away from all of them: the
    largest ball of a slab may lie at its edge. Rows are of unit length, and the polyhedron is
    bounded. Returns OPTIMAL, or that it failed. It is one function, since each takes long to
    compile.
    """
    n = A.shape[1]
    mean = np.empty(n)
    done = _ball(A, b, facet, out)
    if done != OPTIMAL or out[n] <= thinnest:
        return done
    done = _facets(A, b, out[:n].copy(), out[n], kept, mean)
    least = np.min(b - np.dot(A, mean))
    if done == OPTIMAL and least > 0.1 * out[n]:
        out[:n] = mean
    return done


@compiled("int64(float64[:, ::1], float64[::1], float64[::1], float64[:, ::1], float64[:, ::1])")
def support(A: Array, b: Array, inside: Array, directions: Array, out: Array) -> int:
    """Write the farthest point (k, n) of a polyhedron in each direction, from a point inside."""
    slack = b - np.dot(A, inside)
    x = np.empty(len(inside))
    for i in range(len(directions)):
        x[:] = 0.0
        done = _climb(directions[i], A, slack, -1, np.inf, x, np.ones(len(b), np.int64))
        if done != OPTIMAL:
            return done
        out[i] = inside + x
    return OPTIMAL
