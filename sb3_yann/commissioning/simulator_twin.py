"""A simulator in the place of a twin: the gradient goes through its own steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_yann._validation import Array
from sb3_yann.audit.closed_loops import Controller, Excited, Loops, maker, of_law, play
from sb3_yann.audit.own_units import require_deviations, showing_theta
from sb3_yann.audit.plants import SimulatedPlant, simulated
from sb3_yann.control import LinearMPC
from sb3_yann.evaluation.episodes import Source
from sb3_yann.twin.dynamics import Coordinates, Dynamics
from sb3_yann.twin.limits import Limits
from sb3_yann.twin.log import SHORTEST, Episode
from sb3_yann.twin.observers import observer_of
from sb3_yann.twin.plant_twin import PlantTwin
from sb3_yann.twin.reidentification import reidentified
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.twin.starts import Starts

LOGGED = 40
"""Episodes of the MPC that a simulator plays first: they tell where runs of a gradient begin."""
FIRST, APART = 3_000_000, 1_000_000
"""Seed of the first episode; how far the episodes of two seeds are apart."""


class SimulatedResidual:
    """What a simulator does beyond the linear model: see `Residual`.

    Parameters
    ----------
    plant : SimulatedPlant
        Its steps, and their differences.
    linear : ndarray, shape (n, k)
        What the linear model makes of ``[x, d, u]``, or of ``[x, u]``.
    """

    def __init__(self, plant: SimulatedPlant, linear: Array) -> None:
        self.plant, self.linear = plant, linear
        n, m = plant.problem.model.n_states, plant.problem.model.n_inputs
        number = np.arange(linear.shape[1])
        self.n, self.own = n, np.concatenate([number[:n], number[len(number) - m :]])

    def predict(self, z: Array) -> Array:
        """Return the residual (batch, n)."""
        points = z[:, self.own]
        after = np.array([self.plant.after(each[: self.n], each[self.n :]) for each in points])
        return np.asarray(after.reshape(len(z), self.n) - z @ self.linear.T)

    def jacobian(self, z: Array) -> Array:
        """Return its derivatives (batch, n, k)."""
        found = np.tile(-self.linear, (len(z), 1, 1))
        found[:, :, self.own] += self.plant.slopes(z[:, self.own])
        return found


class _Kept(gym.Wrapper[Any, Any, Any, Any]):
    """An env that is used again when it was closed."""

    def __init__(self, env: gym.Env[Any, Any], free: list[gym.Env[Any, Any]]) -> None:
        super().__init__(env)
        self.free = free

    def close(self) -> None:
        """Keep it."""
        self.free.append(self)


@dataclass(frozen=True, eq=False)
class SimulatorTwin:
    """A simulator that stands where a :class:`PlantTwin` may stand, with one exact member.

    Attributes
    ----------
    problem : LinearMPC
        Whose theta it shows.
    episodes : tuple of Episode
        Those of the MPC that were played first, in rows of ``dynamics.row``.
    dynamics : Dynamics
        Its own steps.
    make : callable
        Makes an env that shows theta and takes deviations; one that is closed is used again.
    seeds : range
        Of the episodes.
    """

    problem: LinearMPC
    episodes: tuple[Episode, ...]
    dynamics: Dynamics
    make: Callable[[], gym.Env[Any, Any]]
    seeds: range

    @classmethod
    def of(cls, problem: LinearMPC, env: Source, seed: int = 0) -> SimulatorTwin:
        """Return that of an env, having played some episodes of the MPC.

        Parameters
        ----------
        problem : LinearMPC
        env : gymnasium.Env, str or callable
            It shows theta of the problem, or absolute values where the problem is absolute, can be
            put into a state, and repeats its steps.
        seed : int, default 0
            Of the episodes.

        Raises
        ------
        TypeError, ValueError
            If it is no such env.
        """
        make, free = showing_theta(maker(env), problem), list[gym.Env[Any, Any]]()

        def kept() -> gym.Env[Any, Any]:
            return free.pop() if free else _Kept(make(), free)

        first = FIRST + APART * seed
        seeds = range(first, first + LOGGED)
        loops = play(problem, kept, seeds, of_law(problem))
        require_deviations(problem, loops.steps()[0])
        with closing(kept()) as one:
            row = RowLayout(problem, observer_of(one))
        whole = [each for each in loops.episodes() if len(each[1]) >= SHORTEST]
        if not whole or not all(np.isfinite(each).all() for pair in whole for each in pair):
            raise ValueError(
                f"The MPC's episodes of the simulator are shorter than {SHORTEST} steps, or show "
                "what is not finite: there is nothing to start from."
            )
        episodes = tuple(Episode(*row.recovered(*each)) for each in whole)
        steps = (
            np.concatenate([each.thetas[:-1, row.state] for each in episodes]),
            np.concatenate([each.actions for each in episodes]),
            np.concatenate([each.thetas[1:, row.state] for each in episodes]),
        )
        plant = simulated(problem, make, *steps)
        if plant is None:  # one that is random, or cannot be put into a state
            excited = play(problem, kept, seeds, Excited(problem, seed))
            log = [each for each in excited.episodes() if len(each[1]) >= SHORTEST]
            twin = PlantTwin.fit(
                problem, [*whole, *log], observer=row.observer, n_members=1, seed=seed
            )
            return cls(problem, episodes, twin.dynamics, kept, seeds)
        box = Coordinates.of(problem, episodes, row.observer)
        anywhere = np.full_like(box.low, np.inf)
        free_box = replace(box, low=-anywhere, high=anywhere, scale=np.ones_like(box.scale))
        residual = SimulatedResidual(plant, row.linear[row.state][:, row.inputs])
        return cls(problem, episodes, Dynamics(problem, free_box, (residual,)), kept, seeds)

    def play(self, controller: Controller, seeds: Sequence[int]) -> Loops:
        """Return episodes of the simulator itself."""
        return play(self.problem, self.make, seeds, controller)

    def reidentified(self) -> LinearMPC:
        """Return the MPC with a model of the episodes: see :meth:`PlantTwin.reidentified`."""
        box = Coordinates.of(self.problem, self.episodes, self.dynamics.row.observer)
        return reidentified(self.problem, box, self.episodes)

    @cached_property
    def starts(self) -> Starts:
        """Where runs begin."""
        return Starts.of(self.problem, self.episodes, self.dynamics.row.observer)

    @cached_property
    def limits(self) -> Limits:
        """The problem's own hard bounds of the states."""
        problem, soft = self.problem, self.problem.soft.x > 0
        low = np.where(soft, -np.inf, problem.x_min)
        high = np.where(soft, np.inf, problem.x_max)
        return Limits(problem, low, high, self.dynamics.row)
