"""Laws to build networks from, and points to try them at."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_yann import LinearModel, LinearMPC
from sb3_yann.control import PiecewiseAffine
from sb3_yann_envs import cstr, problems

Array = NDArray[np.float64]


def _asymmetric_bounds() -> LinearMPC:
    model = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1)
    # The middle of the inputs is 0.5 and the reach 1.5: u = 0 is the action -1/3.
    return LinearMPC(
        model,
        Q=np.eye(2),
        R=[[0.1]],
        horizon=3,
        x_min=[-3, -2],
        x_max=[2, 3],
        u_min=-1.0,
        u_max=2.0,
    )


def _two_inputs() -> LinearMPC:
    model = LinearModel([[1.1, 0.2], [-0.1, 0.9]], [[1, 0.1], [0.2, 0.8]], 0.1)
    return LinearMPC(
        model,
        Q=np.eye(2),
        R=np.diag([0.1, 0.5]),
        horizon=2,
        x_min=-4.0,
        x_max=4.0,
        u_min=[-1, -0.5],
        u_max=[0.5, 2],
    )


PROBLEMS: dict[str, Callable[[], LinearMPC]] = {
    "pendulum": problems.clipped_pendulum,
    "reactor": problems.cstr,
    "asymmetric bounds": _asymmetric_bounds,
    "two inputs": _two_inputs,
}


@cache
def reactor_in_plant_units() -> LinearMPC:
    """Return the reactor's MPC with its operating point."""
    mpc = problems.cstr()
    x = cstr.X_SS
    u = cstr.U_SS
    return replace(
        mpc,
        model=replace(mpc.model, x_ss=x, u_ss=u),
        u_min=mpc.u_min + u,
        u_max=mpc.u_max + u,
        theta_min=mpc.theta_min + x,
        theta_max=mpc.theta_max + x,
    )


@cache
def solved(name: str) -> LinearMPC:
    """One of the problems, with its law; the same object for all tests."""
    mpc = PROBLEMS[name]()
    mpc.explicit()
    return mpc


def law_of(name: str, infeasible: str = "nearest_region") -> PiecewiseAffine:
    return replace(solved(name).explicit(), infeasible=infeasible)


def box_points(law: PiecewiseAffine, count: int, stretch: float = 1.0, seed: int = 0) -> th.Tensor:
    """Points (count, n) in float32, uniform in the box of parameters, or in one ``stretch`` it."""
    rng = np.random.default_rng(seed)
    middle = (law.theta_max + law.theta_min) / 2
    half = (law.theta_max - law.theta_min) / 2
    points = middle + stretch * half * rng.uniform(-1, 1, (count, law.n_theta))
    return th.as_tensor(points, dtype=th.float32)


def random_rows(name: str, count: int) -> th.Tensor:
    """Rows [theta, a] over the box and all actions."""
    theta = box_points(law_of(name), count)
    return th.cat([theta, 2 * th.rand(count, law_of(name).n_inputs) - 1], dim=1)


def in_physical_units(name: str, rows: th.Tensor) -> tuple[Array, Array]:
    """Such rows as parameters and inputs, in float64."""
    law = law_of(name)
    theta, action = np.split(rows.double().numpy(), [law.n_theta], axis=1)
    return theta, (law.u_max + law.u_min) / 2 + action * (law.u_max - law.u_min) / 2


def smallest_slack(law: PiecewiseAffine, theta: th.Tensor) -> Array:
    """How far each point lies inside each region (count, p), negative outside."""
    slack = law.b - theta.double().numpy() @ law.A.T
    return np.stack([part.min(axis=1) for part in np.split(slack, law.starts[1:], axis=1)], axis=1)


def to_action(law: PiecewiseAffine, u: Array) -> th.Tensor:
    """Inputs in physical units as actions, u_min at -1 and u_max at 1."""
    return th.as_tensor(2 * (u - law.u_min) / (law.u_max - law.u_min) - 1)


def facet_points(law: PiecewiseAffine, count: int = 4000) -> th.Tensor:
    """Float32 points on facets that two regions share, to the rounding of float32.

    Random segments of the feasible set are bisected, in float64, to where the region changes.
    """
    ends = box_points(law, 2 * count, seed=1).double().numpy()
    ends = ends[law.in_domain(ends)]
    a = ends[: len(ends) // 2]
    b = ends[len(ends) // 2 : 2 * (len(ends) // 2)]
    crossing = law.locate(a) != law.locate(b)
    a = a[crossing]
    b = b[crossing]
    start = law.locate(a)
    for _ in range(60):
        middle = (a + b) / 2
        same = (law.locate(middle) == start)[:, None]
        a = np.where(same, middle, a)
        b = np.where(same, b, middle)
    return th.as_tensor(a, dtype=th.float32)
