"""What the wrappers that complete theta have in common."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from sb3_yann._validation import Array
from sb3_yann.wrappers.spaces import Env, Vector, require_vector


class Appending(gym.Wrapper[Vector, Vector, Vector, Vector]):
    """Appends a vector between ``low`` and ``high`` to the observation.

    The first ``n_replaced`` entries of the env's observation give way to ``n_new`` unbounded ones.
    What lies on a bound is shown inside it, where float32 would round it beyond: some laws are zero
    outside their box.

    Parameters
    ----------
    env : gymnasium.Env, with one-dimensional Box spaces
    low, high : array_like, shape (p,)
        The box of what is appended.
    n_replaced, n_new : int
    """

    def __init__(
        self, env: Env, low: ArrayLike, high: ArrayLike, n_replaced: int = 0, n_new: int = 0
    ) -> None:
        inner = require_vector(env, "observation_space")
        super().__init__(env)
        self.inputs = require_vector(self, "action_space")
        self.low, self.high = (np.atleast_1d(np.array(side, np.float64)) for side in (low, high))
        if self.low.ndim != 1 or self.low.shape != self.high.shape:
            raise ValueError(
                f"low has shape {self.low.shape} and high {self.high.shape}; give the bounds of "
                "each appended entry as two vectors of the same length."
            )
        if not np.all(self.low <= self.high):  # nor is NaN
            raise ValueError(
                f"low = {self.low.tolist()} and high = {self.high.tolist()} must be numbers, and "
                "no entry of low may exceed that of high."
            )
        self._rounded = self.low.astype(np.float32), self.high.astype(np.float32)
        low32, high32 = self._rounded
        self._inside = (
            np.where(low32 < self.low, np.nextafter(low32, np.float32(np.inf)), low32),
            np.where(high32 > self.high, np.nextafter(high32, np.float32(-np.inf)), high32),
        )
        free = np.full(n_new, np.inf)
        self.observation_space = spaces.Box(
            np.concatenate([-free, inner.low[n_replaced:], self.low]).astype(np.float32),
            np.concatenate([free, inner.high[n_replaced:], self.high]).astype(np.float32),
            dtype=np.float32,
        )

    def reset(self, **kwargs: Any) -> tuple[Vector, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(**kwargs)  # seeds the generator that draws
        return self._shown(observation, None, info), info

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Step; the observation is the completed one."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        u = np.clip(np.asarray(action, np.float64), self.inputs.low, self.inputs.high)
        return self._shown(observation, u, info), float(reward), terminated, truncated, info

    def _shown(self, observation: Vector, u: Array | None, info: dict[str, Any]) -> Vector:
        """Return what is observed, with what was appended on its bounds or inside them."""
        shown = self._observe(observation, u, info)
        appended = shown[len(shown) - len(self.low) :]
        for rounded, inside in zip(self._rounded, self._inside, strict=True):
            np.copyto(appended, inside, where=appended == rounded)
        return shown

    def _observe(self, observation: Vector, u: Array | None, info: dict[str, Any]) -> Vector:
        """Return what is observed after an input u (m,), None at the start of an episode."""
        raise NotImplementedError


def joined(*parts: Vector) -> Vector:
    """Return the parts one after another, in float32."""
    return np.concatenate(parts).astype(np.float32)
