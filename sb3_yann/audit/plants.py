"""Plants that a plan may try out: a simulator whose state can be set, and the members of a twin."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import product
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.linearization.simulator import SHOWN, Simulator, borrow
from sb3_yann.twin.dynamics import Coordinates, Dynamics
from sb3_yann.twin.log import Episode
from sb3_yann.twin.row_layout import RowLayout

Rows = NDArray[np.intp]
Access = tuple[Callable[[Any, Array], object] | None, Callable[[Any], ArrayLike] | None]
"""How a simulator is put into a state, and how its state is read, where neither is found."""
CELL = 0.05
"""A derivative holds where states and inputs differ by less than this, in half-widths."""
KNOWN = 100_000
"""Derivatives that are kept, at most."""
STEP = 1e-3
"""Of forward differences, in half-widths."""
AGREES, TRIED = 1e-4, 100
"""How far a simulator may err in a step of the plant, in half-widths; steps that are compared."""


class Plant(Protocol):
    """What a plan may ask of a plant. The rows are numbers of starts."""

    def step(self, theta: Array, u: Array, rows: Rows) -> Array:
        """Return the next theta (k, n_theta) from theta and u (k, m); r and d stay."""

    def jacobians(self, theta: Array, u: Array, rows: Rows) -> tuple[Array, Array]:
        """Return the derivatives of the step at theta (T, k, n_theta) and u (T, k, m)."""


class TwinPlant:
    """The members of a twin, one for each start, or their mean.

    Parameters
    ----------
    dynamics : Dynamics
        The twin's.
    members : sequence of int, optional
        Which acts after each start; by default the mean of all does.
    """

    def __init__(self, dynamics: Dynamics, members: Iterable[int] | None = None) -> None:
        self.dynamics, self.members = dynamics, None if members is None else [*members]
        self._known: dict[bytes, Dynamics] = {}

    def _acting(self, rows: Rows) -> Dynamics:
        if self.members is None:
            return self.dynamics
        key, every = rows.tobytes(), self.dynamics
        if key not in self._known:
            chosen = tuple(every.members[self.members[row]] for row in rows)
            self._known[key] = Dynamics(every.problem, every.coordinates, chosen)
        return self._known[key]

    def advance(self, theta: Array, u: Array, rows: Rows) -> Array:
        """Return the next rows of the twin (k, size), with what an observer remembers."""
        acting = self._acting(rows)
        if self.members is not None:
            return np.asarray(acting.step(theta[:, None], u[:, None])[:, 0])
        every = (len(acting.members), 1, 1)
        after = acting.step(np.tile(theta, every), np.tile(u, every))
        return np.asarray(after.mean(axis=0))

    def step(self, theta: Array, u: Array, rows: Rows) -> Array:
        """Return the next theta (k, n_theta); an estimated d stays, as in an env's plan."""
        row = self.dynamics.row
        after = self.advance(row.begin(theta), u, rows)
        found, parts = row.shown(after).copy(), self.dynamics.problem.layout
        if row.observer is not None:
            found[:, parts.state] = after[:, row.state]
            found[:, parts.disturbance] = theta[:, parts.disturbance]
        return found

    def _slopes(self, theta: Array, u: Array, rows: Rows) -> tuple[Array, Array]:
        """Return the derivatives of rows at theta (T, k, size) and u (T, k, m)."""
        acting, (steps, k) = self._acting(rows), theta.shape[:2]
        if self.members is not None:
            swapped = np.swapaxes(theta, 0, 1), np.swapaxes(u, 0, 1)
            A, B = (np.swapaxes(each, 0, 1) for each in acting.jacobians(*swapped))
            return A, B
        flat = (each.reshape(1, steps * k, -1) for each in (theta, u))
        means = (each.mean(axis=0) for each in acting.jacobians(*flat))
        A, B = (each.reshape(steps, k, *each.shape[1:]) for each in means)
        return A, B

    def jacobians(self, theta: Array, u: Array, rows: Rows) -> tuple[Array, Array]:
        """Return the derivatives, (T, k, n_theta, n_theta) and (T, k, n_theta, m)."""
        row, parts = self.dynamics.row, self.dynamics.problem.layout
        A, B = self._slopes(row.begin(theta), u, rows)
        if row.observer is None:
            return A, B
        number, n = np.arange(parts.size), parts.size
        to = np.where(number < parts.n_states, number + row.state.start, number)
        of_x, B = A[..., to, :], B[..., to, :]
        found = of_x[..., :n].copy()
        found[..., parts.state] += of_x[..., row.state]
        found[..., parts.disturbance, :] = np.eye(n)[parts.disturbance]
        B = B.copy()
        B[..., parts.disturbance, :] = 0.0
        return found, B


