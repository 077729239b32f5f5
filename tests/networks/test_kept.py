"""What networks add to a law keeps the hard bounds of the model, whatever they have learnt."""

import copy
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG

import general_problems
import sample_problems
from general_problems import PUMPS, solved
from sample_laws import by_loops_and_by_torch, scrambled
from sb3_yann import LinearModel, LinearMPC, MixedBounds, OutputBounds, Tracking
from sb3_yann.control.mpc.bound_excess import Bounds, mixed_beyond
from sb3_yann.networks import SharedYannLayer, YannLayer
from twin_samples import problem
from weights import shake


@cache
def cart() -> LinearMPC:
    """A cart with a speed limit and a place to go to; its horizon is too short to brake in."""
    model = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1)
    limits = {"x_min": [-5, -1], "x_max": [5, 1], "u_min": -1, "u_max": 1}
    track = Tracking([0], -5, 5)
    return LinearMPC(model, Q=np.eye(2), R=[[0.1]], horizon=3, tracking=track, **limits)


def spring(**limits: Any) -> LinearMPC:
    """A mass on a spring with a bounded output, whose MPC alone breaks it from some states."""
    limits = limits or {"outputs": OutputBounds([[1, 0.5]], -0.6, 0.8)}
    model = LinearModel([[0.995, 0.0998], [-0.0998, 0.985]], [[0.005], [0.0998]], 0.1)
    return LinearMPC(
        model, Q=np.diag([10, 1]), R=[[0.1]], horizon=5, theta_min=[-2, -2], theta_max=[2, 2],
        u_min=-1, u_max=1, **limits,
    )  # fmt: skip


CASES = {
    "cart": cart,
    "spring": spring,
    "spring, mixed": lambda: spring(mixed=MixedBounds([[1e-8, 5e-9]], low=-6e-9, high=8e-9)),
    "spring, mixed with inputs": lambda: spring(
        mixed=MixedBounds([[1e-8, 5e-9]], [[5e-9]], -6e-9, 8e-9)
    ),
    "references, loads and rates": lambda: general_problems.solved("servo with all of it"),
    "two tanks": lambda: general_problems.solved("two tanks, all parts"),
    "terminal set": lambda: general_problems.solved("invariant with all of it"),
    "unstable": lambda: sample_problems.solved("unstable, part of the box infeasible"),
}


def layer_of(mpc: LinearMPC, kind=SharedYannLayer, **options):
    rate = (mpc.rate.du_min, mpc.rate.du_max) if mpc.has_rate_bounds else None
    options = {"kept": mpc.kept_set, "pinned": False, **options}
    return kind(mpc.law(), (8, 8), rate=rate, **options)


def drawn(mpc: LinearMPC, reach: float = 1.0, count: int = 400) -> np.ndarray:
    middle = (mpc.theta_max + mpc.theta_min) / 2
    half = reach * mpc.theta_half
    return middle + np.random.default_rng(0).uniform(-half, half, (count, mpc.n_theta))


def pushing(layer, towards) -> None:
    """Let the networks push the inputs towards something, with all that they have."""
    with th.no_grad():
        for each in layer.network.weights():
            each.zero_()
        layer.network.weights()[-1][..., -1] = th.as_tensor(towards, dtype=th.float32)


def largest_excess(mpc: LinearMPC, act, steps: int = 80) -> float:
    """Return the largest excess of hard bounds, in half-widths, from states where none need be.

    The reference leaps every seven steps. The plant is its model.
    """
    rng = np.random.default_rng(1)
    parts = mpc.layout
    kept = mpc.kept_set
    bounds = Bounds.of(mpc)
    A, B = mpc.prediction
    alone = not np.any(mpc.mixed.G)  # a row of states alone holds from the next step on
    theta = drawn(mpc, count=4000)
    theta = theta[(theta @ kept.F.T <= kept.g).all(axis=1)][:100]
    assert len(theta) == 100
    found = 0.0
    for t in range(steps):
        if t % 7 == 0 and parts.reference.stop > parts.reference.start:
            low = mpc.theta_min[parts.reference]
            high = mpc.theta_max[parts.reference]
            theta[:, parts.reference] = rng.uniform(low, high, (len(theta), len(low)))
        inputs = act(theta)
        after = theta @ A.T + inputs @ B.T
        beyond = np.abs(bounds.beyond(after))[:, bounds.softness <= 0]
        mixed = mixed_beyond(mpc, after if alone else theta, 0 * inputs if alone else inputs)
        found = max(found, float(beyond.max(initial=0)), float(np.abs(mixed).max(initial=0)))
        theta = after
    return found


