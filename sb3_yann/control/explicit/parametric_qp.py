"""The multi-parametric quadratic program that a linear MPC is."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array

FAINT = 1e-7
"""Bounds that all inputs together move by less, in half-widths of the box of theta, are its own.

Where such a bound is active, the law is so steep that its own rounding shows.
"""


BATCH = 4e6
"""How many numbers a batch of active sets may hold: 32 MB."""


def as_bits(active_set: Iterable[int]) -> int:
    """Return a set of constraints as a whole number, with bit k for constraint k."""
    return sum(1 << int(k) for k in active_set)


def batches(
    sizes: Iterable[int], numbers: Callable[[int], float] = lambda size: 1.0
) -> Iterator[tuple[int, list[int]]]:
    """Yield each size, ascending, with the indices that have it, at most 256 at a time.

    ``numbers`` tells how many numbers one of a size needs: so many that memory and time of a batch
    stay small.
    """
    indices: dict[int, list[int]] = {}
    for i, size in enumerate(sizes):
        indices.setdefault(size, []).append(i)
    for size, members in sorted(indices.items()):
        most = int(np.clip(BATCH / numbers(size), 1, 256))
        for start in range(0, len(members), most):
            yield size, members[start : start + most]


def row_units(G: Array) -> Array:
    """Return factors (rows,) that give rows a length of about 1, without rounding.

    DAQP takes a row that is shorter than about 1e-6 for one that does not bind.
    """
    length = np.linalg.norm(G, axis=1)
    length[length == 0] = 1.0
    return np.asarray(2.0 ** -np.round(np.log2(length)))


@dataclass(frozen=True, eq=False)
class ParametricQP:
    """``min_U 1/2 U'HU + (F theta + c)'U`` with ``G U <= w + S theta``, for theta in a box.

    Attributes
    ----------
    H : ndarray, shape (v, v)
        Positive definite.
    F : ndarray, shape (v, n)
    c : ndarray, shape (v,)
    G : ndarray, shape (rows, v)
    w : ndarray, shape (rows,)
    S : ndarray, shape (rows, n)
    theta_min, theta_max : ndarray, shape (n,)
    n_slacks : int, default 0
        How many of the last variables are slacks of soft constraints, and no inputs.
    n_input_rows : int, default 0
        How many of the first rows are bounds of one input each.
    feedback : ndarray, shape (m, n), or None
        The first input is ``U[:m] + feedback theta``; None is no such part.

    Examples
    --------
    >>> one = np.ones((1, 1))
    >>> ParametricQP(H=one, F=-one, c=[0], G=one, w=np.ones(1), S=0 * one, theta_min=-one[0],
    ...              theta_max=one[0]).solve(np.array([0.5]))
    array([0.5])
    """

    H: Array
    F: Array
    c: Array
    G: Array
    w: Array
    S: Array
    theta_min: Array
    theta_max: Array
    n_slacks: int = 0
    n_input_rows: int = 0
    feedback: Array | None = None
    steep: ClassVar[bool] = False

    def first_input(self, U: Array, theta: Array, m: int) -> Array:
        """Return the first input (m,) of a solution U (v,) at theta (n,)."""
        return U[:m] if self.feedback is None else np.asarray(U[:m] + self.feedback @ theta)

    def solve(self, theta: Array) -> Array | None:
        """Return the optimal U (v,) at one theta (n,) from DAQP, or None where none is feasible."""
        return self.solve_with_multipliers(theta)[0]

    def solve_with_multipliers(self, theta: Array) -> tuple[Array | None, Array]:
        """Return the optimal U (v,), or None, and the multipliers of all rows (rows,)."""
        import daqp

        H, G, fixed, lower, sense, units = self._arrays
        upper = (self.w + self.S @ theta) * units
        if fixed.size:  # bounds of theta alone
            if upper[fixed].min() < -1e-11:
                return None, np.zeros(upper.size)
            upper[fixed] = 1.0
        U, _, status, info = daqp.solve(
            H, self.F @ theta + self.c, G, upper, lower, sense, primal_tol=1e-11
        )
        return (np.asarray(U) if status == 1 else None), np.asarray(info["lam"]) * units

    @cached_property
    def _arrays(self) -> tuple[Array, Array, NDArray[np.intp], Array, NDArray[np.intc], Array]:
        """What DAQP asks for at every theta: H, G, the rows without U, no bounds, no options.

        Last come the units in which it gets the rows.
        """
        units, rows = row_units(self.G), len(self.w)
        H, G = np.ascontiguousarray(self.H), np.ascontiguousarray(self.G * units[:, None])
        fixed = np.flatnonzero(~np.any(G, axis=1))
        return H, G, fixed, np.full(rows, -1e30), np.zeros(rows, dtype=np.intc), units

    def theta_rows(self) -> tuple[Array, Array]:
        """Return A and b of the bounds of theta alone, for a program whose box is the unit box."""
        eye = np.eye(self.F.shape[1])
        bound = ~np.any(self.G, axis=1) & np.any(self.S, axis=1)
        b = np.concatenate([np.ones(2 * len(eye)), self.w[bound]])
        return np.vstack([eye, -eye, -self.S[bound]]), b

    def without_faint_rows(self, most: Array) -> ParametricQP:
        """Return a program of unit rows where rows that U hardly moves bound theta alone.

        Those are tightened by what U can do to them, less than FAINT: the law stays exact, and the
        feasible set is so much smaller. ``most`` (v,) is the largest size of each variable,
        infinite where it has none.
        """
        with np.errstate(invalid="ignore"):  # 0 times inf
            moved = np.nan_to_num(np.abs(self.G) * most, nan=0.0, posinf=np.inf).sum(axis=1)
        faint = (moved < FAINT) & np.any(self.G, axis=1) & np.any(self.S, axis=1)
        if not np.any(faint):
            return self
        w = self.w - np.where(faint, moved, 0.0)
        return replace(self, G=np.where(faint[:, None], 0.0, self.G), w=w)

    def scaled(self, center: Array, half: Array, reach: Array) -> ParametricQP:
        """Return the program in ``U / reach`` and ``(theta - center) / half``, with unit rows.

        It knows no ``feedback``: that is of the units of the plant.
        """
        size = np.mean(np.diag(self.H) * reach**2)
        G, S = self.G * reach, self.S * half
        length = np.linalg.norm(np.hstack([G, S]), axis=1)
        length[length == 0] = 1.0
        return replace(
            self,
            H=self.H * np.outer(reach, reach) / size,
            F=self.F * np.outer(reach, half) / size,
            c=(self.c + self.F @ center) * reach / size,
            G=G / length[:, None],
            w=(self.w + self.S @ center) / length,
            S=S / length[:, None],
            theta_min=(self.theta_min - center) / half,
            theta_max=(self.theta_max - center) / half,
            feedback=None,
        )
