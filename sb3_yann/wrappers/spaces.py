"""What the wrappers take: envs with vectors of observations and actions."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_yann._validation import check_type

Vector = NDArray[np.floating[Any]]
Env = gym.Env[Vector, Vector]


def require_vector(env: gym.Env[Any, Any], name: str) -> spaces.Box:
    """Return a space of the env, a Box with one dimension."""
    check_type("env", env, gym.Env, "a gymnasium.Env: gymnasium.make(id), or one of your own")
    space = getattr(env, name)
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise TypeError(
            f"{name} is {space}, the wrappers need a Box with one dimension. Wrap the env in "
            "gymnasium.wrappers.FlattenObservation, or observe the plant's state."
        )
    return space
