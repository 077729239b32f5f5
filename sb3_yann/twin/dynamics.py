"""The dynamics of a twin: the linear model, and what the plant does beyond it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch as th

from sb3_yann._progress import bar
from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.twin.log import Episode
from sb3_yann.twin.row_layout import RowLayout


class Residual:
    """``y = tanh(tanh(z W1 + b1) W2 + b2) W3 + b3 + z L + z' Q z`` of scaled :class:`Coordinates`.

    Weights are W1 (k, h), b1 (1, h), W2 (h, h), b2 (1, h), W3 (h, n), b3 (1, n), L (k, n) and Q (k,
    k n), symmetric for each of the n; of a polynomial h is 0. Those of several residuals have an
    axis of the members before all else.
    """

    def __init__(self, weights: Sequence[Array]) -> None:
        self.weights = tuple(weights)
        self.is_polynomial = self.weights[0].shape[-1] == 0
        self._is_linear = not np.any(self.weights[7])

    @classmethod
    def polynomial(cls, L: Array, b: Array | None = None, Q: Array | None = None) -> Residual:
        """Return ``z L + b + z' Q z`` for L (k, n), b (n,) and a symmetric Q (k, k, n)."""
        k, n = L.shape
        hidden = [np.zeros(size) for size in ((k, 0), (1, 0), (0, 0), (1, 0), (0, n))]
        constant = np.zeros(n) if b is None else b
        quadratic = np.zeros((k, k, n)) if Q is None else Q
        return cls([*hidden, constant[None], L, quadratic.reshape(k, k * n)])

    @classmethod
    def of_basis(cls, weights: Array, k: int, constant: bool) -> Residual:
        """Return the polynomial of weights (f, n) of k features, one where it is, and products."""
        first = k + int(constant)
        n = weights.shape[1]
        Q: Array = np.zeros((k, k, n))
        if len(weights) > first:
            Q[np.triu_indices(k)] = weights[first:] / 2
            Q = Q + np.swapaxes(Q, 0, 1)
        return cls.polynomial(weights[:k], weights[k:first].sum(axis=0), Q)

    @classmethod
    def zero(cls, k: int, n: int) -> Residual:
        """Return zeros (n,) for k features."""
        return cls.polynomial(np.zeros((k, n)))

    def _hidden(self, z: Array) -> tuple[Array, Array]:
        W1, b1, W2, b2 = self.weights[:4]
        # Several times as fast as numpy's here.
        first: Array = np.asarray(th.tanh_(th.from_numpy(z @ W1 + b1)))
        return first, np.asarray(th.tanh_(th.from_numpy(first @ W2 + b2)))

    def _bent(self, z: Array) -> Array:
        """Return ``Q z``, (..., batch, k, n)."""
        found = z @ self.weights[7]
        return np.asarray(found.reshape(*found.shape[:-1], z.shape[-1], -1))

    def predict(self, z: Array) -> Array:
        """Return the residual (..., batch, n) at z (..., batch, k)."""
        W3, b3, L = self.weights[4:7]
        found = z @ L + b3
        if not self._is_linear:
            found = found + np.sum(z[..., None] * self._bent(z), axis=-2)
        if not self.is_polynomial:
            found = found + self._hidden(z)[1] @ W3
        return np.asarray(found)

    def jacobian(self, z: Array) -> Array:
        """Return its derivatives (..., batch, n, k)."""
        W1, _, W2, _, W3, _, L, _ = (np.swapaxes(each, -1, -2) for each in self.weights)
        batch = np.broadcast_shapes(z.shape[:-1], (*L.shape[:-2], 1))
        found = np.broadcast_to(L[..., None, :, :], (*batch, *L.shape[-2:]))
        if not self._is_linear:
            found = found + 2 * np.swapaxes(self._bent(z), -1, -2)
        if self.is_polynomial:
            return np.asarray(found)
        first, second = self._hidden(z)
        rows = W3[..., None, :, :] * (1 - second**2)[..., None, :]  # (..., batch, n, h)
        flat = rows.reshape(*rows.shape[:-3], -1, rows.shape[-1]) @ W2
        rows = flat.reshape(rows.shape) * (1 - first**2)[..., None, :]
        flat = rows.reshape(*rows.shape[:-3], -1, rows.shape[-1]) @ W1
        return np.asarray(flat.reshape(*rows.shape[:-1], -1) + found)


BEYOND_DATA = 0.25  # how far the residual reaches beyond the data, in widths of the data
FULL_TURNS = 2 * np.pi, 360.0  # by which an angle jumps that is shown between two ends


