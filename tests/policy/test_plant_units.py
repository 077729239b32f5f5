"""A policy on an env in plant units is the MPC, exactly, and names deviations."""

import re
from dataclasses import replace
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure

import unit_samples as units
from sb3_yann import (
    ControlDiagnostics,
    CostAudit,
    LinearModel,
    LinearMPC,
    NoActionNoise,
    NonFiniteWarning,
    Tracking,
    YannPolicy,
)
from sb3_yann.commissioning.commissioning import _costs
from sb3_yann.commissioning.plant import Plant
from sb3_yann.wrappers import SetPoint, StageCost
from sb3_yann_envs import problems

MPC = units.plant_mpc()
ALL = [(shows, takes) for shows in units.SAYS for takes in ("plant", "normalized")]
both = pytest.mark.parametrize(("shows", "takes"), ALL, ids="-".join)


def build(env: Any, observation: Any = None, mpc: LinearMPC = MPC, **kwargs: Any) -> DDPG:
    policy = {"problem": mpc, **({} if observation is None else {"observation": observation})}
    settings = {"seed": 0, "buffer_size": 1000, "device": "cpu", "gamma": 0.99, **kwargs}
    return DDPG(YannPolicy, env, policy_kwargs=policy, **settings)


def error(model: Any, env: Any, x: np.ndarray) -> float:
    """Return how far `predict` is from the law on the plant, as a fraction of the input range."""
    plain = env.unwrapped
    actions, _ = model.predict(plain.shows(x).astype(plain.observation_space.dtype))
    return float(np.max(np.abs(plain.input(actions) - MPC.explicit()(x)))) / 7


@both
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_policy_is_the_mpc_whatever_the_units(shows: str, takes: str, dtype: type) -> None:
    env = units.plant(shows, takes, dtype)
    model = build(env, units.SAYS[shows])
    assert model.policy.action_units.kind == takes
    assert error(model, env, units.states(2000, seed=1)) < 1e-5


def test_small_deviations_of_a_large_value_keep_their_digits() -> None:
    env = units.plant("plant", "plant", np.float64)
    model = build(env)
    x = units.states(500, seed=3, reach=1e-5)  # 1e-4 K of 350 K
    theta = model.policy.theta(x + units.X_SS).numpy()
    assert theta.dtype == np.float64 and np.max(np.abs(theta - x)) < 1e-12


@both
def test_cost_critic_and_logs_count_from_the_operating_point(shows: str, takes: str) -> None:
    """CostAudit, ControlDiagnostics and the replay buffer see the same theta."""
    env = StageCost(units.plant(shows, takes), MPC, observation=units.SAYS[shows])
    model = build(env, units.SAYS[shows])
    audit = CostAudit(steps=60)
    model.set_logger(configure(None, []))
    model.learn(100, callback=[NoActionNoise(), ControlDiagnostics(), audit])
    assert audit.finding.matches, audit.finding.message
    logged = model.logger.name_to_value
    assert logged["yann/distance_from_mpc_max"] < 1e-6
    assert logged["yann/critic_error"] < 0.02


@pytest.mark.parametrize(("shows", "takes"), [("plant", "plant"), ("normalized",) * 2])
def test_a_model_that_is_loaded_reads_the_same(shows: str, takes: str, tmp_path: Any) -> None:
    env = units.plant(shows, takes)
    build(env, units.SAYS[shows]).save(tmp_path / "model.zip")
    model = DDPG.load(tmp_path / "model.zip", env=env)
    assert error(model, env, units.states(100, seed=5)) < 1e-5
    model.policy.save(tmp_path / "policy.zip")
    policy = YannPolicy.load(tmp_path / "policy.zip")
    assert error(policy, env, units.states(100, seed=5)) < 1e-5


@pytest.mark.parametrize(("shows", "takes"), [("plant", "plant"), ("normalized",) * 2])
def test_commissioning_plays_the_plant_in_its_units(shows: str, takes: str) -> None:
    env = StageCost(units.plant(shows, takes), MPC, observation=units.SAYS[shows])
    played = Plant(env, build(env, units.SAYS[shows]))
    episode = played.play(played.begin(3), played.mpc, None)
    np.testing.assert_allclose(_costs(MPC, [episode], False), -episode.reward, rtol=1e-3)
    law = MPC.explicit()(episode.thetas[:-1])
    np.testing.assert_allclose(episode.actions, law, atol=1e-5)
    moved = MPC.deviations.predict(episode.thetas[:-1], episode.actions)
    np.testing.assert_allclose(episode.thetas[1:], moved, atol=1e-5)


