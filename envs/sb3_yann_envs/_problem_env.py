"""What the environments share: spaces, starts, steps, and the errors of a wrong call."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann_envs.rendering import Frame
from sb3_yann_envs.spaces import ProblemBox

Array = NDArray[np.float64]
Single = NDArray[np.float32]


def constant(values: ArrayLike) -> Array:
    """Return `values` as a float64 array that cannot be written to."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


class ProblemEnv(gymnasium.Env[Single, Single]):
    """A plant with one input, whose observation space carries its control problem."""

    state_names: ClassVar[tuple[str, ...]]
    lowest: ClassVar[Array]  # start that `reset` accepts
    highest: ClassVar[Array]
    start_low: ClassVar[Array]  # random start
    start_high: ClassVar[Array]
    observation_space: ProblemBox
    _state: Any = None  # a tuple of floats, once an episode has begun

    def __init__(self, render_mode: str | None, states: ProblemBox, max_input: float) -> None:
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ValueError(f"render_mode must be None or one of {modes}, got {render_mode!r}.")
        self.render_mode, self.observation_space = render_mode, states
        self.action_space = gymnasium.spaces.Box(-max_input, max_input, (1,), np.float32)
        self.limit = max_input

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Single, dict[str, Any]]:
        """Start an episode, from a random state or from ``options["state"]``, shape (n,)."""
        super().reset(seed=seed)
        start = asked_start(options)
        if start is None:
            state = self.np_random.uniform(self.start_low, self.start_high)
        else:
            state = self._valid(np.asarray(start, dtype=np.float64))
        self._state = tuple(state.tolist())
        self._begin()
        state = self._observed()
        return state.astype(np.float32), {"state": state}

    def step(self, action: Single) -> tuple[Single, float, bool, bool, dict[str, Any]]:
        """Hold an input, clipped to its bounds, for one sample."""
        if self._state is None:
            raise not_reset("step", "there is no state yet")
        cost, violation = self._advance(self._clipped(action))
        state = self._observed()
        info = {"cost": cost, "violation": violation, "state": state}
        return state.astype(np.float32), -cost, violation, False, info

    def render(self) -> Frame | None:
        """Return a picture of shape (400, width, 3), or None without a render mode."""
        if self.render_mode is None:  # the warning of Gymnasium's own environments
            env_id = type(self).__name__ if self.spec is None else self.spec.id
            gymnasium.logger.warn(
                "You are calling render method without specifying any render mode. You can specify "
                f'it at initialization, e.g. gym.make("{env_id}", render_mode="rgb_array")'
            )
            return None
        if self._state is None:
            raise not_reset("render", "there is no state yet")
        return self._frame()

    def _begin(self) -> None:
        """Forget the last episode."""
        raise NotImplementedError

    def _advance(self, u: float) -> tuple[float, bool]:
        """Replace the state by the next one; return the cost, and whether a limit is violated."""
        raise NotImplementedError

    def _frame(self) -> Frame:
        raise NotImplementedError

    def _observed(self) -> Array:
        """Return the observation in float64, shape (n,)."""
        return np.array(self._state)

    def _clipped(self, action: ArrayLike) -> float:
        values = np.asarray(action, dtype=np.float64)
        if values.shape != (1,):
            raise ValueError(f"action must have shape (1,), got shape {values.shape}: {action!r}.")
        value = float(values[0])
        if math.isnan(value):
            raise ValueError(
                f"action must be a number, got {action!r}. A policy that returns NaN has usually "
                "diverged in an earlier update."
            )
        return min(max(value, -self.limit), self.limit)

    def _valid(self, start: Array) -> Array:
        names, shape = self.state_names, self.lowest.shape
        if start.shape != shape:
            raise ValueError(
                f"options['state'] must have shape {shape} ({', '.join(names)}), "
                f"got shape {start.shape}."
            )
        for name, value, lower, upper in zip(names, start, self.lowest, self.highest, strict=True):
            if not lower <= value <= upper:  # also true for NaN
                raise ValueError(
                    f"options['state']: {name} must be in [{lower:.9g}, {upper:.9g}], got {value}."
                )
        return start


def asked_start(options: Mapping[str, Any] | None) -> Any:
    """Return ``options["state"]``, which a `reset` asks to start from, None if it asks for none."""
    if not options:
        return None
    unknown = sorted(map(str, set(options) - {"state"}))
    if unknown:
        raise ValueError(f"options has unknown keys {unknown}; the only key is 'state'.")
    if options["state"] is None:
        raise ValueError("options['state'] is None: leave it out for a random start.")
    return options["state"]


def not_reset(what: str, reason: str) -> gymnasium.error.ResetNeeded:
    """Return the error for a `what` ("step", "render") that needs a `reset` first."""
    return gymnasium.error.ResetNeeded(f"Call env.reset() before env.{what}(): {reason}.")