@dataclass(frozen=True)
class Coordinates:
    """Where the data are: what residuals are fed is scaled by it, and never lies far outside.

    ``low`` and ``high`` (k,) are the box of the logged ``[x, d, u]``, or ``[x, u]`` where an
    observer estimates d, a quarter of its width beyond the data; ``scale`` the largest magnitudes;
    ``units`` (n,) the states' standard deviations; ``turn`` (n,) a full turn for each state that is
    an angle and jumps by it, 0 for the others.
    """

    low: Array
    high: Array
    scale: Array
    units: Array
    row: RowLayout
    turn: Array | None = None

    @classmethod
    def of(cls, row: RowLayout, episodes: Sequence[Episode]) -> Coordinates:
        """Return those of a log, whose episodes hold rows of this layout."""
        seen = np.concatenate([row.features(e.thetas[:-1], e.actions) for e in episodes])
        half = row.half
        low = seen.min(0)
        high = seen.max(0)
        room = BEYOND_DATA * np.maximum(high - low, 1e-6 * half)
        scale = np.maximum(np.abs(seen).max(0), 1e-3 * half)
        units = np.maximum(np.std(seen, axis=0), 1e-6 * half)[: row.problem.model.n_states]
        states = [e.thetas[:, row.state] for e in episodes]
        turn = None if row.observer is not None else _turns(states)
        return cls(low - room, high + room, scale, units, row, turn)

    def scaled(self, features: Array) -> Array:
        """Return what residuals are fed, inside the box."""
        return np.asarray(np.clip(features, self.low, self.high) / self.scale)

    def regression(self, episode: Episode) -> tuple[Array, Array]:
        """Return z (T, k), and what the linear model leaves of the next states (T, n)."""
        row = self.row
        rows = episode.thetas
        u = episode.actions
        linear = np.concatenate([rows[:-1], u], axis=1) @ row.linear[row.state].T
        after = self.nearest(rows[1:, row.state], rows[:-1, row.state])
        return self.scaled(row.features(rows[:-1], u)), after - linear

    def nearest(self, x: Array, to: Array) -> Array:
        """Return states (..., n) with their angles turned as near to others as they come."""
        if self.turn is None:
            return x
        turns = (x - to) / np.where(self.turn > 0, self.turn, np.inf)
        return np.asarray(x - self.turn * np.round(turns))

    def wrap(self, rows: Array) -> None:
        """Turn the angles of rows (..., size) to between the ends of the data, in place."""
        if self.turn is not None:
            middle = ((self.low + self.high) / 2)[: len(self.turn)]
            rows[..., self.row.state] = self.nearest(rows[..., self.row.state], middle)


def _turns(episodes: Sequence[Array]) -> Array | None:
    """Return a full turn for each state that jumps by it, else 0; None where none does."""
    steps = np.abs(np.concatenate([np.diff(each, axis=0) for each in episodes]))
    width = np.ptp(np.concatenate(episodes), axis=0)
    found = np.zeros(len(width))
    for turn in FULL_TURNS:
        jumps = (steps > turn / 2).any(axis=0) & (width > 0.9 * turn) & (width < 1.001 * turn)
        moves = np.minimum(steps, np.abs(steps - turn)).max(axis=0, initial=0.0)
        found[jumps & (moves < turn / 4)] = turn
    return found if found.any() else None


def law_of(problem: LinearMPC) -> Callable[[Array], Array]:
    """Return the law as a function of rows (batch, n_theta); NaN where one is not finite."""
    law = problem.law()

    def act(rows: Array) -> Array:
        finite = np.isfinite(rows).all(axis=1)
        u = np.full((len(rows), problem.model.n_inputs), np.nan)
        u[finite] = law(rows[finite])
        return u

    return act


def play(
    act: Callable[[int, Array], Array],
    step: Callable[[int, Array, Array], Array],
    starts: Array,
    steps: int,
    m: int,
    given: tuple[slice, Array] | None = None,
) -> tuple[Array, Array]:
    """Return rows (steps + 1, ..., size) and inputs (steps, ..., m): the one loop in models.

    ``act`` is asked for the inputs at a step and its rows, ``step`` for the rows after a step of
    all rows and inputs so far. ``given`` is a part of the rows, and what it is at each step.
    """
    rows = np.empty((steps + 1, *starts.shape))
    inputs = np.empty((steps, *starts.shape[:-1], m))
    rows[0] = starts
    for t in bar("episodes in a model: steps", range(steps)):
        if given is not None:
            rows[t][..., given[0]] = given[1][t]
        inputs[t] = act(t, rows[t])
        rows[t + 1] = step(t, rows, inputs)
    return rows, inputs


