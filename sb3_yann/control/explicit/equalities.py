"""Constraints of a program that hold with equality wherever it is feasible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from sb3_yann._validation import Array
from sb3_yann.control.explicit.parametric_qp import ParametricQP
from sb3_yann.control.polyhedra import Region

NO_SLACK = 1e-9
"""In half-widths of the box: a constraint that no feasible point keeps by more is an equality."""
ROUNDING = 1e-11
"""What is smaller, relative to what it is a sum of, is zero."""

Slacks = Callable[[Array, Array, NDArray[np.intp]], Array | None]


@dataclass(frozen=True, eq=False)
class Equalities:
    """``U = free y + law [theta; 1]`` for any y: what is left of U by equality constraints.

    Attributes
    ----------
    free : ndarray, shape (v, k)
        Orthonormal.
    law : ndarray, shape (v, n + 1)
    rows : ndarray of int
        The constraints of the program that are these equalities.
    """

    free: Array
    law: Array
    rows: NDArray[np.intp]

    @classmethod
    def of(cls, program: ParametricQP, slacks: Slacks) -> Equalities | None:
        """Return the equalities of a program with unit rows, None if it has none that bind U.

        ``slacks`` returns how much room some rows of ``A z <= b`` have at a point where the sum of
        these is largest, each counted up to a small one; None if there is no point.
        """
        A, b = np.hstack([program.G, -program.S]), program.w
        left: NDArray[np.intp] = np.arange(len(b), dtype=np.intp)
        while len(left):
            room = slacks(A, b, left)
            if room is None:
                return None
            if np.all(room <= NO_SLACK):
                break
            left = np.asarray(left[room <= NO_SLACK])
        own = slice(len(program.c) - program.n_slacks)
        left = np.asarray(left[np.any(program.G[left, own], axis=1)])
        if not len(left):
            return None
        G, limit = program.G[left], np.column_stack([program.S, program.w])[left]
        inverse = np.linalg.pinv(G, rcond=NO_SLACK)
        inputs = G.shape[1] - program.n_slacks
        # Slacks stay as they are: how steep a program is shows in their columns.
        free = linalg.block_diag(
            linalg.null_space(G[:, :inputs], rcond=NO_SLACK), np.eye(program.n_slacks)
        )
        if not free.size:
            free = np.zeros((inputs, 1))  # the equalities leave nothing to choose
        return cls(free, np.asarray(inverse @ limit), left)

    def eliminated(self, program: ParametricQP) -> ParametricQP:
        """Return the program in y, of unit rows.

        Of equalities that no U can meet, what is left binds theta.
        """
        n = program.F.shape[1]
        law, at = self.law[:, :n], self.law[:, n]
        size = np.linalg.norm(program.G, axis=1)
        G = program.G @ self.free
        G[np.linalg.norm(G, axis=1) <= ROUNDING * size] = 0.0
        G[self.rows] = 0.0
        limit = np.column_stack([program.S, program.w]) - program.G @ self.law
        S, w = limit[:, :n], limit[:, n]
        noise = ROUNDING * (1 + size * np.linalg.norm(self.law))
        S[np.linalg.norm(S, axis=1) <= noise] = 0.0
        w[~np.any(G, axis=1) & ~np.any(S, axis=1) & (np.abs(w) <= noise)] = 0.0
        length = np.linalg.norm(np.hstack([G, S]), axis=1)
        length[length == 0] = 1.0
        return replace(
            program,
            H=self.free.T @ program.H @ self.free if np.any(self.free) else np.eye(1),
            F=self.free.T @ (program.F + program.H @ law),
            c=self.free.T @ (program.c + program.H @ at),
            G=G / length[:, None],
            S=S / length[:, None],
            w=w / length,
        )

    def with_all_of_U(self, region: Region) -> Region:
        """Return a region with the law of U in place of that of y."""
        return replace(
            region,
            gain=self.free @ region.gain + self.law[:, :-1],
            offset=self.free @ region.offset + self.law[:, -1],
        )
