"""The transitions that an audit looks at, and how well an explanation agrees with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array

Mask = NDArray[np.bool_]
EXACT = 1e-5
"""What rounding to float32 leaves of an agreement, relative to the spread of the rewards."""
FEWEST = 10
"""Steps that an explanation has to agree with."""


@dataclass(frozen=True)
class Sample:
    """The first transitions of training, env after env, each in the order of time.

    Attributes
    ----------
    theta, following : ndarray, shape (steps, n), before and after the step, in deviations
    u : ndarray, shape (steps, m), as it was sent to the env
    rewards : ndarray, shape (steps,)
    counted : ndarray of bool, shape (steps,)
        False where a violation or an end other than by a time limit may have changed the reward.
    terminated : ndarray of bool, shape (steps,)
    episode : ndarray of int, shape (steps,), a number for each episode
    begins, first : ndarray of bool, shape (steps,), the first step of an episode, and of an env
    blank : ndarray of bool, shape (steps,), where the observation was zero throughout
    rounding : ndarray, shape (steps, n), by how much theta may err, from float32 observations
    scale, offset : float, for the reward ``scale * (-cost) + offset``
    stage_cost : callable, (steps, n), (steps, m) to (steps,)
    step : callable, the model: (steps, n), (steps, m) to (steps, n)
    gamma : float, the learner's discount
    theta_ss : ndarray, shape (n,), what deviations count from
    """

    theta: Array
    following: Array
    u: Array
    rewards: Array
    counted: Mask
    terminated: Mask
    episode: NDArray[np.int64]
    begins: Mask
    first: Mask
    blank: Mask
    rounding: Array
    scale: float
    offset: float
    stage_cost: Callable[[Array, Array], Array]
    step: Callable[[Array, Array], Array]
    gamma: float
    theta_ss: Array

    @cached_property
    def cost(self) -> Array:
        """The problem's cost of each step, (steps,)."""
        return self.stage_cost(self.theta, self.u)

    @cached_property
    def implied(self) -> Array:
        """The cost of each step that the reward stands for, (steps,)."""
        return (self.offset - self.rewards) / self.scale

    @cached_property
    def rounded(self) -> Array:
        """By how much the cost of each step may err because observations are float32, (steps,)."""
        total: Array = np.zeros(len(self.cost))
        for i, unit in enumerate(np.eye(self.theta.shape[1])):
            nearby = self.theta + self.rounding[:, i : i + 1] * unit
            total = total + np.abs(self.stage_cost(nearby, self.u) - self.cost)
        return 2 * total

    def earlier(self, values: Array, steps: int) -> tuple[Array, Mask]:
        """Return values of so many steps before (later, if below 0), and where there are any."""
        index = np.arange(len(values)) - steps
        inside = (index >= 0) & (index < len(values))
        index = np.clip(index, 0, len(values) - 1)
        return values[index], inside & (self.episode[index] == self.episode)

    def matches_stage_cost(self, tolerance: float) -> bool:
        """Tell whether every counted reward is what the problem says."""
        cost, error = np.abs(self.cost), np.abs(self.implied - self.cost)
        allowed = tolerance * np.maximum(cost, cost[self.counted].mean()) + self.rounded
        at_rest = 1e-9 * np.abs(self.rewards[self.counted]).max() + 1e-12
        return bool(np.all((error <= allowed + at_rest)[self.counted]))

    def agrees(self, predicted: Array, tolerance: float, defined: Mask | None = None) -> bool:
        """Tell whether nearly all rewards are minus a predicted cost, where it is defined.

        Errors are relative to how much it varies: a large constant explains nothing.
        """
        used = self.counted if defined is None else self.counted & defined
        if np.count_nonzero(used) < max(FEWEST, np.count_nonzero(self.counted) // 2):
            return False
        known = predicted[used]
        spread = np.abs(known - np.median(known))
        allowed = tolerance * np.maximum(spread, spread.mean()) + self.rounded[used]
        with np.errstate(invalid="ignore"):
            return bool(np.mean(np.abs(self.implied[used] - known) <= allowed) >= 0.98)


@dataclass(frozen=True)
class Line:
    """The line nearest to ``reward = scale * (-cost) + offset``, and its share of the variance."""

    scale: float
    offset: float
    r2: float

    @classmethod
    def through(cls, sample: Sample) -> Line:
        """Return the line by least squares, through the origin where that does as well."""
        x, y = -sample.cost[sample.counted], sample.rewards[sample.counted]
        if np.ptp(x) <= 1e-12 * np.abs(x).max() or np.ptp(y) <= 1e-12 * np.abs(y).max():
            return cls(0.0, float(y.mean()), 0.0)
        # Centered: with a large offset the normal equations would lose what varies.
        dx, dy = x - x.mean(), y - y.mean()
        scale = float(dx @ dy / (dx @ dx))
        offset = float(y.mean() - scale * x.mean())
        if abs(offset) <= EXACT * np.abs(y).mean():
            scale, offset = float(x @ y / (x @ x)), 0.0
        residual = y - scale * x - offset
        return cls(scale, offset, float(1 - residual @ residual / (dy @ dy)))