def inputs_of(mpc: LinearMPC, layer):
    middle = (mpc.u_max + mpc.u_min) / 2
    half = (mpc.u_max - mpc.u_min) / 2
    act = layer.frozen()
    return lambda theta: middle + half * act(theta)


@pytest.mark.parametrize("name", CASES)
def test_any_weights_keep_the_bounds_of_a_plant_that_is_its_model(name):
    mpc = CASES[name]()
    layer = layer_of(mpc)
    free = layer_of(mpc, kept=None)
    broken = 0.0
    m = mpc.model.n_inputs
    for seed in range(3):
        generator = th.Generator().manual_seed(seed)
        with th.no_grad():
            for each in layer.network.weights():
                each.copy_(10.0 ** (3 * seed) * th.randn(each.shape, generator=generator))
        free.network.load_state_dict(layer.network.state_dict())
        assert largest_excess(mpc, inputs_of(mpc, layer)) < 2e-6  # 1e-6 of the range
        broken = max(broken, largest_excess(mpc, inputs_of(mpc, free), 20))
    for towards in (np.full(m, 9.0), np.full(m, -9.0), 9.0 * (-1.0) ** np.arange(m)):
        pushing(layer, towards)
        assert largest_excess(mpc, inputs_of(mpc, layer)) < 2e-6
    assert broken > 0.1


@pytest.mark.parametrize("kind", [YannLayer, SharedYannLayer])
def test_what_pushes_over_a_bound_that_the_law_rides_goes_along_it(kind):
    """Which rounding does not decide: that is how far a few actions are beyond the bound."""
    layer = layer_of(general_problems.solved("level"), kind)
    pushing(layer, [0.4, 0.0])
    theta = np.column_stack([np.linspace(0.8, 1, 50), np.full(50, 2.0)])
    law = layer.law(th.as_tensor(theta)).numpy()
    np.testing.assert_allclose(theta[:, 0] + law @ PUMPS, 1, atol=1e-6)
    along = np.array([PUMPS[1], -PUMPS[0]]) / np.hypot(*PUMPS)
    moved = by_loops_and_by_torch(layer, th.as_tensor(theta)).detach().numpy() - law
    np.testing.assert_allclose(moved, 0.4 * along[0] * along + np.zeros((50, 2)), atol=1e-6)


@pytest.mark.parametrize("kind", [YannLayer, SharedYannLayer])
@pytest.mark.parametrize("name", ["spring", "references, loads and rates", "two tanks"])
def test_at_first_it_is_the_law_and_loops_agree_with_operations_of_torch(name, kind):
    mpc = CASES[name]()
    layer = layer_of(mpc, kind)
    theta = th.as_tensor(drawn(mpc, 1.3))
    assert th.equal(layer(theta), layer.law(theta))
    scrambled(layer)
    free = layer_of(mpc, kind, kept=None)
    free.network.load_state_dict(layer.network.state_dict())
    changed = (by_loops_and_by_torch(layer, theta) != free(theta)).any(1)
    assert 0.02 < changed.float().mean() < 0.9


@pytest.mark.parametrize("margin", [0.0, 0.03])
def test_no_bound_is_nearer_than_the_margin_unless_it_is_to_the_law(margin):
    mpc = CASES["two tanks"]()
    layer = scrambled(layer_of(mpc))
    A, B = mpc.prediction
    layer.keep(margin)
    theta = drawn(mpc, 2.0, 2000)
    theta[:, mpc.layout.previous] = drawn(mpc, 1.0, 2000)[:, mpc.layout.previous]
    middle = (mpc.u_max + mpc.u_min) / 2
    half = (mpc.u_max - mpc.u_min) / 2
    F = mpc.kept_set.F
    g = mpc.kept_set.g
    with th.no_grad():
        points = th.as_tensor(theta)
        law = layer.law(points).double().numpy()
        actions = layer(points).double().numpy()
    slack = [g - (theta @ A.T + (middle + half * a) @ B.T) @ F.T for a in (law, actions)]
    assert np.mean(slack[0] < 0) > 0.05 and not np.array_equal(law, actions)
    assert np.all(slack[1] >= np.minimum(slack[0], 0) - 1e-6)
    held = slack[0] >= 0
    assert np.all(slack[1][held] >= np.minimum(slack[0][held], margin) - 1e-6)
    assert np.mean(slack[1] < margin + 1e-3) > 0.01


def test_a_gradient_leads_back_from_a_bound_and_not_beyond_it():
    mpc = cart()
    layer = layer_of(mpc)
    theta = th.tensor([[0.0, 0.95, 5.0]])  # next to the speed limit: 0.5 of the input is left
    for towards, moves in ((9.0, True), (-9.0, False)):
        pushing(layer, 5.0)
        layer.zero_grad()
        action = layer(theta)
        assert abs(action.item() - 0.5) < 1e-4
        (towards * action.sum()).backward()
        assert bool(layer.network.weights()[-1].grad.any()) is moves


