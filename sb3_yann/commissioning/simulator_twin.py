"""A simulator in the place of a twin: the gradient goes through its own steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_yann._validation import Array
from sb3_yann.audit.closed_loops import Excited, of_law, require_repeated
from sb3_yann.audit.in_deviations import in_deviations, require_theta_shown
from sb3_yann.audit.observed_order import warn_of_order
from sb3_yann.audit.own_reward import below_set_points, warn_of_own_reward
from sb3_yann.audit.plants import simulated_dynamics
from sb3_yann.control import LinearMPC
from sb3_yann.rollout import Controller, EnvPool, Source, Trajectories, maker, rollout
from sb3_yann.twin.dynamics import Coordinates, Dynamics
from sb3_yann.twin.limits import Limits
from sb3_yann.twin.log import SHORTEST, Episode
from sb3_yann.twin.observers import observer_of
from sb3_yann.twin.plant_twin import PlantTwin
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.twin.starts import Starts

LOGGED = 40
"""Episodes of the MPC that are played first: they tell where runs of a gradient begin."""
FIRST, APART = 3_000_000, 1_000_000
"""Seed of the first episode; how far those of two seeds are apart."""


@dataclass(frozen=True, eq=False)
class SimulatorTwin:
    """A simulator that stands where a :class:`PlantTwin` may, with one member.

    Attributes
    ----------
    problem : LinearMPC
        Whose theta it shows.
    episodes : tuple of Episode
        Those of the MPC that were played first, in rows of ``dynamics.row``.
    dynamics : Dynamics
        Its own steps; of one that is random, or cannot be put into a state, those of a twin.
    units : ndarray, shape (n,)
        How far the states move in the episodes: standard deviations.
    seeds : range
        Of the episodes.
    envs : EnvPool
        Of envs that show theta and take deviations.
    played : list of int
        Episodes of each comparison so far.
    """

    problem: LinearMPC
    episodes: tuple[Episode, ...]
    dynamics: Dynamics
    units: Array
    seeds: range
    envs: EnvPool
    played: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, problem: LinearMPC, env: Source, seed: int = 0) -> SimulatorTwin:
        """Return that of an env, having played some episodes of the MPC.

        Parameters
        ----------
        problem : LinearMPC
            Of the policy.
        env : gymnasium.Env, str or callable
            It shows theta of the problem, and takes its inputs, in plant units.
        seed : int, default 0
            Of the episodes.

        Raises
        ------
        TypeError, ValueError
            If it is no such env.
        """
        make = in_deviations(maker(env, "twin"), problem)
        envs = EnvPool(make)
        with envs.acquire(1) as (one,):
            row, unaware = RowLayout(problem, observer_of(one)), below_set_points(one)
            require_spaces(problem, one)
        first = FIRST + APART * seed
        seeds = range(first, first + LOGGED)
        played = rollout(of_law(problem), envs, seeds, problem=problem)
        require_theta_shown(problem, played.steps()[0])
        require_repeated(problem, envs, first, played.costs[0])
        warn_of_order(problem, *played.steps(), stacklevel=4)
        if not unaware:
            warn_of_own_reward(problem, played, stacklevel=4)
        logged = _usable(played)
        if not logged:
            raise ValueError(
                f"None of {LOGGED} episodes of the MPC in the simulator has {SHORTEST} steps that "
                "are all finite: there is nothing to learn from."
            )
        episodes = tuple(Episode(*row.recovered(*each)) for each in logged)
        dynamics = simulated_dynamics(row, make, episodes)
        if dynamics is None:
            excited = rollout(Excited(problem, seed), envs, seeds, problem=problem)
            log = [*logged, *_usable(excited)]
            twin = PlantTwin.fit(
                problem.deviations, log, observer=row.observer, n_members=1, seed=seed
            )
            dynamics = twin.dynamics
        units = Coordinates.of(problem, episodes, row.observer).units
        return cls(problem, episodes, dynamics, units, seeds, envs)

    def play(self, controller: Controller, seeds: Sequence[int]) -> Trajectories:
        """Return episodes of the simulator itself."""
        self.played.append(len(seeds))
        return rollout(controller, self.envs, seeds, problem=self.problem)

    def close(self) -> None:
        """Close all envs."""
        self.envs.close()

    @cached_property
    def starts(self) -> Starts:
        """Where runs begin."""
        return Starts.of(self.problem, self.episodes, self.dynamics.row.observer)

    @cached_property
    def limits(self) -> Limits:
        """The problem's own hard bounds of the states."""
        problem, soft = self.problem, self.problem.soft.x > 0
        low = np.where(soft, -np.inf, problem.deviations.x_min)
        high = np.where(soft, np.inf, problem.deviations.x_max)
        return Limits(problem, low, high, self.dynamics.row)


def require_spaces(problem: LinearMPC, env: gym.Env[Any, Any]) -> None:
    """Raise unless an env shows theta and takes the inputs."""
    shape, actions = env.observation_space.shape, env.action_space.shape
    if shape != (problem.n_theta,) or actions != (problem.model.n_inputs,):
        raise ValueError(
            f"The simulator shows {shape} and takes {actions}; theta of the model's problem has "
            f"{problem.n_theta} entries {problem.layout.names}, and there are "
            f"{problem.model.n_inputs} inputs. Give the env that the model is trained in, or one "
            "that is wrapped like it."
        )


def _usable(played: Trajectories) -> list[tuple[Array, Array]]:
    """Return the episodes of some steps whose values are all finite."""
    return [
        (thetas, inputs)
        for thetas, inputs in played.pairs
        if len(inputs) >= SHORTEST and np.isfinite(thetas).all() and np.isfinite(inputs).all()
    ]
