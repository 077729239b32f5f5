"""The Karush-Kuhn-Tucker (KKT) conditions of active sets, from the equations as they stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control.explicit.parametric_qp import ParametricQP, as_bits

# Constraints whose part across those of an active set is smaller, relative to all, depend on them.
DEPENDENT = 1e-9
# A gradient in theta is rounding if it is smaller, relative to what it is a sum of.
CONSTANT = 1e-11


@dataclass(frozen=True, eq=False)
class Optimality:
    """What the KKT conditions say of one active set.

    Attributes
    ----------
    active : tuple of int
    law : ndarray, shape (v, n + 1)
        ``U = law [theta; 1]``.
    rows : ndarray, shape (rows, n + 1)
        ``rows[:, :n] theta <= rows[:, n]``, of unit length, where constraints and multipliers hold.
        Those without theta are constants.
    labels : ndarray of int, shape (rows,)
        The constraint of each row.
    factors : ndarray, shape (rows, active)
        Each constraint's part along the active ones, all of unit length in U.
    depends : ndarray of bool, shape (rows,)
        Whether a constraint that is not active has no other part.
    """

    active: tuple[int, ...]
    law: Array
    rows: Array
    labels: NDArray[np.intp]
    factors: Array
    depends: NDArray[np.bool_]

    def across(self, row: int) -> tuple[int, ...]:
        """Return the active sets beyond a row, as whole numbers: an empty tuple is a proof of none.

        A constraint that becomes active and depends on the others takes the place of one that it
        contains with a positive factor. If there is no such one, it contradicts them (Farkas).
        """
        flipped = self._bits ^ (1 << self._labels[row])
        if not self._depends[row]:
            return (flipped,)
        leave = (self.factors[row] > DEPENDENT).tolist()
        return tuple(flipped ^ (1 << k) for k, each in zip(self.active, leave, strict=True) if each)

    @cached_property
    def _bits(self) -> int:
        return as_bits(self.active)

    @cached_property
    def _labels(self) -> list[int]:
        return [int(label) for label in self.labels]

    @cached_property
    def _depends(self) -> list[bool]:
        return [bool(each) for each in self.depends]


def optimality(
    program: ParametricQP, members: Sequence[tuple[int, ...]], everywhere: bool = False
) -> list[Optimality]:
    """Return the KKT conditions of active sets of one size, from LU factors of the KKT matrices.

    Those that hold in all of the unit box are left out, unless ``everywhere``.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the constraints of an active set depend on each other.
    """
    n, count, size = program.F.shape[1], len(members), len(members[0])
    active = np.array(members, dtype=int).reshape(count, size)
    laws, rows, noise, factors, depends = equations(program, active)
    rows = _of_unit_length(rows, noise)
    reach = np.abs(rows[:, :, :n]).sum(axis=2)
    binding = rows[:, :, n] < (np.where(reach > 0, np.inf, 0.0) if everywhere else reach)
    return [
        Optimality(
            members[i], laws[i], rows[i, held], np.flatnonzero(held),
            factors[i, held], depends[i, held],
        )
        for i, held in enumerate(binding)
    ]  # fmt: skip


def equations(
    program: ParametricQP, active: NDArray[np.intp]
) -> tuple[Array, Array, Array, Array, NDArray[np.bool_]]:
    """Return laws, slacks or multipliers as [S w], the size of their terms, factors and depends.

    All are for active sets (count, size), as in :class:`Optimality`.
    """
    (v, n), (count, size) = program.F.shape, active.shape
    length = np.linalg.norm(program.G, axis=1)
    length[length == 0] = 1.0
    # In unit length, however little U a constraint holds.
    G, limit = program.G / length[:, None], np.column_stack([program.S, program.w])
    limit = limit / length[:, None]
    K = np.zeros((count, v + size, v + size))
    K[:, :v, :v] = program.H
    K[:, v:, :v] = G[active]
    K[:, :v, v:] = np.swapaxes(G[active], 1, 2)
    right = np.zeros((count, v + size, n + 1 + len(G)))
    right[:, :v, : n + 1] = -np.column_stack([program.F, program.c])
    right[:, v:, : n + 1] = limit[active]
    right[:, :v, n + 1 :] = G.T
    both = np.linalg.solve(K, right)
    # One more step: rows that hold little U have multipliers of many magnitudes.
    both += np.linalg.solve(K, right - K @ both)
    laws, multipliers = both[:, :v, : n + 1], both[:, v:, : n + 1]
    factors = np.swapaxes(both[:, v:, n + 1 :], 1, 2)
    depends = np.linalg.norm(G - factors @ G[active], axis=2) <= DEPENDENT
    rows = limit - G @ laws
    noise = np.linalg.norm(limit, axis=1) + np.linalg.norm(laws, axis=(1, 2))[:, None]
    each = np.arange(count)[:, None]
    depends[each, active] = False
    rows[each, active] = multipliers
    noise[each, active] = np.abs(multipliers).max(axis=(1, 2), initial=0.0)[:, None]
    if program.steep:  # slacks and their multipliers are far larger than all the rest
        terms = np.abs(np.linalg.inv(K)) @ np.abs(right[:, :, : n + 1])
        noise = np.linalg.norm(np.abs(limit) + np.abs(G) @ np.abs(laws), axis=2)
        noise[each, active] = np.linalg.norm(terms[:, v:], axis=2)
    return np.asarray(laws), np.asarray(rows), np.asarray(noise), factors, np.asarray(depends)


def _of_unit_length(rows: Array, noise: Array) -> Array:
    """Return ``[S w]`` of ``0 <= S theta + w`` as ``[A b]`` of ``A theta <= b``.

    ``noise`` is the size of the terms of each row.
    """
    length = np.linalg.norm(rows[:, :, :-1], axis=2)
    constant = length <= CONSTANT * noise
    length[constant] = np.maximum(noise[constant], 1e-300)
    rows = np.concatenate([-rows[:, :, :-1], rows[:, :, -1:]], axis=2) / length[:, :, None]
    rows[constant, :-1] = 0.0
    return np.asarray(rows)
