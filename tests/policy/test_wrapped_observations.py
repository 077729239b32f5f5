"""Wrappers that change what an observation means are refused wherever a policy meets an env."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sample_plants import LinearPlant, two_input_mpc
from sb3_yann import AffineObservation, ImprovementGuard, NoActionNoise, headroom
from sb3_yann.control.wrapper_stack import require_state_shown
from sb3_yann.evaluation import evaluate

MPC = two_input_mpc()


def plant(wrap=lambda env: env) -> gym.Env:
    return wrap(wrappers.TimeLimit(LinearPlant(MPC, 2.0), 20))


def build(env, **policy) -> DDPG:
    options = {"problem": MPC, **policy}
    return DDPG("YannPolicy", env, policy_kwargs=options, device="cpu", buffer_size=100)


class Welford(gym.ObservationWrapper):
    """Keeps a running mean and variance in arrays of its own."""

    def __init__(self, env) -> None:
        super().__init__(env)
        self.mean = np.zeros(3)
        self.m2 = np.ones(3)
        self.count = 1

    def observation(self, observation):
        self.count += 1
        before = observation - self.mean
        self.mean = self.mean + before / self.count
        self.m2 = self.m2 + before * (observation - self.mean)
        shown = (observation - self.mean) / np.sqrt(self.m2 / self.count)
        return shown.astype(self.observation_space.dtype)


class ScaledActions(gym.ActionWrapper):
    """Divides actions by their own running size."""

    def __init__(self, env) -> None:
        super().__init__(env)
        self.running_size = np.ones(env.action_space.shape)

    def action(self, action):
        self.running_size = 0.9 * self.running_size + 0.1 * np.abs(action)
        return action / self.running_size


class Fixed(gym.ObservationWrapper):
    """Shows normalized observations by fixed numbers, and counts its steps."""

    def __init__(self, env) -> None:
        super().__init__(env)
        self.mean = np.array([0.5, 0, -1])
        self.std = np.array([2.0, 1, 3])
        self.steps = 0

    def observation(self, observation):
        self.steps += 1
        return ((observation - self.mean) / self.std).astype(np.float32)


MOVING = [wrappers.NormalizeObservation, Welford, ScaledActions]


def below_another(env):
    return wrappers.TransformReward(wrappers.NormalizeObservation(env), lambda reward: reward)


@pytest.mark.parametrize("wrap", [*MOVING, below_another])
def test_statistics_that_move_are_refused_wherever_an_env_is_met(wrap) -> None:
    match = "by statistics of its own"
    for env in (plant(wrap), DummyVecEnv([lambda: plant(wrap)] * 2)):
        with pytest.raises(ValueError, match=match):
            build(env)
        with pytest.raises(ValueError, match=match):
            build(env, observation=AffineObservation.identity(3))
    model = build(plant())
    law = MPC.explicit()
    for policy in (model, model.policy, law, law.plant_input):
        with pytest.raises(ValueError, match=match):
            evaluate(policy, lambda: plant(wrap), [0])
        with pytest.raises(ValueError, match=match):
            evaluate(policy, plant(wrap), [0])
    evaluate(lambda observation: np.zeros(2), plant(wrap), [0])  # others may act on what they like
    with pytest.raises(ValueError, match=match):
        headroom(MPC, lambda: plant(wrap))
    with pytest.raises(ValueError, match=match):
        model.learn(1, callback=[NoActionNoise(), ImprovementGuard(lambda: plant(wrap))])


def test_an_env_that_is_set_later_is_looked_at_before_the_policy_acts_on_it() -> None:
    model = build(plant())
    model.set_env(plant())
    model.predict(np.zeros(3, np.float32))
    other = plant(Welford)
    model.set_env(other)
    with pytest.raises(ValueError, match="Welford scales"):
        model.learn(5, callback=NoActionNoise())


def boxed() -> gym.Env:
    env = LinearPlant(MPC, 2.0)
    env.observation_space = gym.spaces.Box(np.float32([-4, -5, -6]), np.float32([4, 7, 8]))
    return wrappers.TimeLimit(env, 20)


def test_fixed_scales_are_refused_with_the_map_that_undoes_them() -> None:
    def rescaled() -> gym.Env:
        return wrappers.RescaleObservation(boxed(), np.float32(0), np.float32(1))

    with pytest.raises(ValueError, match="policy_kwargs=") as refused:
        build(rescaled())
    undo = str(refused.value).split("'observation': ")[1].split("}")[0]
    undo = eval(undo, {"AffineObservation": AffineObservation})
    model = build(rescaled(), observation=undo)
    theta = model.policy.theta(rescaled().reset(seed=3)[0][None]).ravel()
    np.testing.assert_allclose(theta, boxed().reset(seed=3)[0], atol=1e-5)
    assert np.isclose(
        evaluate(model, rescaled, [3]).costs, evaluate(MPC.explicit(), boxed, [3]).costs, rtol=1e-4
    )
    with pytest.raises(ValueError, match="RescaleObservation shows other numbers"):
        evaluate(build(boxed()), rescaled, [3])


def test_a_frozen_normalization_is_refused_with_the_map_that_undoes_it() -> None:
    env = wrappers.NormalizeObservation(plant())
    env.reset(seed=0)
    for _ in range(10):
        env.step(env.action_space.sample())
    env.update_running_mean = False
    with pytest.raises(ValueError, match=r"AffineObservation\.normalized\(\["):
        build(env)
    build(env, observation=AffineObservation.identity(3))


def test_stacked_and_late_observations_are_named_unless_they_are_meant() -> None:
    stacked = VecFrameStack(DummyVecEnv([plant]), 3)
    with pytest.raises(ValueError, match=r"newest_frame\(3, 3\)"):
        require_state_shown(stacked, observation_given=False)
    require_state_shown(stacked, observation_given=True)
    require_state_shown(VecFrameStack(DummyVecEnv([plant]), 1), observation_given=False)
    with pytest.warns(UserWarning, match="DelayObservation shows past states"):
        build(wrappers.DelayObservation(plant(), 2))
    with pytest.warns(UserWarning, match="StickyAction repeats past inputs"):
        build(wrappers.StickyAction(plant(), 0.1))


def test_wrappers_of_rewards_and_of_fixed_numbers_pass() -> None:
    require_state_shown(wrappers.NormalizeReward(plant()), observation_given=False)
    require_state_shown(wrappers.RecordEpisodeStatistics(plant()), observation_given=False)
    require_state_shown(Fixed(plant()), observation_given=False)
