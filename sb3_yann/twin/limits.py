"""What counts as a violation in a twin: the problem's bounds, and leaving what the log shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.twin.dynamics import MARGIN, Coordinates, Dynamics, law_of
from sb3_yann.twin.residuals import Residual
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.twin.starts import Starts

ROUNDING = 1e-9
PLANNED = 200
"""Runs of the MPC on its own model that tell where it means to go."""


@dataclass(frozen=True)
class Limits:
    """A box of states; beyond it is a violation.

    Attributes
    ----------
    problem : LinearMPC
    low, high : ndarray, shape (n,)
    row : RowLayout
        Where in the rows of the twin the states are.
    """

    problem: LinearMPC
    low: Array
    high: Array
    row: RowLayout

    @classmethod
    def of(cls, problem: LinearMPC, coordinates: Coordinates, starts: Starts) -> Limits:
        """Return the data's neighborhood, with the starts, as far as hard bounds let it.

        With set-points or disturbances also that of where the MPC would take its own model: the log
        of a worn plant, which rests beside its set-points, does not show that.
        """
        n, soft = problem.model.n_states, problem.soft.x > 0
        low, high = coordinates.low[:n], coordinates.high[:n]
        planned = [_planned(problem, coordinates, starts)] if problem.layout.has_constants else []
        for least, most in [(starts.low, starts.high), *planned]:
            width = MARGIN * (most - least)
            low, high = np.minimum(low, least - width), np.maximum(high, most + width)
        room = ROUNDING * problem.theta_half[:n]
        bounded = np.maximum(low, np.where(soft, -np.inf, problem.deviations.x_min))
        limited = np.minimum(high, np.where(soft, np.inf, problem.deviations.x_max))
        return cls(problem, bounded - room, limited + room, coordinates.row)

    def violated(self, thetas: Array) -> NDArray[np.bool_]:
        """Return whether states lie beyond, for rows (..., size); NaN does."""
        x = thetas[..., self.row.state]
        inside = (x >= self.low) & (x <= self.high)
        return np.asarray(~inside.all(axis=-1))


def _planned(problem: LinearMPC, coordinates: Coordinates, starts: Starts) -> tuple[Array, Array]:
    """Return the box of the MPC's runs on its own model: as long as the log's, from its starts."""
    n, steps = problem.model.n_states, len(starts.rows) // len(starts.first)
    model = Dynamics(problem, coordinates, (Residual.zero(len(coordinates.scale), n),))
    first = starts.draw(PLANNED, np.random.default_rng(0))
    rows = model.roll_out(law_of(problem), first[None], steps)[0]
    x = rows[..., coordinates.row.state].reshape(-1, n)
    least, most = problem.deviations.theta_min[:n], problem.deviations.theta_max[:n]
    return np.clip(x.min(axis=0), least, most), np.clip(x.max(axis=0), least, most)
