"""Compiled evaluation of a piecewise affine law: which region holds theta, and its input.

A law goes in as two arrays (see :func:`pack`): each that numba unpacks costs 0.1 microseconds.
"""

from __future__ import annotations

import numpy as np

from sb3_yann._numba import Integers, compiled
from sb3_yann._validation import Array

HEADER = 7
"""Whole numbers before the packed arrays: n, m, p, q, zero input, disjoint, and 1 + the region that
a walk begins in, 0 where there is none."""

ROWS = 2  # floats before the packed arrays: how far outside counts as inside, which slacks tie
SURELY_INSIDE = 1e-9
"""With this slack, no other one of disjoint regions is as good."""


def pack(
    gains: Array,
    offsets: Array,
    rows: Array,
    starts: Integers,
    bounds: Array,
    box: Array,
    tolerances: tuple[float, float],
    flags: tuple[bool, bool],
    walk: tuple[Integers, int, Array] | None = None,
) -> tuple[Array, Integers]:
    """Return a law as one array of floats and one of whole numbers, for the functions below.

    ``rows`` are [A b] (q, n + 1) of all regions, ``bounds`` u_min and u_max (2, m), ``box`` its
    middle and 1 / half-widths (2, n). ``tolerances`` tell how far outside counts as inside and
    which slacks tie, ``flags`` whether the input is zero outside and whether no regions overlap in
    the box. Regions are scanned, or in the box a ``walk`` goes from one to the next: the region
    beyond each row, where it begins, and at which point (n,).
    """
    (p, m, n) = gains.shape
    q = len(rows)
    header = [n, m, p, q, *flags, 0]
    neighbors: Integers = np.empty(0, np.int64)
    at_start: Array = np.empty(0)
    if walk is not None:
        neighbors, first, inside = walk
        header[-1] = 1 + first
        at_start = rows[:, -1] - rows[:, :-1] @ inside
    floats = (np.array(tolerances), rows, gains, offsets, bounds, box, at_start)
    whole = (header, starts, [q], neighbors)
    packed = np.hstack([np.ravel(each) for each in whole]).astype(np.int64)
    return np.hstack([np.ravel(each) for each in floats]), packed


@compiled()
def _places(whole: Integers) -> tuple[int, int, int, int]:
    """Return where gains, offsets, bounds and the box begin in the floats."""
    gains = ROWS + whole[3] * (whole[0] + 1)
    offsets = gains + whole[2] * whole[1] * whole[0]
    bounds = offsets + whole[2] * whole[1]
    return gains, offsets, bounds, bounds + 2 * whole[1]


@compiled()
def _slack(floats: Array, whole: Integers, region: int, theta: Array, at: int, low: float) -> float:
    """Return the smallest slack of a region, or anything below ``low`` if it is lower."""
    n = whole[0]
    smallest = np.inf
    for k in range(whole[HEADER + region], whole[HEADER + region + 1]):
        row = ROWS + k * (n + 1)
        slack = floats[row + n]
        for j in range(n):
            slack -= floats[row + j] * theta[at, j]
        if slack < smallest:
            smallest = slack
            if smallest < low:
                break
    return smallest


@compiled()
def _best(
    floats: Array, whole: Integers, theta: Array, at: int, known: float, disjoint: bool
) -> tuple[int, float]:
    """Return the first region whose smallest slack ties with the largest, and the largest.

    With the slack of some region that is ``known``, most of the others are soon passed over. Of
    disjoint ones the first that surely holds theta ends the search.
    """
    n = whole[0]
    best = 0
    largest = -np.inf
    low = known - floats[1] * (1 + abs(known))
    tied = False
    for i in range(whole[2]):
        smallest = np.inf  # `_slack` written out: as a call it takes a third longer
        for k in range(whole[HEADER + i], whole[HEADER + i + 1]):
            row = ROWS + k * (n + 1)
            slack = floats[row + n]
            for j in range(n):
                slack -= floats[row + j] * theta[at, j]
            if slack < smallest:
                smallest = slack
                if smallest < low:
                    break
        if smallest < low:
            continue
        if disjoint and smallest >= SURELY_INSIDE:
            return i, smallest
        tied = True
        if smallest > largest:
            low = max(low, smallest - floats[1] * (1 + abs(smallest)))
            tied = largest >= low
            best = i
            largest = smallest
    if not tied:
        return best, largest
    nearly = largest - floats[1] * (1 + abs(largest))
    for i in range(best):
        if _slack(floats, whole, i, theta, at, nearly) >= nearly:
            return i, largest
    return best, largest


