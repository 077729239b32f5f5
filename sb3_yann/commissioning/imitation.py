"""Nearly optimal plans as the weights of an actor: where a search by gradients may begin."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.audit.closed_loops import PAUSE, Planning
from sb3_yann.audit.plants import TwinPlant
from sb3_yann.audit.task import WEIGHT, Task
from sb3_yann.audit.trajectory import Plans, follow
from sb3_yann.commissioning.distillation import fit_layer
from sb3_yann.commissioning.grounds import value_at_end
from sb3_yann.commissioning.simulator_grounds import FINAL, RULE, SimulatorGrounds, controller_of
from sb3_yann.commissioning.trial import Inputs
from sb3_yann.networks.yann import LawLayer
from sb3_yann.rollout import Controller, Rows
from sb3_yann.twin.gradient import actor

UPDATES = 10_000
"""Of a fit: where a plant is steep, the last digits of an input decide."""
NEARBY, SPREAD = 3, 0.1
"""States beside each of a plan that its feedback answers; how far, in standard deviations of the
logged states."""
ROUNDS, PATIENCE, HARDEST = 14, 5, 20
"""Fits, at most; fits in a row that lose no smaller share than one before, at most; lost episodes
of a trial of which the next fit learns."""


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

    def show(self, seeds: Sequence[int], begins: NDArray[np.int64], act: Inputs) -> float:
        """Plan from the steps ``begins`` (k,) of episodes on, until which a policy acts.

        Episodes that cost more than with the MPC from there on show nothing. Return what the others
        gain, as a fraction of what all cost with the MPC.
        """
        plant = TwinPlant(self.twin.dynamics, [0] * len(seeds))
        pause = PAUSE if self.twin.dynamics.row.observer is not None else 0
        law = self.task.problem.law()
        mpc = self.twin.play(_Later(controller_of(law), begins, act), seeds)
        planning = _Later(Planning(plant, self.task, self.steps, pause), begins, act)
        shown = self.twin.play(planning, seeds)
        better = (shown.costs <= mpc.costs) & shown.no_worse(mpc)
        for i in np.flatnonzero(better):
            for t in range(begins[i], shown.lengths[i]):
                when, plan, _ = planning.plans[t][i]
                theta = shown.observations[i][t]
                at, near = min(t, self.steps - 1) - when, self._nearby(theta)
                answers = np.concatenate([follow(plan, at, each[None]) for each in near])
                self.thetas += [theta, *near]
                self.inputs += [shown.actions[i][t], *np.clip(answers, *self.task.limits(near))]
        gained = float(np.sum((mpc.costs - shown.costs)[better]))
        return gained / max(float(np.abs(mpc.costs).sum()), 1e-300)

    def _nearby(self, theta: Array) -> Array:
        states, unit = self.task.problem.layout.state, self.twin.units
        near = np.tile(theta, (NEARBY, 1))
        near[:, states] += SPREAD * unit * self.rng.standard_normal(near[:, states].shape)
        return near

    def teach(self, layer: LawLayer) -> None:
        """Fit a layer to all that was shown."""
        rows, inputs = np.array(self.thetas), np.array(self.inputs)
        fit_layer(layer, self.task.problem, rows, inputs, self.rng, UPDATES)


class _Later:
    """A controller from a step of each episode on.

    Parameters
    ----------
    controller : callable
        Acts from there on.
    begins : ndarray of int, shape (k,)
        The steps.
    act : callable
        The policy that acts before.

    Attributes
    ----------
    plans : list of dict
        Those of `Planning` at every step.
    """

    def __init__(self, controller: Controller, begins: NDArray[np.int64], act: Inputs) -> None:
        self.controller, self.begins, self.act = controller, begins, controller_of(act)
        self.plans: list[dict[int, tuple[int, Plans, Array]]] = []

    def __call__(self, t: int, theta: Array, rows: Rows) -> Array:
        """Return the inputs (r, m)."""
        begun = self.begins[rows] <= t
        u = self.act(t, theta, rows)
        if np.any(begun):
            u = u.copy()
            u[begun] = self.controller(t, theta[begun], rows[begun])
        self.plans.append({**getattr(self.controller, "plans", {})})
        return u


def imitate(layer: LawLayer, grounds: SimulatorGrounds, seed: int) -> Iterator[int]:
    """Fit a layer to plans of a simulator's episodes, and to their feedback nearby.

    Then the policy plays the trial, and new ones. From the episodes that it loses, or nearly, it
    learns more: plans begin where they do, and where it had got to (S. Ross, G. Gordon and
    D. Bagnell, *A reduction of imitation learning and structured prediction to no-regret online
    learning*, AISTATS 2011). The layer ends with the fit that lost the least. Yields after each.
    Where plans gain less than would be accepted, there is none.
    """
    teacher, problem = Teacher(grounds, seed), grounds.twin.problem
    first = grounds.twin.seeds[: grounds.n_starts]
    if teacher.show(first, np.zeros(len(first), dtype=np.int64), problem.law()) < RULE.least_gain:
        return
    smallest, best, failed = np.inf, layer.state_dict(), 0
    for fit in range(ROUNDS):
        teacher.teach(layer)
        yield fit
        act = actor(layer, problem)
        lost, share = _lost(grounds, act)
        failed = 0 if share < smallest else failed + 1
        if share <= smallest:
            smallest, best = share, copy.deepcopy(layer.state_dict())
        if not lost or failed == PATIENCE or fit == ROUNDS - 1:
            break
        seeds, lengths = zip(*lost, strict=True)
        later = teacher.rng.integers(1, np.maximum(2, lengths))
        teacher.show([*seeds, *seeds], np.concatenate([0 * later, later]), act)
    layer.load_state_dict(best)


def _lost(grounds: SimulatorGrounds, act: Inputs) -> tuple[list[tuple[int, int]], float]:
    """Return seeds and lengths of episodes that a policy loses, and the share of all that it lost.

    It plays the trial and a new one; where it loses nothing there, so many more new ones as decide
    in the end, until it does.
    """
    found: list[tuple[int, int]] = []
    lost = played = 0
    for number in range(2 + FINAL):
        trial = grounds.draw(grounds.drawing) if number else grounds.trial
        numbers = trial.lost(trial.play(act))
        lost, played = lost + len(numbers), played + len(trial.seeds)
        found += [(trial.seeds[i], int(trial.last.lengths[i])) for i in numbers[:HARDEST]]
        if number and lost:
            break
    return found, lost / played