def refused(env: Any, observation: Any = None, mpc: LinearMPC = MPC) -> str:
    with pytest.raises((ValueError, TypeError)) as caught:
        build(env, observation, mpc)
    return str(caught.value)


def test_an_env_in_deviations_is_refused() -> None:
    message = "The action space is [[-2.0], [5.0]], but the MPC has u_min = [38.0]"
    assert message in refused(units.plant("deviation", "deviation"))


@pytest.mark.parametrize(
    ("said", "message"),
    [("deviation", "must be an AffineObservation"), (3, "must be an AffineObservation")],
)
def test_another_word_for_what_is_shown_is_refused(said: Any, message: str) -> None:
    assert re.search(message, refused(units.plant("plant", "plant"), said))


def test_deviations_that_are_shown_are_named_once_as_training_begins() -> None:
    model = build(units.plant("deviation", "plant"))
    expected = r"temperature = .* is shown, and the operating point is 350: this is a deviation"
    with pytest.warns(UserWarning, match=expected):
        model.learn(3, callback=NoActionNoise())
    model.predict(np.zeros(2))  # a warning would be an error


@pytest.mark.parametrize("shows", units.SAYS)
def test_a_reading_that_is_lost_is_called_by_its_name(shows: str) -> None:
    """The law then acts at the operating point of that state, in any units."""
    env = units.plant(shows, "plant")
    model = build(env, units.SAYS[shows])
    x = np.array([0.0, 0.7])
    seen = np.where([True, False], np.nan, env.unwrapped.shows(x))
    with pytest.warns(NonFiniteWarning, match=r"not finite in entries \[0\] \(temperature\)"):
        action = model.predict(seen)[0]
    assert env.unwrapped.input(action) == pytest.approx(MPC.explicit()(x), abs=1e-5)


def test_the_state_that_lies_at_zero_is_found() -> None:
    mpc = LinearMPC(
        LinearModel(np.eye(2) / 2, np.eye(2), 1.0, x_ss=[1, -30], u_ss=[0, 0]),
        Q=np.eye(2), R=np.eye(2), horizon=1, x_min=[-1, -32], x_max=[3, -28],
    )  # fmt: skip
    assert mpc.shown_as_deviation(np.array([[0.2, -0.5], [-0.2, 1]])).startswith("x[1] = -0.5 is")
    for shown in (np.array([[1.2, -30.5]]), np.array([[2.5, 9]]), np.zeros((0, 2))):
        assert mpc.shown_as_deviation(shown) == ""


def test_set_points_in_deviations_are_named() -> None:
    given = {"Q": np.eye(2), "R": [[0.1]], "horizon": 2, "gamma": 0.99}
    mpc = LinearMPC(units.MODEL, tracking=Tracking([0], 345, 355), **given, **units.LIMITS)
    plant = units.plant("plant", "plant")
    right = SetPoint(plant, 345, 355)
    build(right, mpc=mpc).predict(right.reset(seed=0)[0])
    wrong = SetPoint(plant, -5, 5)
    beyond = "SetPoint shows set-point of temperature from -5 to 5, and .* beyond 345 to 355 as at"
    with pytest.warns(UserWarning, match=beyond):
        model = build(wrong, mpc=mpc)
    with pytest.warns(UserWarning, match="set-point of temperature = .* this is a deviation"):
        model.predict(wrong.reset(seed=0)[0])


def test_a_plant_that_lacks_a_part_of_theta_is_told_of_the_wrappers() -> None:
    design = {"Q": np.diag([1, 0]), "R": [[0.1]], "horizon": 2, **units.LIMITS}
    mpc = LinearMPC(units.MODEL, tracking=Tracking([0], 349, 351), **design)
    with pytest.raises(ValueError, match=r"takes theta of shape \(3,\).*SetPoint"):
        build(units.plant("plant", "plant"), mpc=mpc)


EPISODES = 3
STEPS = 100


