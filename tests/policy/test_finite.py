"""What is no finite number: named at once, not learnt from, and met by the law."""

import copy
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import DDPG, PPO, TD3
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv

import general_problems
from errors import told
from policy_samples import make_policy
from random_problems import examples
from random_problems import problems as random_problems
from sample_plants import LinearPlant, Recorder, two_input_mpc
from sb3_yann import AffineObservation, LinearMPC, NoActionNoise, NonFiniteWarning, YannPolicy
from sb3_yann.policy.sb3_hooks import FiniteRows
from sb3_yann_envs import problems
from weights import redrawn, shake

OPTIONS = {"seed": 0, "device": "cpu", "buffer_size": 1000, "batch_size": 32}
POLICY = {"critic_warmup": 10, "net_arch": {"pi": [3, 3], "qf": [4, 4]}}


class Faulty(gym.Wrapper):
    """Shows what is not finite at some steps, counted from 1; step 0 is the first reset."""

    def __init__(self, env: gym.Env, at, what: str = "reward", value: float = np.nan) -> None:
        super().__init__(env)
        self.at = at
        self.what = what
        self.value = value
        self.steps = 0

    def shown(self, observation):
        observation = np.array(observation)
        if self.what == "observation" and self.steps in self.at:
            observation[1] = self.value
        return observation

    def reset(self, **kwargs):
        observation, info = self.env.reset(**kwargs)
        return self.shown(observation), info

    def step(self, action):
        observation, reward, *rest = self.env.step(action)
        self.steps += 1
        if self.what == "reward" and self.steps in self.at:
            reward = self.value
        return self.shown(observation), reward, *rest


def pendulum(*args, **kwargs) -> gym.Env:
    return Faulty(gym.make("ClippedPendulum-v0"), *args, **kwargs)


def build(env, algorithm=DDPG, policy=None, **kwargs):
    return algorithm(YannPolicy, env, policy_kwargs=POLICY | (policy or {}), **(OPTIONS | kwargs))


def shaken(model):
    shake(model.actor, 1.0)
    return model


def is_finite(model) -> bool:
    return all(bool(each.isfinite().all()) for each in model.policy.parameters())


def stored(model) -> np.ndarray:
    buffer = model.replay_buffer
    rows = slice(0, buffer.size())
    parts = (buffer.observations, buffer.next_observations, buffer.actions, buffer.rewards)
    return np.concatenate([part[rows].reshape(buffer.size(), -1) for part in parts], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "value", "algorithm"),
    [("reward", np.nan, DDPG), ("observation", np.inf, DDPG), ("observation", np.nan, TD3)],
)
def test_one_value_that_is_not_finite_is_named_and_spoils_nothing(what, value, algorithm) -> None:
    env = Recorder(pendulum([30], what, value))
    model = build(env, algorithm)
    said = told(lambda: model.learn(120, callback=NoActionNoise()), NonFiniteWarning)
    assert said[-1 if what == "reward" else 0].startswith(f"Step 30: {what}[")
    assert np.all(np.isfinite(env.recorded()[1]))
    assert is_finite(model)
    assert np.all(np.isfinite(stored(model)))
    assert len(stored(model)) == (119 if what == "reward" else 118)
    assert int(model.policy.critic_updates) == 120


@pytest.mark.parametrize("what", ["reward", "observation"])
def test_what_is_not_finite_from_the_first_step_on_is_not_learnt_from(what) -> None:
    model = build(pendulum(range(4), what), policy={"critic_warmup": 0})
    networks = th.nn.ModuleList([model.actor, model.critic])
    before = copy.deepcopy(dict(networks.named_parameters()))
    assert told(lambda: model.learn(3, callback=NoActionNoise()), NonFiniteWarning)
    assert all(th.equal(value, before[name]) for name, value in networks.named_parameters())
    told(lambda: model.learn(20, callback=NoActionNoise(), reset_num_timesteps=False))
    assert is_finite(model) and np.all(np.isfinite(stored(model)))
    assert int(model.policy.critic_updates) > 10


def test_of_several_envs_the_row_is_left_out() -> None:
    env = DummyVecEnv([lambda i=i: pendulum([50] if i == 2 else []) for i in range(4)])
    model = build(env)
    with pytest.warns(NonFiniteWarning, match=r"reward\[0\] of env 2 is nan.*nor are those"):
        model.learn(400, callback=NoActionNoise())
    assert model.replay_buffer.size() == 99
    assert is_finite(model) and np.all(np.isfinite(stored(model)))


