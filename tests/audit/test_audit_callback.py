"""When the audit speaks, as a warning or an error; several envs, and VecNormalize."""

from __future__ import annotations

import functools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from audit_samples import (
    MPC,
    WRONG,
    audited,
    plant,
)
from sb3_yann import (
    AffineObservation,
    CostAudit,
    CostMismatchError,
    CostMismatchWarning,
    NoActionNoise,
    NonFiniteWarning,
    YannPolicy,
)


def test_a_mismatch_is_a_warning_and_an_error_where_the_audit_is_strict() -> None:
    def model():
        env = wrappers.TransformReward(plant(), lambda reward: -reward)
        return DDPG(YannPolicy, env, policy_kwargs={"problem": MPC}, gradient_steps=0)

    with pytest.warns(CostMismatchWarning, match="Likely cause: the env returns the cost itself"):
        model().learn(110, callback=[NoActionNoise(), CostAudit()])
    strict = model()
    with pytest.raises(CostMismatchError, match="The reward is not minus the cost"):
        strict.learn(500, callback=[NoActionNoise(), CostAudit(strict=True)])
    assert strict.num_timesteps == 100
    assert issubclass(CostMismatchError, RuntimeError)
    assert not issubclass(CostMismatchError, ValueError)


def test_a_short_run_is_judged_at_its_end_and_a_very_short_one_is_not() -> None:
    wrong = functools.partial(wrappers.TransformReward, func=lambda reward: -reward)
    assert audited(wrong(plant()), learn=30).finding.cause == "sign flipped"
    assert audited(wrong(plant()), learn=5).finding is None


def test_the_audit_draws_no_random_numbers_and_keeps_nothing() -> None:
    audit = audited(plant())
    assert audit._records == []
    plain = DDPG(YannPolicy, plant(), policy_kwargs={"problem": MPC}, seed=0, gradient_steps=0)
    plain.learn(110, callback=NoActionNoise())
    np.testing.assert_array_equal(
        plain.replay_buffer.observations[:110], audit.model.replay_buffer.observations[:110]
    )


@pytest.mark.parametrize("wrong", ["the next state", "StickyAction"])
def test_steps_of_several_envs_count_together(wrong) -> None:
    make, cause, wrapper, _ = WRONG[wrong]
    finding = audited(DummyVecEnv([make] * 3), steps=150, learn=150).finding
    wrappers_named = () if wrapper is None else (wrapper,)
    assert (finding.cause, finding.wrappers, finding.steps) == (cause, wrappers_named, 150)


def test_a_frozen_vec_normalize_is_seen_through() -> None:
    env = VecNormalize(DummyVecEnv([plant] * 2), norm_reward=False, clip_obs=np.inf)
    env.seed(0)
    env.reset()
    for _ in range(30):
        env.step(np.array([env.action_space.sample()] * 2))
    env.training = False
    policy = {"observation": AffineObservation.from_vec_normalize(env)}
    assert audited(env, policy=policy).finding.matches
    forgotten = {"observation": AffineObservation.identity(3)}
    assert audited(env, policy=forgotten).finding.cause == "unknown"


def test_one_step_that_is_lost_does_not_hide_what_is_wrong_in_the_others() -> None:
    class Fails(gym.Wrapper):
        steps = 0

        def step(self, action):
            observation, reward, *rest = super().step(action)
            self.steps += 1
            return observation, np.nan if self.steps == 7 else -reward, *rest

    with pytest.warns(NonFiniteWarning):
        finding = audited(Fails(plant())).finding
    assert finding.cause == "not finite" and "In the others, sign flipped: " in finding.message


def test_a_run_without_steps_is_not_judged() -> None:
    audit = CostAudit()
    audit.init_callback(DDPG(YannPolicy, plant(), policy_kwargs={"problem": MPC}))
    audit.on_training_end()
    assert audit.finding is None


@pytest.mark.parametrize(
    ("switch", "cause"),
    [("norm_reward", "normalized reward"), ("training", "normalized observation")],
)
def test_a_vec_normalize_that_is_switched_on_later_is_named(switch, cause) -> None:
    env = VecNormalize(DummyVecEnv([plant]), training=False, norm_reward=False, clip_obs=np.inf)
    options = {"problem": MPC, "observation": AffineObservation.from_vec_normalize(env)}
    model = DDPG(YannPolicy, env, policy_kwargs=options, gradient_steps=0)
    setattr(env, switch, True)
    with pytest.warns(CostMismatchWarning, match=f"Set venv.{switch} = False"):
        model.learn(100, callback=(audit := CostAudit()))  # NoActionNoise would refuse it
    assert audit.finding.cause == cause


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"steps": 9}, ValueError, "steps = 9"),
        ({"steps": 1.5}, ValueError, r"steps = 1\.5"),
        ({"tolerance": 0}, ValueError, "tolerance = 0"),
        ({"tolerance": -1}, ValueError, "tolerance = -1"),
        ({"strict": 1}, TypeError, "strict = 1"),
    ],
)
def test_arguments_out_of_range_are_named(kwargs, error, message) -> None:
    with pytest.raises(error, match=message):
        CostAudit(**kwargs)


def test_other_policies_have_no_problem_to_compare_with() -> None:
    with pytest.raises(TypeError, match="TD3Policy"):
        DDPG("MlpPolicy", "Pendulum-v1").learn(8, callback=CostAudit())
