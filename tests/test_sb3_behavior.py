"""What sb3-yann leans on in Stable-Baselines3, with its own policies alone.

Where one of these fails, Stable-Baselines3 has changed, and the module that is named must follow.
"""

from __future__ import annotations

import sys

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.td3.policies import TD3Policy

STEPS = 4


class Plant(gym.Env):
    """Counts its steps: its observation is their number, and an episode ends after four."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = spaces.Box(np.float32([-1.0]), np.float32([3.0]))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        observation = np.full(1, self.steps, np.float32)
        return observation, -1.0, False, self.steps == STEPS, {"action": np.array(action)}


class Seen(BaseCallback):
    """Keeps what a callback sees, and the names of the hooks in their order."""

    def __init__(self, stop=None) -> None:
        super().__init__()
        self.rows, self.hooks, self.stop = [], [], stop

    def _init_callback(self) -> None:
        self.hooks.append("init")
        self.before = self.model._last_obs.copy(), self.model.num_timesteps

    def _on_training_start(self) -> None:
        self.hooks.append("training start")

    def _on_rollout_start(self) -> None:
        self.hooks.append("rollout start")

    def _on_step(self) -> bool:
        self.hooks.append("step")
        names = ("actions", "buffer_actions", "new_obs", "rewards", "dones", "infos")
        row = {name: self.locals[name] for name in names}
        self.rows.append({**row, "last_obs": self.model._last_obs.copy()})
        if self.stop is not None:
            raise self.stop
        return True

    def _on_training_end(self) -> None:
        self.hooks.append("training end")


def build(algorithm=DDPG, **kwargs):
    options = {"learning_starts": 0, "batch_size": 2, "buffer_size": 50, "device": "cpu", "seed": 0}
    policy = {"net_arch": [3], **kwargs.pop("policy_kwargs", {})}
    return algorithm("MlpPolicy", Plant(), policy_kwargs=policy, **(options | kwargs))


def learn(steps: int = STEPS + 1, callback=None, **kwargs):
    model = build(**kwargs)
    model.learn(steps, callback=callback)
    return model


def test_a_policy_is_built_by_a_method_of_its_algorithm() -> None:
    """policy.sb3_hooks.algorithm_under_construction looks for it, or for the learning rate."""

    class Asks(TD3Policy):
        def __init__(self, *args, **kwargs) -> None:
            caller = sys._getframe(1)
            self.built_by = caller.f_locals.get("self")
            self.method = caller.f_code.co_name
            self.same_rate = args[2] is self.built_by.lr_schedule
            super().__init__(*args, **kwargs)

    model = DDPG(Asks, Plant(), device="cpu")
    assert model.policy.built_by is model and isinstance(model, BaseAlgorithm)
    assert model.policy.method == "_setup_model" and model.policy.same_rate


def test_ddpg_finds_the_policies_of_td3_by_their_names() -> None:
    """policy.policies registers YannPolicy in one table."""
    assert DDPG.policy_aliases is TD3.policy_aliases


def test_a_load_builds_the_policy_from_the_keywords_that_were_saved(tmp_path) -> None:
    """policy.policies saves the problem there."""
    model = build(policy_kwargs={"net_arch": [5]})
    model.policy_kwargs = {**model.policy_kwargs, "net_arch": [7]}
    spaces_of = model.observation_space, model.action_space
    model.policy = model.policy_class(*spaces_of, model.lr_schedule, **model.policy_kwargs)
    model.save(tmp_path / "m")
    loaded = DDPG.load(tmp_path / "m", device="cpu")
    assert loaded.actor.mu[0].out_features == 7


def test_a_load_with_n_steps_warns_and_keeps_them_all_the_same(tmp_path) -> None:
    DDPG("MlpPolicy", Plant(), n_steps=5, gamma=0.9).save(tmp_path / "model")
    with pytest.warns(UserWarning, match="`n_steps=5` is ignored"):  # docs/troubleshooting.md
        buffer = DDPG.load(tmp_path / "model").replay_buffer
    assert (buffer.n_steps, buffer.gamma) == (5, 0.9)


def test_what_is_set_on_a_model_travels_in_its_zip(tmp_path) -> None:
    """guard.state keeps `model.guard_state` there."""
    model = build()
    model.of_ours = {"accepted": 3}
    model.save(tmp_path / "m")
    assert DDPG.load(tmp_path / "m", device="cpu").of_ours == {"accepted": 3}


def test_buffers_of_networks_are_saved_and_loaded(tmp_path) -> None:
    """policy.policies counts the critic's updates in one."""
    model = build()
    model.policy.register_buffer("count", th.tensor(0))
    parameters = model.get_parameters()
    parameters["policy"]["count"] = th.tensor(5)
    model.set_parameters(parameters)
    assert model.policy.count == 5


@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_each_update_is_one_step_of_the_critic_then_of_the_actor(algorithm) -> None:
    """policy.policies decides in the optimizers' hooks, the critic's first."""
    model, order = build(algorithm), []
    for name in ("actor", "critic"):
        optimizer = getattr(model, name).optimizer
        optimizer.register_step_pre_hook(lambda *_, name=name: order.append(name))
    model.learn(2)
    model.train(gradient_steps=4, batch_size=2)
    pairs = ["critic", "actor"] if algorithm is DDPG else ["critic", "critic", "actor"]
    assert order[-len(pairs) :] == pairs