def test_no_n_step_return_bridges_the_gap() -> None:
    model = build(pendulum([50]), n_steps=3)
    assert isinstance(model.replay_buffer, NStepReplayBuffer)
    with pytest.warns(NonFiniteWarning):
        model.learn(100, callback=NoActionNoise())
    batch = model.replay_buffer._get_samples(np.array([47, 48, 49]))
    assert batch.discounts[:, 0].tolist() == pytest.approx([0.99**2, 0.99, 0.99**3])
    assert batch.dones.sum() == 0
    assert is_finite(model)


def test_a_saved_copied_or_loaded_buffer_leaves_out_what_is_not_finite(tmp_path) -> None:
    model = build(pendulum([20, 130, 240]))
    with pytest.warns(NonFiniteWarning):
        model.learn(100, callback=NoActionNoise())
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    assert copy.deepcopy(model.replay_buffer).add.buffer() is not model.replay_buffer
    loaded = DDPG.load(tmp_path / "model", env=model.get_env())
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.replay_buffer.add.buffer() is loaded.replay_buffer
    assert is_finite(loaded)
    with pytest.warns(NonFiniteWarning, match="2 left out so far"):
        loaded.learn(100, callback=NoActionNoise(), reset_num_timesteps=False)
    del loaded.replay_buffer.add  # as a buffer from elsewhere would be
    with pytest.warns(NonFiniteWarning, match="1 left out so far"):
        loaded.learn(100, callback=NoActionNoise(), reset_num_timesteps=False)
    assert isinstance(loaded.replay_buffer.add, FiniteRows)
    assert loaded.replay_buffer.size() == 297


@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_a_reward_too_large_for_float32_is_no_step_of_training(algorithm) -> None:
    model = build(pendulum([50], value=1e30), algorithm)
    with pytest.warns(NonFiniteWarning, match=r"gradient of the critic .* this step is not taken"):
        model.learn(150, callback=NoActionNoise())
    assert is_finite(model)
    moments = model.critic.optimizer.state_dict()["state"].values()
    assert all(bool(each.isfinite().all()) for state in moments for each in state.values())
    assert model.policy.refused["critic"] > 0
    assert int(model.policy.critic_updates) == 150 - model.policy.refused["critic"]


def test_a_reward_that_is_not_finite_is_named_where_steps_of_ppo_are_refused() -> None:
    env = pendulum([20])
    model = PPO("YannPolicy", env, n_steps=64, policy_kwargs={"simulator": True}, device="cpu")
    with pytest.warns(NonFiniteWarning, match="paid rewards that are not finite"):
        model.learn(64)
    assert is_finite(model)


LOST = np.float32([[np.nan, 0.3], [0.2, np.inf], [np.nan, -np.inf], [0.1, 0.2]])


@pytest.mark.parametrize("net_arch", [[3], [3, 3]], ids=["torch", "compiled"])
@pytest.mark.parametrize("bound", [None, 0.1])
def test_where_an_observation_is_not_finite_the_law_acts_and_says_so(net_arch, bound) -> None:
    model = shaken(build(pendulum([]), policy={"net_arch": net_arch, "max_correction": bound}))
    law = problems.clipped_pendulum().explicit()
    with pytest.warns(NonFiniteWarning, match=r"entries \[0, 1\] \(angle, speed\): the law"):
        actions, _ = model.predict(LOST)
    known = np.where(np.isfinite(LOST), LOST, 0)[:3].astype(float)
    np.testing.assert_allclose(actions[:3], law(known), atol=1e-5)
    np.testing.assert_allclose(actions[3], model.predict(LOST[3])[0], atol=1e-6)
    with pytest.warns(NonFiniteWarning, match=r"entries \[0\]"):
        assert np.isfinite(model.predict(LOST[0])[0]).all()
    with pytest.warns(NonFiniteWarning):
        assert model.policy(th.as_tensor(LOST)).isfinite().all()


