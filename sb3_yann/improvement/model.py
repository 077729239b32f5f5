"""A learnt model in the middle: what plans are made in, and episodes are imagined in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.compare import unsafe_columns
from sb3_yann.control import LinearMPC, StateEstimator
from sb3_yann.control.mpc.bound_excess import bound_excess
from sb3_yann.plan import WEIGHT, Task, TwinPlant, value_at_end
from sb3_yann.rollout import Controller
from sb3_yann.twin.dynamics import Coordinates, Dynamics
from sb3_yann.twin.ensemble import fit_ensemble
from sb3_yann.twin.limits import Limits
from sb3_yann.twin.log import Episode
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.twin.starts import Starts

MEMBERS = 2  # networks of a model of a simulator, which repeats its steps
NOISE = 0.01  # standard deviations of the states: what errs less in most steps has no noise
LACKING = 0.5  # share of the errors of neighboring steps that is not alike: more is noise
DOUBT = 10.0  # mean costs of a step for members that differ by a standard deviation of a state


def one_step_error(row: RowLayout, episodes: Sequence[Episode]) -> float:
    """Return how far the given model errs in 95 % of the steps at most, in half-widths of theta.

    It is what the inputs that keep the problem's bounds are computed with.
    """
    half, errors = row.problem.theta_half[row.problem.layout.state], []
    for each in episodes:
        predicted = np.hstack([each.thetas[:-1], each.actions]) @ row.linear[row.state].T
        errors.append(np.max(np.abs(each.thetas[1:, row.state] - predicted) / half, axis=1))
    return float(np.nanquantile(np.concatenate(errors), 0.95))


class Model(Protocol):
    """A :class:`PlantTwin`, or a model of a simulator's episodes."""

    @property
    def problem(self) -> LinearMPC:
        """Whose theta it shows."""

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """What it was fitted to."""

    @property
    def dynamics(self) -> Dynamics:
        """Its members."""

    @property
    def starts(self) -> Starts:
        """Where episodes begin."""

    @property
    def limits(self) -> Limits:
        """Where it holds."""


@dataclass(frozen=True, eq=False)
class SimulatorModel:
    """An ensemble of networks on top of the given model, fitted to a simulator's episodes.

    Attributes
    ----------
    problem : LinearMPC
    episodes : tuple of Episode
    dynamics : Dynamics
    """

    problem: LinearMPC
    episodes: tuple[Episode, ...]
    dynamics: Dynamics

    @classmethod
    def fit(
        cls,
        problem: LinearMPC,
        episodes: Sequence[Episode],
        observer: StateEstimator | None,
        seed: int,
    ) -> SimulatorModel:
        """Return the model of some episodes, in rows of the observer's layout."""
        coordinates = Coordinates.of(problem, episodes, observer)
        members = fit_ensemble(coordinates, [episodes] * MEMBERS, seed)
        return cls(problem, tuple(episodes), Dynamics(problem, coordinates, tuple(members)))

    @cached_property
    def starts(self) -> Starts:
        """Where episodes begin."""
        return Starts.of(self.problem, self.episodes, self.dynamics.row.estimator)

    @cached_property
    def limits(self) -> Limits:
        """Where it holds, and the problem's own bounds of the states."""
        return Limits.of(self.problem, self.dynamics.coordinates, self.starts)

    def lacks(self) -> tuple[bool, bool]:
        """Return whether it errs in most steps, and whether that is more than noise.

        Kinks of a plant show in few. Noise of a step says nothing about that of the nearest one,
        half of whose squared difference is its variance. What a model lacks is alike in both.
        """
        from scipy.spatial import cKDTree

        row, units = self.dynamics.row, self.dynamics.coordinates.units
        rows = np.concatenate([each.thetas[:-1] for each in self.episodes])
        inputs = np.concatenate([each.actions for each in self.episodes])
        after = np.concatenate([each.thetas[1:, row.state] for each in self.episodes])
        predicted = TwinPlant(self.dynamics).advance(rows, inputs, np.arange(len(rows)))
        near = self.dynamics.coordinates.nearest(predicted[:, row.state], after)
        errors = (after - near) / units
        points = row.features(rows, inputs)
        points = points / np.maximum(points.std(axis=0), 1e-9)
        other = cKDTree(points).query(points, k=2)[1][:, 1]
        apart = float(np.mean((errors - errors[other]) ** 2)) / 2
        whole = float(np.mean(errors**2))
        errs = bool(np.median(np.abs(errors), axis=0).max() > NOISE)
        return errs, errs and apart < LACKING * whole


