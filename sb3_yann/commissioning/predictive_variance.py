"""How familiar a point is to a plant's log: how far the twin's residual may be wrong there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.twin.log import Episode
from sb3_yann.twin.plant_twin import PlantTwin
from sb3_yann.twin.residuals import Monomials
from sb3_yann.twin.row_layout import RowLayout

MOST_MONOMIALS = 200
INPUT_SHARE = 0.2
"""What an input is expected to bend, relative to a state: a closed loop tells little of it."""
LEAST = 0.1
"""The residual is taken to be at least so large, in standard deviations of one-step errors."""


@dataclass(frozen=True)
class PredictiveVariance:
    """How far the residual may be from the twin's, at a point that the log tells little about.

    The standard deviation of a Bayesian cubic regression on the log. Its prior is as wide as what
    the twin's residual explains; its noise are the held-out one-step errors. Where these are
    correlated they count as fewer samples. Beyond the log the prior itself is added, times the
    distance in widths of the log (Rasmussen and Williams, section 2.1).

    Attributes
    ----------
    row : RowLayout
    scale, low, high : ndarray, shape (k,)
        Of the features ``[x, d, u]``: magnitudes, and the log's box.
    monomials : Monomials
    axes : ndarray, shape (size, size)
        Eigenvectors of the Gram matrix of the monomials, each times its share of the prior.
    variances : ndarray, shape (size, n)
        Posterior variances along them.
    size : ndarray, shape (n,)
        What the residual explains.
    """

    row: RowLayout
    scale: Array
    low: Array
    high: Array
    monomials: Monomials
    axes: Array
    variances: Array
    size: Array

    @classmethod
    def of(
        cls, twin: PlantTwin, episodes: Sequence[Episode], error: Array, white: Array
    ) -> PredictiveVariance:
        """Return that of some episodes of a twin.

        Parameters
        ----------
        twin : PlantTwin
            Of the plant.
        episodes : sequence of Episode
            What is familiar.
        error, white : ndarray, shape (n,)
            Root mean squares of held-out one-step errors, and the share of samples that count.
        """
        row, scale = twin.dynamics.row, twin.dynamics.coordinates.scale
        seen = np.concatenate([row.features(e.thetas[:-1], e.actions) for e in episodes])
        degree = 3
        while degree > 1 and Monomials(len(scale), degree).values(scale).size > MOST_MONOMIALS:
            degree -= 1
        monomials = Monomials(len(scale), degree)
        inputs = monomials.holding(len(scale) - twin.problem.model.n_inputs)
        share = np.where(inputs, INPUT_SHARE, 1.0)
        F = monomials.values(seen / scale) * share
        values, axes = np.linalg.eigh(F.T @ F)
        explained = [twin.dynamics.residual(e.thetas[None, :-1], e.actions[None])[0]
                     for e in twin.episodes]  # fmt: skip
        size = np.sqrt(np.mean(np.concatenate(explained) ** 2, axis=0) + (LEAST * error) ** 2)
        known = np.maximum(values, 0.0)[:, None] * white / error**2
        low, high = seen.min(axis=0), seen.max(axis=0)
        variances = 1.0 / (known + 1.0 / size**2)
        return cls(row, scale, low, high, monomials, share[:, None] * axes, variances, size)

    @cached_property
    def _width(self) -> Array:
        return np.maximum(self.high - self.low, 1e-6 * self.scale)

    def doubt(self, theta: Array, u: Array) -> Array:
        """Return standard deviations (n,) at a row (size,) and u (m,)."""
        z = self.row.features(theta, u)
        beyond = np.maximum(np.maximum(z - self.high, self.low - z), 0.0)
        far = (beyond / self._width).sum()
        far += far**2  # a twin of a narrow log underrates what is far away
        along = self.monomials.values(z / self.scale) @ self.axes
        return np.asarray(np.sqrt(along**2 @ self.variances + (far * self.size) ** 2))
