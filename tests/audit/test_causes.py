"""The audit against wrappers that change what rewards mean, and when it speaks."""

import dataclasses
import functools
import warnings
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import errors
from sample_plants import LinearPlant, Sampled, asymmetric_pendulum_mpc, two_input_mpc
from sb3_yann import (
    ActionRepeat,
    AffineObservation,
    CostAudit,
    CostMismatchError,
    CostMismatchWarning,
    LinearModel,
    LinearMPC,
    NoActionNoise,
    NonFiniteWarning,
    Tracking,
    YannPolicy,
    headroom,
    improve,
)
from sb3_yann.audit.meaning import warn_of_own_reward
from sb3_yann.improvement.simulator import of_law
from sb3_yann.rollout import rollout
from sb3_yann.wrappers.theta import SetPoint, below

pytestmark = pytest.mark.usefixtures("brisk")
MPC = two_input_mpc()


class Changed(gym.Wrapper):
    """Passes each step through a function (env, theta, action, outcome) -> outcome."""

    def __init__(self, env: gym.Env, change) -> None:
        super().__init__(env)
        self.change = change

    def step(self, action):
        return self.change(self.unwrapped, self.unwrapped.x, action, self.env.step(action))


def plant(mpc=MPC, steps: int = 20) -> gym.Env:
    return wrappers.TimeLimit(LinearPlant(mpc, 2.0), steps)


def audited(env, mpc=MPC, steps: int = 100, policy=None, learn: int = 110, **kwargs) -> CostAudit:
    """Return what an audit finds in an env, with any warning that is not its own an error.

    What the env shows is said: else the policy itself would object to some wrappers.
    """
    given = AffineObservation.identity(mpc.n_theta)
    options = {"problem": mpc, "observation": given, **(policy or {})}
    model = DDPG(YannPolicy, env, policy_kwargs=options, seed=0, gradient_steps=0, buffer_size=500)
    audit = CostAudit(steps, **kwargs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CostMismatchWarning)
        model.learn(learn, callback=[NoActionNoise(), audit])
    return audit


def at_the_next_state(env, theta, action, outcome):
    observation, _, *rest = outcome
    return observation, -float(MPC.stage_cost(observation, action)), *rest


WEIGHED = dataclasses.replace(MPC, Q=np.diag([1, 2, 3]), R=MPC.R / 2, terminal=None)

# What is done to the env; of those below also what it is taken for, and what else is said.
UNKNOWN = {
    "NormalizeReward": lambda: wrappers.NormalizeReward(plant()),
    "DelayObservation by two": lambda: wrappers.DelayObservation(plant(), 2),
    "StickyAction": lambda: wrappers.StickyAction(plant(), 0.3),
    "ActionRepeat": lambda: ActionRepeat(plant(), 2),
    "other weights": lambda: plant(WEIGHED),
}
WRONG = {
    **{kind: (make, "unknown", "step by step: weights, units") for kind, make in UNKNOWN.items()},
    "TransformReward: sign": (
        lambda: wrappers.TransformReward(plant(), lambda reward: -reward),
        "sign flipped",
        "The learner would maximize it",
    ),
    "TransformReward: scale": (
        lambda: wrappers.TransformReward(plant(), lambda reward: 0.01 * reward),
        "scaled",
        'policy_kwargs={"critic": {"reward_scale": 0.01, "reward_offset": 0}}',
    ),
    "TransformReward: scale and offset": (
        lambda: wrappers.TransformReward(plant(), lambda reward: 0.5 * reward + 10),
        "scaled and shifted",
        '"reward_scale": 0.5',
    ),
    "TransformReward: constant": (
        lambda: wrappers.TransformReward(plant(), lambda reward: 1.0),
        "constant",
        "every reward is 1",
    ),
    "TransformReward: bent": (
        lambda: wrappers.TransformReward(plant(), lambda reward: -np.sqrt(-reward)),
        "unknown",
        "R² = 0.9",
    ),
    "the next state": (lambda: Changed(plant(), at_the_next_state), "next state", "c(s', u)"),
}


@pytest.mark.filterwarnings("ignore:NormalizeReward divides:UserWarning")
@pytest.mark.parametrize("wrong", WRONG)
def test_a_reward_or_observation_of_another_meaning_is_named(wrong) -> None:
    make, cause, text = WRONG[wrong]
    finding = audited(make()).finding
    assert not finding.matches
    assert finding.cause == cause
    assert text in finding.message


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


def test_penalties_at_violations_and_at_ends_are_no_mismatch() -> None:
    def penalize(env, theta, action, outcome):
        observation, reward, _, truncated, info = outcome
        violation = bool(np.abs(theta).max() > 1.5)
        over = bool(np.abs(observation).max() < 0.4)
        info = {**info, "violation": violation}
        return observation, reward - 1e5 * violation + 50 * over, over, truncated, info

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


@pytest.mark.parametrize("wrong", ["the next state", "StickyAction"])
def test_steps_of_several_envs_count_together(wrong) -> None:
    make, cause, _ = WRONG[wrong]
    finding = audited(DummyVecEnv([make] * 3), steps=150, learn=150).finding
    assert (finding.cause, finding.steps) == (cause, 150)


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
    assert finding.cause == "sign flipped" and finding.steps == 99