@pytest.mark.parametrize("net_arch", [[3], [3, 3]], ids=["torch", "compiled"])
@pytest.mark.parametrize("networks", ["per_region", "shared"])
def test_an_infinite_set_point_is_not_the_end_of_its_range(networks, net_arch) -> None:
    mpc = general_problems.solved("servo")
    policy = policy_of(mpc, net_arch=net_arch, networks=networks)
    seen = np.float32([[0.3, 0.2, np.inf], [0.3, 0.2, 0.0], [0.3, 0.2, 1.0]])
    with pytest.warns(NonFiniteWarning, match=r"entries \[2\]"):
        lost, rests, end = policy.predict(seen)[0]
    np.testing.assert_allclose(lost, rests, atol=1e-6)
    assert abs(end - rests) > 0.01


@pytest.mark.parametrize("net_arch", [[3], [3, 3]], ids=["torch", "compiled"])
def test_where_the_networks_are_not_finite_the_law_acts_and_says_so(net_arch) -> None:
    model = build(pendulum([]), policy={"net_arch": net_arch})
    before, _ = model.predict(np.float32([[0.1, 0.2], [0.0, -0.3]]))
    with th.no_grad():
        for parameter in model.actor.parameters():
            parameter.fill_(th.nan)
    with pytest.warns(NonFiniteWarning, match="networks put out what is not finite"):
        after, _ = model.predict(np.float32([[0.1, 0.2], [0.0, -0.3]]))
    np.testing.assert_allclose(after, before, atol=1e-6)


@pytest.mark.parametrize("net_arch", [[3], [3, 3]], ids=["torch", "compiled"])
def test_where_an_observation_overflows_in_the_networks_the_law_acts_and_says_so(net_arch) -> None:
    mpc = two_input_mpc(x_min=-0.1, x_max=0.1)  # in half-widths it is beyond float32
    model = shaken(build(LinearPlant(mpc), policy={"problem": mpc, "net_arch": net_arch}))
    seen = np.float32([[3e38, -3e38, 3e38], [0.05, 0.01, 0]])
    alone, _ = model.predict(seen[1:])
    with pytest.warns(NonFiniteWarning, match="networks put out what is not finite"):
        actions, _ = model.predict(seen)
    np.testing.assert_allclose(actions[0], mpc.explicit()(seen[0]), atol=1e-6)
    np.testing.assert_allclose(actions[1:], alone, atol=1e-6)


def test_an_entry_that_theta_does_not_depend_on_leaves_theta_as_it_is() -> None:
    mpc = two_input_mpc()
    seen = AffineObservation(np.eye(3, 4))
    space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
    plant = LinearPlant(mpc)
    more = TransformObservation(plant, lambda x: np.append(x, np.float32(0)), space)
    model = build(more, policy={"problem": mpc, "observation": seen})
    with pytest.warns(NonFiniteWarning, match=r"entries \[3\]"):
        action, _ = model.predict(np.float32([0.1, 0.2, 0.3, np.nan]))
    np.testing.assert_allclose(action, mpc.explicit()([0.1, 0.2, 0.3]), atol=1e-5)


KINDS = st.sampled_from([{"networks": "per_region"}, {"networks": "shared"}, {"law": "online"}])
ARCHITECTURES = st.sampled_from([{"pi": [4, 3], "qf": [4, 3]}, {"pi": [4], "qf": [4]}])


def policy_of(mpc: LinearMPC, dtype: Any = np.float32, **kwargs: Any) -> YannPolicy:
    seen = spaces.Box(-np.inf, np.inf, (mpc.n_theta,), dtype)
    low = mpc.u_min.astype(dtype)
    high = mpc.u_max.astype(dtype)
    return make_policy(seen, spaces.Box(low, high, dtype=dtype), problem=mpc, **kwargs)


def predicted(policy: YannPolicy, observations: np.ndarray) -> np.ndarray:
    """Return the actions in float64, each of which lies in the action space."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of states that look like absolute ones
        actions, _ = policy.predict(observations)
    assert all(policy.action_space.contains(each) for each in actions)
    return np.asarray(actions, np.float64)


@examples(30)
@given(random_problems(), st.data(), KINDS, ARCHITECTURES, st.sampled_from([None, np.nan]))
def test_every_observation_of_float32_has_an_action_of_the_space(
    mpc: LinearMPC, data: Any, kind: dict, net_arch: dict, poison: float | None
) -> None:
    policy = redrawn(policy_of(mpc, net_arch=net_arch, **kind), 0.3, 0, poison)
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
