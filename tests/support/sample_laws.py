"""Laws to build networks from, points to try them at, and a few steps of training."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch as th
from numpy.typing import NDArray

import sample_problems
from sb3_yann import LinearMPC
from sb3_yann.control import PiecewiseAffine
from sb3_yann.networks import AfterstateValue, LinearPrediction, Ranges, YannLayer
from sb3_yann.networks.value import PredictionModel
from sb3_yann_envs import cstr, problems

Array = NDArray[np.float64]


PROBLEMS: dict[str, Callable[[], LinearMPC]] = {
    "pendulum": problems.clipped_pendulum,
    "reactor": problems.cstr,
    "asymmetric bounds": sample_problems.PROBLEMS["asymmetric input bounds"],
    "two inputs": sample_problems.PROBLEMS["two inputs"],
}
solved = sample_problems.kept(PROBLEMS)
EVERY_LAW = pytest.mark.parametrize("name", PROBLEMS)
INFEASIBLE = pytest.mark.parametrize("infeasible", ["nearest_region", "zero_input"])


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


def law_of(name: str, infeasible: str = "nearest_region") -> PiecewiseAffine:
    return replace(solved(name).explicit(), infeasible=infeasible)


def box_points(law: PiecewiseAffine, count: int, stretch: float = 1.0, seed: int = 0) -> th.Tensor:
    """Points (count, n) in float32, uniform in the box of parameters, or in one ``stretch`` it."""
    rng = np.random.default_rng(seed)
    middle = (law.theta_max + law.theta_min) / 2
    half = (law.theta_max - law.theta_min) / 2
    points = middle + stretch * half * rng.uniform(-1, 1, (count, law.n_theta))
    return th.as_tensor(points, dtype=th.float32)


def ranges_of(name: str) -> Ranges:
    mpc = solved(name)
    return Ranges((mpc.theta_max - mpc.theta_min) / 2, mpc.u_min, mpc.u_max)


def critic_of(
    name: str, gamma: float = 0.99, model: PredictionModel | None = None, **changes: Any
) -> AfterstateValue:
    mpc = solved(name)
    costs = mpc.stage_matrix, mpc.value_matrix(gamma)
    model = model or LinearPrediction(*mpc.prediction)
    return AfterstateValue(*costs, model, gamma, ranges_of(name), **changes)


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


def scrambled(layer: YannLayer, size: float = 1.0) -> YannLayer:
    """The layer with random weights, as after much training."""
    for parameter in layer.parameters():
        th.nn.init.normal_(parameter, std=size)
    return layer


def region_of(layer: YannLayer, theta: th.Tensor) -> th.Tensor:
    return layer.locate(theta)[0]


def train(layer: YannLayer, theta: th.Tensor, target: float, steps: int = 20) -> None:
    optimizer = th.optim.Adam(layer.parameters(), 1e-2)
    for _ in range(steps):
        optimizer.zero_grad()
        (layer(theta) - target).square().mean().backward()
        optimizer.step()


def by_loops_and_by_torch(layer: YannLayer, theta: th.Tensor) -> th.Tensor:
    """Assert that compiled loops and torch give the same actions and gradients; return actions."""
    found = []
    for compiles in (True, False):
        layer.network.has_loops = compiles
        layer.zero_grad()
        actions = layer(theta)
        (actions - 0.3).square().sum().backward()
        found.append([actions, *[each.grad.clone() for each in layer.network.weights()]])
    for ours, theirs in zip(*found, strict=True):
        th.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)
    return found[0][0]
