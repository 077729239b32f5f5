"""What a trajectory is to minimize, and within which bounds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC

INSIDE, WEIGHT = 1e-3, 1e4
"""How far inside of the bounds plans stay, in half-widths; what one half-width beyond that costs in
a step, in mean costs of a step."""


@dataclass(frozen=True)
class Bounds:
    """Bounds of states and outputs.

    Attributes
    ----------
    C : ndarray, shape (k, n)
        Combinations of the states.
    low, high, half : ndarray, shape (k,)
        Their bounds, one of which is finite at least, and half-widths.
    states : slice
        Where theta has the states.
    """

    C: Array
    low: Array
    high: Array
    half: Array
    states: slice

    @classmethod
    def of(cls, problem: LinearMPC, low: ArrayLike = -np.inf, high: ArrayLike = np.inf) -> Bounds:
        """Return those of a problem, and of its states (n,) besides."""
        outputs, size = problem.outputs, problem.theta_half[problem.layout.state]
        C = np.vstack([np.eye(len(size)), outputs.C])
        lowest = np.concatenate([np.maximum(problem.x_min, low), outputs.y_min])
        highest = np.concatenate([np.minimum(problem.x_max, high), outputs.y_max])
        half = np.concatenate([size, np.abs(outputs.C) @ size])
        used = np.isfinite(lowest) | np.isfinite(highest)
        return cls(C[used], lowest[used], highest[used], half[used], problem.layout.state)

    def beyond(self, thetas: Array, room: float) -> Array:
        """Return by how much bounds that are moved out by some room are exceeded (..., k).

        Room and result are in half-widths.
        """
        y = thetas[..., self.states] @ self.C.T
        above = np.maximum((y - self.high) / self.half - room, 0)
        return np.asarray(above - np.maximum((self.low - y) / self.half - room, 0))


@dataclass(frozen=True)
class Task:
    """What a trajectory is to minimize: stage costs, the value at the end, what is beyond bounds.

    Attributes
    ----------
    problem : LinearMPC
        Its stage cost; its bounds of states, outputs, inputs and rates, soft ones too.
    low, high : ndarray, shape (n,)
        Bounds of the states besides, infinite where there are none.
    end : ndarray, shape (n_theta, n_theta)
        ``theta' end theta`` is the cost of what comes after the last step.
    weight : float
        What one half-width beyond a bound costs in a step, `WEIGHT` typical stage costs.
    """

    problem: LinearMPC
    low: Array
    high: Array
    end: Array
    weight: float

    @cached_property
    def _bounds(self) -> Bounds:
        return Bounds.of(self.problem, self.low, self.high)

    def costs(self, thetas: Array, inputs: Array) -> Array:
        """Return the costs (k,) of thetas (T + 1, k, n_theta) and inputs (T, k, m); inf for NaN."""
        with np.errstate(over="ignore", invalid="ignore"):
            stage = self.problem.stage_cost(thetas[:-1], inputs).sum(axis=0)
            end = np.sum((thetas[-1] @ self.end) * thetas[-1], axis=-1)
            outside = np.sum(self._bounds.beyond(thetas[1:], -INSIDE) ** 2, axis=(0, 2))
            total = stage + end + self.weight * outside
        return np.where(np.isfinite(total), total, np.inf)

    def limits(self, thetas: Array) -> tuple[Array, Array]:
        """Return the bounds (..., m) of the inputs at thetas (..., n_theta)."""
        problem = self.problem
        low, high = (np.broadcast_to(each, (*thetas.shape[:-1], len(each)))
                     for each in (problem.u_min, problem.u_max))  # fmt: skip
        if problem.has_rate_bounds:
            before = thetas[..., problem.layout.previous]
            low = np.maximum(low, before + problem.rate.du_min)
            high = np.maximum(np.minimum(high, before + problem.rate.du_max), low)
        return low, high

    def penalty(self, thetas: Array) -> tuple[Array, Array]:
        """Return gradient (..., n) and curvature (..., n, n) of what is beyond bounds."""
        over, weight = self._bounds.beyond(thetas, -INSIDE), 2 * self.weight
        scaled = self._bounds.C / self._bounds.half[:, None]
        active = (over != 0).astype(float)
        curvature = np.einsum("ki,...k,kj->...ij", scaled, active, scaled)
        return weight * over @ scaled, weight * curvature
