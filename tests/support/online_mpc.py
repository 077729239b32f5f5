"""The MPC problem solved at one parameter, written a second time, in another form.

The package condenses the states away. Here they are variables, the model is an equality
constraint, every bound of an input or a state is a simple bound, and the program is in units of the
input ranges and of the box. Nothing but the fields of `LinearMPC` is used; the steady state is that
of the optimality conditions of its own small program.
"""

import daqp
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from sb3_yann import LinearMPC

Array = NDArray[np.float64]

EQUALITY = 5  # DAQP's code for a constraint that holds with equality
NO_BOUND = 1e30


class OnlineMPC:
    """Solves one theta at a time; variables are (u_0 ... u_{N-1}, x_1 ... x_N, slacks), scaled."""

    def __init__(self, mpc: LinearMPC) -> None:
        self.mpc = mpc
        model = mpc.model
        N = mpc.horizon
        n, m = model.B.shape
        self.sizes = [n, len(mpc.tracking.C), model.E.shape[1]]  # then u_prev, where there is one
        self.n_previous = len(mpc.theta_min) - sum(self.sizes)
        width = mpc.u_max - mpc.u_min
        self.u_unit = np.where(np.isfinite(width), width / 2, 1.0)
        self.x_unit = np.maximum(np.abs(mpc.theta_min), np.abs(mpc.theta_max))[:n]
        self.soft = {
            name: units
            for name, units in (("x", mpc.soft.x), ("y", mpc.soft.y))
            if np.any(units > 0)
        }
        self.unit = np.concatenate(
            [np.tile(self.u_unit, N), np.tile(self.x_unit, N), np.ones(len(self.soft))]
        )
        self.n_moves = N * (n + m)

        # x_{k+1} - A x_k - B u_k = 0; A x_0 and E d stand on the right-hand side
        steps = np.hstack(
            [
                np.kron(np.eye(N), -model.B),
                np.eye(N * n) - np.kron(np.eye(N, k=-1), model.A),
                np.zeros((N * n, len(self.soft))),
            ]
        )
        self.row_unit = np.tile(self.x_unit, N)
        self.steps = steps * self.unit / self.row_unit[:, None]
        self._set_cost()
        self._set_rows()

    def _set_cost(self) -> None:
        """Half the cost: ``1/2 (z - target)'W(z - target)``, changes of u, and slacks."""
        mpc = self.mpc
        N = self.mpc.horizon
        n, m = mpc.model.B.shape
        discounts = mpc.gamma ** np.arange(N)
        weights = [discount * mpc.R for discount in discounts]
        weights += [mpc.gamma**k * mpc.Q for k in range(1, N)]
        weights += [mpc.gamma**N * mpc.terminal.cost[:n, :n]]
        cost = block_diag(*weights, *(np.zeros((1, 1)) for _ in self.soft))
        if len(mpc.terminal.cost) > n:  # the terminal cost of u_{N-1} - u_s as well
            last = slice((N - 1) * m, N * m)
            final = slice(self.n_moves - n, self.n_moves)
            P = mpc.gamma**N * mpc.terminal.cost
            cost[last, last] += P[n:, n:]
            cost[last, final] += P[n:, :n]
            cost[final, last] += P[:n, n:]
        self.changes = np.zeros((N * m, len(cost)))
        self.changes[:, : N * m] = np.eye(N * m) - np.kron(np.eye(N, k=-1), np.eye(m))
        rate = np.kron(np.diag(discounts), mpc.rate.R_du)
        slack = np.zeros(len(cost))
        slack[self.n_moves :] = mpc.soft.penalty
        self.size = np.mean(np.diag(cost)[: self.n_moves] * self.unit[: self.n_moves] ** 2)
        self.cost = cost * self.unit[:, None] / self.size  # times the target: a gradient
        self.rate_gradient = self.unit[:, None] * self.changes.T @ rate / self.size
        self.slack_gradient = slack / 2 / self.size
        whole = cost + self.changes.T @ rate @ self.changes + np.diag(slack)
        whole = whole * np.outer(self.unit, self.unit) / self.size
        # Zero along the equality constraints, so the optimum is the same; it makes the Hessian
        # positive definite, as DAQP wants it, where Q is singular.
        self.hessian = np.ascontiguousarray(whole + self.steps.T @ self.steps)

    def _set_rows(self) -> None:
        """Rows besides the steps, as (A, A_theta, upper, lower): A z + A_theta theta is bounded."""
        mpc = self.mpc
        N = self.mpc.horizon
        n, m = mpc.model.B.shape
        n_theta = len(mpc.theta_min)
        states = [np.zeros((n, len(self.unit))) for _ in range(N)]
        for k, row in enumerate(states):
            row[:, N * m + k * n : N * m + (k + 1) * n] = np.eye(n)
        rows = []
        F, g = mpc.terminal.set
        last = np.zeros((n_theta, len(self.unit)))
        last[:n] = states[-1]
        last[n_theta - self.n_previous :, (N - 1) * m : N * m] = np.eye(m)[: self.n_previous]
        constant = np.zeros((n_theta, n_theta))
        kept = slice(n, n_theta - self.n_previous)
        constant[kept, kept] = np.eye(kept.stop - kept.start)
        rows.append((F @ last, F @ constant, g, np.full(len(g), -np.inf)))
        if self.n_previous:
            start = np.zeros((N * m, n_theta))
            start[:m, n_theta - m :] = -np.eye(m)
            rows.append(
                (self.changes, start, np.tile(mpc.rate.du_max, N), np.tile(mpc.rate.du_min, N))
            )
        for row in states:
            seen = mpc.outputs.C @ row
            rows += self._softened("y", seen, mpc.outputs.y_max, mpc.outputs.y_min, mpc.soft.y)
            if "x" in self.soft:
                rows += self._softened("x", row, mpc.x_max, mpc.x_min, mpc.soft.x)
        A, self.rows_theta, self.rows_upper, self.rows_lower = (
            np.concatenate(part) for part in zip(*rows, strict=True)
        )
        A = A * self.unit
        length = np.maximum(np.linalg.norm(A, axis=1), 1e-9)
        self.rows_length = length
        self.rows = np.ascontiguousarray(np.vstack([self.steps, A / length[:, None]]))
        free_x = self.mpc.soft.x > 0
        x_max = np.where(free_x, np.inf, mpc.x_max)
        x_min = np.where(free_x, -np.inf, mpc.x_min)
        slacks = np.ones(len(self.soft))
        upper = [np.tile(mpc.u_max, N), np.tile(x_max, N), np.inf * slacks]
        lower = [np.tile(mpc.u_min, N), np.tile(x_min, N), 0 * slacks]
        self.upper = np.concatenate(upper) / self.unit
        self.lower = np.concatenate(lower) / self.unit
        self.sense = np.zeros(len(self.upper) + len(self.rows), dtype=np.intc)
        self.sense[len(self.upper) : len(self.upper) + N * n] = EQUALITY

    def _softened(self, kind, row, high, low, units):
        """The bounds of some rows, with a slack where they are soft."""
        slack = np.zeros_like(row)
        if kind in self.soft:
            slack[:, self.n_moves + list(self.soft).index(kind)] = units
        free = np.zeros((len(row), len(self.mpc.theta_min)))
        none = np.full(len(row), np.inf)
        return [(row - slack, free, high, -none), (row + slack, free, none, low)]

    def steady_state(self, theta: Array) -> Array:
        """Return [u_s; x_s]: the cheapest steady state that holds the reference."""
        mpc = self.mpc
        model = self.mpc.model
        n, m = model.B.shape
        _, r, d, _ = np.split(theta, np.cumsum(self.sizes))
        holds = np.hstack([model.B, model.A - np.eye(n)])
        shows = np.hstack([np.zeros((len(r), m)), mpc.tracking.C])
        M = np.vstack([holds, shows])
        right = np.concatenate([-model.E @ d, r])
        weight = block_diag(mpc.R, mpc.Q)
        kkt = np.block([[weight, M.T], [M, np.zeros((len(M), len(M)))]])
        right = np.concatenate([np.zeros(n + m), right])
        return np.linalg.lstsq(kkt, right, rcond=1e-13)[0][: n + m]

    def start(self, theta: Array) -> Array:
        """Return the right-hand side of the steps of the model, scaled."""
        model = self.mpc.model
        N = self.mpc.horizon
        x, _, d, _ = np.split(theta, np.cumsum(self.sizes))
        start = np.tile(model.E @ d, N)
        start[: len(x)] += model.A @ x
        return np.asarray(start / self.row_unit)

    def limits(self, theta: Array) -> tuple[Array, Array]:
        """Return lower and upper limits of the variables, and of the rows, all scaled."""
        shift = self.rows_theta @ theta
        start = self.start(theta)
        lower = [self.lower, start, (self.rows_lower - shift) / self.rows_length]
        upper = [self.upper, start, (self.rows_upper - shift) / self.rows_length]
        return np.concatenate(lower), np.concatenate(upper)

    def __call__(self, theta: Array) -> Array | None:
        """Return u_0, or None where no input keeps all constraints."""
        n, m = self.mpc.model.B.shape
        *_, previous = np.split(theta, np.cumsum(self.sizes))
        start = self.start(theta)
        gradient = self.slack_gradient - self.steps.T @ start
        if len(theta) > n:
            steady = self.steady_state(theta)
            steps = self.mpc.horizon
            target = np.concatenate([np.tile(steady[:m], steps), np.tile(steady[m:], steps)])
            gradient = gradient - self.cost[:, : self.n_moves] @ target
        if len(previous):
            gradient = gradient + self.rate_gradient[:, :m] @ -previous
        lower, upper = self.limits(theta)
        z, _, status, _ = daqp.solve(
            self.hessian,
            gradient,
            self.rows,
            np.minimum(upper, NO_BOUND),
            np.maximum(lower, -NO_BOUND),
            self.sense.copy(),
            primal_tol=1e-12,
            dual_tol=1e-12,
        )
        return np.asarray(z)[:m] * self.u_unit if status == 1 else None
