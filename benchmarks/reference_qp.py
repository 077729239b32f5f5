"""A problem solved a second time, without eliminating its states, to the last places."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from benchmarks.problems import Array
from sb3_yann.control import LinearMPC, ParametricQP

Indices = NDArray[np.intp]
FEASIBLE = 1e-12
POSITIVE = 1e-9
"""How far a constraint of unit length may be off, and a multiplier, relative to the largest."""


class ReferenceQP:
    """The program of a problem in all of its states and inputs, proved by its KKT conditions.

    Nothing is condensed: the model's equations are constraints, in which no power of A appears.
    Active sets are proposed by Lawson and Hanson's least-distance program (scipy) and by DAQP. The
    equations of an active set are solved with refinement. What then keeps all constraints with no
    negative multiplier is the answer, whoever proposed it.

    Parameters
    ----------
    mpc : LinearMPC
    """

    def __init__(self, mpc: LinearMPC) -> None:
        self.mpc = mpc
        self.center = (mpc.theta_max + mpc.theta_min) / 2
        self.half = mpc.theta_half
        self.unit = mpc.u_half
        program = mpc.condensed()
        self.program: ParametricQP
        self.program, _ = program.scaled(mpc.u_min, mpc.u_max, self.center)
        self.L = np.linalg.cholesky(self.program.H)
        self.back = np.linalg.inv(self.L).T
        self.length = np.linalg.norm(self.program.G, axis=1)
        self.length[self.length == 0] = 1.0
        self._build()

    def _build(self) -> None:
        """Set the cost, the model's equations and the constraints in ``(theta_1 ... U, slacks)``.

        All of it is in half-widths of the boxes. The constraints come in the order of the condensed
        program's.
        """
        mpc = self.mpc
        slacks = self.program.n_slacks
        N = mpc.horizon
        m = mpc.model.n_inputs
        self.size = N * (mpc.n_theta + m) + slacks
        self.units = np.concatenate([
            np.tile(self.half, N), np.tile(self.unit, N), np.ones(slacks)
        ])  # fmt: skip
        A, B = mpc.prediction
        equal = [self._theta(k + 1)[0] - A @ self._theta(k)[0] - B @ self._u(k) for k in range(N)]
        start = [A @ self._theta(k)[1] for k in range(N)]
        H, cost, linear = self._cost()
        size = np.mean(np.diag(H) * self.units**2)
        self.H = H * np.outer(self.units, self.units) / size
        self.linear = linear * self.units / size
        self.cost = cost * self.units[:, None] / size
        rows = np.vstack(equal) * self.units
        S = np.vstack(start)
        self.equal, self.start, _ = self._unit(rows, S, np.zeros(len(rows)))
        rows, w, S = (np.concatenate(each) for each in zip(*self._rows(), strict=True))
        bounded = np.isfinite(w)
        self.G, self.S, self.w = self._unit(rows[bounded] * self.units, S[bounded], w[bounded])

    def _theta(self, k: int) -> tuple[Array, Array]:
        """Return rows of the variables, and of theta_0, that make up theta_k."""
        n = self.mpc.n_theta
        rows = np.zeros((n, self.size))
        if k == 0:
            return rows, np.eye(n)
        rows[:, (k - 1) * n : k * n] = np.eye(n)
        return rows, np.zeros((n, n))

    def _u(self, k: int) -> Array:
        m = self.mpc.model.n_inputs
        first = self.mpc.horizon * self.mpc.n_theta
        rows = np.zeros((m, self.size))
        rows[:, first + k * m : first + (k + 1) * m] = np.eye(m)
        return rows

    def _cost(self) -> tuple[Array, Array, Array]:
        """Return the Hessian, what theta_0 and what nothing multiplies."""
        mpc = self.mpc
        N = self.mpc.horizon
        errors = mpc.error_system
        slacks = self.program.n_slacks
        H = np.zeros((self.size, self.size))
        cost = np.zeros((self.size, mpc.n_theta))
        weight = errors.stage_matrix
        for k in range(N):
            at, free = self._theta(k)
            both = np.vstack([at, self._u(k)])
            both_free = np.vstack([free, np.zeros((len(self.unit), mpc.n_theta))])
            weighted = 2 * mpc.gamma**k * both.T @ weight
            H = H + weighted @ both
            cost = cost + weighted @ both_free
        z = errors.to_error @ self._theta(N)[0]
        H = H + 2 * mpc.gamma**N * z.T @ mpc.terminal.cost @ z
        linear = np.zeros(self.size)
        linear[self.size - slacks :] = mpc.soft.penalty
        H[range(self.size - slacks, self.size), range(self.size - slacks, self.size)] += (
            2 * mpc.soft.penalty
        )
        return H, cost, linear

    def _rows(self) -> Iterator[tuple[Array, Array, Array]]:
        """Yield constraints ``rows variables <= w + S theta_0``."""
        mpc = self.mpc
        N = self.mpc.horizon
        n = self.mpc.n_theta
        kinds = [kind for kind in "xy" if np.any(getattr(mpc.soft, kind))]

        def slack(kind: str, softness: Array) -> Array:
            rows = np.zeros((len(softness), self.size))
            if kind in kinds:
                rows[:, self.size - len(kinds) + kinds.index(kind)] = -softness
            return rows

        def between(
            rows: Array, free: Array, low: Array, high: Array, soft: Array | float = 0.0
        ) -> Iterator[tuple[Array, Array, Array]]:
            yield rows + soft, high, -free
            yield -rows + soft, -low, free

        inputs = np.vstack([self._u(k) for k in range(N)])
        yield from between(
            inputs, np.zeros((len(inputs), n)), np.tile(mpc.u_min, N), np.tile(mpc.u_max, N)
        )
        state = mpc.layout.state
        C = mpc.outputs.C
        for k in range(1, N + 1):
            rows = self._theta(k)[0][state]
            yield from between(
                rows, np.zeros((len(rows), n)), mpc.x_min, mpc.x_max, slack("x", mpc.soft.x)
            )
        F, g = mpc.terminal.set
        yield F @ self._theta(N)[0], g, np.zeros((len(g), n))
        for k in range(N) if mpc.layout.n_previous else ():
            at, free = (each[mpc.layout.previous] for each in self._theta(k))
            yield from between(self._u(k) - at, -free, mpc.rate.du_min, mpc.rate.du_max)
        for k in range(1, N + 1) if len(C) else ():
            rows = C @ self._theta(k)[0][state]
            free = np.zeros((len(C), n))
            soft = slack("y", mpc.soft.y)
            yield from between(rows, free, mpc.outputs.y_min, mpc.outputs.y_max, soft)
        for kind in kinds:
            yield slack(kind, np.ones(1)), np.zeros(1), np.zeros((1, n))

    @staticmethod
    def _unit(rows: Array, S: Array, w: Array) -> tuple[Array, Array, Array]:
        length = np.linalg.norm(rows, axis=1)
        length[length == 0] = 1.0
        return rows / length[:, None], S / length[:, None], w / length

    def __call__(self, theta: Array) -> Array | None:
        """Return u_0 (m,) at theta (n,), None where no active set is proved to be optimal."""
        m = len(self.unit)
        first = self.mpc.horizon * self.mpc.n_theta
        for active in self._proposals((theta - self.center) / self.half):
            found = self._proved(theta, active)
            if found is not None:
                return found[first : first + m] * self.unit
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

    def _proved(self, theta: Array, active: Indices) -> Array | None:
        """Return the variables of an active set if that is optimal."""
        tight = np.vstack([self.equal, self.G[active]])
        zero = np.zeros((len(tight), len(tight)))
        K = np.block([[self.H, tight.T], [tight, zero]])
        limit = self.w + self.S @ theta
        right = np.concatenate([
            -(self.cost @ theta + self.linear), self.start @ theta, limit[active],
        ])  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", linalg.LinAlgWarning)  # what is singular is not proved
            factor = linalg.lu_factor(K)
        found = linalg.lu_solve(factor, right)
        for _ in range(3):
            if not np.all(np.isfinite(found)):
                return None
            found = found + linalg.lu_solve(factor, right - K @ found)
        values = found[: self.size]
        multipliers = found[self.size + len(self.equal) :]
        off = self.G @ values - limit
        off[active] = 0.0
        least = -POSITIVE * max(1.0, np.abs(multipliers).max(initial=0.0))
        proved = np.all(off <= FEASIBLE) and np.all(multipliers >= least)
        return values if proved and np.abs(right - K @ found).max() < 1e-9 else None