@compiled()
def walk_to(floats: Array, whole: Integers, theta: Array, at: int) -> int:
    """Return the region where a line from the start of the walk ends, or where it gets lost."""
    n = whole[0]
    at_start = _places(whole)[3] + 2 * n
    neighbors = HEADER + whole[2] + 1
    region: int = whole[6] - 1
    reached = 0.0
    for _ in range(10_000):
        leaves = np.inf
        out = -1
        for k in range(whole[HEADER + region], whole[HEADER + region + 1]):
            row = ROWS + k * (n + 1)
            slack = floats[row + n]
            for j in range(n):
                slack -= floats[row + j] * theta[at, j]
            if slack < 0 and slack < floats[at_start + k]:
                there = floats[at_start + k] / (floats[at_start + k] - slack)
                if there < leaves:
                    leaves = there
                    out = k
        # A region that the walk enters holds the line from there on, to rounding.
        if out < 0 or leaves < reached - 1e-9 or whole[neighbors + out] < 0:
            return region
        region = whole[neighbors + out]
        reached = max(reached, leaves)
    return region


@compiled()
def _choose(
    floats: Array, whole: Integers, theta: Array, at: int, near: int = -1
) -> tuple[int, float]:
    """Return the region in use and how far inside it theta lies: (-1, nan) if it is not finite.

    Region ``near``, if that is not negative, is asked first: of disjoint ones no other is as good.
    Beyond the box, where they may overlap, all are compared, and it counts how far beyond.
    """
    n = whole[0]
    box = _places(whole)[3]
    room = np.inf
    for j in range(n):
        if not np.isfinite(theta[at, j]):
            return -1, np.nan
        room = min(room, 1 - abs(theta[at, j] - floats[box + j]) * floats[box + n + j])
    disjoint = whole[5] == 1 and room >= -floats[0]
    if near >= 0 and disjoint:
        inside = _slack(floats, whole, near, theta, at, SURELY_INSIDE)
        if inside >= SURELY_INSIDE:
            return near, inside
    known = -np.inf
    if whole[6] > 0 and disjoint:
        region = walk_to(floats, whole, theta, at)
        known = _slack(floats, whole, region, theta, at, -np.inf)
        if known >= SURELY_INSIDE:
            return region, known
    region, inside = _best(floats, whole, theta, at, known, disjoint)
    return region, min(inside, room)


@compiled()
def input_at(
    floats: Array, whole: Integers, theta: Array, out: Array, at: int, near: int = -1
) -> int:
    """Write the input at one row of theta to that of ``out``, and return the region, -1 for none.

    Region ``near`` is asked first. Functions take the array and the row: numba counts references to
    a row of its own.
    """
    n = whole[0]
    m = whole[1]
    region, inside = _choose(floats, whole, theta, at, near)
    if region < 0:
        return -1
    gains, offsets, bounds, _ = _places(whole)
    zero = whole[4] == 1 and inside < -floats[0]
    for k in range(m):
        u = 0.0
        if not zero:
            for j in range(n):
                u += floats[gains + (region * m + k) * n + j] * theta[at, j]
            u += floats[offsets + region * m + k]
        u = u if u == u else 0.0  # inf - inf, far from everything
        out[at, k] = min(max(u, floats[bounds + k]), floats[bounds + m + k])
    return region


@compiled("boolean(float64[::1], int64[::1], float64[::1], float64[::1])")
def law_at(floats: Array, whole: Integers, theta: Array, out: Array) -> bool:
    """Write the input (m,) at one theta (n,); False where theta is not finite or too long."""
    if len(theta) != whole[0]:
        return False
    return input_at(floats, whole, theta.reshape(1, -1), out.reshape(1, -1), 0) >= 0


@compiled("void(float64[::1], int64[::1], float64[:, ::1], float64[:, ::1])")
def law_of_batch(floats: Array, whole: Integers, theta: Array, out: Array) -> None:
    """Write the inputs (batch, m) at the rows of theta (batch, n), all finite."""
    near = -1
    for i in range(len(theta)):
        near = input_at(floats, whole, theta, out, i, near)


@compiled("void(float64[::1], int64[::1], float64[:, ::1], int64[::1], float64[::1])")
def locate_batch(
    floats: Array, whole: Integers, theta: Array, region: Integers, inside: Array
) -> None:
    """Write the region in use (batch,) and how far inside it each row of theta lies (batch,)."""
    near = -1
    for i in range(len(theta)):
        near, inside[i] = _choose(floats, whole, theta, i, near)
        region[i] = near