def test_the_learning_rate_is_set_anew_before_each_training() -> None:
    """policy.sb3_hooks multiplies the rate for one step and restores it."""
    model = learn(learning_rate=1e-3)
    for group in model.actor.optimizer.param_groups:
        group["lr"] = 7.0
    model.train(gradient_steps=1, batch_size=2)
    rates = {group["lr"] for group in model.actor.optimizer.param_groups}
    assert rates == {1e-3}


def test_targets_follow_the_parameters_and_leave_other_buffers_alone() -> None:
    """networks.zero_output.register_constants keeps a law in buffers."""
    model = build(tau=1.0)
    for network in (model.actor, model.actor_target, model.critic, model.critic_target):
        network.register_buffer("constant", th.tensor(1.0))
    model.actor.constant.fill_(2.0)
    model.critic.constant.fill_(2.0)
    model.learn(3)
    assert model.actor_target.constant == 1 and model.critic_target.constant == 1
    pairs = zip(model.actor.parameters(), model.actor_target.parameters(), strict=True)
    assert all(th.equal(own, target) for own, target in pairs)


def test_a_callback_sees_a_step_before_its_observation_becomes_the_last_one() -> None:
    """callbacks and audit.callback read `_last_obs` as s_t."""
    seen = Seen()
    learn(callback=seen)
    assert [row["last_obs"].item() for row in seen.rows] == [0, 1, 2, 3, 0]
    assert [row["new_obs"].item() for row in seen.rows] == [1, 2, 3, 0, 1]


def test_the_end_of_an_episode_carries_its_last_observation_and_its_cause() -> None:
    """The same modules, and the twin's log, read them."""
    seen = Seen()
    learn(callback=seen)
    assert [bool(row["dones"][0]) for row in seen.rows] == [False, False, False, True, False]
    info = seen.rows[3]["infos"][0]
    assert info["terminal_observation"].item() == STEPS and info["TimeLimit.truncated"]


def test_buffer_actions_are_in_one_and_actions_in_the_envs_units() -> None:
    """callbacks takes the former for inputs in [-1, 1]."""
    seen = Seen()
    learn(callback=seen)
    for row in seen.rows:
        np.testing.assert_allclose(row["actions"], 1 + 2 * row["buffer_actions"], atol=1e-6)
        np.testing.assert_array_equal(row["infos"][0]["action"], row["actions"][0])


def test_hooks_come_in_this_order_and_before_the_first_action() -> None:
    """NoActionNoise takes the random first actions away in `_init_callback`."""
    seen = Seen()
    learn(2, callback=seen)
    order = ["init", "training start", "rollout start", "step", "rollout start", "step"]
    assert seen.hooks == [*order, "training end"]
    assert seen.before[0].item() == 0 and seen.before[1] == 0


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_error_in_training_skips_the_end_of_training(error) -> None:
    """guard.interrupt restores the accepted policy itself."""
    seen = Seen(stop=error)
    with pytest.raises(error):
        learn(callback=seen)
    assert "training end" not in seen.hooks


def test_noise_and_random_actions_are_attributes_that_a_callback_may_change() -> None:
    """callbacks.NoActionNoise sets both."""

    class Silence(BaseCallback):
        def _init_callback(self) -> None:
            self.model.action_noise, self.model.learning_starts = None, 0

        def _on_step(self) -> bool:
            obs = self.model._last_obs
            np.testing.assert_allclose(self.locals["actions"], self.model.predict(obs)[0])
            return True

    noise = NormalActionNoise(np.zeros(1), np.ones(1))
    learn(callback=Silence(), learning_starts=100, action_noise=noise, learning_rate=0.0)


def test_the_buffer_of_an_instance_may_have_its_own_add() -> None:
    """policy.sb3_hooks leaves rows out there, and reads these arrays."""
    model, rows = build(), []
    buffer = model.replay_buffer
    buffer.add = lambda *args: (rows.append(args), type(buffer).add(buffer, *args))
    model.learn(STEPS + 1)
    assert len(rows) == STEPS + 1 and len(rows[0]) == 6
    assert buffer.size() == buffer.pos == STEPS + 1 and not buffer.full
    assert [each.item() for each in buffer.next_observations[: STEPS + 1]] == [1, 2, 3, 4, 1]
    assert buffer.dones[3].item() == 1 and buffer.timeouts[3].item() == 1
    assert buffer.actions.shape[1:] == (*buffer.rewards.shape[1:], 1) == (1, 1)


def test_scaled_actions_are_unscaled_by_the_policy() -> None:
    """policy.policies clips what this formula rounds."""
    policy = build().policy
    ends = policy.unscale_action(np.float32([[-1], [0], [1]]))
    np.testing.assert_allclose(ends[:, 0], [-1, 1, 3])
    np.testing.assert_allclose(policy.scale_action(ends)[:, 0], [-1, 0, 1])