@pytest.mark.parametrize(
    ("switch", "cause"),
    [("norm_reward", "normalized reward"), ("training", "normalized observation")],
)
def test_a_vec_normalize_that_is_switched_on_later_is_named(switch, cause) -> None:
    env = VecNormalize(DummyVecEnv([plant]), training=False, norm_reward=False, clip_obs=np.inf)
    options = {"problem": MPC, "observation": AffineObservation.from_vec_normalize(env)}
    model = DDPG(YannPolicy, env, policy_kwargs=options, gradient_steps=0, learning_starts=0)
    setattr(env, switch, True)
    with pytest.warns(CostMismatchWarning, match=f"Set venv.{switch} = False"):
        model.learn(100, callback=(audit := CostAudit()))  # NoActionNoise would refuse it
    assert audit.finding.cause == cause


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"steps": 9}, ValueError, "steps = 9"),
        ({"tolerance": 0}, ValueError, "tolerance = 0"),
        ({"strict": 1}, TypeError, "strict = 1"),
    ],
)
def test_arguments_out_of_range_are_named(kwargs, error, message) -> None:
    with pytest.raises(error, match=message):
        CostAudit(**kwargs)


def test_other_policies_have_no_problem_to_compare_with() -> None:
    with pytest.raises(TypeError, match="TD3Policy"):
        DDPG("MlpPolicy", "Pendulum-v1").learn(8, callback=CostAudit())


PLANT = LinearModel([[0.9, 0.2], [0, 0.7]], [[0], [1]], 1.0)


def mpc() -> LinearMPC:
    bounds = {"theta_min": -9, "theta_max": 9, "u_min": -2, "u_max": 2}
    return LinearMPC(PLANT, Q=np.diag([1, 0.1]), R=[[0.1]], horizon=3, **bounds)


class Rewarded(Sampled):
    """A linear plant, and a reward that is a function of state, input and next state."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-2, 2, (1,), np.float64)
    starts = (-3, 3)
    steps = 25

    def __init__(self, reward) -> None:
        self.reward = reward

    def moved(self, u):
        return PLANT.step(self.x, u)

    def step(self, action):
        before = self.x
        shown, _, *rest = super().step(action)
        return shown, self.reward(before, action, self.x), *rest


def stage(x, u, after) -> float:
    return -float(mpc().stage_cost(x, u))


OTHER = {
    "another weight": lambda x, u, after: -float(x[1] ** 2),
    "the cost itself": lambda x, u, after: float(mpc().stage_cost(x, u)),
    "a profit": lambda x, u, after: float(x[0]),
    "one for each step": lambda x, u, after: 1.0,
}
SAME = {
    "minus the cost": stage,
    "in other units": lambda x, u, after: 7 * stage(x, u, after) + 3,
    "of the next state": lambda x, u, after: stage(after, u, after),
    "none": lambda x, u, after: 0.0,
    "no number": lambda x, u, after: None,
}


def told(env, problem: LinearMPC, seeds: int = 4) -> list[str]:
    played = rollout(of_law(problem), env, range(seeds), problem=problem)
    return errors.told(lambda: warn_of_own_reward(problem, played))


@pytest.mark.parametrize("kind", OTHER)
def test_a_reward_of_its_own_is_reported(kind: str) -> None:
    (message,) = told(partial(Rewarded, OTHER[kind]), mpc())
    assert "The env has a reward of its own, and it is ignored" in message
    assert "over 100 steps" in message and "state it in Q and R" in message


@pytest.mark.parametrize("kind", SAME)
def test_minus_the_stage_cost_is_none_in_any_units(kind: str) -> None:
    assert not told(partial(Rewarded, SAME[kind]), mpc())


def test_what_a_violation_or_a_termination_costs_does_not_count() -> None:
    class Ends(gym.Wrapper):
        def step(self, action):
            seen, reward, *_ = self.env.step(action)
            t = self.unwrapped.t
            return seen, reward - 1e4 * (t in (3, 20)), t == 20, False, {"violation": t == 3}

    assert not told(lambda: Ends(Rewarded(stage)), mpc())


def test_a_reward_that_knows_nothing_of_the_set_points_is_none() -> None:
    held = gym.wrappers.TimeLimit(SetPoint(Rewarded(stage), -1, 1), 9)
    assert below(held, SetPoint) and not below(Rewarded(stage), SetPoint)
    tracking = dataclasses.replace(mpc(), tracking=Tracking([0], -1, 1))
    headroom(tracking, held, n_starts=2, max_steps=100)  # a warning would be an error


def test_headroom_and_improve_tell_once_and_point_to_the_call() -> None:
    env = Rewarded(OTHER["a profit"])
    problem = mpc()
    with pytest.warns(CostMismatchWarning, match="it is ignored") as found:
        assert "By its own cost" in str(headroom(problem, env, n_starts=2))
    assert [each.filename for each in found] == [__file__]
    model = DDPG("YannPolicy", env, policy_kwargs={"problem": problem})
    with pytest.warns(CostMismatchWarning, match="it is ignored") as found:
        improve(model, env, updates=1, n_starts=2, rounds=1)
    assert [each.filename for each in found] == [__file__]
