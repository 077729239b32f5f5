"""The audit of rewards and observations, against every wrapper that changes what they mean."""

from __future__ import annotations

import dataclasses
import functools
import warnings

import gymnasium as gym
import numpy as np
import pytest
from conftest import LinearPlant, asymmetric_pendulum_mpc, two_input_mpc
from gymnasium import spaces, wrappers
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_yann import (
    ActionRepeat,
    AffineObservation,
    CostAudit,
    CostMismatchError,
    CostMismatchWarning,
    NoActionNoise,
    NonFiniteWarning,
    YannPolicy,
)

MPC = two_input_mpc()


class Changed(gym.Wrapper):
    """Passes each step through a function (env, theta, action, outcome) -> outcome."""

    def __init__(self, env: gym.Env, change) -> None:
        super().__init__(env)
        self.change = change

    def step(self, action):
        theta = self.unwrapped.x
        return self.change(self.unwrapped, theta, action, self.env.step(action))


def plant(mpc=MPC, steps: int = 20) -> gym.Env:
    return wrappers.TimeLimit(LinearPlant(mpc, 2.0), steps)


def audited(env, mpc=MPC, steps: int = 100, policy=None, learn: int = 110, **kwargs) -> CostAudit:
    """Return what an audit finds in an env, with any warning that is not its own an error."""
    options = {"problem": mpc, **(policy or {})}
    model = DDPG(YannPolicy, env, policy_kwargs=options, seed=0, gradient_steps=0, buffer_size=500)
    audit = CostAudit(steps, **kwargs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CostMismatchWarning)
        model.learn(learn, callback=[NoActionNoise(), audit])
    return audit


def boxed() -> gym.Env:
    env = LinearPlant(MPC, 2.0)
    env.observation_space = spaces.Box(np.float32([-5, -5, -5]), np.float32([5, 6, 7]))
    return wrappers.TimeLimit(env, 20)


def with_other_inputs() -> gym.Env:
    env = LinearPlant(MPC, 2.0)
    env.action_space = spaces.Box(np.float32([-3, -1]), np.float32([1, 2]))
    return wrappers.TimeLimit(env, 20)


def at_the_next_state(env, theta, action, outcome):
    observation, _, *rest = outcome
    return observation, -float(MPC.stage_cost(observation, action)), *rest


def shifted(observation):
    return (observation + np.float32([0.3, 0.6, -0.9])).astype(np.float32)


def show_shifted(env: gym.Env) -> gym.Env:
    return wrappers.TransformObservation(env, shifted, env.observation_space)


OTHER = dataclasses.replace(MPC, Q=np.diag([1, 2, 3]), R=MPC.R / 2, terminal=None)
LOW, HIGH = MPC.u_min.astype(np.float32), MPC.u_max.astype(np.float32)

