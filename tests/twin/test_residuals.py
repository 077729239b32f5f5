"""Residuals: what they say, one by one and as a stack, and their derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann.twin.residuals import Residual

K, N = 3, 2


def network(seed: int, hidden: int) -> Residual:
    rng = np.random.default_rng(seed)
    Q = rng.normal(size=(K, K, N))
    Q = (Q + np.swapaxes(Q, 0, 1)).reshape(K, K * N)
    shapes = (K, hidden), (1, hidden), (hidden, hidden), (1, hidden), (hidden, N), (1, N), (K, N)
    return Residual([*(rng.normal(size=each) for each in shapes), Q])


@pytest.mark.parametrize("hidden", [0, 4])
def test_it_is_the_sum_of_a_network_and_a_polynomial(hidden: int) -> None:
    found, z = network(1, hidden), np.random.default_rng(0).uniform(-1, 1, (9, K))
    W1, b1, W2, b2, W3, b3, L, Q = found.weights
    expected = np.tanh(np.tanh(z @ W1 + b1) @ W2 + b2) @ W3 + b3 + z @ L
    expected += np.einsum("bi,ijn,bj->bn", z, Q.reshape(K, K, N), z)
    np.testing.assert_allclose(found.predict(z), expected, rtol=1e-12)
    moves = 1e-6 * np.eye(K)
    slopes = [(found.predict(z + e) - found.predict(z - e)) / 2e-6 for e in moves]
    np.testing.assert_allclose(found.jacobian(z), np.stack(slopes, -1), atol=1e-8)


@pytest.mark.parametrize("hidden", [0, 4])
def test_a_stack_says_what_each_of_them_says(hidden: int) -> None:
    members, z = [network(seed, hidden) for seed in range(2)], np.ones((2, 5, K))
    z[1] *= 0.3
    for method in ("predict", "jacobian"):
        expected = [getattr(each, method)(rows) for each, rows in zip(members, z, strict=True)]
        np.testing.assert_allclose(getattr(Residual.stack(members), method)(z), expected)


def test_none_is_zero_and_a_polynomial_without_a_constant_is_so_at_rest() -> None:
    nothing, z = Residual.zero(K, N), np.ones((2, 4, K))
    assert not nothing.predict(z).any() and not nothing.jacobian(z).any()
    assert nothing.jacobian(z).shape == (2, 4, N, K)
    straight = Residual.polynomial(np.ones((K, N)))
    assert not straight.predict(0 * z).any() and straight.is_polynomial
