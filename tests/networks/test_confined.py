"""What networks add to a law counts in a box of theta only, where there is one."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG

from general_problems import solved
from sample_layers import by_loops_and_by_torch, scrambled
from sb3_yann.networks import SharedYannLayer, YannLayer
from twin_samples import problem


def layer_of(kind: str):
    mpc = solved("servo with rates")
    rate = mpc.rate.du_min, mpc.rate.du_max
    if kind == "per_region":
        return mpc, scrambled(YannLayer(mpc.explicit(), (8, 8), rate=rate))
    return mpc, scrambled(SharedYannLayer(mpc.online(), (8, 8), rate=rate))


def drawn(mpc, reach: float, count: int = 300) -> th.Tensor:
    half = reach * mpc.theta_half
    return th.as_tensor(np.random.default_rng(0).uniform(-half, half, (count, mpc.n_theta)))


@pytest.mark.parametrize("kind", ["per_region", "shared"])
def test_within_the_box_nothing_changes_and_far_beyond_it_the_law_acts(kind) -> None:
    mpc, layer = layer_of(kind)
    free = copy.deepcopy(layer)
    half = 0.3 * mpc.theta_half
    layer.confine(-half, half)
    inside = drawn(mpc, 0.3)
    everywhere = drawn(mpc, 1.0)
    assert th.equal(layer(inside), free(inside))
    beyond = (everywhere.abs() / th.as_tensor(half)).amax(1) >= 1.25
    assert 0.1 < beyond.float().mean() < 1
    law = layer.law(everywhere)
    assert th.equal(layer(everywhere)[beyond], law[beyond])
    assert not th.equal(free(everywhere)[beyond], law[beyond])
    layer.confine(None, None)
    assert th.equal(layer(everywhere), free(everywhere))


@pytest.mark.parametrize("kind", ["per_region", "shared"])
def test_loops_and_operations_of_torch_agree_forward_and_backward(kind) -> None:
    mpc, layer = layer_of(kind)
    layer.confine(-0.4 * mpc.theta_half, 0.2 * mpc.theta_half)
    theta = drawn(mpc, 0.6)
    part = layer.confined(theta)
    assert bool(((part > 0) & (part < 1)).any() and (part == 0).any() and (part == 1).any())
    by_loops_and_by_torch(layer, theta)


def test_where_the_law_acts_alone_nothing_is_learnt() -> None:
    mpc, layer = layer_of("shared")
    layer.confine(-0.01 * mpc.theta_half, 0.01 * mpc.theta_half)
    theta = drawn(mpc, 1.0)
    theta = theta[layer.confined(theta)[:, 0] == 0]
    layer(theta).square().sum().backward()
    assert all(not each.grad.any() for each in layer.network.weights())


def test_a_policy_s_box_is_saved_and_what_is_no_box_is_named(tmp_path) -> None:
    model = DDPG("YannPolicy", "CSTR-v0", device="cpu")
    scrambled(model.actor.mu)
    half = model.policy.problem.theta_half
    model.policy.confine_correction(-0.1 * half, 0.1 * half)
    assert th.equal(model.actor_target.mu.confines, model.actor.mu.confines)
    model.save(tmp_path / "model")
    again = DDPG.load(tmp_path / "model", device="cpu")
    theta = np.float32(0.13 * half * np.eye(4))
    np.testing.assert_array_equal(again.predict(theta)[0], model.predict(theta)[0])
    model.policy.confine_correction(None, None)
    assert not np.array_equal(again.predict(theta)[0], model.predict(theta)[0])
    for low, high in ((half, -half), (None, half), (half[:2], half), (-np.inf * half, half)):
        with pytest.raises(ValueError, match="low = "):
            model.policy.confine_correction(low, high)


@pytest.mark.parametrize("kind", [YannLayer, SharedYannLayer])
def test_a_frozen_layer_acts_as_the_layer_and_refuses_another_width(kind: Any) -> None:
    layer = kind(problem().explicit(), (8, 8), max_correction=0.3)
    with th.no_grad():
        for each in layer.network.weights():
            each.add_(0.3 * th.randn(each.shape, generator=th.Generator().manual_seed(0)))
    layer.confine(0.3 * problem().theta_min, 0.4 * problem().theta_max)
    theta = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    theta[7] = np.inf
    with th.no_grad():
        np.testing.assert_array_equal(layer.frozen()(theta), layer(th.as_tensor(theta)).numpy())
    with pytest.raises(ValueError, match=r"theta has shape \(4, 3\), expected \(batch, 2\)"):
        layer.frozen()(np.zeros((4, 3)))
