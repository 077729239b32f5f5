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
FEASIBLE, POSITIVE = 1e-12, 1e-9
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
        steps = (len(program.c) - program.n_slacks) // len(self.unit)
        reach = np.concatenate([np.tile(self.unit, steps), np.ones(program.n_slacks)])
        self.program: ParametricQP = program.scaled(self.center, self.half, reach)
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
        mpc, N, n, m = self.mpc, self.mpc.horizon, self.mpc.n_theta, self.mpc.model.n_inputs
        slacks = self.program.n_slacks
        self.size = N * (n + m) + slacks
        A, B = mpc.prediction
        errors, gamma = mpc.error_system, mpc.gamma
        H = np.zeros((self.size, self.size))
        cost = np.zeros((self.size, n))  # of theta_0 beside the variables
        equal, start = np.zeros((N * n, self.size)), np.zeros((N * n, n))

        def theta(k: int) -> tuple[Array, Array]:
            rows = np.zeros((n, self.size))
            if k == 0:
                return rows, np.eye(n)
            rows[:, (k - 1) * n : k * n] = np.eye(n)
            return rows, np.zeros((n, n))

        def u(k: int) -> Array:
            rows = np.zeros((m, self.size))
            rows[:, N * n + k * m : N * n + (k + 1) * m] = np.eye(m)
            return rows

        for k in range(N + 1):
            at, free = theta(k)
            z, z_free = errors.to_error @ at, errors.to_error @ free
            weight = gamma**k * (mpc.terminal.cost if k == N else errors.Q)
            H, cost = H + 2 * z.T @ weight @ z, cost + 2 * z.T @ weight @ z_free
            if k < N:
                v, v_free = u(k) - errors.to_input @ at, -errors.to_input @ free
                R = gamma**k * errors.R
                H, cost = H + 2 * v.T @ R @ v, cost + 2 * v.T @ R @ v_free
                if errors.cross is not None:
                    cross = gamma**k * errors.cross
                    H = H + 2 * (z.T @ cross @ v + v.T @ cross.T @ z)
                    cost = cost + 2 * (z.T @ cross @ v_free + v.T @ cross.T @ z_free)
                after = theta(k + 1)[0]
                equal[k * n : (k + 1) * n] = after - A @ at - B @ u(k)
                start[k * n : (k + 1) * n] = A @ free
        linear = np.zeros(self.size)
        kinds = [kind for kind in "xy" if np.any(getattr(mpc.soft, kind))]
        for i in range(slacks):
            H[self.size - slacks + i, self.size - slacks + i] += 2 * mpc.soft.penalty
            linear[self.size - slacks + i] = mpc.soft.penalty

        def slack(kind: str, softness: Array) -> Array:
            rows = np.zeros((len(softness), self.size))
            if kind in kinds:
                rows[:, self.size - slacks + kinds.index(kind)] = -softness
            return rows

        G: list[tuple[Array, Array, Array]] = []

        def add(
            rows: Array, free: Array, low: Array, high: Array, soft: Array | float = 0.0
        ) -> None:
            G.append((rows + soft, high, -free))
            G.append((-rows + soft, -low, free))

        states, none = mpc.layout.state, np.zeros((N * m, n))
        all_inputs = np.vstack([u(k) for k in range(N)])
        add(all_inputs, none, np.tile(mpc.u_min, N), np.tile(mpc.u_max, N))
        for k in range(1, N + 1):
            add(
                theta(k)[0][states],
                0 * np.eye(n)[states],
                mpc.x_min,
                mpc.x_max,
                slack("x", mpc.soft.x),
            )
        F, g = mpc.terminal.set
        G.append((F @ theta(N)[0], g, np.zeros((len(g), n))))
        for k in range(N) if mpc.layout.n_previous else ():
            at, free = theta(k)
            part = mpc.layout.previous
            add(u(k) - at[part], -free[part], mpc.rate.du_min, mpc.rate.du_max)
        C = mpc.outputs.C
        for k in range(1, N + 1) if len(C) else ():
            rows = C @ theta(k)[0][states]
            add(
                rows,
                np.zeros((len(C), n)),
                mpc.outputs.y_min,
                mpc.outputs.y_max,
                slack("y", mpc.soft.y),
            )
        for kind in kinds:
            G.append((slack(kind, np.ones(1)), np.zeros(1), np.zeros((1, n))))
        rows, w, S = (np.concatenate(each) for each in zip(*G, strict=True))
        bounded = np.isfinite(w)
        units = np.concatenate([np.tile(self.half, N), np.tile(self.unit, N), np.ones(slacks)])
        self.units = units
        size = np.mean(np.diag(H * np.outer(units, units)))
        self.H, self.linear = H * np.outer(units, units) / size, linear * units / size
        self.cost = cost * units[:, None] / size
        self.equal, self.start = self._unit(equal * units, start, np.zeros(len(equal)))[:2]
        self.G, self.S, self.w = self._unit(rows[bounded] * units, S[bounded], w[bounded])
        assert len(self.w) == len(self.program.w)

    @staticmethod
    def _unit(rows: Array, S: Array, w: Array) -> tuple[Array, Array, Array]:
        length = np.linalg.norm(rows, axis=1)
        length[length == 0] = 1.0
        return rows / length[:, None], S / length[:, None], w / length

    def __call__(self, theta: Array) -> Array | None:
        """Return u_0 (m,) at theta (n,), None where no active set is proved to be optimal."""
        m, first = len(self.unit), self.mpc.horizon * self.mpc.n_theta
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
        values, multipliers = found[: self.size], found[self.size + len(self.equal) :]
        off = self.G @ values - limit
        off[active] = 0.0
        least = -POSITIVE * max(1.0, np.abs(multipliers).max(initial=0.0))
        proved = np.all(off <= FEASIBLE) and np.all(multipliers >= least)
        return values if proved and np.abs(right - K @ found).max() < 1e-9 else None
