"""Nearly optimal plans as the weights of an actor: where a search by gradients may begin."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.audit.closed_loops import PAUSE, Planning
from sb3_yann.audit.plants import Plant, TwinPlant
from sb3_yann.audit.task import WEIGHT, Task
from sb3_yann.audit.trajectory import Plans, follow
from sb3_yann.commissioning.distillation import fit_layer
from sb3_yann.commissioning.grounds import value_at_end
from sb3_yann.commissioning.simulator_grounds import SimulatorGrounds, controller_of
from sb3_yann.commissioning.trial import Inputs
from sb3_yann.networks.law_layer import LawLayer
from sb3_yann.twin.gradient import actor

UPDATES = 5000
"""Of a fit: where a plant is steep, the last digits of an input decide."""
NEARBY, SPREAD = 3, 0.1
"""States beside each of a plan that its feedback answers; how far, in standard deviations of the
logged states."""
ROUNDS, HARDEST = 3, 20
"""Fits, at most; lost episodes of which the next one learns."""

Keep = Callable[[Array, Array, Plans, int], None]


class Teacher:
    """Plans episodes of a simulator, and keeps what plans and their feedback do.

    Plans are those of :func:`headroom`: differential dynamic programming, which knows neither
    changes of references nor disturbances before they come.

    Parameters
    ----------
    grounds : SimulatorGrounds
    seed : int
        Of the states beside plans.
    """

    def __init__(self, grounds: SimulatorGrounds, seed: int) -> None:
        self.twin, self.rng = grounds.twin, np.random.default_rng([seed, 4])
        problem, limits, mpc = self.twin.problem, self.twin.limits, grounds.trial.base
        unit = max(float(np.abs(mpc.costs).sum() / mpc.lengths.sum()), 1e-300)
        end = value_at_end(problem)
        self.task = Task(problem, limits.low, limits.high, end, WEIGHT * unit)
        self.steps = int(mpc.lengths.max())
        self.thetas: list[Array] = []
        self.inputs: list[Array] = []

    def show(self, seeds: Sequence[int], begins: NDArray[np.int64], act: Inputs) -> None:
        """Plan from the steps ``begins`` (k,) of episodes on, until which a policy acts."""
        plant = TwinPlant(self.twin.dynamics, [0] * len(seeds))
        pause = PAUSE if self.twin.dynamics.row.observer is not None else 0
        later = _Later(plant, self.task, self.steps, begins, act, self._keep, pause)
        self.twin.play(later, seeds)

    def _keep(self, theta: Array, u: Array, plan: Plans, at: int) -> None:
        states, unit = self.task.problem.layout.state, self.twin.units
        near = np.tile(theta, (NEARBY, 1))
        near[:, states] += SPREAD * unit * self.rng.standard_normal(near[:, states].shape)
        answers = np.concatenate([follow(plan, at, each[None]) for each in near])
        self.thetas += [theta, *near]
        self.inputs += [u, *np.clip(answers, *self.task.limits(near))]

    def teach(self, layer: LawLayer) -> None:
        """Fit a layer to all that was shown."""
        rows, inputs = np.array(self.thetas), np.array(self.inputs)
        fit_layer(layer, self.task.problem, rows, inputs, self.rng, UPDATES)


class _Later(Planning):
    """Plans from a step of each episode on.

    Parameters
    ----------
    plant, task, steps, pause
        As those of `Planning`.
    begins : ndarray of int, shape (k,)
        The steps.
    act : callable
        The policy that acts before.
    keep : callable
        Told of each theta, its input, the plan, and its step.
    """

    def __init__(
        self,
        plant: Plant,
        task: Task,
        steps: int,
        begins: NDArray[np.int64],
        act: Inputs,
        keep: Keep,
        pause: int,
    ) -> None:
        super().__init__(plant, task, steps, pause)
        self.begins, self.act, self.keep = begins, controller_of(act), keep

    def __call__(self, t: int, theta: Array, running: NDArray[np.bool_]) -> Array:
        """Return the inputs (k, m)."""
        begun = self.begins <= t
        u = self.act(t, theta, running)
        if np.any(running & begun):
            u = np.where(begun[:, None], super().__call__(t, theta, running & begun), u)
        for i in np.flatnonzero(running & begun):
            when, plan = self.plans[i]
            self.keep(theta[i], u[i], plan, min(t, self.steps - 1) - when)
        return u


def imitate(layer: LawLayer, grounds: SimulatorGrounds, seed: int) -> Iterator[int]:
    """Fit a layer to plans of a simulator's episodes, and to their feedback nearby.

    Then the policy plays new ones. From those that it loses, or nearly, it learns more: plans begin
    where they do, and where it had got to (S. Ross, G. Gordon and D. Bagnell, *A reduction of
    imitation learning and structured prediction to no-regret online learning*, AISTATS 2011).
    Yields after each fit.
    """
    teacher, problem = Teacher(grounds, seed), grounds.twin.problem
    first = grounds.twin.seeds[: grounds.n_starts]
    teacher.show(first, np.zeros(len(first), dtype=np.int64), problem.law())
    for more in range(ROUNDS):
        teacher.teach(layer)
        yield more
        if more == ROUNDS - 1:
            return
        trial, act = grounds.draw(grounds.drawing), actor(layer, problem)
        lost = trial.lost(trial.play(act))[:HARDEST]
        if not len(lost):
            return
        seeds = [trial.seeds[i] for i in lost]
        later = teacher.rng.integers(1, np.maximum(2, trial.last.lengths[lost]))
        teacher.show([*seeds, *seeds], np.concatenate([0 * later, later]), act)
