"""A small plant that its linear model does not describe, its MPC, and logs of it."""

from dataclasses import replace
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np

from sample_plants import Sampled
from sb3_yann import (
    DisturbanceObserver,
    LinearModel,
    LinearMPC,
    PlantTwin,
    RateLimits,
    Tracking,
    offset_free,
)
from sb3_yann.twin.log import Episode
from sb3_yann.wrappers import ObserveDisturbance
from sb3_yann_envs import ProblemBox

DT = 0.1

POLYNOMIALS = ("none", "linear", "quadratic")  # a fit of networks takes seconds


@cache
def problem() -> LinearMPC:
    """A cart with a force; the model knows nothing of the slope that it stands on."""
    model = LinearModel([[1.0, DT], [0.0, 0.95]], [[0.0], [DT]], DT)
    return LinearMPC(
        model, Q=np.diag([1.0, 0.1]), R=[[0.5]], horizon=3,
        u_min=-1, u_max=1, theta_min=[-3, -3], theta_max=[3, 3],
    )  # fmt: skip


class Cart(Sampled):
    """The plant: theta is observed, the reward is minus the stage cost."""

    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    starts = ([-1.5, -0.5], [1.5, 0.5])

    def __init__(self, steps: int = 60) -> None:
        mpc = problem()
        low = np.float32(mpc.theta_min)
        high = np.float32(mpc.theta_max)
        self.observation_space = ProblemBox(low, high, problem=mpc)
        self.steps = steps

    def cost(self, u):
        return problem().stage_cost(self.x, np.clip(u, -1, 1))

    def moved(self, u):
        place, speed = self.x
        pull = 0.3 * place**2 - 0.8 * place
        force = np.clip(u, -1, 1)[0]
        return np.array([place + DT * speed, 0.9 * speed + DT * (2.0 * force - pull)])


def log(episodes: int, noise: float = 0.0, first: int = 0, act: Any = None) -> list[Any]:
    """Return episodes of the MPC, or of another function, with sensor noise."""
    rng = np.random.default_rng(first)
    env = Cart()
    found = []
    act = problem().explicit() if act is None else act
    for seed in range(first, first + episodes):
        x = env.reset(seed=seed)[0]
        over = False
        states = [x + noise * rng.standard_normal(2)]
        actions = []
        while not over:
            actions.append(np.atleast_1d(act(states[-1])))
            x, _, _, over, _ = env.step(actions[-1])
            states.append(x + noise * rng.standard_normal(2))
        found.append((np.array(states, float), np.array(actions, float)))
    return found


def random_episode(mpc: LinearMPC, steps: int = 12, seed: int = 0) -> Episode:
    """Return an episode whose set-points and disturbances move at each step."""
    rng = np.random.default_rng(seed)
    thetas = 0.1 * rng.uniform(mpc.theta_min, mpc.theta_max, (steps + 1, mpc.n_theta))
    return Episode(thetas, rng.uniform(mpc.u_min, mpc.u_max, (steps, mpc.model.n_inputs)))


@cache
def twin(episodes: int = 5) -> PlantTwin:
    """Return the cart's twin."""
    return PlantTwin.fit(problem(), log(episodes), residuals=POLYNOMIALS)


def rated() -> PlantTwin:
    """The cart's twin with bounds on the rate of its input."""
    mpc = replace(problem(), rate=RateLimits(-0.3, 0.3))
    return PlantTwin.fit(mpc, log(4), residuals=POLYNOMIALS)


D_MAX = 0.02
"""Largest disturbance of the offset-free cart: less than what its observer estimates at times."""


@cache
def offset_free_problem() -> tuple[LinearMPC, Any]:
    """The cart's MPC with a set-point and a disturbance, and the observer that estimates it."""
    mpc, _ = offset_free(replace(problem(), horizon=2, tracking=Tracking([0], -0.5, 0.5)), D_MAX)
    return mpc, DisturbanceObserver(mpc.model, disturbance_noise=0.05)  # a slow one


class Calm(Cart):
    """The cart, from starts from which it does not run away at first."""

    def reset(self, *, seed=None, options=None):
        self.x = 0.4 * super().reset(seed=seed)[0]
        return self.x.astype(np.float32), {}


class Moved(gym.Wrapper[Any, Any, Any, Any]):
    """A plant whose set-point changes amid an episode; it is appended to the measurement."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        low = np.append(env.observation_space.low, -0.5)
        high = np.append(env.observation_space.high, 0.5)
        self.observation_space = gym.spaces.Box(np.float32(low), np.float32(high))

    def reset(self, *, seed=None, options=None):
        x, info = self.env.reset(seed=seed, options=options)
        self.wanted = np.random.default_rng(seed).uniform(-0.5, 0.5, 2)
        self.t = 0
        return np.float32([*x, self.wanted[0]]), info

    def step(self, action):
        x, reward, over, late, info = self.env.step(action)
        self.t += 1
        return np.float32([*x, self.wanted[self.t // 30 % 2]]), reward, over, late, info


def observed_env(plant: Any = None) -> ObserveDisturbance:
    """Return the cart, or another plant, as its offset-free MPC sees it."""
    mpc, observer = offset_free_problem()
    bounds = mpc.disturbances.d_min, mpc.disturbances.d_max
    return ObserveDisturbance(Moved(Calm() if plant is None else plant), observer, *bounds)


def observed_log(episodes: int = 5, plant: Any = None) -> list[Any]:
    """Return episodes of the offset-free MPC: thetas and actions, and what the plant did.

    The third entry of each are the plant's states, the fourth the observer's estimates.
    """
    law = offset_free_problem()[0].explicit()
    env = observed_env(plant)
    found = []
    for seed in range(episodes):
        theta = env.reset(seed=seed)[0]
        over = False
        rows = [theta]
        actions = []
        states = [env.unwrapped.x]
        estimates = [env.observer.estimate]
        while not over:
            actions.append(law(theta).astype(np.float32))
            theta, _, _, over, _ = env.step(actions[-1])
            rows.append(theta)
            states.append(env.unwrapped.x)
            estimates.append(env.observer.estimate)
        found.append((*map(np.array, (rows, actions, states, estimates)),))
    return found


@cache
def observed() -> PlantTwin:
    """Return the twin of the cart and its observer."""
    mpc, observer = offset_free_problem()
    return PlantTwin.fit(
        mpc, [each[:2] for each in observed_log()], observer=observer, residuals=POLYNOMIALS
    )