class SimulatedPlant:
    """A simulator whose state can be set.

    Parameters
    ----------
    problem : LinearMPC
        Whose theta the env shows.
    simulator : Simulator
        Of the env.
    put, got : ndarray, shape (n,)
        What a state has more than that of theta where it is set, and where it is read: an env in
        plant units is put into states of the plant, and shows deviations here.
    """

    def __init__(self, problem: LinearMPC, simulator: Simulator, put: Array, got: Array) -> None:
        self.problem, self.simulator, self.put, self.got = problem, simulator, put, got
        self._known: dict[bytes, Array] = {}

    def after(self, x: Array, u: Array) -> Array:
        """Return the state (n,) of theta one step later."""
        return self.simulator.next_state(x + self.put, u) - self.got

    def after_if_any(self, x: Array, u: Array) -> Array:
        """Return the same, NaN where the simulator cannot go on from there."""
        if np.isfinite(x).all():
            with suppress(Exception):  # whatever an env raises in a state that it cannot be in
                return self.after(x, u)
        return np.full(len(x), np.nan)

    def step(self, theta: Array, u: Array, rows: Rows) -> Array:
        """Return the next theta (k, n_theta); NaN where the simulator cannot go on."""
        A, B = self.problem.prediction
        following = theta @ A.T + u @ B.T
        states = self.problem.layout.state
        for i, x in enumerate(theta[:, states]):
            following[i, states] = self.after_if_any(x, u[i])
        return np.asarray(following)

    def jacobians(self, theta: Array, u: Array, rows: Rows) -> tuple[Array, Array]:
        """Return forward differences; one that is known of nearby holds."""
        problem, n = self.problem, self.problem.model.n_states
        A, B = (np.tile(M, (*theta.shape[:2], 1, 1)) for M in problem.prediction)
        A[:, :, :n, n : problem.layout.disturbance.stop] = 0.0
        slopes = self.slopes(np.concatenate([theta[..., :n], u], axis=-1))
        A[..., :n, :n], B[..., :n, :] = np.split(slopes, [n], axis=-1)
        return A, B

    def slopes(self, points: Array) -> Array:
        """Return the derivatives (..., n, n + m) at points ``[x, u]``, shape (..., n + m).

        They are forward differences; one that is known of nearby holds. Where there is none, 0.
        """
        problem, n = self.problem, self.problem.model.n_states
        unit = np.concatenate([problem.theta_half[:n], problem.u_half])
        found = np.zeros((*points.shape[:-1], n, len(unit)))
        for at in zip(*np.nonzero(np.isfinite(points).all(axis=-1)), strict=True):
            key = np.round(points[at] / (CELL * unit)).tobytes()
            if key not in self._known:
                if len(self._known) >= KNOWN:
                    self._known.clear()
                self._known[key] = self._differences(points[at], unit)
            found[at] = self._known[key]
        return found

    def _differences(self, point: Array, unit: Array) -> Array:
        """Return the derivatives (n, n + m) at ``[x, u]``."""
        n = self.problem.model.n_states
        limit = np.concatenate([np.full(n, np.inf), self.problem.deviations.u_max])
        steps = np.where(point + STEP * unit < limit, STEP, -STEP) * unit
        base = self.after_if_any(point[:n], point[n:])
        J: Array = np.empty((n, len(unit)))
        for i, moved in enumerate(point + np.diag(steps)):
            taken = steps[i]
            if i >= n:  # in the precision of the action space
                taken = (self.simulator.actual(moved[n:]) - self.simulator.actual(point[n:]))[i - n]
            J[:, i] = (self.after_if_any(moved[:n], moved[n:]) - base) / taken
        return np.nan_to_num(J, posinf=0.0, neginf=0.0)


def simulated(
    problem: LinearMPC,
    env: Any,
    thetas: Array,
    inputs: Array,
    following: Array,
    access: Access = (None, None),
) -> SimulatedPlant | None:
    """Return a simulator of the env that repeats its steps, None where there is none.

    Parameters
    ----------
    problem : LinearMPC
        Whose theta the env shows.
    env : callable
        Makes an env.
    thetas, inputs, following : ndarray, shapes (steps, n_theta), (steps, m) and (steps, n_theta)
        Steps of the env.
    access : tuple of two callables, or None
        ``set_state`` and ``get_state`` of :func:`headroom`.
    """
    n, x_ss = problem.model.n_states, problem.model.x_ss
    simulator = Simulator(borrow(env), *access)
    # The wrappers that complete theta append to the states.
    if SHOWN in simulator.readers:
        simulator.readers[SHOWN] = lambda env, observation, info: np.ravel(observation)[:n]
    chosen = np.unique(np.linspace(0, len(inputs) - 1, TRIED).astype(int))
    steps = thetas[chosen, :n], inputs[chosen], following[chosen, :n]
    for setter, reader in product(simulator.setters, simulator.readers):
        simulator.setter, simulator.reader = setter, reader
        for put, got in product((np.zeros(n), x_ss), repeat=2):
            plant = SimulatedPlant(problem, simulator, put, got)
            if _error(plant.after, *steps, problem.theta_half[:n]) <= AGREES:
                return plant
    simulator.env.close()
    return None


