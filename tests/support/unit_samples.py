"""A linear plant in its own units, or in others, and the MPC of it."""

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TimeLimit

from sample_plants import Sampled
from sb3_yann import AffineObservation, LinearModel, LinearMPC

X_SS = np.array([350.0, 2.0])
U_SS = np.array([40.0])
MODEL = LinearModel(
    [[0.9, 0.2], [0, 0.7]], [[0], [0.5]], 0.1, X_SS, U_SS, state_names=["temperature", "level"]
)
LIMITS = {"x_min": [340, 0], "x_max": [360, 4], "u_min": 38, "u_max": 45}
CENTER = np.array([345.0, 2.0])
SCALE = np.array([10.0, 2.0])


def plant_mpc() -> LinearMPC:
    return LinearMPC(MODEL, Q=np.eye(2), R=[[0.1]], horizon=3, gamma=0.99, **LIMITS)


SHOWS = {
    "deviation": lambda x: x,
    "plant": lambda x: x + X_SS,
    "normalized": lambda x: (x + X_SS - CENTER) / SCALE,
}
SAYS = {"plant": None, "normalized": AffineObservation.normalized(CENTER, SCALE)}
TAKES = {"deviation": (-2.0, 5.0, 0.0), "plant": (38.0, 45.0, 40.0), "normalized": (-1, 1, None)}


class OwnUnits(Sampled):
    """The model as a plant; it shows and takes what it is asked to."""

    def __init__(self, shows: str, takes: str, dtype: type = np.float64) -> None:
        self.shows = SHOWS[shows]
        self.takes = takes
        low, high, _ = TAKES[takes]
        self.action_space = gym.spaces.Box(dtype(low), dtype(high), (1,), dtype)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), dtype)

    def shown(self) -> np.ndarray:
        return self.shows(self.x).astype(self.observation_space.dtype)

    def input(self, action) -> np.ndarray:
        """Return the input in deviations."""
        action = np.asarray(action, np.float64)
        return 1.5 + 3.5 * action if self.takes == "normalized" else action - TAKES[self.takes][2]

    def cost(self, action):
        u = self.input(action)
        return self.x @ self.x + 0.1 * u @ u

    def moved(self, action):
        return MODEL.step(self.x, self.input(action))


def plant(shows: str, takes: str, dtype: type = np.float64) -> gym.Env:
    return TimeLimit(OwnUnits(shows, takes, dtype), 20)


def states(count: int, seed: int, reach: float = 1.0) -> np.ndarray:
    """Return deviations of the state within the box of the law, or a part of it."""
    return np.random.default_rng(seed).uniform([-10, -2], [10, 2], (count, 2)) * reach
