"""The critic: the linear plant's state-action value, plus a network that is zero at first."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th

from sample_laws import (
    PROBLEMS,
    box_points,
    in_physical_units,
    law_of,
    random_rows,
    solved,
    to_action,
)
from sb3_yann.networks import QuadraticStateActionValue, Ranges, YannLayer

GAMMAS = pytest.mark.parametrize("gamma", [0.9, 0.99, 1 - 1e-3])
EVERY_PROBLEM = pytest.mark.parametrize("name", PROBLEMS)


def critic(name: str, gamma: float = 0.99) -> QuadraticStateActionValue:
    mpc = solved(name)
    ranges = Ranges((mpc.theta_max - mpc.theta_min) / 2, mpc.u_min, mpc.u_max)
    return QuadraticStateActionValue(mpc.state_action_matrix(gamma), ranges)


def at_rest(name: str) -> th.Tensor:
    law = law_of(name)
    action = to_action(law, np.zeros((1, law.n_inputs)))
    return th.cat([th.zeros(1, law.n_theta), action.float()], dim=1)


def train(value: QuadraticStateActionValue, rows: th.Tensor, steps: int) -> None:
    """Adam steps of 1e-3 towards a return that is not a quadratic form."""
    optimizer = th.optim.Adam(value.parameters(), 1e-3)
    target = 0.7 * value(rows).detach() - 3.0
    for _ in range(steps):
        optimizer.zero_grad()
        (value(rows) - target).square().mean().backward()
        optimizer.step()


def matrix(value: QuadraticStateActionValue) -> th.Tensor:
    """M in physical units, as it now is."""
    return value.quadratic.entries.detach() * th.outer(value.quadratic.root, value.quadratic.root)


# --- at first ----------------------------------------------------------------------------------


@GAMMAS
@EVERY_PROBLEM
def test_value_is_the_quadratic_form_to_the_rounding_of_float32(name: str, gamma: float) -> None:
    rows = random_rows(name, 2000)
    z = np.hstack(in_physical_units(name, rows))
    exact = -np.einsum("bi,ij,bj->b", z, solved(name).state_action_matrix(gamma), z)[:, None]
    with th.no_grad():
        got = critic(name, gamma)(rows)
    assert got.shape == (2000, 1)
    assert got.dtype == th.float32
    np.testing.assert_allclose(got.numpy(), exact, rtol=np.finfo(np.float32).eps, atol=0)


@GAMMAS
@EVERY_PROBLEM
def test_bellmans_equation_holds_along_the_law(name: str, gamma: float) -> None:
    # On the linear plant, from states from which the law stays in the unconstrained region.
    mpc, law = solved(name), law_of(name)
    origin = law.locate(np.zeros(law.n_theta))
    points = box_points(law, 4000).numpy() * np.geomspace(1e-3, 1, 4000)[:, None]
    theta, visits = points.astype(np.float64), np.ones(len(points), dtype=bool)
    for _ in range(2):
        visits &= (law.locate(theta) == origin) & law.in_domain(theta)
        theta = theta @ mpc.model.A.T + law(theta) @ mpc.model.B.T
    start = th.as_tensor(points[visits], dtype=th.float32)
    assert len(start) > 300

    value, actor = critic(name, gamma), YannLayer(law)
    with th.no_grad():
        action = actor(start)
        x, u = in_physical_units(name, th.cat([start, action], 1))
        following = th.as_tensor(x @ mpc.model.A.T + u @ mpc.model.B.T, dtype=th.float32)
        now = value(th.cat([start, action], 1)).double().numpy()
        then = value(th.cat([following, actor(following)], 1)).double().numpy()
    error = now - (-mpc.stage_cost(x, u)[:, None] + gamma * then)
    assert np.mean(error**2) < 1e-12 * np.mean(now**2)


# --- the equilibrium ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pendulum", "reactor"])
def test_value_of_the_equilibrium_is_zero_and_stays_so(name: str) -> None:
    value = critic(name)
    assert value(at_rest(name)).item() == 0
    train(value, random_rows(name, 256), steps=50)
    assert value(at_rest(name)).item() == 0


# --- training ----------------------------------------------------------------------------------


def test_twenty_steps_of_adam_do_not_flip_the_sign_of_the_reactors_smallest_entry() -> None:
    # Raw entries would: M_uu is of the order of 1e-4, one step of Adam is 1e-3.
    value = critic("reactor")
    before = matrix(value).diag()
    assert before.min() < 1e-3
    train(value, random_rows("reactor", 256), steps=20)
    change = matrix(value).diag() / before - 1
    assert change.abs().max() < 0.021
    assert change.abs().min() > 0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((np.zeros(2), -np.ones(1), np.ones(1)), "theta_half"),
        ((np.ones((2, 1)), -np.ones(1), np.ones(1)), "theta_half has shape"),
        ((np.ones(2), np.ones(1), np.ones(1)), "u_min must lie below u_max"),
        ((np.ones(2), -np.ones(1), np.ones(2)), "u_max has shape"),
    ],
)
def test_ranges_that_scale_nothing_are_refused(given, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Ranges(*given)
