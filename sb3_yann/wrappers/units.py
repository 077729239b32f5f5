"""A plant that shows and takes absolute values, in deviations from the operating point."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_yann._validation import Array
from sb3_yann.control import LinearModel, LinearMPC
from sb3_yann.wrappers.spaces import Env, Vector, require_vector


class Deviations(gym.Wrapper[Vector, Vector, Vector, Vector]):
    """Shows ``x - x_ss`` and takes ``u - u_ss``, in boxes that are shifted likewise.

    Wrap the plant in it first; what other wrappers append then counts from the operating point too,
    as a :class:`MeasuredDisturbance` counts from ``d_ss``.
    Entries of the observation after the n states stay as they are, but for the set-points of a
    plant that shows its own: pass the problem for those. An env that is wrapped in it already is
    refused, and so is an action that is NaN.

    Parameters
    ----------
    env : gymnasium.Env, with one-dimensional Box spaces
        Its observation begins with the model's n states, its action is the m inputs.
    model : LinearModel or LinearMPC
        Its operating point is taken off. With a problem that has ``tracking``, the p entries after
        the states are set-points, and ``C x_ss`` is taken off them.

    Examples
    --------
    >>> model = LinearModel(np.eye(4) / 2, np.ones((4, 1)), dt=1, x_ss=[1, 2, 3, 4], u_ss=[0.5])
    >>> env = Deviations(gym.make("CSTR-v0"), model)
    >>> env.action_space.high - gym.make("CSTR-v0").action_space.high
    array([-0.5])
    """

    def __init__(self, env: Env, model: LinearModel | LinearMPC) -> None:
        super().__init__(env)
        tracked: Array = np.zeros((0, 0))
        if isinstance(model, LinearMPC):
            tracked, model = model.tracking.C, model.model
        if not isinstance(model, LinearModel):
            raise TypeError(f"model = {model!r} must be a LinearModel or a LinearMPC.")
        _require_absolute(env)
        seen, taken = (require_vector(env, f"{k}_space") for k in ("observation", "action"))
        n, m = model.n_states, model.n_inputs
        if seen.shape[0] < n or taken.shape != (m,):
            raise ValueError(
                f"The env shows {seen.shape} and takes {taken.shape}, but the model has {n} states "
                f"and {m} inputs. Wrap the plant before other wrappers, or pass its own model; of "
                "one with dead time wrap the plant in PastInputs first."
            )
        self.x_ss: Array = np.zeros(seen.shape[0])
        self.x_ss[:n] = model.x_ss
        if tracked.size and seen.shape[0] > n:
            self.x_ss[n : n + len(tracked)] = tracked @ model.x_ss
        self.u_ss: Array = model.u_ss
        self.d_ss: Array = model.d_ss[[*model.measured]]
        self.taken = taken
        self.observation_space = _shifted(seen, self.x_ss)
        self.action_space = _shifted(taken, self.u_ss)

    def reset(self, **kwargs: Any) -> tuple[Vector, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(**kwargs)
        return np.asarray(observation, np.float64) - self.x_ss, info

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Step with ``u_ss`` added to the action, and ``x_ss`` taken off the observation."""
        # Rounding must not leave the space of the env.
        u = np.clip(np.asarray(action, np.float64) + self.u_ss, self.taken.low, self.taken.high)
        if np.isnan(u).any():
            raise ValueError(f"action = {np.asarray(action).tolist()} must not be NaN.")
        observation, reward, terminated, truncated, info = self.env.step(u.astype(self.taken.dtype))
        shown = np.asarray(observation, np.float64) - self.x_ss
        return shown, float(reward), terminated, truncated, info


def _require_absolute(env: gym.Env[Any, Any]) -> None:
    """Raise if a wrapper has taken an operating point off before."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, Deviations):
            raise ValueError(
                "The env is wrapped in Deviations already: the operating point would be taken off "
                "twice. Wrap it once."
            )
        env = env.env


def _shifted(space: spaces.Box, point: Array) -> Any:
    """Return the box of what is seen minus the point."""
    return spaces.Box(space.low - point, space.high - point, dtype=np.float64)
