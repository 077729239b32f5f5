"""A simulator that supplies episodes and decides; each of its steps is counted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_yann.audit.closed_loops import Excited, of_law, require_repeated
from sb3_yann.audit.in_deviations import in_deviations, require_theta_shown
from sb3_yann.audit.input_signs import warn_of_signs
from sb3_yann.audit.observed_order import warn_of_order
from sb3_yann.audit.own_reward import below_set_points, warn_of_own_reward
from sb3_yann.control import LinearMPC
from sb3_yann.rollout import Controller, EnvPool, Source, Trajectories, maker, rollout
from sb3_yann.twin.log import SHORTEST, Episode
from sb3_yann.twin.observers import observer_of
from sb3_yann.twin.row_layout import RowLayout

FIRST = 3_000_000  # seed of the first episode: far from those that people try first
APART = 1_000_000  # how far the episodes of two seeds are apart
EPISODES = 20  # of the MPC, with and without random inputs, that the first model is fitted to
SHORT = 1_500  # steps that they have at least: of short episodes there are more
MOST = 60  # of such episodes, at most
PUSH = 0.5  # half-widths by which inputs are moved at random, at most
OFTEN = 0.7  # share of the time in which they are


class OutOfStepsError(Exception):
    """The simulator would take more steps than it may."""


class _Counted(gym.Wrapper[Any, Any, Any, Any]):
    """Counts each step before it is taken, of which there may be no more."""

    def __init__(self, env: gym.Env[Any, Any], simulator: Simulator) -> None:
        super().__init__(env)
        self.simulator = simulator

    def step(self, action: Any) -> Any:
        """Step the env."""
        self.simulator.count()
        return self.env.step(action)


class Simulator:
    """Episodes of a simulator of a problem's plant; none before :meth:`begin`.

    Parameters
    ----------
    problem : LinearMPC
        Of the policy.
    env : gymnasium.Env, str or callable
        It shows theta of the problem, and takes its inputs, in plant units.
    seed : int
        Of the episodes.
    max_steps : int, optional
        How many it may take in all.

    Attributes
    ----------
    steps, played : int
        How many it has taken, in how many episodes.
    episodes : list of Episode
        What is known of it, in rows of ``row``.

    Raises
    ------
    TypeError, ValueError
        If it is no such env.
    """

    def __init__(
        self, problem: LinearMPC, env: Source, seed: int, max_steps: int | None = None
    ) -> None:
        self.problem, self.seed, self.max_steps = problem, seed, max_steps
        self.steps = self.played = 0
        make = in_deviations(maker(env, "twin"), problem)
        self.envs = EnvPool(lambda: _Counted(make(), self))
        with self.envs.acquire(1) as (one,):
            self.row, self.unaware = RowLayout(problem, observer_of(one)), below_set_points(one)
            require_spaces(problem, one)
        self.next_seed, self.longest = FIRST + APART * seed, 0
        self.episodes: list[Episode] = []

    def begin(self) -> None:
        """Play the first episodes, of the MPC with and without random inputs; check the env."""
        problem = self.problem
        first = self.new_seeds(1)
        played = self.play(of_law(problem), first)
        require_repeated(problem, self.envs, first[0], played.costs[0])
        each = EPISODES // 2
        while each < MOST // 2 and 2 * each * self.longest < SHORT:
            each += EPISODES // 4
        seeds = self.new_seeds(each - 1)
        logged = self.play(of_law(problem), seeds)
        require_theta_shown(problem, logged.steps()[0])
        warn_of_order(problem, *logged.steps(), stacklevel=5)
        with self.envs.acquire(1) as (one,):
            warn_of_signs(problem, one, seeds, logged, stacklevel=5)
        if not self.unaware:
            warn_of_own_reward(problem, logged, stacklevel=5)
        excited = self.play(Excited(problem, self.seed, PUSH, OFTEN), self.new_seeds(each))
        for some in (played, logged, excited):
            self.learn(some)
        if not self.episodes:
            raise ValueError(
                f"None of {2 * each} episodes of the MPC in the simulator is finite in all of its "
                f"rows, {SHORTEST} steps or more: there is nothing to learn from. An episode with "
                "a reading that is no finite number is left out."
            )

    def count(self) -> None:
        """Count a step before it is taken; OutOfStepsError where none is left."""
        if self.steps == self.max_steps:
            raise OutOfStepsError
        self.steps += 1

    def new_seeds(self, count: int) -> range:
        """Return seeds of episodes that nothing has seen."""
        first = self.next_seed
        self.next_seed += count
        return range(first, self.next_seed)

    def play(self, controller: Controller, seeds: Sequence[int]) -> Trajectories:
        """Return episodes; OutOfStepsError where they might take more steps than are left."""
        if self.max_steps is not None and self.steps + self.longest * len(seeds) > self.max_steps:
            raise OutOfStepsError
        played = rollout(controller, self.envs, seeds, problem=self.problem)
        self.played += len(seeds)
        self.longest = max(self.longest, int(played.lengths.max(initial=0)))
        return played

    def learn(self, played: Trajectories) -> list[Episode | None]:
        """Take episodes into the model's data, and return them; None where one is of no use."""
        found: list[Episode | None] = []
        for thetas, inputs in played.pairs:
            finite = np.isfinite(thetas).all() and np.isfinite(inputs).all()
            usable = len(inputs) >= SHORTEST and bool(finite)
            found.append(Episode(*self.row.recovered(thetas, inputs)) if usable else None)
        self.episodes += [each for each in found if each is not None]
        return found

    def close(self) -> None:
        """Close all envs."""
        self.envs.close()


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
