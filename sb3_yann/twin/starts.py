"""Where episodes of a twin begin, and what they are given: as in the log."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC, StateEstimator
from sb3_yann.twin.log import Episode
from sb3_yann.twin.row_layout import RowLayout

AROUND, WIDEST, RARE = 3.0, 2.0, 0.05
"""How many boxes wide starts are drawn at most; how much wider than the log's starts their box is
at most; how likely a start is, in one coordinate, beyond what the log shows."""


@dataclass(frozen=True)
class Starts:
    """The box of first states, and the logged rows.

    The box is that of a uniform distribution, estimated without bias from the first states of the
    log: with k of them it is (k + 1) / (k - 1) times as wide as they are, twice at most.

    Attributes
    ----------
    problem : LinearMPC
    low, high : ndarray, shape (n,)
    first, rows : ndarray, shapes (episodes, size) and (rows, size)
        The first row of each episode, and all of them.
    observer : StateEstimator, optional
        The twin's, which begins with them.
    """

    problem: LinearMPC
    low: Array
    high: Array
    first: Array
    rows: Array
    observer: StateEstimator | None = None

    @classmethod
    def of(
        cls,
        problem: LinearMPC,
        episodes: tuple[Episode, ...],
        observer: StateEstimator | None = None,
    ) -> Starts:
        """Return those of a log."""
        first = np.array([each.thetas[0] for each in episodes])
        rows = np.concatenate([each.thetas[:-1] for each in episodes])
        n = problem.model.n_states
        x, k = first[:, :n], len(first)
        middle, half = (x.max(0) + x.min(0)) / 2, (x.max(0) - x.min(0)) / 2
        half = half * _widened(k)
        low = np.maximum(middle - half, problem.deviations.theta_min[:n])
        high = np.minimum(middle + half, problem.deviations.theta_max[:n])
        return cls(problem, low, high, first, rows, observer)

    @cached_property
    def row(self) -> RowLayout:
        """What a row holds."""
        return RowLayout(self.problem, self.observer)

    @property
    def shown(self) -> tuple[Array, Array]:
        """The box of theta (n_theta,), twice, that the log shows: all rows, and where it may begin.

        Beyond the latter, in one coordinate, lies one start in twenty: see :meth:`chance_beyond`.
        """
        first, rows, k = self.row.shown(self.first), self.row.shown(self.rows), len(self.first)
        low, high = first.min(0), first.max(0)
        ranges = 2 * (2 / (k + 1) / RARE) ** (1 / max(k - 1, 1)) - 1
        further = (high - low) / 2 * max(ranges - 1, 0.0)
        low, high = np.minimum(rows.min(0), low - further), high + further
        return low, np.maximum(rows.max(0), high)

    def draw(self, count: int, rng: np.random.Generator, episodes: Any = None) -> Array:
        """Return rows (count, size) where episodes begin: in the box, the rest as logged.

        Numbers of ``episodes`` (count,) say in which of them; by default they are drawn.
        """
        if episodes is None:
            episodes = rng.integers(len(self.first), size=count)
        drawn = self.first[episodes]
        drawn[:, : len(self.low)] = rng.uniform(self.low, self.high, (count, len(self.low)))
        return self.row.begin(drawn)

    def draw_between(self, count: int, rng: np.random.Generator) -> Array:
        """Return rows (count, size) where episodes begin, at other set-points as well.

        Every other one has references and disturbances from the box that the log shows: what
        passes at the few of the log may fail between them.
        """
        drawn, layout = self.draw(count, rng), self.problem.layout
        if not layout.has_constants:
            return drawn
        held, some = self.row.given, drawn[::2].copy()
        low, high = np.clip(
            self.shown, self.problem.deviations.theta_min, self.problem.deviations.theta_max
        )
        some[:, held] = rng.uniform(low[held], high[held], some[:, held].shape)
        inside = self.problem.law().in_domain(self.row.shown(some))
        drawn[::2][inside] = some[inside]
        return drawn

    def draw_logged(self, count: int, rng: np.random.Generator) -> Array:
        """Return rows (count, size) from amid the log."""
        return self.rows[rng.integers(len(self.rows), size=count)]

    def draw_around(self, count: int, rng: np.random.Generator) -> Array:
        """Return rows (count, size) from boxes up to three times as wide: nothing is known.

        How wide is drawn evenly, and wider where :meth:`chance_beyond` says so: the fewer starts
        there are in the log, the wider. Those that the law has no solution for are replaced by
        logged ones.
        """
        drawn, n, k = self.draw_between(count, rng), len(self.low), len(self.first)
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        nearest = (1 + _widened(k)) / 2
        ranges = 2 * nearest * rng.uniform(size=(count, 1)) ** (-1 / max(k - 1, 1)) - 1
        wide = np.maximum(ranges / _widened(k), rng.uniform(1, AROUND, (count, 1)))
        reach = np.minimum(wide, AROUND) * half
        drawn[:, :n] = middle + reach * rng.uniform(-1, 1, (count, n))
        shown = np.clip(
            self.row.shown(drawn),
            self.problem.deviations.theta_min,
            self.problem.deviations.theta_max,
        )
        outside, drawn = ~self.problem.law().in_domain(shown), self.row.begin(shown)
        drawn[outside] = self.draw_logged(int(outside.sum()), rng)
        return drawn

    def chance_beyond(self, thetas: Array) -> Array:
        """Return how likely a start lies so far out or farther, in one coordinate: (...,).

        For rows (..., size), in the one that lies farthest out. Of k draws from a uniform
        distribution the next one lies beyond ``rho`` times their range with probability
        ``2 / (k + 1) ((1 + rho) / 2) ** (1 - k)``: spacings are exchangeable.
        """
        n, k = len(self.low), len(self.first)
        x, seen = thetas[..., :n], self.first[:, :n]
        middle, half = (self.high + self.low) / 2, np.ptp(seen, axis=0) / 2
        rho = (np.abs(x - middle) / np.maximum(half, 1e-300)).max(axis=-1)
        return np.asarray(2 / (k + 1) * ((1 + np.maximum(rho, 1.0)) / 2) ** (1.0 - k))

    def draw_anywhere(self, count: int, rng: np.random.Generator) -> Array:
        """Return rows (count, size), a third each of first states, of logged and of around."""
        third = count // 3
        parts = self.draw_logged(third, rng), self.draw_around(third, rng)
        return np.concatenate([self.draw_between(count - 2 * third, rng), *parts])


def _widened(k: int) -> float:
    """Return how many times as wide as the range of k starts their box is."""
    return min(WIDEST, (k + 1) / max(k - 1, 1))
