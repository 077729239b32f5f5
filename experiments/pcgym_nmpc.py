"""A nonlinear MPC for PC-Gym's plants: it knows the equations, not the next set-point."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from experiments.pcgym import Case
    from sb3_yann_envs.pcgym import PCGymEnv

HORIZON = 15  # samples
ELEMENTS = 4
DEGREE = 3
"""Of the polynomials in a sample, at Radau's points."""
OPTIONS = {"print_time": 0, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 60,
           "ipopt.tol": 1e-6}  # fmt: skip


class NonlinearMPC:
    """Direct collocation, solved by IPOPT; from theta of a case to its inputs.

    Squared errors weigh 1,000, as in the linear MPC, and moves of the inputs, in parts of their
    range, 1e-4. States and inputs are scaled by their ranges. See Biegler, Nonlinear Programming
    (2010), chapter 10.
    """

    def __init__(self, case: Case) -> None:
        import casadi

        self.plant = case.plant
        self.mpc = case.mpc
        n = len(self.plant.x0)
        m = len(self.plant.u_min)
        p = len(self.plant.outputs)
        self.n = n
        self.m = m
        self.inner = n * DEGREE * ELEMENTS
        low, width = self.plant._box()
        self.low = low
        self.width = width
        V = casadi.MX.sym("V", m, HORIZON)
        Z = casadi.MX.sym("Z", self.inner, HORIZON)
        first = casadi.MX.sym("first", n)
        wanted = casadi.MX.sym("wanted", p)
        sample = collocated(self.plant)
        outputs = self.plant.outputs
        s = (first - low[:n]) / width[:n]
        cost = 0
        gaps = []
        for k in range(HORIZON):
            s, gap = sample(s, V[:, k], Z[:, k])
            error = low[outputs] + width[outputs] * s[outputs] - wanted
            moved = V[:, k] - V[:, max(k - 1, 0)]
            cost += 1e3 * casadi.sumsqr(error) + 1e-4 * casadi.sumsqr(moved)
            gaps.append(gap)
        program = {
            "x": casadi.veccat(V, Z), "p": casadi.vertcat(first, wanted),
            "f": cost, "g": casadi.vertcat(*gaps),
        }  # fmt: skip
        self.solve = casadi.nlpsol("plan", "ipopt", program, OPTIONS)
        free = np.full(self.inner * HORIZON, 5.0)  # states, far beyond their ranges
        lowest = np.zeros(m * HORIZON)
        highest = np.ones(m * HORIZON)
        self.limits = {
            "lbx": np.append(lowest, -free), "ubx": np.append(highest, free), "lbg": 0, "ubg": 0,
        }  # fmt: skip
        self.plans: dict[int, Any] = {}

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        """Return inputs (batch, m); each row goes on with its own plan."""
        given = np.atleast_2d(theta)
        found = np.array([self.low[self.n :] + self._next(i, row) for i, row in enumerate(given)])
        return found.reshape(*np.shape(theta)[:-1], self.m)

    def _next(self, i: int, row: np.ndarray) -> np.ndarray:
        """Return how far above their least the inputs (m,) of the i-th episode are to be."""
        if i not in self.plans:
            s = (row[: self.n] - self.low[: self.n]) / self.width[: self.n]
            still = np.tile(s, DEGREE * ELEMENTS * HORIZON)
            self.plans[i] = np.append(np.full(self.m * HORIZON, 0.5), still)
        known = row[: self.n + len(self.plant.outputs)]
        plan = np.array(self.solve(x0=self.plans[i], p=known, **self.limits)["x"]).ravel()
        V, Z = np.split(plan, [self.m * HORIZON])
        later = V[self.m :], V[-self.m :], Z[self.inner :], Z[-self.inner :]
        self.plans[i] = np.concatenate(later)
        return np.asarray(self.width[self.n :] * np.clip(V[: self.m], 0, 1))


def collocated(plant: PCGymEnv) -> Any:
    """Return CasADi's function of a sample: where it ends, and what its states miss.

    It takes the first states (n,), the inputs (m,) and the states at the inner points, all in
    parts of their ranges.
    """
    import casadi

    n = len(plant.x0)
    m = len(plant.u_min)
    low, width = plant._box()
    C, D, _ = casadi.collocation_coeff(casadi.collocation_points(DEGREE, "radau"))
    x = casadi.SX.sym("x", n)
    v = casadi.SX.sym("v", m)
    z = casadi.SX.sym("z", n, DEGREE * ELEMENTS)
    u = low[n:] + width[n:] * v
    end = x
    gaps = []
    for e in range(ELEMENTS):
        points = casadi.horzcat(end, z[:, e * DEGREE : (e + 1) * DEGREE])
        slopes = points @ C
        end = points @ D
        for i in range(DEGREE):
            rate = plant._rate(low[:n] + width[:n] * points[:, i + 1], u) / width[:n]
            gaps.append(slopes[:, i] - plant.dt / ELEMENTS * rate)
    return casadi.Function("sample", [x, v, casadi.vec(z)], [end, casadi.vertcat(*gaps)])
