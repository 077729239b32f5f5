"""Many copies of an environment that step as one array: hundreds of episodes in less than a second.

``gymnasium.make_vec("CSTR-v0", num_envs=100)`` makes them. Each copy has a random generator of its
own: ``reset(seed=[...])`` starts the episodes that the single environment starts from these seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from sb3_yann_envs import clipped_pendulum, cstr
from sb3_yann_envs._problem_env import Array, ProblemEnv, Single, asked_start, not_reset


class _VectorEnv(VectorEnv[Single, Single, NDArray[Any]]):
    """What the vectorized environments share: starts, time limit, and resets at the next step."""

    single: ClassVar[type[cstr.CSTREnv | clipped_pendulum.ClippedPendulumEnv]]
    metadata = {
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
        "seeds_each": True,  # `reset` takes a seed for each copy
    }

    def __init__(self, num_envs: int = 1, max_episode_steps: int | None = None) -> None:
        self.num_envs, self.max_episode_steps = num_envs, max_episode_steps
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
        self._over[:], self._steps[:] = False, 0
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
        begun, limit = np.flatnonzero(self._over), self._env.limit
        cost, terminated = self._advance(np.clip(u[:, 0], -limit, limit))
        self._steps += 1
        for i in begun:
            self._state[:, i] = self._start(i, None)
        cost[begun], terminated[begun], self._steps[begun] = 0.0, False, 0
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


class CSTRVectorEnv(_VectorEnv):
    """Many `sb3_yann_envs.cstr.CSTREnv`."""

    single = cstr.CSTREnv

    def _advance(self, u: Array) -> tuple[Array, NDArray[np.bool_]]:
        a, b, s, t = self._state
        cost = cstr.stage_cost(a, b, s, t, u)
        after = np.empty_like(self._state)
        cstr.advance_all(self._state, cstr.U_SS[0] + u, after)
        self._state = after
        terminated = cstr.X_SS[3] + self._state[3] > cstr.TEMPERATURE_LIMIT
        return cost + cstr.PENALTY * terminated, terminated


class ClippedPendulumVectorEnv(_VectorEnv):
    """Many `sb3_yann_envs.clipped_pendulum.ClippedPendulumEnv`."""

    single = clipped_pendulum.ClippedPendulumEnv

    def _advance(self, u: Array) -> tuple[Array, NDArray[np.bool_]]:
        theta, speed = self._state
        cost = clipped_pendulum.stage_cost(theta, speed, u)
        speed = clipped_pendulum.next_speed(np.sin(theta), speed, u)
        speed = np.clip(speed, -clipped_pendulum.MAX_SPEED, clipped_pendulum.MAX_SPEED)
        self._state = np.array([theta + speed * clipped_pendulum.DT, speed])
        return cost, np.zeros(self.num_envs, dtype=bool)

    def _observed(self) -> Array:
        return np.column_stack([clipped_pendulum.wrapped(self._state[0]), self._state[1]])
