"""A quadratic program solved a second time: by non-negative least squares, to the last places."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from benchmarks.problems import Array
from sb3_yann.control import LinearMPC, ParametricQP

Indices = NDArray[np.intp]
FEASIBLE, POSITIVE = 1e-13, 1e-9
"""How far a constraint of unit length may be off, and a multiplier, relative to the largest."""


class ReferenceQP:
    """The condensed program of a problem, whose answers are proved by their KKT conditions.

    Active sets come from Lawson and Hanson's least-distance program (scipy), and where rounding
    spoils that, from DAQP. The equations of an active set are solved with refinement. What then
    keeps all constraints with no negative multiplier is the answer, whoever proposed it.

    Parameters
    ----------
    mpc : LinearMPC
    """

    def __init__(self, mpc: LinearMPC) -> None:
        self.center = (mpc.theta_max + mpc.theta_min) / 2
        self.half = (mpc.theta_max - mpc.theta_min) / 2
        width = (mpc.u_max - mpc.u_min) / 2
        self.unit = np.where(np.isfinite(width), width, 1.0)
        program = mpc.condensed()
        steps = (len(program.c) - program.n_slacks) // len(self.unit)
        reach = np.concatenate([np.tile(self.unit, steps), np.ones(program.n_slacks)])
        self.program: ParametricQP = program.scaled(self.center, self.half, reach)
        self.L = np.linalg.cholesky(self.program.H)
        self.back = np.linalg.inv(self.L).T
        self.length = np.linalg.norm(self.program.G, axis=1)
        self.length[self.length == 0] = 1.0

    def __call__(self, theta: Array) -> Array | None:
        """Return u_0 (m,) at theta (n,), None where no active set is proved to be optimal."""
        at = (theta - self.center) / self.half
        for active in self._proposals(at):
            U = self._proved(at, active)
            if U is not None:
                return U[: len(self.unit)] * self.unit
        return None

    def _proposals(self, at: Array) -> Iterator[Indices]:
        """Yield active sets: none; that of a least-distance program; that of DAQP."""
        yield np.empty(0, dtype=np.intp)
        p = self.program
        free = -np.linalg.solve(p.H, p.F @ at + p.c)
        N = -(p.G @ self.back) / self.length[:, None]
        h = -(p.w + p.S @ at - p.G @ free) / self.length
        E = np.vstack([N.T, h])
        try:
            found, _ = optimize.nnls(E, np.append(np.zeros(len(free)), 1.0))
            yield np.flatnonzero(found > 1e-13 * max(found.max(), 1e-300))
        except RuntimeError:  # too many iterations
            pass
        _, multipliers = p.solve_with_multipliers(at)
        yield np.flatnonzero(multipliers * self.length > 1e-11)

    def _proved(self, at: Array, active: Indices) -> Array | None:
        """Return the U of an active set if that is optimal."""
        p, v, size = self.program, len(self.program.c), len(active)
        if size > v:
            return None
        G = p.G[active] / self.length[active, None]
        K = np.block([[p.H, G.T], [G, np.zeros((size, size))]])
        limit = p.w + p.S @ at
        right = np.concatenate([-(p.F @ at + p.c), limit[active] / self.length[active]])
        try:
            found = np.linalg.solve(K, right)
            for _ in range(2):
                found = found + np.linalg.solve(K, right - K @ found)
        except np.linalg.LinAlgError:
            return None
        U, multipliers = found[:v], found[v:]
        off = p.G @ U - limit
        off[active] = 0.0
        least = -POSITIVE * max(1.0, np.abs(multipliers).max(initial=0.0))
        proved = np.all(off <= FEASIBLE) and np.all(multipliers >= least)
        return U if proved and np.abs(right - K @ found).max() < 1e-6 else None
