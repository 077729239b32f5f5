"""Problems whose explicit law has too many regions: their programs are solved online."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import linalg

from sb3_yann._validation import Array
from sb3_yann.control import (
    DisturbanceBounds,
    LinearModel,
    LinearMPC,
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
    nothing, eye = np.zeros((masses, masses)), np.eye(masses)
    A = np.block([[nothing, eye], [springs, nothing]])
    B = np.vstack([np.zeros((masses, len(pushed))), eye[:, list(pushed)]])
    size = {"Q": np.eye(2 * masses), "R": 0.1 * np.eye(len(pushed)), "horizon": horizon}
    bounds = {"x_min": -4, "x_max": 4, "u_min": -1, "u_max": 1}
    return LinearMPC(LinearModel.from_continuous(A, B, 0.5), **size, **bounds)


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
    rng, n, m, p = np.random.default_rng(0), 125, 10, 20
    A = np.diag(rng.uniform(0.6, 0.95, n)) + np.diag(rng.uniform(0, 0.04, n - 1), 1)
    B, C, E = np.zeros((n, m)), np.zeros((p, n)), np.zeros((n, p))
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


PROBLEMS = {
    "three masses, N = 10 (6 states, 2 inputs)": three_masses,
    "six masses, N = 20 (12 states, 3 inputs)": six_masses,
    "wide plant, N = 10 (165 parameters, 10 inputs)": wide_plant,
}


def points(mpc: LinearMPC, count: int, seed: int = 0) -> Array:
    """Return feasible points drawn uniformly from the middle half of the box."""
    rng, law, found = np.random.default_rng(seed), mpc.online(), np.empty((0, mpc.n_theta))
    while len(found) < count:
        drawn = rng.uniform(mpc.theta_min, mpc.theta_max, (256, mpc.n_theta)) / 2
        found = np.concatenate([found, drawn[law.in_domain(drawn)]])
    return found[:count]
