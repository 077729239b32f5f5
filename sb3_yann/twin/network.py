"""A small network as the residual."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

from sb3_yann._validation import Array

UNITS = 24
"""Of the one hidden layer."""


class Network:
    """One hidden layer of tanh units; the function is zero at zero, where the equilibrium is.

    It starts as zero. All weights are drawn towards zero, so towards the linear model. L-BFGS fits
    it to all rows at once.

    Parameters
    ----------
    rng : Generator
        Draws the weights that the fit starts from: another member starts elsewhere.
    decay : float
        Weight of the squared weights, beside the mean squared error in variances of the residual.
    offset : bool, default False
        Whether there is a constant term.
    """

    def __init__(self, rng: np.random.Generator, decay: float, offset: bool = False) -> None:
        self.rng, self.decay, self.offset = rng, decay, offset

    @classmethod
    def stack(cls, members: Sequence[Network]) -> Network:
        """Return fitted ones as one, from z (members, batch, k) to (members, batch, n)."""
        found = cls(members[0].rng, members[0].decay, members[0].offset)
        found.first = np.array([each.first for each in members])
        found.shift, found.constant = (
            np.array([getattr(each, name) for each in members])[:, None]
            for name in ("shift", "constant")
        )
        found.second = np.array([each.second for each in members])
        return found

    def fit(self, z: Array, y: Array) -> Network:
        """Fit to residuals y (N, n) at z (N, k)."""
        k, n = z.shape[1], y.shape[1]
        size = np.sqrt(np.mean(y**2, axis=0))
        start = np.zeros((k + 1 + n, UNITS))
        start[:k] = self.rng.standard_normal((k, UNITS)) / np.sqrt(k)
        start[k] = self.rng.uniform(-1, 1, UNITS)
        flat = np.concatenate([start.ravel(), np.zeros(n)])
        scaled = y / np.where(size > 0, size, 1.0)
        found = minimize(
            self._loss, flat, (z, scaled), "L-BFGS-B", jac=True, options={"maxiter": 200}
        ).x
        self.first, self.shift, second, self.constant = self._parts(found, k, n)
        self.second, self.constant = second.T * size, self.constant * size
        return self

    def predict(self, z: Array) -> Array:
        """Return the residual (batch, n)."""
        hidden = np.tanh(z @ self.first + self.shift) - np.tanh(self.shift)
        return np.asarray(hidden @ self.second + self.constant)

    def jacobian(self, z: Array) -> Array:
        """Return its derivatives (batch, n, k)."""
        slopes = 1 - np.tanh(z @ self.first + self.shift) ** 2
        carried = self.second[..., :, :, None] * np.swapaxes(self.first, -1, -2)[..., :, None, :]
        flat = carried.reshape(*carried.shape[:-2], -1)
        return np.asarray((slopes @ flat).reshape(*slopes.shape[:-1], *carried.shape[-2:]))

    @staticmethod
    def _parts(flat: Array, k: int, n: int) -> tuple[Array, Array, Array, Array]:
        """Return weights (k, h), shifts (h,), weights (n, h) and the constant (n,)."""
        block = flat[: (k + 1 + n) * UNITS].reshape(k + 1 + n, UNITS)
        return block[:k], block[k], block[k + 1 :], flat[(k + 1 + n) * UNITS :]

    def _loss(self, flat: Array, z: Array, y: Array) -> tuple[float, Array]:
        """Return the mean squared error with the decay, and its slope."""
        k, n = z.shape[1], y.shape[1]
        first, shift, second, constant = self._parts(flat, k, n)
        at_zero, hidden = np.tanh(shift), np.tanh(z @ first + shift)
        error = (hidden - at_zero) @ second.T + constant - y
        value = np.sum(error**2) / len(z) + self.decay * (np.sum(first**2) + np.sum(second**2))
        upstream = 2 * error / len(z)
        by_hidden = upstream @ second
        by_sum = by_hidden * (1 - hidden**2)
        slope = np.concatenate(
            [
                z.T @ by_sum + 2 * self.decay * first,
                (by_sum.sum(axis=0) - by_hidden.sum(axis=0) * (1 - at_zero**2))[None],
                upstream.T @ (hidden - at_zero) + 2 * self.decay * second,
            ]
        )
        by_constant = upstream.sum(axis=0) * self.offset
        return float(value), np.concatenate([slope.ravel(), by_constant])
