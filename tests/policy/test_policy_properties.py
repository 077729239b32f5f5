"""What holds for the policy of any problem, with any weights, and through whole trainings."""

from __future__ import annotations

import copy
import tempfile
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.noise import NormalActionNoise

from partitions import mixture
from policy_samples import make_policy
from random_problems import examples, in_box, problems
from sample_plants import LinearPlant
from sb3_yann import LinearMPC, NonFiniteWarning, YannPolicy
from weights import network_of

SEEDS = st.integers(0, 2**32 - 1)
ALGORITHMS = st.sampled_from([DDPG, TD3])
KINDS = st.sampled_from([{"networks": "per_region"}, {"networks": "shared"}, {"law": "online"}])
ARCHITECTURES = st.sampled_from([{"pi": [4, 3], "qf": [4, 3]}, {"pi": [4], "qf": [4]}])
LARGEST = float(np.finfo(np.float32).max)


def policy_of(mpc: LinearMPC, dtype: Any = np.float32, **kwargs: Any) -> YannPolicy:
    seen = spaces.Box(-np.inf, np.inf, (mpc.n_theta,), dtype)
    low, high = mpc.u_min.astype(dtype), mpc.u_max.astype(dtype)
    return make_policy(seen, spaces.Box(low, high, dtype=dtype), problem=mpc, **kwargs)


def shaken(policy: YannPolicy, size: float, seed: int, poison: float | None = None) -> YannPolicy:
    """Give the actor weights of this size, and some that are ``poison``."""
    rng = np.random.default_rng(seed)
    with th.no_grad():
        for weight in network_of(policy).parameters():
            drawn = np.clip(size * rng.normal(size=weight.shape), -LARGEST, LARGEST)
            if poison is not None:
                drawn[rng.random(weight.shape) < 0.1] = poison
            weight.copy_(th.as_tensor(drawn, dtype=th.float32))
    return policy