class SimulatedResidual:
    """What a simulator does beyond the linear model: a residual of `Dynamics`.

    Where it cannot go on from a state, it stays there.

    Parameters
    ----------
    plant : SimulatedPlant
        Its steps, and their differences.
    linear : ndarray, shape (n, k)
        What the linear model makes of ``[x, d, u]``, or of ``[x, u]``.
    """

    def __init__(self, plant: SimulatedPlant, linear: Array) -> None:
        self.plant, self.linear = plant, linear
        self.n, number = plant.problem.model.n_states, np.arange(linear.shape[1])
        self.own = np.concatenate([number[: self.n], number[-plant.problem.model.n_inputs :]])

    def predict(self, z: Array) -> Array:
        """Return the residual (batch, n)."""
        after = np.array([self._after(each) for each in z[:, self.own]])
        return np.asarray(after.reshape(len(z), self.n) - z @ self.linear.T)

    def _after(self, point: Array) -> Array:
        x, u = point[: self.n], point[self.n :]
        found = self.plant.after_if_any(x, u)
        return np.where(np.isfinite(found), found, x)

    def jacobian(self, z: Array) -> Array:
        """Return its derivatives (batch, n, k)."""
        found = np.tile(-self.linear, (len(z), 1, 1))
        found[:, :, self.own] += self.plant.slopes(z[:, self.own])
        return found


def simulated_dynamics(
    row: RowLayout, env: Any, episodes: Sequence[Episode], access: Access = (None, None)
) -> Dynamics | None:
    """Return a simulator's own steps as those of a twin, with an observer where the row has one.

    None where no simulator repeats its steps: see `simulated`.

    Parameters
    ----------
    row : RowLayout
        What the episodes hold.
    env : callable
        Makes an env.
    episodes : sequence of Episode
        Of the env.
    access : tuple of two callables, or None
        ``set_state`` and ``get_state`` of :func:`headroom`.
    """
    before, after = (
        np.concatenate([each.thetas[part, row.state] for each in episodes])
        for part in (slice(-1), slice(1, None))
    )
    inputs = np.concatenate([each.actions for each in episodes])
    plant = simulated(row.problem, env, before, inputs, after, access)
    if plant is None:
        return None
    box = Coordinates.of(row.problem, episodes, row.observer)
    anywhere = np.full_like(box.low, np.inf)
    whole = replace(box, low=-anywhere, high=anywhere, scale=np.ones_like(box.scale))
    residual = SimulatedResidual(plant, row.linear[row.state][:, row.inputs])
    return Dynamics(row.problem, whole, (residual,))


def lack_of_fit(
    plant: Plant, problem: LinearMPC, thetas: Array, inputs: Array, following: Array
) -> float:
    """Return the share of a plant's one-step errors that neighbors share: 0 for noise, 1 for none.

    Noise of a step says nothing about that of the nearest one, half of whose squared difference is
    its variance. What a model lacks is alike in both.

    Parameters
    ----------
    plant, problem : Plant and LinearMPC
        What predicts the steps.
    thetas, inputs, following : ndarray, shapes (steps, n_theta), (steps, m) and (steps, n_theta)
        Steps of the env.
    """
    from scipy.spatial import cKDTree

    states, rows = problem.layout.state, np.zeros(len(inputs), dtype=np.intp)
    errors = (following - plant.step(thetas, inputs, rows))[:, states]
    errors = errors / problem.theta_half[states]
    points = np.hstack([thetas, inputs])
    points = points / np.maximum(points.std(axis=0), 1e-9)
    other = cKDTree(points).query(points, k=2)[1][:, 1]
    whole = max(float(np.sum(errors**2)), 1e-300)
    return 1.0 - float(np.sum((errors - errors[other]) ** 2)) / 2 / whole


def _error(
    after: Callable[[Array, Array], Array], x: Array, u: Array, following: Array, size: Array
) -> float:
    """Return the largest error of the steps in half-widths, infinite where one fails.

    Parameters
    ----------
    after : callable
        From a state (n,) and an input (m,) to the next state.
    x, u, following : ndarray, shapes (steps, n), (steps, m) and (steps, n)
        Steps of the env.
    size : ndarray, shape (n,)
        Half-widths.
    """
    worst = 0.0
    for start, action, wanted in zip(x, u, following, strict=True):
        try:
            error = float(np.max(np.abs(after(start, action) - wanted) / size))
        except Exception:  # whatever an env raises that cannot be put into this state
            return np.inf
        worst = max(worst, error)
        if not worst <= AGREES:
            return np.inf
    return worst
