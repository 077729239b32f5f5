"""Problems whose explicit law has too many regions: their programs are solved online."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from sb3_yann._validation import Array
from sb3_yann.control import (
    DisturbanceBounds,
    LinearModel,
    LinearMPC,
    OnlineLaw,
    OutputBounds,
    RateLimits,
    SoftBounds,
    Tracking,
)


def chain(masses: int, pushed: Sequence[int], horizon: int) -> LinearMPC:
    """Return unit masses on unit springs from wall to wall, a force of at most 1 on some.

    Positions and speeds are bounded by 4, over the whole horizon. A sample takes 0.5.
    """
    springs = linalg.toeplitz([-2.0, 1.0] + [0.0] * (masses - 2))
    nothing = np.zeros((masses, masses))
    eye = np.eye(masses)
    A = np.block([[nothing, eye], [springs, nothing]])
    B = np.vstack([np.zeros((masses, len(pushed))), eye[:, list(pushed)]])
    return LinearMPC(
        LinearModel.from_continuous(A, B, 0.5),
        Q=np.eye(2 * masses), R=0.1 * np.eye(len(pushed)), horizon=horizon,
        x_min=-4, x_max=4, u_min=-1, u_max=1,
    )  # fmt: skip


def three_masses() -> LinearMPC:
    """Return 6 states and 2 inputs over 10 steps: 160 constraints."""
    return chain(3, (0, 1), 10)


def six_masses() -> LinearMPC:
    """Return 12 states and 3 inputs over 20 steps: 600 constraints."""
    return chain(6, (0, 2, 4), 20)


def wide_plant() -> LinearMPC:
    """Return 10 inputs and 20 outputs with soft bounds over 10 steps: 165 parameters.

    125 slow states, of which each is moved by two inputs, 10 references, 20 disturbances and the
    inputs of the step before, whose change has a bound and a weight.
    """
    rng = np.random.default_rng(0)
    n = 125
    m = 10
    p = 20
    A = np.diag(rng.uniform(0.6, 0.95, n)) + np.diag(rng.uniform(0, 0.04, n - 1), 1)
    B = np.zeros((n, m))
    C = np.zeros((p, n))
    E = np.zeros((n, p))
    for i in range(n):
        B[i, rng.choice(m, 2, replace=False)] = rng.uniform(-0.1, 0.1, 2)
        B[i, i % m] += 0.1
        C[i % p, i] = rng.uniform(0.2, 0.5)
        E[i, i % p] = 0.02
    model = LinearModel(A, B, 1.0, E=E)
    return LinearMPC(
        model, Q=C.T @ C + 1e-3 * np.eye(n), R=0.1 * np.eye(m), horizon=10,
        u_min=-1, u_max=1, theta_min=-2, theta_max=2,
        tracking=Tracking(C[:m], -0.3, 0.3), disturbances=DisturbanceBounds(-1, 1),
        rate=RateLimits(-0.4, 0.4, 0.1 * np.eye(m)),
        outputs=OutputBounds(C, -1, 1), soft=SoftBounds(y=0.2, penalty=300.0),
    )  # fmt: skip


@dataclass(eq=False)
class OnlineProblem:
    """A problem with its online law; what is measured of it is named by its size.

    Attributes
    ----------
    name : str
    make : callable
    """

    name: str
    make: Callable[[], LinearMPC]

    @cached_property
    def mpc(self) -> LinearMPC:
        """The problem, which keeps to its online law."""
        mpc = self.make()
        mpc.law("online")
        return mpc

    @property
    def law(self) -> OnlineLaw:
        """Its law."""
        return self.mpc.online()

    def points(self, count: int, seed: int = 0) -> Array:
        """Return feasible points drawn uniformly from the middle of the box, half as wide."""
        return points(self.mpc, count, seed)


def points(mpc: LinearMPC, count: int, seed: int = 0) -> Array:
    """Return feasible points drawn uniformly from the middle of the box, half as wide."""
    rng = np.random.default_rng(seed)
    law = mpc.online()
    found: Array = np.empty((0, mpc.n_theta))
    while len(found) < count:
        drawn = rng.uniform(mpc.theta_min, mpc.theta_max, (256, mpc.n_theta)) / 2
        found = np.concatenate([found, drawn[law.in_domain(drawn)]])
    return found[:count]


def worst_condition(law: OnlineLaw, theta: Array) -> tuple[float, float]:
    """Return by how much optimality fails, and the largest error of an input, of its range.

    The plan for the constraints that the law holds to be active is solved for in the units of the
    input range, without any of the law's own matrices. It is the optimum where slacks and
    multipliers are positive; negative ones count by their size.
    """
    units = np.tile((law.u_max - law.u_min) / 2, (len(law.c) - law.n_slacks) // law.n_inputs)
    units = np.concatenate([units, np.ones(law.n_slacks)])
    worst = 0.0
    error = 0.0
    H = law.H * np.outer(units, units)
    G = law.G * units
    found = law.dual.solve(theta)
    inputs = law(theta)
    for k, at in enumerate(theta):
        active = law.dual.rows[found.active[k, : found.sizes[k]]]
        left = np.block([[H, G[active].T], [G[active], np.zeros((len(active), len(active)))]])
        right = [-(law.F @ at + law.c) * units, law.w[active] + law.S[active] @ at]
        solution = np.linalg.solve(left, np.concatenate(right))
        plan = solution[: len(H)]
        multipliers = solution[len(H) :]
        slack = law.w + law.S @ at - G @ plan
        size = max(1.0, float(np.abs(multipliers).max(initial=0.0)))
        worst = max(worst, -slack.min(), -multipliers.min(initial=0.0) / size)
        apart = (units * plan)[: law.n_inputs] - inputs[k]
        error = max(error, float(np.max(np.abs(apart) / (law.u_max - law.u_min))))
    return float(worst), error


PROBLEMS = (
    OnlineProblem("6 states, N = 10", three_masses),
    OnlineProblem("12 states, N = 20", six_masses),
    OnlineProblem("165 parameters, N = 10", wide_plant),
)
