"""Actor and critic in SB3: their networks, rates and optimizers, and the critic's warm-up."""

import copy

import cloudpickle
import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, TD3

from policy_samples import (
    CRITICS,
    POLICIES,
    build,
    changed,
    scalar_mpc,
    starts,
    two_inputs,
    updates,
    with_full_buffer,
)
from sample_plants import LinearPlant
from sb3_yann import NoActionNoise, YannActor, YannCritic, YannPolicy
from sb3_yann.networks import AfterstateValue, QuadraticStateActionValue, RowAdam
from weights import network_of


@POLICIES
@CRITICS
@pytest.mark.parametrize("n_critics", [1, 2])
def test_actor_and_critic_are_those_of_sb3_with_yann_networks(algorithm, critic, n_critics) -> None:
    kwargs = {"critic": critic, "n_critics": n_critics, "critic_warmup": 0}
    model = build(algorithm, policy_kwargs=kwargs, seed=0)
    assert isinstance(model.actor, YannActor)
    assert isinstance(model.critic, YannCritic)
    network = {"afterstate": AfterstateValue, "state_action": QuadraticStateActionValue}[critic]
    for each in (model.critic, model.critic_target):
        assert [type(q) for q in each.q_networks] == [network] * n_critics
    before = copy.deepcopy(model.policy)
    model.learn(60, callback=NoActionNoise())
    for name in ("actor", "actor_target", "critic", "critic_target"):
        assert changed(getattr(model.policy, name), getattr(before, name)), name


def first_step(network) -> float:
    before = [p.clone() for p in network.parameters()]
    for p in network.parameters():
        p.grad = th.ones_like(p)
    network.optimizer.state.clear()
    network.optimizer.step()
    steps = [(a - b).detach() for a, b in zip(before, network.parameters(), strict=True)]
    np.testing.assert_allclose(steps[-1], float(steps[0].mean()), rtol=1e-2)
    return float(steps[0].mean())


def again(model, way, folder):
    """Return the policy of a model: itself, or after a copy or a file."""
    if way == "deep copy":
        return copy.deepcopy(model.policy)
    if way == "pickle":
        return cloudpickle.loads(cloudpickle.dumps(model.policy))
    if way == "saved and loaded":
        model.save(folder / "model")
        return DDPG.load(folder / "model").policy
    return model.policy


@pytest.mark.parametrize("way", ["as built", "deep copy", "pickle", "saved and loaded"])
def test_actor_and_critic_step_at_their_own_rates(way, tmp_path) -> None:
    mpc = scalar_mpc()
    kwargs = {"problem": mpc, "actor_lr_mult": 0.1, "critic_lr_mult": 0.5, "critic_warmup": 0}
    model = DDPG(YannPolicy, LinearPlant(mpc), learning_rate=1e-2, policy_kwargs=kwargs)
    policy = again(model, way, tmp_path)
    assert first_step(policy.actor) == pytest.approx(1e-3, rel=1e-2)
    assert first_step(policy.critic) == pytest.approx(5e-3, rel=1e-2)
    assert policy.actor.optimizer.param_groups[0]["lr"] == 1e-2  # SB3's own, untouched


def test_the_actors_loss_leaves_the_critic_alone_which_still_learns() -> None:
    model = build(policy_kwargs={"critic_warmup": 0})
    critic = model.critic
    theta = th.rand(32, model.observation_space.shape[0])
    actions = th.zeros(32, model.action_space.shape[0], requires_grad=True)
    q = critic.q1_forward(theta, actions)
    th.testing.assert_close(q, critic(theta, actions)[0], rtol=0, atol=0)
    q.sum().backward()
    assert bool((actions.grad != 0).any())
    assert all(each.grad is None and each.requires_grad for each in critic.parameters())
    critic(theta, actions)[0].sum().backward()
    assert all(each.grad is not None for each in critic.parameters())


def test_constants_are_no_parameters_and_target_updates_leave_them_alone() -> None:
    model = build()
    learnt = {name for name, _ in model.actor.named_parameters()}
    assert all(name.startswith("mu.network.") for name in learnt)
    assert isinstance(model.critic.qf0, AfterstateValue)  # by default
    learnt = {name.split(".")[1] for name, _ in model.critic.named_parameters()}
    assert learnt == {"quadratic", "network"}
    assert not any("running_" in name for name in model.policy.state_dict())


@CRITICS
@pytest.mark.parametrize("policy_delay", [1, 2])
def test_the_actor_stays_the_mpc_bit_for_bit_until_the_critic_is_warm(policy_delay, critic) -> None:
    model = with_full_buffer(TD3, two_inputs(), critic=critic, critic_warmup=6)
    model.policy_delay = policy_delay
    first = copy.deepcopy(model.policy)
    theta = th.as_tensor(starts(two_inputs()))
    law = first.actor(theta)
    for _ in range(5):
        updates(model, 1)
        assert not changed(model.actor, first.actor)
        assert th.equal(model.actor(theta), law)
        assert th.equal(model.actor_target(theta), law)
        assert not model.actor.optimizer.state
        assert changed(model.critic, first.critic)
    updates(model, 1)  # the sixth of the critic, and then the actor's first
    assert changed(model.actor, first.actor)
    assert not th.equal(model.actor(theta), law)
    assert {int(state["steps"].max()) for state in model.actor.optimizer.state.values()} == {1}
    updates(model, 2)  # the first step moves one layer of zeros only
    assert not th.equal(model.actor_target(theta), law)


@pytest.mark.parametrize("way", ["deep copy", "pickle", "saved and loaded", "parameters"])
def test_a_warm_up_goes_on_where_it_was(way, tmp_path) -> None:
    model = with_full_buffer(critic_warmup=5)
    updates(model, 3)
    policy = again(model, way, tmp_path)
    if way == "parameters":
        other = with_full_buffer(critic_warmup=5)
        other.set_parameters(model.get_parameters())
        policy = other.policy
    assert policy.critic_updates == 3
    model.policy = policy
    model._create_aliases()
    first = copy.deepcopy(policy.actor)
    updates(model, 1)
    assert not changed(policy.actor, first)
    updates(model, 1)
    assert changed(policy.actor, first)


def test_beyond_32_regions_those_without_data_do_not_move_not_even_by_momentum() -> None:
    model = with_full_buffer(DDPG, two_inputs(), critic_warmup=0)
    assert isinstance(model.actor.optimizer, RowAdam)
    assert two_inputs().explicit().n_regions > 32
    updates(model, 5)
    before = copy.deepcopy(network_of(model))
    data = model.replay_buffer.sample(3)
    model.replay_buffer.sample = lambda *_, **__: data
    updates(model, 1)
    seen = set(two_inputs().explicit().locate(data.observations.double().numpy()).tolist())
    for old, new in zip(before.parameters(), network_of(model).parameters(), strict=True):
        moved = (old != new).flatten(1).any(1).nonzero()[:, 0].tolist()
        assert moved and set(moved) <= seen