# What is done to the env, what it is taken for, the wrapper that is named, what else is said.
WRONG = {
    "NormalizeReward": (
        lambda: wrappers.NormalizeReward(plant()),
        "normalized reward",
        "NormalizeReward",
        "Leave it out",
    ),
    "NormalizeReward with a discount of its own": (
        lambda: wrappers.NormalizeReward(plant(), gamma=0.97),
        "unknown",
        "NormalizeReward",
        "step by step",
    ),
    "TransformReward: sign": (
        lambda: wrappers.TransformReward(plant(), lambda reward: -reward),
        "sign flipped",
        "TransformReward",
        "The learner would maximize it",
    ),
    "TransformReward: scale": (
        lambda: wrappers.TransformReward(plant(), lambda reward: 0.01 * reward),
        "scaled",
        "TransformReward",
        'policy_kwargs={"critic": {"reward_scale": 0.01, "reward_offset": 0}}',
    ),
    "TransformReward: scale and offset": (
        lambda: wrappers.TransformReward(plant(), lambda reward: 0.5 * reward + 10),
        "scaled and shifted",
        "TransformReward",
        '"reward_scale": 0.5',
    ),
    "TransformReward: constant": (
        lambda: wrappers.TransformReward(plant(), lambda reward: 1.0),
        "constant",
        "TransformReward",
        "every reward is 1",
    ),
    "TransformReward: bent": (
        lambda: wrappers.TransformReward(plant(), lambda reward: -np.sqrt(-reward)),
        "unknown",
        "TransformReward",
        "R² = 0.9",
    ),
    "ClipReward": (
        lambda: wrappers.ClipReward(plant(), -1.0),
        "clipped",
        "ClipReward",
        r"clipped to [-1, ",
    ),
    "DelayObservation": (
        lambda: wrappers.DelayObservation(plant(), 1),
        "delayed observation",
        "DelayObservation",
        "1 step(s) later",
    ),
    "DelayObservation by two": (
        lambda: wrappers.DelayObservation(plant(), 2),
        "delayed observation",
        "DelayObservation",
        "2 step(s) later",
    ),
    "StickyAction": (
        lambda: wrappers.StickyAction(plant(), 0.3),
        "sticky action",
        "StickyAction",
        "the previous action",
    ),
    "StickyAction for three steps": (
        lambda: wrappers.StickyAction(plant(), 0.2, 3),
        "sticky action",
        "StickyAction",
        "the previous action",
    ),
    "ActionRepeat": (
        lambda: ActionRepeat(plant(), 2),
        "repeated action",
        "ActionRepeat",
        "the sum of 2 steps",
    ),
    "ActionRepeat five times": (
        lambda: ActionRepeat(plant(steps=50), 5),
        "repeated action",
        "ActionRepeat",
        "the sum of 5 steps",
    ),
    "RescaleAction": (
        lambda: wrappers.RescaleAction(with_other_inputs(), LOW, HIGH),
        "rescaled action",
        "RescaleAction",
        "the input [1.3333, 2.5] * action + [-1.6667, 0.25]",
    ),
    "NormalizeObservation": (
        lambda: wrappers.NormalizeObservation(plant()),
        "unknown",
        "NormalizeObservation",
        "step by step",
    ),
    "RescaleObservation": (
        lambda: wrappers.RescaleObservation(boxed(), np.float32(-1), np.float32(1)),
        "normalized observation",
        "RescaleObservation",
        "AffineObservation.normalized(mean=[0, 0.5, 1], std=[5, 5.5, 6])",
    ),
    "absolute observations": (
        lambda: show_shifted(plant()),
        "shifted observation",
        "TransformObservation",
        "AffineObservation.deviation([0.3, 0.6, -0.9])",
    ),
    "the next state": (
        lambda: Changed(plant(), at_the_next_state),
        "next state",
        None,
        "c(s', u)",
    ),
    "other weights": (
        lambda: plant(OTHER),
        "other weights",
        None,
        "theta by [1, 2, 3] and of u by [0.5, 0.5] times",
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_reward_or_observation_of_another_meaning_is_named(wrong) -> None:
    make, cause, wrapper, text = WRONG[wrong]
    finding = audited(make()).finding
    assert not finding.matches
    assert finding.cause == cause
    assert finding.wrappers == (() if wrapper is None else (wrapper,))
    assert text in finding.message


@pytest.mark.skipif(not hasattr(wrappers, "RepeatAction"), reason="from Gymnasium 1.3 on")
def test_gymnasium_s_own_repetition_is_named_too() -> None:
    finding = audited(wrappers.RepeatAction(plant(), 3)).finding
    assert (finding.cause, finding.wrappers) == ("repeated action", ("RepeatAction",))


def test_a_reward_that_comes_late_is_named() -> None:
    class Late(gym.Wrapper):
        reward = 0.0

        def step(self, action):
            observation, reward, *rest = self.env.step(action)
            reward, self.reward = self.reward, reward
            return observation, reward, *rest

    assert audited(Late(plant())).finding.cause == "late reward"


def test_an_action_that_acts_late_is_named() -> None:
    class Late(gym.ActionWrapper):
        held = np.zeros(2)

        def action(self, action):
            action, self.held = self.held, action
            return action

    assert audited(Late(plant())).finding.cause == "late action"


def test_a_reward_that_is_not_a_number_is_named() -> None:
    env = wrappers.TransformReward(plant(), lambda reward: np.nan)
    with pytest.warns(NonFiniteWarning):
        assert audited(env).finding.cause == "not finite"


@pytest.mark.parametrize("what", ["reward", "observation"])
def test_one_step_that_is_not_finite_is_named_and_left_out_of_the_statistics(what) -> None:
    class Faulty(gym.Wrapper):
        steps = 0

        def step(self, action):
            observation, reward, *rest = self.env.step(action)
            self.steps += 1
            if self.steps == 30:
                observation, reward = (
                    (observation, np.nan) if what == "reward" else (observation * np.nan, reward)
                )
            return observation, reward, *rest

    with pytest.warns(NonFiniteWarning):
        finding = audited(Faulty(plant())).finding
    assert (finding.matches, finding.cause) == (False, "not finite")
    assert f"{'the reward' if what == 'reward' else 'an observation'}" in finding.message
    assert "of step 30" in finding.message
    assert (finding.scale, finding.offset) == (pytest.approx(1), 0)
    assert finding.r2 == pytest.approx(1)


# --- what is no mismatch --------------------------------------------------------------------------


@pytest.mark.parametrize("make", [two_input_mpc, asymmetric_pendulum_mpc])
def test_the_problem_s_own_cost_is_no_mismatch(make, capsys) -> None:
    audit = audited(plant(make()), make(), verbose=1)
    assert audit.finding.matches
    assert audit.finding.cause == ""
    assert (audit.finding.scale, audit.finding.offset) == (pytest.approx(1, rel=1e-6), 0)
    assert audit.finding.steps == 100
    assert "is the cost of the problem in all of 100 steps" in capsys.readouterr().out


@pytest.mark.parametrize("env_id", ["CSTR-v0", "ClippedPendulum-v0"])
def test_our_envs_have_no_mismatch(env_id) -> None:
    audited(env_id, gym.make(env_id).observation_space.problem, strict=True)


def test_a_wrapper_that_changes_nothing_is_not_blamed() -> None:
    env = wrappers.RescaleAction(plant(), LOW, HIGH)
    assert audited(env).finding.matches


def test_the_numbers_that_the_audit_prints_make_the_next_audit_pass() -> None:
    def env():
        return wrappers.TransformReward(plant(), lambda reward: 0.37 * reward - 4.2)

    line = audited(env()).finding
    assert line.scale == pytest.approx(0.37, rel=1e-5)
    assert line.offset == pytest.approx(-4.2, rel=1e-5)
    assert line.r2 > 1 - 1e-9
    policy = {"critic": {"reward_scale": line.scale, "reward_offset": line.offset}}
    assert audited(env(), policy=policy).finding.matches
    wrong = audited(plant(), policy=policy).finding
    assert "not 0.37 * (-cost) -4.2, as the policy assumes" in wrong.message
    assert '"reward_scale": 1' in wrong.message


def test_a_map_to_theta_is_taken_into_account() -> None:
    policy = {"observation": AffineObservation.deviation([0.3, 0.6, -0.9])}
    assert audited(show_shifted(plant()), policy=policy).finding.matches


def test_penalties_at_violations_and_at_ends_are_no_mismatch() -> None:
    def penalize(env, theta, action, outcome):
        observation, reward, _, truncated, info = outcome
        violation = bool(np.abs(theta).max() > 1.5)
        over = bool(np.abs(observation).max() < 0.4)
        return (
            observation,
            reward - 1e5 * violation + 50 * over,
            over,
            truncated,
            {
                **info,
                "violation": violation,
            },
        )

    finding = audited(Changed(plant(), penalize)).finding
    assert finding.matches
    assert 10 < finding.steps < 95  # those with a penalty are left out


def test_a_penalty_without_a_flag_is_a_mismatch() -> None:
    def penalize(env, theta, action, outcome):
        observation, reward, *rest = outcome
        return observation, reward - 100 * bool(np.abs(theta).max() > 1.5), *rest

    assert audited(Changed(plant(), penalize)).finding.cause == "unknown"


@pytest.mark.parametrize("start", [0.0, 1e-3, 0.05, 2.0])
def test_what_float32_cannot_tell_is_no_mismatch(start) -> None:
    def absolute(observation):
        return (env.unwrapped.x + 475).astype(np.float32)

    env = wrappers.TimeLimit(LinearPlant(MPC, start), 20)
    env = wrappers.TransformObservation(env, absolute, env.observation_space)
    policy = {"observation": AffineObservation.deviation([475] * 3)}
    assert audited(env, policy=policy).finding.matches


def test_an_env_at_rest_says_nothing_against_the_reward() -> None:
    assert audited(wrappers.TimeLimit(LinearPlant(MPC, 0.0), 20)).finding.matches


# --- the callback ---------------------------------------------------------------------------------


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


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("wrong", ["NormalizeReward", "StickyAction", "DelayObservation"])
def test_of_several_envs_each_is_followed_for_itself(wrong, n_envs) -> None:
    make, cause, wrapper, _ = WRONG[wrong]
    finding = audited(DummyVecEnv([make] * n_envs), steps=150, learn=150).finding
    assert (finding.cause, finding.wrappers, finding.steps) == (cause, (wrapper,), 150)


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
    assert audited(env, policy=forgotten).finding.cause == "normalized observation"


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
        model.learn(100, callback=[NoActionNoise(), audit := CostAudit()])
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
