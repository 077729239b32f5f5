"""An env that shows functions of theta, and models that are told how to read them."""

from functools import cache

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import DDPG

from sample_plants import LinearPlant, two_input_mpc
from sb3_yann import AffineObservation, YannPolicy

MPC = two_input_mpc()
LOW = np.array([-5.0, -5, -5])
HIGH = np.array([5.0, 6, 7])
STEADY = np.array([20.0, 0, -7])
FAR = np.array([1e5, 0, 0])
RANDOM = AffineObservation(np.random.default_rng(0).normal(size=(3, 5)), [1, 2, 3])


@cache
def law():
    return MPC.explicit()


class Seen(gym.ObservationWrapper):
    """Shows a function of theta, in float32 unless it is given another type."""

    def __init__(self, show, size: int, start: float = 1.0, dtype: type = np.float32) -> None:
        super().__init__(TimeLimit(LinearPlant(MPC, start), 20))
        self.show = show
        self.dtype = dtype
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), dtype)

    def observation(self, _):
        return np.asarray(self.show(self.unwrapped.x), self.dtype)


def build(env, observation: AffineObservation, algorithm=DDPG, **kwargs):
    policy = {"problem": MPC, "observation": observation, "critic_warmup": 0}
    policy |= kwargs.pop("policy_kwargs", {})
    return algorithm(YannPolicy, env, policy_kwargs=policy, seed=0, buffer_size=1000, **kwargs)


def states(count: int = 5000) -> np.ndarray:
    return np.random.default_rng(0).uniform(LOW, HIGH, (count, 3))


def error(model, observations: np.ndarray, theta: np.ndarray) -> float:
    """Return the largest distance of `predict` from the law, as a fraction of the input range."""
    actions, _ = model.predict(observations)
    return float(np.max(np.abs(actions - law()(theta)) / (MPC.u_max - MPC.u_min)))
