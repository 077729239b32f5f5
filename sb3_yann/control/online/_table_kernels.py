"""Compiled table of points: where the bits of a row of theta are found again."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_yann._numba import Integers, compiled
from sb3_yann._validation import Array

PLACES = 8
"""Places of the table in which a point may lie."""


@compiled()
def _keys(theta: Integers, at: int) -> tuple[Any, Any]:
    """Return two 64-bit numbers that a row of theta, as whole numbers, is known by."""
    first, second = np.int64(-7046029254386353131), np.int64(1609587929392839161)
    for j in range(theta.shape[1]):
        first = (first ^ theta[at, j]) * np.int64(-4417276706812531889)
        first ^= (first >> 29) & np.int64(0x7FFFFFFFF)
        second = (second + theta[at, j]) * np.int64(-8796714831421723037)
        second ^= (second >> 32) & np.int64(0xFFFFFFFF)
    return first ^ (first >> 31), second | 1  # 0 is no point


@compiled("int64(int64[:, ::1], int64[:, ::1], float64[:, ::1], float64[:, ::1], int64[::1])")
def recall(theta: Integers, keys: Integers, values: Array, u: Array, missing: Integers) -> int:
    """Write the inputs of known rows, and which rows are not known; return how many these are.

    ``keys`` (size, 2) and ``values`` (size, m) are a table whose size is a power of 2.
    """
    count, mask = 0, len(keys) - 1
    for at in range(len(theta)):
        first, second = _keys(theta, at)
        known = False
        for place in range(PLACES):
            slot = (first + place) & mask
            if keys[slot, 1] == second and keys[slot, 0] == first:
                u[at] = values[slot]
                known = True
                break
        if not known:
            missing[count] = at
            count += 1
    return count


@compiled(
    "int64(int64[:, ::1], int64[:, ::1], float64[:, ::1], float64[:, ::1], int64[::1], int64)"
)
def remember(
    theta: Integers, keys: Integers, values: Array, u: Array, rows: Integers, count: int
) -> int:
    """Put some rows into the table, in place of others if need be; return how many are new."""
    new, mask = 0, len(keys) - 1
    for i in range(count):
        first, second = _keys(theta, rows[i])
        slot, free = first & mask, False
        for place in range(PLACES):
            here = (first + place) & mask
            if keys[here, 1] == 0 or (keys[here, 1] == second and keys[here, 0] == first):
                slot, free = here, keys[here, 1] == 0
                break
        else:
            slot = (first + ((second >> 7) & (PLACES - 1))) & mask
        keys[slot, 0], keys[slot, 1] = first, second
        values[slot] = u[rows[i]]
        new += 1 if free else 0
    return new


@compiled("void(int64[:, ::1], float64[:, ::1], int64[:, ::1], float64[:, ::1])")
def move(keys: Integers, values: Array, to_keys: Integers, to_values: Array) -> None:
    """Put what a table holds into a larger one."""
    mask = len(to_keys) - 1
    for i in range(len(keys)):
        if keys[i, 1] == 0:
            continue
        for place in range(PLACES):
            slot = (keys[i, 0] + place) & mask
            if to_keys[slot, 1] == 0:
                to_keys[slot] = keys[i]
                to_values[slot] = values[i]
                break
