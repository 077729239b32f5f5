"""One network beside a law: the law at first, bounded, pinned, continuous, and it trains."""

from __future__ import annotations

import copy
from functools import cache

import numpy as np
import pytest
import torch as th

from general_problems import servo, solved
from sample_layers import by_loops_and_by_torch, scrambled, train
from sb3_yann.control import LinearModel, LinearMPC
from sb3_yann.networks import SharedYannLayer
from sb3_yann_envs import problems

LAWS = pytest.mark.parametrize("kind", ["explicit", "online"])


@cache
def reactor() -> LinearMPC:
    return problems.cstr()


def layer_of(mpc: LinearMPC, kind: str, **options) -> SharedYannLayer:
    rate = (mpc.rate.du_min, mpc.rate.du_max) if mpc.has_rate_bounds else None
    return SharedYannLayer(mpc.law(kind), (8, 8), rate=rate, **options)


def drawn(mpc: LinearMPC, count: int = 64) -> th.Tensor:
    theta = np.random.default_rng(0).uniform(mpc.theta_min, mpc.theta_max, (count, mpc.n_theta))
    return th.as_tensor(theta)


def as_inputs(mpc: LinearMPC, actions: th.Tensor) -> np.ndarray:
    low, high = mpc.u_min, mpc.u_max
    return low + (actions.detach().double().numpy() + 1) / 2 * (high - low)


@LAWS
def test_loops_and_operations_of_torch_agree(kind) -> None:
    mpc = solved("servo with rates")
    theta = drawn(mpc)
    for limit in (None, 0.1):
        layer = scrambled(layer_of(mpc, kind, max_correction=limit))
        by_loops_and_by_torch(layer, theta)


def test_the_equilibrium_stays_where_it_is_unless_it_is_not_pinned() -> None:
    origin = th.zeros(1, 4)
    rest = layer_of(reactor(), "online")(origin)
    assert th.equal(scrambled(layer_of(reactor(), "online"))(origin), rest)
    assert not th.equal(scrambled(layer_of(reactor(), "online", pinned=False))(origin), rest)


@LAWS
def test_its_gradient_by_theta_is_its_slope(kind) -> None:
    mpc = servo()
    layer = scrambled(layer_of(mpc, kind), 0.3).double()
    layer.theta_half = layer.theta_half.double()
    theta = drawn(mpc, 40).requires_grad_()
    layer(theta).sum().backward()
    step, slopes = 1e-6, []
    for j in range(mpc.n_theta):
        shift = th.zeros(mpc.n_theta).double()
        shift[j] = step
        slopes.append((layer(theta + shift) - layer(theta - shift)).detach()[:, 0] / (2 * step))
    inside = layer(theta).detach().abs()[:, 0] < 0.999
    assert inside.sum() > 10
    assert th.allclose(theta.grad[inside], th.stack(slopes, 1)[inside], atol=1e-4)


@LAWS
def test_loops_do_not_stand_in_where_a_gradient_by_theta_is_asked_for(kind) -> None:
    layer, theta = scrambled(layer_of(servo(), kind), 0.3), drawn(servo(), 40).float()
    assert layer.network.compiles
    found = []
    for compiles in (True, False):
        layer.network.has_loops, asked = compiles, theta.clone().requires_grad_()
        layer(asked).sum().backward()
        found.append(asked.grad)
    assert found[0].abs().sum() > 0 and th.equal(*found)


def test_it_learns_and_copies() -> None:
    layer, theta = layer_of(reactor(), "online"), drawn(reactor())
    other = copy.deepcopy(layer)
    train(layer, theta, 0.5, steps=30)
    assert other.base_law is layer.base_law
    assert not layer.network.is_zero()
    assert other.network.is_zero()
    other.load_state_dict(layer.state_dict())
    assert th.equal(other(theta), layer(theta))
    assert layer.n_networks == 1
    assert layer.regions(theta).tolist() == [0] * len(theta)


@pytest.mark.filterwarnings("ignore")
def test_it_says_that_it_cannot_be_traced() -> None:
    with pytest.raises(RuntimeError, match="cannot be traced"):
        th.jit.trace(layer_of(reactor(), "online"), drawn(reactor()).float())


def test_inputs_without_bounds_are_refused() -> None:
    mpc = LinearMPC(
        LinearModel([[0.5]], [[1.0]], 1), Q=[[1]], R=[[1]], horizon=2, x_min=-1, x_max=1
    )
    with pytest.raises(ValueError, match="finite bounds on every input"):
        SharedYannLayer(mpc.online())
