"""What a plant does beyond its linear model, as a function of states, disturbances and inputs.

A residual is asked in scaled coordinates: see :class:`~sb3_yann.twin.dynamics.Coordinates`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_yann._validation import Array


class Residual:
    """``y = tanh(tanh(z W1 + b1) W2 + b2) W3 + b3 + z L + z' Q z``.

    Without hidden units it is a polynomial, and without L, Q and b3 the linear model as it is.

    Parameters
    ----------
    weights : sequence of ndarray
        W1 (k, h), b1 (1, h), W2 (h, h), b2 (1, h), W3 (h, n), b3 (1, n), L (k, n) and Q (k, k n),
        which is symmetric for each of the n. Those of several
        residuals have an axis of the members before all else.
    """

    def __init__(self, weights: Sequence[Array]) -> None:
        self.weights = tuple(weights)
        self.is_polynomial = self.weights[0].shape[-1] == 0
        self._is_linear = not np.any(self.weights[7])

    @classmethod
    def polynomial(cls, L: Array, b: Array | None = None, Q: Array | None = None) -> Residual:
        """Return ``z L + b + z' Q z`` for L (k, n), b (n,) and a symmetric Q (k, k, n)."""
        k, n = L.shape
        hidden = np.zeros((k, 0)), np.zeros((1, 0)), np.zeros((0, 0)), np.zeros((1, 0))
        constant = np.zeros(n) if b is None else b
        quadratic = np.zeros((k, k, n)) if Q is None else Q
        return cls([*hidden, np.zeros((0, n)), constant[None], L, quadratic.reshape(k, k * n)])

    @classmethod
    def zero(cls, k: int, n: int) -> Residual:
        """Return zeros (n,) for k features."""
        return cls.polynomial(np.zeros((k, n)))

    @classmethod
    def stack(cls, members: Sequence[Residual]) -> Residual:
        """Return several as one, from z (members, batch, k) to (members, batch, n)."""
        return cls([np.array(each) for each in zip(*(m.weights for m in members), strict=True)])

    def _hidden(self, z: Array) -> tuple[Array, Array]:
        W1, b1, W2, b2 = self.weights[:4]
        first = np.tanh(z @ W1 + b1)
        return first, np.tanh(first @ W2 + b2)

    def _bent(self, z: Array) -> Array:
        """Return ``Q z``, (..., batch, k, n)."""
        found = z @ self.weights[7]
        return np.asarray(found.reshape(*found.shape[:-1], z.shape[-1], -1))

    def predict(self, z: Array) -> Array:
        """Return the residual (..., batch, n) at z (..., batch, k)."""
        W3, b3, L = self.weights[4:7]
        found = z @ L + b3
        if not self._is_linear:
            found = found + np.sum(z[..., None] * self._bent(z), axis=-2)
        if not self.is_polynomial:
            found = found + self._hidden(z)[1] @ W3
        return np.asarray(found)

    def jacobian(self, z: Array) -> Array:
        """Return its derivatives (..., batch, n, k)."""
        W1, _, W2, _, W3, _, L, _ = (np.swapaxes(each, -1, -2) for each in self.weights)
        batch = np.broadcast_shapes(z.shape[:-1], (*L.shape[:-2], 1))
        found = np.broadcast_to(L[..., None, :, :], (*batch, *L.shape[-2:]))
        if not self._is_linear:
            found = found + 2 * np.swapaxes(self._bent(z), -1, -2)
        if self.is_polynomial:
            return np.asarray(found)
        first, second = self._hidden(z)
        rows = W3[..., None, :, :] * (1 - second**2)[..., None, :]  # (..., batch, n, h)
        flat = rows.reshape(*rows.shape[:-3], -1, rows.shape[-1]) @ W2
        rows = flat.reshape(rows.shape) * (1 - first**2)[..., None, :]
        flat = rows.reshape(*rows.shape[:-3], -1, rows.shape[-1]) @ W1
        return np.asarray(flat.reshape(*rows.shape[:-1], -1) + found)
