"""The messages on the page of troubleshooting are those that are printed."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TransformReward
from stable_baselines3 import DDPG, SAC
from stable_baselines3.common.callbacks import EveryNTimesteps
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from policy_samples import scalar_mpc
from sample_plants import LinearPlant
from sb3_yann import (
    CostAudit,
    ImprovementGuard,
    LinearModel,
    LinearMPC,
    NoActionNoise,
    PlantTwin,
    YannPolicy,
)

PAGE = Path(__file__).parents[1] / "docs" / "troubleshooting.md"
UNSEEDED = np.random.default_rng(0)
"""No env seeds it."""


class Plant(LinearPlant):
    """A first-order plant, with something to go wrong."""

    def __init__(self, **changes) -> None:
        self.changes = changes
        super().__init__(scalar_mpc())
        for name in ("observation_space", "action_space"):
            setattr(self, name, changes.get(name, getattr(self, name)))

    def reset(self, *, seed=None, options=None):
        if self.changes.get("deaf"):
            seed = 0
        return super().reset(seed=seed, options=options)

    def step(self, action):
        x, reward, *rest = super().step(action)
        return x, reward + self.changes.get("noise", 0) * UNSEEDED.random(), *rest


def model(env: gym.Env | None = None, **policy_kwargs) -> DDPG:
    env = Plant() if env is None else env
    return DDPG(YannPolicy, env, policy_kwargs={"problem": scalar_mpc(), **policy_kwargs})


def learn(callback, env: gym.Env | None = None, steps: int = 5) -> None:
    model(env).learn(steps, callback=callback)


def box(low: float, high: float, size: int = 1) -> gym.spaces.Box:
    return gym.spaces.Box(low, high, (size,), np.float32)


def two_tanks() -> LinearMPC:
    plant = LinearModel([[0.9, 0.1], [0, 0.9]], [[0], [1]], 1)
    bounds = {"x_min": -5, "x_max": 5, "u_min": -1, "u_max": 1}
    return LinearMPC(plant, Q=np.eye(2), R=[[1]], horizon=6, **bounds)


def too_large() -> None:
    with patch("sb3_yann.control.mpc.linear_mpc.LARGE", 0):
        two_tanks().law()


def linear_plant_with(**changes) -> LinearMPC:
    plant = LinearModel([[0.9]], [[1]], 1)
    return LinearMPC(plant, **{"Q": [[1]], "R": [[1]], "horizon": 2, **changes})


def normalized() -> DDPG:
    return model(VecNormalize(DummyVecEnv([Plant]), training=False, norm_reward=False))


def shown_deviations() -> None:
    shown = Plant(observation_space=box(300, 400))
    shown.start = 0
    plant = LinearModel([[0.9]], [[1]], 1, x_ss=[350], state_names=["T"])
    design = {"Q": [[1]], "R": [[1]], "horizon": 2, "x_min": 345, "x_max": 355}
    problem = LinearMPC(plant, **design, u_min=-1, u_max=1)
    built = DDPG(YannPolicy, shown, policy_kwargs={"problem": problem})
    built.predict(np.array([2], np.float32))


def log(steps: int = 30, factor: float = 1) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return one episode of noise, and inputs that may be too large."""
    rng = np.random.default_rng(0)
    return [(rng.normal(size=(steps + 1, 1)), factor * rng.uniform(-1, 1, (steps, 1)))]


NO_BOX = "The algorithm only supports (<class 'gymnasium.spaces.box.Box'>,) as action spaces"
RAISED = (ValueError, TypeError, AssertionError, RuntimeError, Warning)
CASES: dict[str, Callable[[], object]] = {
    # The problem
    "x_min must lie below x_max, but entry 0 has": lambda: linear_plant_with(x_min=1, x_max=-1),
    "R must be positive definite": lambda: linear_plant_with(Q=[[0]], R=[[0]]),
    "The law needs a bounded box of theta, not": lambda: linear_plant_with(
        u_min=-1, u_max=1
    ).explicit(),
    "The MPC problem is infeasible: no theta in its box": lambda: linear_plant_with(
        x_min=8, x_max=9, u_min=-1, u_max=0
    ).explicit(),
    "The law has more than region_limit = 3 regions": lambda: two_tanks().explicit(region_limit=3),
    "The program will be solved online, at each point.": too_large,
    # The policy
    "YannPolicy has no problem: the observation space": lambda: DDPG(YannPolicy, Plant()),
    "This policy is one of TD3, not of": lambda: SAC(
        YannPolicy, Plant(), policy_kwargs={"problem": scalar_mpc()}
    ),
    "The observation has shape (3,), but the law of the problem takes theta": lambda: model(
        Plant(observation_space=box(-9, 9, 3))
    ),
    "The action space is [[-2.0], [2.0]], but the MPC has u_min = [-1.0]": lambda: model(
        Plant(action_space=box(-2, 2))
    ),
    NO_BOX: lambda: model(Plant(action_space=gym.spaces.Discrete(3))),
    "T = 2 is shown, and the operating point is 350": shown_deviations,
    "VecNormalize normalizes observations, and the law takes the state.": normalized,
    # The reward
    "The reward is not minus the cost of the problem": lambda: learn(
        [NoActionNoise(), CostAudit(steps=10)],
        TransformReward(Plant(), lambda reward: 2 * reward),
        steps=20,
    ),
    # The guard
    "The guard's env Plant is the training env": lambda: learn(
        ImprovementGuard(env := Plant()), env
    ),
    "The MPC played two episodes of the guard's env": lambda: learn(
        ImprovementGuard(lambda: gym.wrappers.TimeLimit(Plant(noise=0.1), 5), n_eval_episodes=2)
    ),
    "All 3 starts of the guard's env": lambda: learn(
        ImprovementGuard(lambda: gym.wrappers.TimeLimit(Plant(deaf=True), 5), n_eval_episodes=3)
    ),
    "The guard is within a callback of the class EveryNTimesteps": lambda: learn(
        EveryNTimesteps(2, ImprovementGuard(Plant))
    ),
    # Logs and twins
    "The data do not excite the plant": lambda: LinearModel.from_data(
        np.zeros((30, 1)), np.zeros((29, 1)), dt=1
    ),
    "episode 0: action 0 is": lambda: PlantTwin.fit(scalar_mpc(), log(factor=5)),
    "The twin is not to be trusted": lambda: PlantTwin.fit(scalar_mpc(), log()).env(),
}


def quoted() -> list[str]:
    """Return the beginnings of messages that the page quotes."""
    return re.findall(r"^\| `(.+?)` \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)


def test_each_message_of_the_page_is_one_of_the_cases() -> None:
    assert sorted(quoted()) == sorted(CASES)


@pytest.mark.parametrize("beginning", CASES)
def test_the_message_begins_as_quoted(beginning: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(RAISED) as raised:
            CASES[beginning]()
    assert str(raised.value).startswith(beginning)
