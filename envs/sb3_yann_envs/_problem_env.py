"""What the environments share: spaces, starts, steps, many copies, pictures, wrong calls."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from sb3_yann_envs.spaces import ProblemBox

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Frame = NDArray[np.uint8]


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
        self.render_mode = render_mode
        self.observation_space = states
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
        names = self.state_names
        shape = self.lowest.shape
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


class ProblemVectorEnv(VectorEnv[Single, Single, NDArray[Any]]):
    """Many copies of a plant that step as one array: what the vectorized environments share.

    ``gymnasium.make_vec("CSTR-v0", num_envs=100)`` makes them. Each copy has a random generator of
    its own: ``reset(seed=[...])`` starts the episodes that the single environment starts from these
    seeds. An episode that is over starts anew at the next step.
    """

    single: ClassVar[type[Any]]
    metadata = {
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
        "seeds_each": True,  # `reset` takes a seed for each copy
    }

    def __init__(self, num_envs: int = 1, max_episode_steps: int | None = None) -> None:
        self.num_envs = num_envs
        self.max_episode_steps = max_episode_steps
        self._env: ProblemEnv = self.single()
        self.single_observation_space = states = self._env.observation_space
        self.single_action_space = self._env.action_space
        box = gymnasium.spaces.Box(states.low, states.high, dtype=np.float32)
        self.observation_space = batch_space(box, num_envs)  # of a ProblemBox it would be the same
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators: list[np.random.Generator] = []
        self._over: NDArray[np.bool_] = np.zeros(num_envs, dtype=bool)
        self._steps = np.zeros(num_envs, dtype=np.int64)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Single, dict[str, Any]]:
        """Start all episodes.

        Parameters
        ----------
        seed : int or sequence of int, optional
            One for each copy, or the first of as many consecutive ones.
        options : dict, optional
            ``{"state": starts}``, shape (num_envs, n).
        """
        asked = asked_start(options)
        starts = [None] * self.num_envs if asked is None else [*asked]
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = [*seed]
        for name, given in (("seed", seeds), ("options['state']", starts)):
            if len(given) != self.num_envs:
                raise ValueError(f"{name} has {len(given)} entries for {self.num_envs} episodes.")
        self._generators = [
            self._generators[i] if self._generators and each is None else seeding.np_random(each)[0]
            for i, each in enumerate(seeds)
        ]
        states = [self._start(i, start) for i, start in enumerate(starts)]
        self._state = np.ascontiguousarray(np.array(states).T)
        self._over[:] = False
        self._steps[:] = 0
        observed = self._observed()
        return observed.astype(np.float32), {"state": observed, "_state": ~self._over}

    def step(
        self, actions: Single
    ) -> tuple[Single, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Step every copy; those whose episode is over start a new one instead, with reward 0."""
        if not self._generators:
            raise not_reset("step", "no episode has begun")
        u = np.asarray(actions, dtype=np.float64)
        if u.shape != (self.num_envs, 1) or np.isnan(u).any():
            raise ValueError(
                f"actions must be numbers of shape ({self.num_envs}, 1), got {actions!r}."
            )
        begun = np.flatnonzero(self._over)
        limit = self._env.limit
        cost, terminated = self._advance(np.clip(u[:, 0], -limit, limit))
        self._steps += 1
        for i in begun:
            self._state[:, i] = self._start(i, None)
        cost[begun] = 0.0
        terminated[begun] = False
        self._steps[begun] = 0
        longest = np.inf if self.max_episode_steps is None else self.max_episode_steps
        truncated = self._steps >= longest
        self._over = terminated | truncated
        observed = self._observed()
        info = {"cost": cost, "violation": terminated, "state": observed}
        info |= {f"_{name}": np.ones(self.num_envs, dtype=bool) for name in info}
        return observed.astype(np.float32), -cost, terminated, truncated, info

    def _start(self, i: int, start: Any) -> Any:
        """Return the i-th start, by the rules of the single environment."""
        self._env.np_random = self._generators[i]
        return self._env.reset(options=None if start is None else {"state": start})[1]["state"]

    def _observed(self) -> Array:
        """Return the observation of each copy in float64, shape (num_envs, n)."""
        return self._state.T.copy()

    def _advance(self, u: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Replace the state (n, num_envs) by the next one; return the costs and who terminated."""
        raise NotImplementedError


def new_figure(width: float, height: float) -> Figure:
    """Return a figure of the given size in inches (at 100 dots each) that pyplot never sees."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=100)


def pixels(figure: Figure) -> Frame:
    """Return the figure as RGB values of shape (height, width, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.array(canvas.buffer_rgba(), dtype=np.uint8)[:, :, :3].copy()  # type: ignore[no-untyped-call]
