"""Simulators of all kinds, and what is left of a run that was cut off."""

from __future__ import annotations

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env

from guard_samples import (
    RIGHT,
    At,
    Slide,
    better,
    build,
    correct,
    make_guard,
    train,
)
from sb3_yann import NoActionNoise, restore_accepted
from sb3_yann.rollout import evaluate
from weights import is_mpc


class InPlace(Slide):
    """Returns its own state, which the next step overwrites."""

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        self.observation = observation
        return self.observation, info

    def step(self, action):
        observation, *rest = super().step(action)
        self.observation[:] = observation
        return self.observation, *rest


class Door(gym.Env):
    """x runs away; the env ends the episode beyond 3, whatever the MPC does there."""

    def __init__(self, success: bool = False) -> None:
        self.success = success
        self.observation_space = gym.spaces.Box(-5, 5, (1,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = self.np_random.uniform(1.7, 1.8, 1), 0
        return self.x.astype(np.float32), {}

    def step(self, action):
        self.x = 1.3 * self.x + 0.1 * float(np.asarray(action)[0])
        self.t += 1
        out = bool(abs(self.x[0]) > 3)
        info = {"violation": out and not self.success, "is_success": out and self.success}
        return self.x.astype(np.float32), -float(self.x[0] ** 2), out, self.t == 20, info


@pytest.mark.parametrize("success", [False, True], ids=["a trip", "a goal"])
def test_an_episode_that_ends_sooner_is_refused_unless_its_end_is_a_success(success) -> None:
    """All episodes end under the MPC too; without its input they end a step sooner, and cheaper."""
    model = build(learning_rate=0.0, env=Door(success))
    guard = make_guard(partial(Door, success), n_new_starts=0, n_final_starts=0)
    # The MPC's input is -1 right of 1.4: plus 2 it is 1.
    train(model, 8, At([2], partial(correct, region=RIGHT, value=2.0)), guard)
    first = guard.decisions[0]
    assert first.candidate_cost < first.mpc_cost
    assert first.verdict == ("accepted" if success else "rejected")
    if not success:
        assert "ends, or ends sooner" in first.reason and "is_success" in first.reason
        assert is_mpc(model)


class Endless(Slide):
    def step(self, action):
        observation, reward, *_ = super().step(action)
        return observation, reward, False, False, {}


def test_an_env_that_overwrites_its_observation_gives_the_same_episodes() -> None:
    seeds, policy = range(3), build().policy
    for ours, theirs in zip(
        evaluate(policy, InPlace, seeds).observations,
        evaluate(policy, Slide, seeds).observations,
        strict=True,
    ):
        np.testing.assert_array_equal(ours, theirs)


def test_one_env_for_all_starts_is_refused() -> None:
    env = Slide()
    with pytest.raises(ValueError, match="returned the same one twice"):
        train(build(), 4, make_guard(lambda: env))


def test_envs_are_made_for_the_first_trial_kept_for_the_others_and_closed_at_the_end() -> None:
    counts = {"made": 0, "closed": 0}

    class Counted(Slide):
        def __init__(self) -> None:
            counts["made"] += 1
            super().__init__()

        def close(self) -> None:
            counts["closed"] += 1

    guard = make_guard(Counted, n_new_starts=0)
    train(build(), 12, At([2], better), guard)
    trials = len(guard.decisions)
    assert trials > 1
    # One more, whose spaces are looked at before.
    assert counts["made"] == counts["closed"] <= len(guard.state.evidence.starts.seeds) + 1


def test_a_function_that_makes_no_env_is_named() -> None:
    with pytest.raises(TypeError, match=r"returned None, not a gymnasium\.Env"):
        train(build(), 4, make_guard(lambda: None))


def test_an_episode_that_is_long_is_told_before_memory_is_full(monkeypatch) -> None:
    monkeypatch.setattr("sb3_yann.rollout.LONG_EPISODE", 20)
    monkeypatch.setattr("sb3_yann.rollout.MAX_EPISODE_STEPS", 50)
    with (
        pytest.warns(UserWarning, match=r"not ended after 20 steps, all of which .*TimeLimit"),
        pytest.raises(RuntimeError, match="has not ended after 50 steps"),
    ):
        train(build(), 4, make_guard(Endless))


@pytest.mark.parametrize("n_envs", [1, 2])
def test_a_training_env_that_never_ends_is_told(n_envs, monkeypatch) -> None:
    monkeypatch.setattr("sb3_yann.guard.callback.LONG_EPISODE", 20)
    endless = build(env=make_vec_env(Endless, n_envs))
    with pytest.warns(
        UserWarning, match=r"training env has not ended after 20 .*TimeLimit"
    ) as told:
        train(endless, 30 * n_envs, NoActionNoise(), make_guard())
    assert sum("has not ended" in str(each.message) for each in told) == 1


def test_a_guard_counts_the_steps_of_the_present_learn_whatever_its_envs(monkeypatch) -> None:
    monkeypatch.setattr("sb3_yann.guard.callback.LONG_EPISODE", 5)
    guard = make_guard(n_new_starts=0, n_final_starts=0)
    for n_envs in (2, 3, 3):  # stopped amid episodes of 4 steps; a warning is an error
        train(build(env=make_vec_env(Slide, n_envs)), 3 * n_envs, NoActionNoise(), guard)


def test_the_accepted_policy_can_be_had_from_a_checkpoint(tmp_path) -> None:
    model, guard = build(learning_rate=0.0), make_guard(eval_freq=100)
    train(model, 6, At([5], better), guard, CheckpointCallback(5, str(tmp_path), "run"))
    loaded = DDPG.load(tmp_path / "run_5_steps", device="cpu")
    assert not is_mpc(loaded)
    restore_accepted(loaded)
    assert is_mpc(loaded)


def test_a_model_without_a_guard_has_nothing_to_restore() -> None:
    with pytest.raises(ValueError, match="No ImprovementGuard has been at work on this DDPG"):
        restore_accepted(build())