@dataclass(frozen=True, eq=False)
class Disagreement:
    """A price on the members' disagreement over a step, in standard deviations of the states.

    Attributes
    ----------
    dynamics : Dynamics
        Of two members or more, without an observer.
    weight : float
        What one standard deviation costs.
    """

    dynamics: Dynamics
    weight: float

    def costs(self, thetas: Array, inputs: Array) -> Array:
        """Return what steps cost (T, k)."""
        return np.asarray(self.weight * np.sum(self._apart(thetas, inputs) ** 2, axis=-1))

    def slopes(self, thetas: Array, inputs: Array) -> tuple[Array, Array]:
        """Return gradients (T, k, n_theta + m) and Gauss-Newton curvatures of that."""
        shape, apart = thetas.shape[:2], self._apart(thetas, inputs)
        flat = (each.reshape(1, -1, each.shape[-1]) for each in (thetas, inputs))
        slopes = np.concatenate(self.dynamics.jacobians(*flat), axis=-1)
        slopes = slopes[..., self.dynamics.row.state, :]
        slopes = (slopes - slopes.mean(axis=0)) / self._units[:, None]
        members, rows, n, size = slopes.shape
        J = np.moveaxis(slopes, 0, 1).reshape(rows, members * n, size)
        gradient = np.einsum("rqi,rq->ri", J, apart.reshape(rows, -1))
        curvature = np.swapaxes(J, 1, 2) @ J
        twice = 2 * self.weight
        return twice * gradient.reshape(*shape, size), twice * curvature.reshape(*shape, size, size)

    @property
    def _units(self) -> Array:
        return np.asarray(self.dynamics.coordinates.units * np.sqrt(len(self.dynamics.members)))

    def _apart(self, thetas: Array, inputs: Array) -> Array:
        """Return how far each member is from their mean, (T, k, members n)."""
        flat = (each.reshape(1, -1, each.shape[-1]) for each in (thetas, inputs))
        residual = self.dynamics.residual(*flat)
        apart = (residual - residual.mean(axis=0)) / self._units
        return np.asarray(np.moveaxis(apart, 0, 1).reshape(*thetas.shape[:2], -1))


def task_of(model: Model, unit: float, priced: bool = True) -> Task:
    """Return what plans in a model are to minimize.

    Parameters
    ----------
    model : Model
        Its limits bound the states.
    unit : float
        A typical cost of a step.
    priced : bool, default True
        Whether the members' disagreement has a price; with an observer it has none.
    """
    doubt = None
    if priced and model.dynamics.row.observer is None:
        doubt = Disagreement(model.dynamics, DOUBT * unit)
    end, limits = value_at_end(model.problem), model.limits
    box = limits.low, limits.high
    return Task(model.problem, *box, end.P, WEIGHT * unit, doubt, end.slope)


@dataclass(frozen=True, eq=False)
class Imagined:
    """Episodes that were played in a model, side by side.

    Attributes
    ----------
    rows : ndarray, shape (T + 1, k, size)
    thetas, inputs : ndarray, shapes (T + 1, k, n_theta) and (T, k, m)
    costs : ndarray, shape (k,)
        Stage costs, and what soft bounds cost.
    unsafe : ndarray, shape (k, 9)
        As :func:`~sb3_yann.compare.unsafe_columns` returns it.
    """

    rows: Array
    thetas: Array
    inputs: Array
    costs: Array
    unsafe: Array


@dataclass(frozen=True, eq=False)
class Scenarios:
    """Starts, and the references and measured disturbances of the episodes that follow.

    Attributes
    ----------
    model : Model
    members : ndarray of int, shape (k,), optional
        The member that acts in each; by default their mean does.
    starts : ndarray, shape (k, size)
        Rows.
    given : ndarray, shape (T, k, p)
    """

    model: Model
    members: NDArray[np.intp] | None
    starts: Array
    given: Array

    @classmethod
    def like(cls, model: Model, episodes: Sequence[Episode], rng: np.random.Generator) -> Scenarios:
        """Return scenarios like some episodes, with their references and disturbances.

        Every other one begins as its episode did, the others in the box of all first states.

        Parameters
        ----------
        model : Model
            Whose members act.
        episodes : sequence of Episode
            One for each scenario.
        rng : numpy.random.Generator
            Of the starts in the box.
        """
        row, steps, n = model.dynamics.row, max(map(len, episodes)), model.problem.model.n_states
        thetas = row.shown(np.array([each.thetas[0] for each in episodes])).copy()
        moved = thetas[1::2, :n]
        thetas[1::2, :n] = rng.uniform(model.starts.low, model.starts.high, moved.shape)
        given = [e.thetas[np.minimum(np.arange(steps), len(e)), row.given] for e in episodes]
        return cls(model, None, row.begin(thetas), np.stack(given, axis=1))

    @cached_property
    def plant(self) -> TwinPlant:
        """What acts in them."""
        return TwinPlant(self.model.dynamics, self.members)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.starts)

    def play(self, controller: Controller) -> Imagined:
        """Return the episodes of a controller."""
        problem, row = self.model.problem, self.model.dynamics.row
        steps, k = self.given.shape[:2]
        rows, numbers = np.empty((steps + 1, *self.starts.shape)), np.arange(k)
        inputs = np.empty((steps, k, problem.model.n_inputs))
        rows[0] = self.starts
        low, high = problem.deviations.u_min, problem.deviations.u_max
        with np.errstate(all="ignore"):
            for t in range(steps):
                rows[t][:, row.given] = self.given[t]
                u = np.asarray(controller(t, row.shown(rows[t]), numbers))
                inputs[t] = np.clip(np.nan_to_num(u), low, high)
                rows[t + 1] = self.plant.advance(rows[t], inputs[t], numbers)
            thetas = row.shown(rows)
            excess = bound_excess(problem, thetas, inputs)
            costs = problem.deviations.stage_cost(thetas[:-1], inputs).sum(axis=0) + excess.penalty
        lost = ~(np.isfinite(costs) & np.isfinite(thetas).all(axis=(0, 2)))
        costs = np.where(lost, np.inf, costs)
        return Imagined(rows, thetas, inputs, costs, unsafe_columns(0, 0, lost, excess))
