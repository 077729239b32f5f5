"""The MPC problem solved at one state, written a second time, in another form.

The package condenses the states away. Here they are variables, the model is an equality
constraint, every bound is a simple bound, and the program is in units of the input ranges and of
the box. Nothing but the fields of `LinearMPC` is used.
"""

from __future__ import annotations

import daqp
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from sb3_yann import LinearMPC

Array = NDArray[np.float64]

EQUALITY = 5  # DAQP's code for a constraint that holds with equality
NO_BOUND = 1e30


class OnlineMPC:
    """Solves one state at a time; variables are (u_0 ... u_{N-1}, x_1 ... x_N), scaled."""

    def __init__(self, mpc: LinearMPC) -> None:
        A, B, N = mpc.model.A, mpc.model.B, mpc.horizon
        n, m = B.shape
        self.inputs = slice(0, m)
        width = mpc.u_max - mpc.u_min
        self.u_unit = np.where(np.isfinite(width), width / 2, 1.0)
        x_unit = np.maximum(np.abs(mpc.theta_min), np.abs(mpc.theta_max))
        unit = np.concatenate([np.tile(self.u_unit, N), np.tile(x_unit, N)])

        # x_{k+1} - A x_k - B u_k = 0, and A theta on the right-hand side of the first step
        steps = np.hstack([np.kron(np.eye(N), -B), np.eye(N * n) - np.kron(np.eye(N, k=-1), A)])
        self.steps = steps * unit / np.tile(x_unit, N)[:, None]
        self.start = np.vstack([A, np.zeros(((N - 1) * n, n))]) / np.tile(x_unit, N)[:, None]
        terminal_F, terminal_g = mpc.terminal_set
        self.last = np.hstack([np.zeros((len(terminal_g), N * m + (N - 1) * n)), terminal_F])
        self.last_length = np.maximum(np.linalg.norm(self.last * unit, axis=1), 1e-9)
        self.last = self.last * unit / self.last_length[:, None]
        self.last_upper = terminal_g / self.last_length

        weights = [mpc.gamma**k * mpc.R for k in range(N)]
        weights += [mpc.gamma**k * mpc.Q for k in range(1, N)]
        weights += [mpc.gamma**N * mpc.terminal_cost]
        cost = block_diag(*weights) * np.outer(unit, unit)
        cost /= np.mean(np.diag(cost))
        # Zero along the equality constraints, so the optimum is the same; it makes the Hessian
        # positive definite, as DAQP wants it, where Q is singular.
        self.hessian = np.ascontiguousarray(cost + self.steps.T @ self.steps)
        self.upper = np.concatenate([np.tile(mpc.u_max, N), np.tile(mpc.x_max, N)]) / unit
        self.lower = np.concatenate([np.tile(mpc.u_min, N), np.tile(mpc.x_min, N)]) / unit
        self.rows = np.ascontiguousarray(np.vstack([self.steps, self.last]))
        self.sense = np.zeros(len(self.upper) + len(self.rows), dtype=np.intc)
        self.sense[len(self.upper) : len(self.upper) + N * n] = EQUALITY

    def __call__(self, theta: Array) -> Array | None:
        """Return u_0, or None where no input keeps all constraints."""
        start = self.start @ theta
        upper = np.concatenate([self.upper, start, self.last_upper])
        lower = np.concatenate([self.lower, start, np.full(len(self.last_upper), -np.inf)])
        z, _, status, _ = daqp.solve(
            self.hessian,
            -self.steps.T @ start,
            self.rows,
            np.minimum(upper, NO_BOUND),
            np.maximum(lower, -NO_BOUND),
            self.sense.copy(),
            primal_tol=1e-12,
            dual_tol=1e-12,
        )
        return np.asarray(z)[self.inputs] * self.u_unit if status == 1 else None
