"""What a trajectory is to minimize, and within which bounds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.mpc.bound_excess import Bounds

INSIDE, WEIGHT = 1e-3, 1e4
"""How far inside of the bounds plans stay, in half-widths; what one half-width beyond that costs in
a step, in mean costs of a step."""


class Doubt(Protocol):
    """A price on what a model does not know, a sum of squares."""

    def costs(self, thetas: Array, inputs: Array) -> Array:
        """Return what steps cost (T, k), at thetas (T, k, n_theta) and inputs (T, k, m)."""

    def slopes(self, thetas: Array, inputs: Array) -> tuple[Array, Array]:
        """Return gradients (T, k, n_theta + m) and Gauss-Newton curvatures of that."""


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
    doubt : Doubt, optional
        What a plan pays where the members of a model disagree.
    """

    problem: LinearMPC
    low: Array
    high: Array
    end: Array
    weight: float
    doubt: Doubt | None = None

    @cached_property
    def _bounds(self) -> Bounds:
        return Bounds.of(self.problem, self.low, self.high)

    def costs(self, thetas: Array, inputs: Array) -> Array:
        """Return the costs (k,) of thetas (T + 1, k, n_theta) and inputs (T, k, m); inf for NaN."""
        with np.errstate(over="ignore", invalid="ignore"):
            stage = self.problem.deviations.stage_cost(thetas[:-1], inputs).sum(axis=0)
            end = np.sum((thetas[-1] @ self.end) * thetas[-1], axis=-1)
            outside = np.sum(self._bounds.beyond(thetas[1:], -INSIDE) ** 2, axis=(0, 2))
            total = stage + end + self.weight * outside
            if self.doubt is not None:
                total = total + self.doubt.costs(thetas[:-1], inputs).sum(axis=0)
        return np.where(np.isfinite(total), total, np.inf)

    def limits(self, thetas: Array) -> tuple[Array, Array]:
        """Return the bounds (..., m) of the inputs at thetas (..., n_theta)."""
        problem = self.problem
        low, high = (np.broadcast_to(each, (*thetas.shape[:-1], len(each)))
                     for each in (problem.deviations.u_min, problem.deviations.u_max))  # fmt: skip
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