class OtherUnits(gym.Wrapper):
    """Shows states, takes inputs and pays rewards in so many of other units."""

    def __init__(self, env: gym.Env, cost: float, x: Any, u: Any) -> None:
        super().__init__(env)
        self.cost = cost
        self.x = x
        self.u = u
        seen = env.observation_space
        taken = env.action_space
        box = [np.float32(each * x) for each in (seen.low, seen.high)]
        self.observation_space = gym.spaces.Box(*box)
        self.action_space = gym.spaces.Box(
            *[np.float32(each * u) for each in (taken.low, taken.high)]
        )

    def reset(self, **kwargs):
        observation, info = self.env.reset(**kwargs)
        return np.float32(observation * self.x), info

    def step(self, action):
        observation, reward, *rest = self.env.step(np.float32(np.float64(action) / self.u))
        return np.float32(observation * self.x), reward * self.cost, *rest


class Inputs(BaseCallback):
    def __init__(self) -> None:
        super().__init__()
        self.taken: list[Any] = []

    def _on_step(self) -> bool:
        self.taken.append(self.locals["actions"][0].copy())
        return True


@cache
def trained(cost: float = 1.0, x: tuple[float, ...] = (1, 1, 1, 1), u: float = 1.0):
    """Return the inputs of all training steps in the reactor's own units, and the model."""
    mpc = problems.cstr()
    x_unit = np.array(x)
    to_x = np.diag(x_unit)
    from_x = np.diag(1 / x_unit)
    model = LinearModel(to_x @ mpc.model.A @ from_x, to_x @ mpc.model.B / u, mpc.model.dt)
    changed = replace(
        mpc,
        model=model,
        Q=cost * from_x @ mpc.Q @ from_x,
        R=cost * mpc.R / u**2,
        u_min=mpc.u_min * u,
        u_max=mpc.u_max * u,
        theta_min=mpc.theta_min * x_unit,
        theta_max=mpc.theta_max * x_unit,
        x_min=mpc.x_min * x_unit,
        x_max=mpc.x_max * x_unit,
        terminal=None,
    )
    env = OtherUnits(gym.make("CSTR-v0", max_episode_steps=STEPS), cost, x_unit, u)
    policy = {"problem": changed, "critic_warmup": 100}
    learner = DDPG(YannPolicy, env, seed=0, device="cpu", policy_kwargs=policy, buffer_size=1000)
    inputs = Inputs()
    learner.learn(EPISODES * STEPS, callback=[NoActionNoise(), inputs])
    return np.array(inputs.taken) / u, learner


@cache
def in_own_units() -> tuple[np.ndarray, DDPG]:
    return trained()


@pytest.mark.parametrize(
    "units",
    [{"cost": 1e-3}, {"x": (1e3, 1e-2, 7.0, 0.1)}, {"u": 100.0}],
    ids=["cost / 1000", "states", "inputs"],
)
def test_other_units_give_the_same_actions_through_training_episodes(units) -> None:
    expected, model = in_own_units()
    found, other = trained(**units)
    span = np.ptp(expected)
    assert np.abs(found - expected).max() < 1e-6 * span  # rounding in float32
    # It has learnt by then, and the scale of the values has followed the costs.
    theta = np.float32(np.random.default_rng(0).uniform(-0.1, 0.1, (200, 4)) * [1, 1, 1, 30])
    moved = np.abs(model.predict(theta)[0] - model.policy.problem.explicit()(theta)).max()
    assert moved > 1e-3 * span
    scales = [each.policy.critic.qf0.scale for each in (model, other)]
    assert scales[1] / scales[0] == pytest.approx(units.get("cost", 1.0), rel=1e-5)


@th.no_grad()
def test_the_scale_moves_by_twos_and_leaves_what_the_critic_puts_out() -> None:
    _, model = trained()
    critic = model.policy.critic
    points = th.rand(50, 5)
    before = critic.values(points)[0]
    scale = critic.qf0.scale
    assert critic.rescale(100 * float(model.policy.mean_stage_cost)) >= 32 * scale
    assert th.equal(critic.values(points)[0], before)
    critic.rescale((1 - model.gamma) * scale)
    assert critic.qf0.scale == scale


def test_a_model_that_is_loaded_keeps_the_scale(tmp_path) -> None:
    _, model = trained()
    model.save(tmp_path / "model")
    loaded = DDPG.load(tmp_path / "model")
    assert loaded.critic.qf0.scale == model.critic.qf0.scale
    assert loaded.critic_target.qf0.scale == model.critic.qf0.scale
    assert float(loaded.policy.mean_stage_cost) == float(model.policy.mean_stage_cost)
