"""What counts as a violation in a twin: the problem's bounds, and leaving what the log shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.twin.dynamics import MARGIN, Coordinates
from sb3_yann.twin.starts import Starts

ROUNDING = 1e-9


@dataclass(frozen=True)
class Limits:
    """A box of states; beyond it is a violation.

    Attributes
    ----------
    problem : LinearMPC
    low, high : ndarray, shape (n,)
    """

    problem: LinearMPC
    low: Array
    high: Array

    @classmethod
    def of(cls, problem: LinearMPC, coordinates: Coordinates, starts: Starts) -> Limits:
        """Return the data's neighborhood, with the starts, as far as hard bounds let it."""
        n, soft = problem.model.n_states, problem.soft.x > 0
        width = MARGIN * (starts.high - starts.low)
        low = np.minimum(coordinates.low[:n], starts.low - width)
        high = np.maximum(coordinates.high[:n], starts.high + width)
        room = ROUNDING * problem.theta_half[:n]
        bounded = np.maximum(low, np.where(soft, -np.inf, problem.x_min))
        limited = np.minimum(high, np.where(soft, np.inf, problem.x_max))
        return cls(problem, bounded - room, limited + room)

    def broken(self, thetas: Array) -> NDArray[np.bool_]:
        """Return whether states break a hard bound of the problem itself."""
        x, problem = thetas[..., self.problem.layout.state], self.problem
        room, hard = ROUNDING * problem.theta_half[problem.layout.state], problem.soft.x <= 0
        beyond = (x < problem.x_min - room) | (x > problem.x_max + room)
        return np.asarray((beyond & hard).any(axis=-1))

    def violated(self, thetas: Array) -> NDArray[np.bool_]:
        """Return whether states lie beyond, for thetas (..., n_theta); NaN does."""
        x = thetas[..., self.problem.layout.state]
        inside = (x >= self.low) & (x <= self.high)
        return np.asarray(~inside.all(axis=-1))
