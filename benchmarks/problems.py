"""The problems: from 7 regions to 4,000."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import LinearModel, LinearMPC, PiecewiseAffine
from sb3_yann_envs import problems


@dataclass(eq=False)
class Problem:
    """An MPC problem with its law, solved when it is first asked for.

    Attributes
    ----------
    name : str
    make : callable
    """

    name: str
    make: Callable[[], LinearMPC]

    @cached_property
    def mpc(self) -> LinearMPC:
        """The problem, with whatever it remembers of its solution."""
        return self.make()

    @cached_property
    def law(self) -> PiecewiseAffine:
        """Its explicit law, ready to be asked."""
        _compile()
        return self.mpc.explicit()

    @property
    def regions(self) -> int:
        """Number of regions."""
        return self.law.n_regions

    def points(self, count: int, seed: int = 0) -> Array:
        """Return points drawn uniformly from the part of the box where there is a solution."""
        rng = np.random.default_rng(seed)
        found = np.empty((0, self.law.n_theta))
        while len(found) < count:
            drawn = rng.uniform(self.law.theta_min, self.law.theta_max, (256, self.law.n_theta))
            found = np.concatenate([found, drawn[self.law.in_domain(drawn)]])
        return found[:count]


@cache
def _compile() -> None:
    """Have the compiled parts of solution and search ready, whichever problem comes first."""
    law = double_integrator().explicit()
    law.locate((law.theta_min + law.theta_max) / 2)


def double_integrator() -> LinearMPC:
    """Return the textbook's cart, every bound in force: part of the box has no solution."""
    model = LinearModel([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], 0.1)
    return LinearMPC(
        model, Q=np.eye(2), R=[[0.03]], horizon=6,
        x_min=[-5, -2], x_max=[5, 2], u_min=-1, u_max=1,
    )  # fmt: skip


def two_masses(dt: float, horizon: int, speed_weight: float, R: float) -> LinearMPC:
    """Return two masses between walls on three springs, a bounded force on each."""
    springs = np.array([[-2.0, 1.0], [1.0, -2.0]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [springs, -0.1 * np.eye(2)]])
    B = np.vstack([np.zeros((2, 2)), np.eye(2)])
    return LinearMPC(
        LinearModel.from_continuous(A, B, dt),
        Q=np.diag([1.0, 1.0, speed_weight, speed_weight]), R=R * np.eye(2), horizon=horizon,
        theta_min=[-8] * 4, theta_max=[8] * 4, u_min=[-1, -1], u_max=[1, 1],
    )  # fmt: skip


PROBLEMS = (
    Problem("reactor, N = 2 (4 states, 1 input)", problems.cstr),
    Problem("double integrator, N = 6 (2 states, 1 input)", double_integrator),
    Problem("two masses, N = 4 (4 states, 2 inputs)", lambda: two_masses(1.0, 4, 0.01, 0.01)),
    Problem("two masses, N = 5 (4 states, 2 inputs)", lambda: two_masses(0.5, 5, 1.0, 1.0)),
)
SMALLEST = PROBLEMS[0]
