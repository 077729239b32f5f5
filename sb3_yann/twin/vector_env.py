"""Many episodes of a twin that step as one array, for Gymnasium and for Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_yann._validation import Array, check_int
from sb3_yann.twin.dynamics import Dynamics
from sb3_yann.twin.env import Single, TwinEnv, step_all


class _Copies:
    """Envs of one twin, and the member that acts in each of them."""

    def __init__(self, envs: Sequence[TwinEnv]) -> None:
        self.envs = envs
        self._stack: Dynamics | None = None

    def reset(self) -> None:
        """Take note that an episode has begun: another member may act in it."""
        self._stack = None

    def step(self, actions: Any) -> tuple[Array, dict[str, NDArray[Any]], NDArray[np.bool_]]:
        """Return thetas, what infos tell, and which episodes are over."""
        first = self.envs[0]
        if any(each._theta is None for each in self.envs):
            raise gym.error.ResetNeeded("Call env.reset() before env.step().")
        if self._stack is None:
            members = tuple(each._acting.members[0] for each in self.envs)
            self._stack = Dynamics(first.dynamics.problem, first.dynamics.coordinates, members)
        u, shape = np.asarray(actions, np.float64), (len(self.envs), first.dynamics.m)
        if u.shape != shape or not np.all(np.isfinite(u)):
            raise ValueError(f"actions = {actions!r} must be {shape} finite numbers.")
        rows, told, over = step_all(self.envs, self._stack, u)
        units = first.dynamics.problem.units
        return units.to_plant(first.dynamics.row.shown(rows)), told, over


class TwinVectorEnv(VectorEnv[Single, Single, NDArray[Any]]):
    """Copies of a :class:`TwinEnv` that step as one array; each has a random generator of its own.

    Where an episode is over the next one begins in the same step: ``info["final_obs"]`` holds its
    last observation. The rest of ``info`` is that of the step.

    :meth:`PlantTwin.vector_env` makes one.

    Parameters
    ----------
    envs : sequence of TwinEnv
        Of one twin.
    """

    metadata: dict[str, Any] = {
        "render_modes": [],
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "seeds_each": True,  # `reset` takes a seed for each copy
    }

    def __init__(self, envs: Sequence[TwinEnv]) -> None:
        self.envs, self._copies, self.num_envs = tuple(envs), _Copies(envs), len(envs)
        self.single_observation_space = theta = envs[0].observation_space
        self.single_action_space = envs[0].action_space
        box = gym.spaces.Box(theta.low, theta.high, dtype=np.float32)
        self.observation_space = batch_space(box, self.num_envs)  # a ProblemBox would stay one
        self.action_space = batch_space(self.single_action_space, self.num_envs)

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
            ``{"state": starts}``, shape (num_envs, n) or (num_envs, n_theta).
        """
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = [*seed]
        if options and "state" not in options:
            raise ValueError(f"options = {options!r} must be {{'state': starts}}.")
        starts = [{"state": each} for each in options["state"]] if options else [None] * len(seeds)
        for name, given in (("seed", seeds), ("options['state']", starts)):
            if len(given) != self.num_envs:
                raise ValueError(f"{name} has {len(given)} entries for {self.num_envs} episodes.")
        begun = [
            each.reset(seed=seed, options=start)
            for each, seed, start in zip(self.envs, seeds, starts, strict=True)
        ]
        self._copies.reset()
        infos: dict[str, Any] = {}
        for i, (_, info) in enumerate(begun):
            infos = self._add_info(infos, info, i)
        return np.array([observation for observation, _ in begun]), infos

    def step(
        self, actions: Single
    ) -> tuple[Single, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Step every copy; whose episode is over starts the next one."""
        thetas, told, over = self._copies.step(actions)
        infos: dict[str, Any] = {**told, "state": thetas}
        infos |= {f"_{name}": np.ones(self.num_envs, dtype=bool) for name in infos}
        observations = thetas.astype(np.float32)
        for i in np.flatnonzero(over):
            final = {name: each[i] for name, each in told.items()} | {"state": thetas[i].copy()}
            ended = {"final_obs": observations[i].copy(), "final_info": final}
            infos = self._add_info(infos, ended, i)
            observations[i], begun = self.envs[i].reset()
            infos["state"][i] = begun["state"]
            self._copies.reset()
        return observations, -told["cost"], np.zeros_like(over), over, infos


class TwinVecEnv(DummyVecEnv):
    """Copies of a :class:`TwinEnv` that step as one array, as Stable-Baselines3 takes them.

    :meth:`PlantTwin.vec_env` makes one.

    Parameters
    ----------
    envs : sequence of TwinEnv
        Of one twin.
    """

    def __init__(self, envs: Sequence[TwinEnv]) -> None:
        super().__init__([iter(envs).__next__] * len(envs))
        self._copies = _Copies(envs)

    def reset(self) -> Any:
        """Start all episodes."""
        self._copies.reset()
        return super().reset()

    def step_wait(self) -> tuple[Any, Any, Any, list[dict[str, Any]]]:
        """Step every copy; whose episode is over starts the next one."""
        thetas, told, over = self._copies.step(self.actions)
        observations = thetas.astype(np.float32)
        infos: list[dict[str, Any]] = [
            {**dict(zip(told, values, strict=True)), "state": theta, "TimeLimit.truncated": ended}
            for *values, theta, ended in zip(
                *(each.tolist() for each in told.values()), thetas, over.tolist(), strict=True
            )
        ]
        for i in np.flatnonzero(over):
            infos[i]["terminal_observation"] = observations[i].copy()
            observations[i], self.reset_infos[i] = self.envs[i].reset()
            self._copies.reset()
        return observations, -told["cost"].astype(np.float32), over, infos


def copies(env: TwinEnv, n_envs: int) -> list[TwinEnv]:
    """Return so many envs like the given one."""
    own = env.dynamics, env.episodes, env.starts, env.limits, env.member
    return [TwinEnv(*own) for _ in range(check_int("n_envs", n_envs))]
