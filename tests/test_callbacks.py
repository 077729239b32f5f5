"""No action noise, ever; and the scalars that tensorboard shows."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, PPO, TD3
from stable_baselines3.common.noise import NormalActionNoise

from event_files import scalars
from sample_plants import Recorder
from sb3_yann import ControlDiagnostics, NoActionNoise, YannPolicy
from weights import last_layer, unpin


class FixedRewards(gym.Wrapper):
    """Every step costs 1 and the third ends the episode, with a violation."""

    steps = 0

    def reset(self, **kwargs):
        self.steps = 0
        return self.env.reset(**kwargs)

    def step(self, action):
        observation, _, _, _, info = self.env.step(action)
        self.steps += 1
        return observation, -1.0, self.steps == 3, False, {**info, "violation": self.steps == 3}


def noisy(algorithm=DDPG, env: gym.Env | None = None, **kwargs):
    """Return a model that would explore in both of SB3's ways, and does not learn."""
    noise = NormalActionNoise(np.zeros(1), 0.5 * np.ones(1))
    env = Recorder(gym.make("ClippedPendulum-v0")) if env is None else env
    options = {"action_noise": noise, "learning_starts": 100, "gradient_steps": 0, "seed": 0}
    return algorithm(YannPolicy, env, **{**options, **kwargs}), env


def assert_all_actions_are_the_policy_s(model, env: Recorder) -> None:
    observations, executed = (np.array(part) for part in zip(*env.pairs, strict=True))
    predicted, _ = model.predict(observations)
    np.testing.assert_allclose(executed, predicted, atol=1e-6, rtol=0)


@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_every_executed_action_is_the_policy_s_own_in_every_learn(algorithm) -> None:
    model, env = noisy(algorithm)
    model.learn(150, callback=NoActionNoise())
    model.learn(150, callback=NoActionNoise())
    assert len(env.pairs) == 300
    assert_all_actions_are_the_policy_s(model, env)


def test_without_the_callback_the_same_model_explores() -> None:
    model, env = noisy()
    model.learn(150)
    with pytest.raises(AssertionError):
        assert_all_actions_are_the_policy_s(model, env)


def test_training_starts_at_once_and_still_without_noise() -> None:
    model, env = noisy(gradient_steps=1, policy_kwargs={"critic_warmup": 0}, learning_rate=0.1)
    model.learn(5, callback=NoActionNoise())
    assert model._n_updates == 5
    observations, executed = (np.array(part) for part in zip(*env.pairs, strict=True))
    with pytest.raises(AssertionError):  # the policy has moved on since
        assert_all_actions_are_the_policy_s(model, env)
    np.testing.assert_allclose(executed[0], DDPG(YannPolicy, env).predict(observations[0])[0])


def test_an_on_policy_algorithm_is_refused() -> None:
    with pytest.raises(TypeError, match="PPO"):
        PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8).learn(8, callback=NoActionNoise())


def test_diagnostics_need_a_yann_policy() -> None:
    with pytest.raises(TypeError, match="TD3Policy"):
        DDPG("MlpPolicy", "Pendulum-v1").learn(8, callback=ControlDiagnostics())


def test_tensorboard_shows_distance_regions_violations_and_critic_error(tmp_path) -> None:
    model, _ = noisy(tensorboard_log=str(tmp_path))
    model.learn(800, callback=[NoActionNoise(), ControlDiagnostics()])  # four episodes: one dump
    shown = scalars(tmp_path)
    assert shown["yann/distance_from_mpc_max"][-1] < 1e-6  # nothing was learnt, nothing differs
    assert 0 <= shown["yann/region"][-1] < 7
    assert 1 <= shown["yann/regions_visited"][-1] <= 7
    assert shown["yann/violations"] == [0]
    assert shown["yann/critic_error"][-1] > 0


def test_the_distance_is_a_fraction_of_the_input_range(tmp_path) -> None:
    model, _ = noisy(tensorboard_log=str(tmp_path))
    with th.no_grad():  # push every output to its upper bound
        last_layer(model)[..., -1] = 100.0
        unpin(model)
    model.learn(800, callback=[NoActionNoise(), ControlDiagnostics()])
    shown = scalars(tmp_path)
    assert 0.4 < shown["yann/distance_from_mpc_max"][-1] <= 1
    assert 0 < shown["yann/distance_from_mpc_mean"][-1] <= shown["yann/distance_from_mpc_max"][-1]


def test_violations_are_counted(tmp_path) -> None:
    model, _ = noisy(env=FixedRewards(gym.make("ClippedPendulum-v0")))
    diagnostics = ControlDiagnostics()
    model.learn(12, callback=[NoActionNoise(), diagnostics])
    assert diagnostics.violations == 4


def test_the_critic_error_compares_q_with_the_return_that_followed() -> None:
    model, _ = noisy(env=FixedRewards(gym.make("ClippedPendulum-v0")), gamma=0.5)
    states: list[np.ndarray] = []
    diagnostics = ControlDiagnostics()
    record = diagnostics._record_critic_error
    diagnostics._record_critic_error = lambda episode, info: (  # type: ignore[method-assign]
        states.extend(step[0] for step in episode),
        record(episode, info),
    )[-1]
    model.learn(3, callback=[NoActionNoise(), diagnostics], log_interval=100)
    theta = th.as_tensor(np.array(states))
    with th.no_grad():
        q = model.critic.q1_forward(theta, model.actor(theta)).numpy()[:, 0]
    returns = np.array([-1.75, -1.5, -1.0])  # three steps at -1, discounted by a half
    expected = np.abs(q - returns).mean() / np.abs(returns).mean()
    assert model.logger.name_to_value["yann/critic_error"] == pytest.approx(expected, rel=1e-5)
