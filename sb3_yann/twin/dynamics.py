"""The linear model plus a residual, bounded outside the data: what a twin steps with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC, StateEstimator
from sb3_yann.twin.log import Episode
from sb3_yann.twin.residuals import Residual
from sb3_yann.twin.row_layout import RowLayout

MARGIN = 0.25
"""How far the residual reaches beyond the data, in widths of the data."""
FULL_TURNS = 2 * np.pi, 360.0
"""By which an angle jumps that is shown between two ends, such as -pi and pi."""


@dataclass(frozen=True)
class Coordinates:
    """Where the data are: what residuals are fed is scaled by it, and never lies far outside.

    Attributes
    ----------
    low, high : ndarray, shape (k,)
        The box of the logged ``[x, d, u]``, or ``[x, u]`` where an observer estimates d, a quarter
        of its width beyond the data.
    scale : ndarray, shape (k,)
        The largest magnitudes.
    units : ndarray, shape (n,)
        How far the states move in the log: standard deviations.
    row : RowLayout
        What a row of the twin holds: theta alone, unless an observer is a part of it.
    turn : ndarray, shape (n,), optional
        A full turn for each state that is an angle and jumps by it, 0 for the others.
    """

    low: Array
    high: Array
    scale: Array
    units: Array
    row: RowLayout
    turn: Array | None = None

    @classmethod
    def of(
        cls,
        problem: LinearMPC,
        episodes: Sequence[Episode],
        observer: StateEstimator | None = None,
    ) -> Coordinates:
        """Return those of a log, whose episodes hold rows of this layout."""
        row = RowLayout(problem, observer)
        seen = np.concatenate([row.features(e.thetas[:-1], e.actions) for e in episodes])
        half = row.half
        low, high = seen.min(0), seen.max(0)
        width = np.maximum(high - low, 1e-6 * half)
        scale = np.maximum(np.abs(seen).max(0), 1e-3 * half)
        units = np.maximum(np.std(seen, axis=0), 1e-6 * half)[: problem.model.n_states]
        turn = (
            None if row.observer is not None else _turns([e.thetas[:, row.state] for e in episodes])
        )
        return cls(low - MARGIN * width, high + MARGIN * width, scale, units, row, turn)

    def scaled(self, features: Array) -> Array:
        """Return what residuals are fed, inside the box."""
        return np.asarray(np.clip(features, self.low, self.high) / self.scale)

    def regression(self, episode: Episode) -> tuple[Array, Array]:
        """Return z (T, k), and what the linear model leaves of the next states (T, n)."""
        row, rows, u = self.row, episode.thetas, episode.actions
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
    law, m = problem.law(), problem.model.n_inputs

    def act(rows: Array) -> Array:
        finite = np.isfinite(rows).all(axis=1)
        u = np.full((len(rows), m), np.nan)
        u[finite] = law(rows[finite])
        return u

    return act


@dataclass(frozen=True)
class Dynamics:
    """``theta+ = A_bar theta + B_bar u + residual``, with one residual for each member.

    Where an observer estimates d, a row holds what it remembers behind theta: see
    :class:`RowLayout`. It steps with the plant.

    Attributes
    ----------
    problem : LinearMPC
    coordinates : Coordinates
    members : tuple of Residual
        One for each member, all of the same kind.
    """

    problem: LinearMPC
    coordinates: Coordinates
    members: tuple[Residual, ...]

    @cached_property
    def _stack(self) -> Residual:
        """All members as one that maps (members, batch, k)."""
        return Residual.stack(self.members)

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
        row, at = self.row, self.row.features(theta, u)
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
        parts, n = self.row, self.problem.model.n_states
        theta = np.broadcast_to(
            episode.thetas[starts], (len(self.members), len(starts), parts.size)
        )
        theta, found = theta.copy(), np.empty((len(self.members), len(starts), steps + 1, n))
        for k in range(steps + 1):
            found[:, :, k] = theta[..., parts.state]
            if k == steps:
                break
            theta[..., parts.given] = episode.thetas[starts + k][:, parts.given]
            u = np.broadcast_to(
                episode.actions[starts + k], (*theta.shape[:2], len(self.problem.R))
            )
            theta = self.step(theta, u)
        return found

    def roll_out(
        self,
        act: Callable[[Array], Array],
        starts: Array,
        steps: int,
        given: Array | None = None,
    ) -> tuple[Array, Array]:
        """Return rows (steps + 1, members, batch, size) and inputs (steps, ...) of a policy.

        Parameters
        ----------
        act : callable
            From theta (rows, n_theta) to inputs (rows, m).
        starts : ndarray, shape (members, batch, size)
            Where the runs begin.
        steps : int
            How long they are.
        given : ndarray, shape (steps, batch, p), optional
            References and measured disturbances at each step. The default is that they stay.
        """
        k, batch, size = starts.shape
        thetas, inputs = np.empty((steps + 1, *starts.shape)), np.empty((steps, k, batch, self.m))
        thetas[0] = starts
        for t in range(steps):
            if given is not None:
                thetas[t][..., self.row.given] = given[t]
            u = np.asarray(act(self.row.shown(thetas[t].reshape(-1, size))), np.float64)
            inputs[t] = u.reshape(k, batch, self.m)
            thetas[t + 1] = self.step(thetas[t], inputs[t])
        return thetas, inputs

    @property
    def m(self) -> int:
        """Number of inputs."""
        return self.problem.model.n_inputs

    def replay_in_closed_loop(self, episode: Episode) -> Array:
        """Return the predicted costs (members,) of a whole episode.

        The inputs are the logged ones, corrected by what the law makes of the deviation of the
        state: where the law made the log, it acts on its own predictions.
        """
        parts, law = self.row, law_of(self.problem)
        u_min, u_max = self.problem.deviations.u_min, self.problem.deviations.u_max
        logged = law(parts.shown(episode.thetas[:-1]))
        theta = np.repeat(episode.thetas[:1][None], len(self.members), axis=0)
        costs = np.zeros(len(self.members))
        for k in range(len(episode)):
            theta[..., parts.given] = episode.thetas[k, parts.given]
            correction = law(parts.shown(theta[:, 0])) - logged[k]
            u = np.clip(episode.actions[k] + correction, u_min, u_max)[:, None]
            costs += self.problem.deviations.stage_cost(parts.shown(theta), u)[:, 0]
            theta = self.step(theta, u)
        return costs
