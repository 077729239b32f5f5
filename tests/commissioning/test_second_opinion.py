"""A twin's members agree on what no log told them: a model of another kind must agree as well."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_yann import LinearModel, LinearMPC, PlantTwin, improve
from sb3_yann_envs import ProblemBox
from twin_samples import Cart, log, problem

DT, FRICTION = 0.05, 2.4
TESTS = range(900, 930)


@pytest.fixture(autouse=True)
def no_networks() -> None:
    """Here a log may have them."""


def motor() -> LinearMPC:
    """A motor's angle and speed; the model knows no dry friction."""
    model = LinearModel.from_continuous([[0, 1], [0, -1.5]], [[0], [2.0]], dt=DT)
    return LinearMPC(
        model, Q=np.diag([1, 0.02]), R=[[0.005]], horizon=5,
        x_min=[-6, -18], x_max=[6, 18], u_min=-12, u_max=12,
    )  # fmt: skip


class Motor(gym.Env[Any, Any]):
    """The motor with dry friction. Its MPC's input is on a bound but near the target."""

    def __init__(self, mpc: LinearMPC) -> None:
        low, high = np.float32(mpc.theta_min), np.float32(mpc.theta_max)
        self.mpc, self.observation_space = mpc, ProblemBox(low, high, problem=mpc)
        self.action_space = gym.spaces.Box(-12, 12, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = self.np_random.uniform([-3, -5], [3, 5]), 0
        return self.x.astype(np.float32), {}

    def step(self, action):
        cost = float(self.mpc.stage_cost(self.x, np.asarray(action, float)))
        place, speed = self.x
        for _ in range(10):
            drive = 2.0 * float(action[0]) - 1.5 * speed
            if abs(speed) < 1e-3 and abs(drive) <= FRICTION:
                speed = 0.0
            else:
                way = np.sign(speed if abs(speed) >= 1e-3 else drive)
                after = speed + DT / 10 * (drive - FRICTION * way)
                speed = 0.0 if speed * after < 0 else after
            place += DT / 10 * speed
        self.x, self.t = np.array([place, speed]), self.t + 1
        return self.x.astype(np.float32), -cost, False, self.t >= 100, {}


def episodes(mpc: LinearMPC, act: Any, seeds: range) -> tuple[list[Any], np.ndarray]:
    """Return a log of the motor, and what each episode cost."""
    env, law, found, costs = Motor(mpc), mpc.law(), [], []
    for seed in seeds:
        x, over, cost = env.reset(seed=seed)[0], False, 0.0
        states, actions = [x], []
        while not over:
            actions.append(np.atleast_1d((act or law)(x)))
            x, reward, _, over, _ = env.step(actions[-1])
            states.append(x)
            cost -= reward
        found.append((np.array(states, float), np.array(actions, float)))
        costs.append(cost)
    return found, np.array(costs)


@pytest.mark.slow
def test_what_no_polynomial_knows_is_refused_with_polynomials_and_gained_with_networks() -> None:
    mpc = motor()
    logged, (_, before) = episodes(mpc, None, range(100, 110))[0], episodes(mpc, None, TESTS)
    for kinds in (("none", "linear", "quadratic", "cubic"), ("none", "network")):
        twin = PlantTwin.fit(mpc, logged, residuals=kinds)
        assert twin.trusted
        model = DDPG("YannPolicy", Motor(mpc), device="cpu", seed=0)
        found = improve(model, twin)
        assert found.accepted == ("network" in kinds)
    costs = episodes(mpc, lambda x: model.predict(x)[0], TESTS)[1]
    assert costs.mean() < 0.99 * before.mean() and np.all(costs < before)
    assert costs.mean() / before.mean() - 1 == pytest.approx(found.change, abs=0.02)


def test_the_second_opinion_knows_the_log_and_nothing_beyond() -> None:
    twin = PlantTwin.fit(problem(), log(5))
    theta, u = twin.episodes[0].thetas, twin.episodes[0].actions
    second, given = twin.second_opinion, np.concatenate(problem().prediction, axis=1)
    there = second.step(theta[None, :-1], u[None])[0]
    assert np.abs(there - theta[1:]).max() < 1e-3
    linear = np.hstack([theta[:-1], u]) @ given.T
    assert np.abs(linear - theta[1:]).max() > 1e-2
    # A slow cart far away under full force: the log has no such row, the MPC brakes there.
    far = np.array([[[3.0, 3.0]]]), np.array([[[1.0]]])
    known = np.abs(second.step(*far)[0, 0] - given @ [3.0, 3.0, 1.0])
    twins = np.abs(twin.dynamics.step(*(np.repeat(each, 5, 0) for each in far)) - given @ [3, 3, 1])
    assert known.max() < 0.5 * twins[0].max()


def test_what_gains_on_the_plant_passes() -> None:
    twin = PlantTwin.fit(problem(), log(5))
    model = DDPG("YannPolicy", Cart(), device="cpu", seed=0)
    assert improve(model, twin, updates=1000, n_starts=20).accepted
