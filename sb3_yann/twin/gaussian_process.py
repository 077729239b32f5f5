"""A Gaussian process as the residual: no degree to choose, zero far from the data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import linalg
from scipy.optimize import minimize

from sb3_yann._validation import Array

POINTS = 150
"""Points that carry the fitted function: the time of a prediction grows with their number."""
ROWS = 200
"""Rows of the log, evenly drawn, that the lengths and noises are fitted to."""
SHORTEST, LONGEST, NOISES = 2.0, 20.0, (1e-8, 1e3)
"""Bounds of the lengths, in scaled coordinates, and of the noise, in variances of the function."""
SMALLEST = 1e-9
"""A point that leaves less of the variance unexplained adds nothing but rounding."""


class GaussianProcess:
    """The mean of a Gaussian process with a squared-exponential kernel: towards zero without data.

    Each variable has its length, each output its noise; they maximize the likelihood of some rows.
    All rows then decide the weights of few points, which a pivoted Cholesky factorization of the
    kernel picks (subset of regressors: Rasmussen and Williams, section 8.3.1).

    Parameters
    ----------
    offset : bool, default False
        Whether the function may differ from zero at zero, where the equilibrium is.
    stiffness : float, default 1
        How many times the fitted variance of the noise is taken: more leads to the linear model.
    shortest : float, default 2
        The least length, in scaled coordinates: the shorter, the nearer to the data it is zero.
    """

    lengths: Array
    points: Array
    weights: Array

    def __init__(
        self, offset: bool = False, stiffness: float = 1.0, shortest: float = SHORTEST
    ) -> None:
        self.offset, self.stiffness, self.shortest = offset, stiffness, shortest

    @classmethod
    def stack(cls, members: Sequence[GaussianProcess]) -> GaussianProcess:
        """Return fitted ones as one, from z (members, batch, k) to (members, batch, n)."""
        found = cls(members[0].offset)
        found.lengths = np.array([each.lengths for each in members])[:, None]
        found.points = np.array([each.points for each in members])
        found.weights = np.array([each.weights for each in members])
        return found

    def fit(self, z: Array, y: Array) -> GaussianProcess:
        """Fit to residuals y (N, n) at z (N, k)."""
        size = np.sqrt(np.mean(y**2, axis=0))
        y = y / np.where(size > 0, size, 1.0)
        self.lengths, noises = self._most_likely(z, y)
        picked, root = self._factor(z)
        weights = np.empty((len(picked), y.shape[1]))
        for i, noise in enumerate(self.stiffness * noises):
            matrix = root.T @ root + noise * np.eye(len(picked))
            weights[:, i] = linalg.solve(matrix, root.T @ y[:, i], assume_a="pos")
        weights = linalg.solve_triangular(root[picked], weights, lower=True, trans="T")
        self.points = np.zeros((POINTS, z.shape[1]))  # of one shape, so that members are stacked
        self.weights = np.zeros((POINTS, y.shape[1]))
        self.points[: len(picked)] = z[picked]
        self.weights[: len(picked)] = weights * size
        return self

    def predict(self, z: Array) -> Array:
        """Return the residual (batch, n)."""
        near, origin = self._kernels(z, self.points)
        return np.asarray((near - origin) @ self.weights)

    def jacobian(self, z: Array) -> Array:
        """Return its derivatives (batch, n, k)."""
        near, origin = self._kernels(z, self.points)
        # The slope of a kernel is itself, times the way to its point in squared lengths.
        carried = self.weights[..., None] * self.points[..., None, :]
        flat = carried.reshape(*carried.shape[:-2], -1)
        toward = (near @ flat).reshape(*near.shape[:-1], *carried.shape[-2:])
        toward = toward - ((near - origin) @ self.weights)[..., None] * z[..., None, :]
        return np.asarray(toward / self.lengths[..., None, :] ** 2)

    def _kernels(self, z: Array, points: Array) -> tuple[Array, Array | float]:
        """Return the kernel (batch, points), and what knowing the function at zero takes off it."""
        a, b = z / self.lengths, points / self.lengths
        of_a, of_b = np.sum(a**2, axis=-1)[..., None], np.sum(b**2, axis=-1)[..., None, :]
        squares = np.maximum(of_a + of_b - 2 * a @ np.swapaxes(b, -1, -2), 0.0)
        return np.exp(-squares / 2), 0.0 if self.offset else np.exp(-(of_a + of_b) / 2)

    def _factor(self, z: Array) -> tuple[Array, Array]:
        """Return the rows of z (N, k) that tell most, and the kernel's factor (N, picked)."""
        known = 0.0 if self.offset else np.exp(-np.sum((z / self.lengths) ** 2, axis=1))
        left = np.ones(len(z)) - known
        picked: list[int] = []
        root = np.empty((len(z), min(POINTS, len(z))))
        while len(picked) < root.shape[1] and left.max() > SMALLEST:
            row, so_far = int(np.argmax(left)), len(picked)
            near, origin = self._kernels(z, z[row : row + 1])
            column = (near - origin)[:, 0] - root[:, :so_far] @ root[row, :so_far]
            root[:, so_far] = column / np.sqrt(left[row])
            left = left - root[:, so_far] ** 2
            picked.append(row)
        return np.array(picked, dtype=int), root[:, : len(picked)]

    def _most_likely(self, z: Array, y: Array) -> tuple[Array, Array]:
        """Return the lengths (k,) and noises (n,) that make y (N, n) at z (N, k) most likely."""
        distinct = np.sort(
            np.unique(z, axis=0, return_index=True)[1]
        )  # one drawn twice is no proof
        rows = distinct[np.linspace(0, len(distinct) - 1, min(ROWS, len(distinct))).astype(int)]
        k, n = z.shape[1], y.shape[1]
        bounds = [np.log((self.shortest, LONGEST))] * k + [np.log(NOISES)] * n
        start = np.concatenate([np.full(k, np.log(2.0)), np.full(n, np.log(1e-2))])
        found = minimize(
            self._unlikeliness, start, (z[rows], y[rows]), "L-BFGS-B", jac=True, bounds=bounds,
            options={"maxiter": 100},
        ).x  # fmt: skip
        return np.exp(found[:k]), np.exp(found[k:])

    def _unlikeliness(self, logs: Array, z: Array, y: Array) -> tuple[float, Array]:
        """Return minus the log likelihood and its slope, each output's variance the best one.

        Rasmussen and Williams, equations 5.8 and 5.9, with y' K^-1 y / N as the variance.
        """
        k, count = z.shape[1], len(z)
        self.lengths, noises = np.exp(logs[:k]), np.exp(logs[k:])
        near, origin = self._kernels(z, z)
        values, vectors = linalg.eigh(near - origin)
        values = np.maximum(values, 0.0)[:, None] + noises  # (N, n), one column for each output
        alpha = vectors @ ((vectors.T @ y) / values)
        variances = np.maximum(np.sum(y * alpha, axis=0) / count, 1e-300)
        value = 0.5 * (count * np.log(variances).sum() + np.log(values).sum())
        by_kernel = 0.5 * ((vectors * np.sum(1 / values, axis=1)) @ vectors.T)
        by_kernel -= 0.5 * (alpha / variances) @ alpha.T
        by_noise = 0.5 * (np.sum(1 / values, axis=0) - np.sum(alpha**2, axis=0) / variances)
        close = by_kernel * near
        both = 2 * np.sum(close - by_kernel * origin, axis=1) @ z**2 - 2 * np.sum(
            z * (close @ z), axis=0
        )
        return float(value), np.concatenate([both / self.lengths**2, noises * by_noise])