def predicted(policy: YannPolicy, observations: np.ndarray) -> np.ndarray:
    """Return the actions in float64, each of which lies in the action space."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of states that look like absolute ones
        actions, _ = policy.predict(observations)
    assert all(policy.action_space.contains(each) for each in actions)
    return np.asarray(actions, np.float64)


# --- the bounds --------------------------------------------------------------------------------


@examples(25)
@given(
    problems(),
    SEEDS,
    KINDS,
    st.sampled_from([0.0, 0.05, 1.0]),
    st.sampled_from([1.0, 1e6, LARGEST]),
    st.sampled_from([None, np.nan, np.inf]),
)
def test_no_weights_lead_farther_from_the_mpc_than_the_bound(
    mpc: LinearMPC, seed: int, kind: dict, bound: float, size: float, poison: float | None
) -> None:
    policy = policy_of(mpc, max_correction=bound, net_arch={"pi": [4, 3], "qf": [4]}, **kind)
    mixed = mixture(mpc, seed)[::3].astype(np.float32)
    start = predicted(policy, mixed)
    found = predicted(shaken(policy, size, seed, poison), mixed)
    reach = bound * (mpc.u_max - mpc.u_min)
    rounding = 2.0**-23 * np.maximum(np.abs(mpc.u_min), np.abs(mpc.u_max)) * (bound > 0)
    assert np.all(np.abs(found - start) <= reach + rounding)  # that of both actions
    law = mpc.law(kind.get("law", "explicit"))
    inside = law.in_domain(mixed) | (not mpc.has_rate_bounds)
    if bound > 0:  # no tolerance: it is left out of the bound
        assert np.all(np.abs(found - law(mixed))[inside] <= reach)


@pytest.mark.slow
@examples(25)
@given(
    problems(always=("rate",), parts=("tracking", "disturbance")),
    SEEDS,
    KINDS,
    st.sampled_from([None, 0.3]),
    st.sampled_from([1.0, 1e6, LARGEST]),
    st.sampled_from([None, np.nan, np.inf]),
)
def test_no_weights_move_an_input_faster_than_its_rate(
    mpc: LinearMPC, seed: int, kind: dict, bound: float | None, size: float, poison: float | None
) -> None:
    policy = policy_of(mpc, max_correction=bound, net_arch={"pi": [4, 3], "qf": [4]}, **kind)
    seen = np.vstack([in_box(mpc, 100, seed=seed), in_box(mpc, 100, 3.0, seed)]).astype(np.float32)
    last = slice(mpc.n_theta - mpc.model.n_inputs, None)
    seen[:, last] = np.clip(seen[:, last], mpc.u_min, mpc.u_max)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NonFiniteWarning)
        moved = predicted(shaken(policy, size, seed, poison), seen) - seen[:, last]
    assert np.all((mpc.rate.du_min <= moved) & (moved <= mpc.rate.du_max))


# --- what is no number --------------------------------------------------------------------------


@examples(30)
@given(problems(), st.data(), KINDS, ARCHITECTURES, st.sampled_from([None, np.nan]))
def test_every_observation_of_float32_has_an_action_of_the_space(
    mpc: LinearMPC, data: Any, kind: dict, net_arch: dict, poison: float | None
) -> None:
    policy = shaken(policy_of(mpc, net_arch=net_arch, **kind), 0.3, 0, poison)
    rows = st.lists(st.floats(width=32), min_size=mpc.n_theta, max_size=mpc.n_theta)
    seen = np.float32(data.draw(st.lists(rows, min_size=1, max_size=5)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        actions = predicted(policy, seen)
    said = {each.category for each in caught}
    with np.errstate(over="ignore"):  # the networks' own entries, in half-widths of the box
        held = np.isfinite(seen / policy.actor.mu.theta_half.numpy()).all()
    assert NonFiniteWarning in said or np.isfinite(seen).all()
    assert NonFiniteWarning not in said or not held or poison is not None
    for row, action in zip(seen, actions, strict=True):
        if not np.isfinite(row).all():  # the law, at the operating point in what is lost
            known = np.where(np.isfinite(row), row, 0).astype(np.float64)
            u = policy.problem.law(kind.get("law", "explicit"))(known)
            if not mpc.has_rate_bounds:
                assert np.all(np.abs(action - u) <= 1e-6 * (mpc.u_max - mpc.u_min))


# --- the critic, and targets --------------------------------------------------------------------


@examples(25)
@given(
    problems(), SEEDS, st.sampled_from(["afterstate", "state_action"]),
    st.sampled_from([0.9, 0.99]), ARCHITECTURES,
)  # fmt: skip
def test_critic_is_the_value_of_the_problem_at_first(
    mpc: LinearMPC, seed: int, kind: str, gamma: float, net_arch: dict
) -> None:
    try:
        M = mpc.state_action_matrix(gamma)
    except ValueError as error:  # of problems whose law does not rest at the origin
        assert "law" in str(error)
        return
    policy = policy_of(mpc, critic=kind, gamma=gamma, net_arch=net_arch, n_critics=2)
    theta = in_box(mpc, 50, 2.0, seed).astype(np.float32)
    action = np.random.default_rng(seed).uniform(-1, 1, (50, mpc.model.n_inputs))
    action = action.astype(np.float32)
    middle, half = (mpc.u_max + mpc.u_min) / 2, (mpc.u_max - mpc.u_min) / 2
    z = np.hstack([theta, middle + half * action])
    terms = z[:, :, None] * M * z[:, None]
    with th.no_grad():
        found = policy.critic(th.as_tensor(theta), th.as_tensor(action))
    rounding = 1e-7 * np.abs(terms.sum((1, 2))) + 1e-11 * np.abs(terms).sum((1, 2))
    for q in found:
        assert np.all(np.abs(q.numpy()[:, 0] + terms.sum((1, 2))) <= rounding + 1e-30)


def rests(mpc: LinearMPC) -> bool:
    """Whether a critic is known for the problem."""
    try:
        mpc.value_matrix(0.99)
    except ValueError:
        return False
    return True


def outputs(networks: Any, theta: th.Tensor, action: th.Tensor) -> list[th.Tensor]:
    actor, critic = networks
    with th.no_grad():
        return [actor(theta), *critic(theta, action)]


@pytest.mark.slow
@examples(12)
@given(problems(), SEEDS, ALGORITHMS, KINDS, st.sampled_from([0.0, 1.0]))
def test_targets_begin_as_the_networks_and_follow_them_as_tau_says(
    mpc: LinearMPC, seed: int, algorithm: Any, kind: dict, tau: float
) -> None:
    if not rests(mpc):
        return
    own = {"problem": mpc, "critic_warmup": 0, "net_arch": {"pi": [4, 3], "qf": [4, 3]}, **kind}
    options = {"buffer_size": 100, "learning_starts": 20, "learning_rate": 1e-2, "batch_size": 16}
    delay = {"policy_delay": 1} if algorithm is TD3 else {}
    env = gym.wrappers.TimeLimit(LinearPlant(mpc), 10)
    model = algorithm(
        YannPolicy, env, tau=tau, seed=0, device="cpu", policy_kwargs=own, **options, **delay
    )
    online, target = (model.actor, model.critic), (model.actor_target, model.critic_target)
    for one, other in zip(online, target, strict=True):
        for a, b in zip(one.state_dict().values(), other.state_dict().values(), strict=True):
            assert th.equal(a, b)
    theta = th.as_tensor(in_box(mpc, 20, seed=seed).astype(np.float32))
    action = 2 * th.rand(20, mpc.model.n_inputs) - 1
    first = outputs(target, theta, action)
    model.learn(60)
    expected = outputs(online, theta, action) if tau == 1 else first
    for a, b in zip(outputs(target, theta, action), expected, strict=True):
        assert th.equal(a, b)
    assert any(
        not th.equal(a, b) for a, b in zip(outputs(online, theta, action), first, strict=True)
    )


# --- whole trainings ----------------------------------------------------------------------------


class Strict(gym.Env):
    """The linear plant, in units of its own; takes no action that is outside its space."""

    def __init__(self, mpc: LinearMPC, dtype: Any, scaled: bool) -> None:
        self.mpc, self.scaled, m = mpc, scaled, mpc.model.n_inputs
        self.observation_space = spaces.Box(-np.inf, np.inf, (mpc.n_theta,), dtype)
        low, high = (-np.ones(m), np.ones(m)) if scaled else (mpc.u_min, mpc.u_max)
        self.action_space = spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype)
        self.taken = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.theta = self.np_random.uniform(self.mpc.theta_min, self.mpc.theta_max)
        self.steps = 0
        return self.theta.astype(self.observation_space.dtype), {}

    def step(self, action):
        assert self.action_space.contains(action), repr(action)
        self.taken, self.steps = self.taken + 1, self.steps + 1
        u = np.asarray(action, np.float64)
        if self.scaled:
            u = (self.mpc.u_max + self.mpc.u_min) / 2 + u * (self.mpc.u_max - self.mpc.u_min) / 2
        reward = -float(self.mpc.stage_cost(self.theta, u))
        self.theta = self.mpc.predict(self.theta, u)
        seen = self.theta.astype(self.observation_space.dtype)
        return seen, reward, False, self.steps == 10, {}


@pytest.mark.nightly
@examples(10)
@given(
    problems(), ALGORITHMS, KINDS, st.sampled_from([1, 2]),
    st.sampled_from([np.float32, np.float64]), st.booleans(),
)  # fmt: skip
def test_no_step_of_a_training_leaves_the_action_space(
    mpc: LinearMPC, algorithm: Any, kind: dict, n_envs: int, dtype: Any, scaled: bool
) -> None:
    if not rests(mpc):
        return
    m = mpc.model.n_inputs
    own = {"problem": mpc, "critic_warmup": 0, "actor_lr_mult": 10.0, **kind}
    own |= {"net_arch": {"pi": [4, 3], "qf": [4, 3]}}
    envs = [Strict(mpc, dtype, scaled) for _ in range(n_envs)]
    venv = gym_vec(envs)
    model = algorithm(
        YannPolicy, venv, seed=0, device="cpu", policy_kwargs=own, learning_rate=1e-2,
        learning_starts=10, batch_size=16, buffer_size=200, train_freq=1,
        action_noise=NormalActionNoise(np.zeros(m), np.ones(m)),
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NonFiniteWarning)  # an unstable plant may run away
        model.learn(60)
    assert sum(each.taken for each in envs) == 60
    actions = model.replay_buffer.actions[: model.replay_buffer.size()]
    assert np.all(np.abs(actions) <= 1)


def gym_vec(envs: list[gym.Env]) -> Any:
    from stable_baselines3.common.vec_env import DummyVecEnv

    return DummyVecEnv([lambda env=env: env for env in envs])


# --- files --------------------------------------------------------------------------------------


@examples(8)
@given(problems(), SEEDS, KINDS, st.sampled_from([None, 0.2]))
def test_a_policy_is_saved_to_the_last_bit(
    mpc: LinearMPC, seed: int, kind: dict, bound: float | None
) -> None:
    if not rests(mpc):
        return
    policy = shaken(policy_of(mpc, max_correction=bound, **kind), 0.3, seed)
    seen = mixture(mpc, seed)[::5].astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:
        policy.save(Path(folder) / "policy")
        loaded = YannPolicy.load(Path(folder) / "policy")
    for other in (loaded, copy.deepcopy(policy)):
        assert other.problem == policy.problem
        np.testing.assert_array_equal(predicted(other, seen), predicted(policy, seen))
        for name, each in policy.state_dict().items():
            assert th.equal(other.state_dict()[name], each)