def confined_layer(kind: str):
    mpc = solved("servo with rates")
    layer = YannLayer if kind == "per_region" else SharedYannLayer
    return mpc, scrambled(layer_of(mpc, layer, kept=None, pinned=True))


def drawn_in(mpc, reach: float, count: int = 300) -> th.Tensor:
    half = reach * mpc.theta_half
    return th.as_tensor(np.random.default_rng(0).uniform(-half, half, (count, mpc.n_theta)))


@pytest.mark.parametrize("kind", ["per_region", "shared"])
def test_within_the_box_nothing_changes_and_far_beyond_it_the_law_acts(kind) -> None:
    mpc, layer = confined_layer(kind)
    free = copy.deepcopy(layer)
    half = 0.3 * mpc.theta_half
    layer.confine(-half, half)
    inside = drawn_in(mpc, 0.3)
    everywhere = drawn_in(mpc, 1.0)
    assert th.equal(layer(inside), free(inside))
    beyond = (everywhere.abs() / th.as_tensor(half)).amax(1) >= 1.25
    assert 0.1 < beyond.float().mean() < 1
    law = layer.law(everywhere)
    assert th.equal(layer(everywhere)[beyond], law[beyond])
    assert not th.equal(free(everywhere)[beyond], law[beyond])
    layer.confine(None, None)
    assert th.equal(layer(everywhere), free(everywhere))


@pytest.mark.parametrize("kind", ["per_region", "shared"])
def test_loops_and_torch_agree_and_where_the_law_acts_alone_nothing_is_learnt(kind) -> None:
    mpc, layer = confined_layer(kind)
    layer.confine(-0.4 * mpc.theta_half, 0.2 * mpc.theta_half)
    theta = drawn_in(mpc, 0.6)
    part = layer.confined(theta)
    assert bool(((part > 0) & (part < 1)).any() and (part == 0).any() and (part == 1).any())
    by_loops_and_by_torch(layer, theta)
    layer.zero_grad()
    layer(theta[part[:, 0] == 0]).square().sum().backward()
    assert not any(each.grad.to_dense().any() for each in layer.network.weights())


def test_a_policy_s_box_is_saved_and_what_is_no_box_is_named(tmp_path) -> None:
    model = DDPG("YannPolicy", "CSTR-v0")
    scrambled(model.actor.mu)
    half = model.policy.problem.theta_half
    model.policy.confine_correction(-0.1 * half, 0.1 * half)
    assert th.equal(model.actor_target.mu.confines, model.actor.mu.confines)
    model.save(tmp_path / "model")
    again = DDPG.load(tmp_path / "model")
    theta = np.float32(0.13 * half * np.eye(4))
    np.testing.assert_array_equal(again.predict(theta)[0], model.predict(theta)[0])
    model.policy.confine_correction(None, None)
    assert not np.array_equal(again.predict(theta)[0], model.predict(theta)[0])
    for low, high in ((half, -half), (None, half), (half[:2], half), (-np.inf * half, half)):
        with pytest.raises(ValueError, match="low"):
            model.policy.confine_correction(low, high)


@pytest.mark.parametrize("kind", [YannLayer, SharedYannLayer])
def test_a_frozen_layer_acts_and_a_compiled_one_descends_as_the_layer(kind: Any) -> None:
    layer = kind(problem().explicit(), (8, 8), max_correction=0.3)
    shake(layer, 0.3)
    layer.confine(0.3 * problem().theta_min, 0.4 * problem().theta_max)
    theta = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    theta[7] = np.inf
    with th.no_grad():
        acts = layer(th.as_tensor(theta)).numpy()
        np.testing.assert_array_equal(layer.frozen()(theta), acts)
    with pytest.raises(ValueError, match=r"theta has shape \(4, 3\), expected \(batch, 2\)"):
        layer.frozen()(np.zeros((4, 3)))
    at = th.as_tensor(theta)[th.isfinite(th.as_tensor(acts[:, 0]))]
    wanted = layer(at).detach().neg()
    own = copy.deepcopy(layer)
    own.network.has_loops = False
    for each in (layer, own):
        each.descend(at, wanted, 0.1, [(np.arange(k, k + 40), 1e-3) for k in range(9)])
    after = layer(at).detach()
    assert 1e-3 < float((after + wanted).abs().max()) < 0.1
    np.testing.assert_allclose(after, own(at).detach(), atol=1e-6)
