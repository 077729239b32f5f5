"""No setting carries a unit: the same plant in other units is learnt the same way."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback

from sb3_yann import LinearModel, NoActionNoise, YannPolicy
from sb3_yann_envs import problems

EPISODES, STEPS = 5, 100


class OtherUnits(gym.Wrapper):
    """Shows states, takes inputs and pays rewards in so many of other units."""

    def __init__(self, env: gym.Env, cost: float, x: Any, u: Any) -> None:
        super().__init__(env)
        self.cost, self.x, self.u = cost, x, u
        seen, taken = env.observation_space, env.action_space
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
    mpc, x_unit = problems.cstr(), np.array(x)
    to_x, from_x = np.diag(x_unit), np.diag(1 / x_unit)
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


@pytest.mark.parametrize(
    "units",
    [{"cost": 1e-3}, {"x": (1e3, 1e-2, 7.0, 0.1)}, {"u": 100.0}],
    ids=["cost / 1000", "states", "inputs"],
)
def test_other_units_give_the_same_actions_through_five_training_episodes(units) -> None:
    expected, model = trained()
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
    before, scale = critic.values(points)[0], critic.qf0.scale
    assert critic.rescale(100 * float(model.policy.mean_stage_cost)) >= 32 * scale
    assert th.equal(critic.values(points)[0], before)
    critic.rescale((1 - model.gamma) * scale)
    assert critic.qf0.scale == scale


def test_a_model_that_is_loaded_keeps_the_scale(tmp_path) -> None:
    _, model = trained()
    model.save(tmp_path / "model")
    loaded = DDPG.load(tmp_path / "model", device="cpu")
    assert loaded.critic.qf0.scale == model.critic.qf0.scale
    assert loaded.critic_target.qf0.scale == model.critic.qf0.scale
    assert float(loaded.policy.mean_stage_cost) == float(model.policy.mean_stage_cost)