@dataclass(frozen=True)
class Dynamics:
    """``row+ = A_bar row + B_bar u + residual``, with one for each member: see `RowLayout`."""

    problem: LinearMPC
    coordinates: Coordinates
    members: tuple[Residual, ...]

    @cached_property
    def _stack(self) -> Residual:
        """All members as one that maps (members, batch, k)."""
        weights = zip(*(each.weights for each in self.members), strict=True)
        return Residual([np.array(each) for each in weights])

    @property
    def row(self) -> RowLayout:
        """What a row holds."""
        return self.coordinates.row

    def residual(self, theta: Array, u: Array) -> Array:
        """Return the residuals (members, batch, n) at rows (members, or 1 for all, batch, size)."""
        return self._stack.predict(self._scaled(theta, u))

    def _scaled(self, theta: Array, u: Array) -> Array:
        z = self.coordinates.scaled(self.row.features(theta, u))
        return np.broadcast_to(z, (len(self.members), *z.shape[1:]))

    def step(self, theta: Array, u: Array) -> Array:
        """Return the next rows (members, batch, size); r and a measured d stay as they are."""
        after = np.concatenate([theta, u], axis=-1) @ self.row.linear.T
        after = after + self.residual(theta, u) @ self.row.spread.T
        self.row.clip(after)
        self.coordinates.wrap(after)
        return np.asarray(after)

    def jacobians(self, theta: Array, u: Array) -> tuple[Array, Array]:
        """Return the derivatives of the step by theta and by u, for each member and row."""
        row = self.row
        at = self.row.features(theta, u)
        J = self._stack.jacobian(self._scaled(theta, u))
        inside = (at > self.coordinates.low) & (at < self.coordinates.high)
        J = J * (inside / self.coordinates.scale)[..., None, :]
        whole = np.broadcast_to(row.linear, (*J.shape[:-2], *row.linear.shape)).copy()
        whole[..., row.inputs] += row.spread @ J
        if row.observer is not None:  # on its bounds the shown estimate does not move
            free = row.clip(self.step(theta, u))
            whole[..., self.problem.layout.disturbance, :] *= free[..., None]
        A, B = np.split(whole, [row.size], axis=-1)
        return A, B

    def replay(self, episode: Episode, starts: Array, steps: int) -> Array:
        """Return states (members, starts, steps + 1, n) from logged ones, under the logged inputs.

        References and disturbances are those of the log at each step.
        """
        times = starts + np.arange(steps)[:, None]
        begin = np.repeat(episode.thetas[starts][None], len(self.members), axis=0)
        given = episode.thetas[times][..., self.row.given]
        rows, _ = self._play(lambda t, _: episode.actions[times[t]], begin, steps, given)
        return np.asarray(np.moveaxis(rows[..., self.row.state], 0, 2))

    def roll_out(
        self, act: Callable[[Array], Array], starts: Array, steps: int, given: Array | None = None
    ) -> tuple[Array, Array]:
        """Return rows (steps + 1, members, batch, size) and inputs (steps, ...) of a policy.

        ``starts`` are (members, batch, size), ``given`` (steps, batch, p) references and measured
        disturbances at each step; by default they stay.
        """

        def inputs(t: int, rows: Array) -> Array:
            u = np.asarray(act(self.row.shown(rows.reshape(-1, rows.shape[-1]))), np.float64)
            return u.reshape(*rows.shape[:2], self.problem.model.n_inputs)

        return self._play(inputs, starts, steps, given)

    def replay_in_closed_loop(self, episode: Episode) -> Array:
        """Return the predicted costs (members,) of a whole episode.

        The inputs are the logged ones, corrected by what the law makes of the deviation of the
        state: where the law made the log, it acts on its own predictions.
        """
        row = self.row
        law = law_of(self.problem)
        own = self.problem.deviations
        logged = law(row.shown(episode.thetas[:-1]))

        def inputs(t: int, rows: Array) -> Array:
            correction = law(row.shown(rows[:, 0])) - logged[t]
            u: Array = np.clip(episode.actions[t] + correction, own.u_min, own.u_max)
            return u[:, None]

        begin = np.repeat(episode.thetas[:1][None], len(self.members), axis=0)
        rows, u = self._play(inputs, begin, len(episode), episode.thetas[:-1, None, row.given])
        return np.asarray(own.stage_cost(row.shown(rows[:-1]), u)[..., 0].sum(axis=0))

    def _play(
        self, act: Callable[[int, Array], Array], starts: Array, steps: int, given: Array | None
    ) -> tuple[Array, Array]:
        fixed = None if given is None else (self.row.given, given)
        m = self.problem.model.n_inputs
        return play(act, lambda t, rows, u: self.step(rows[t], u[t]), starts, steps, m, fixed)
