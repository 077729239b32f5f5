"""Residuals: what they fit exactly, how they are shrunk, and their derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann.twin.residuals import Monomials, Polynomial, Regressor


def data(n: int = 400, k: int = 3):
    z = np.random.default_rng(0).uniform(-1, 1, (n, k))
    return z, np.column_stack([z[:, 0] * z[:, 1], z[:, 2] ** 3 - z[:, 0]])


def differences(residual, z, step: float = 1e-6):
    moves = step * np.eye(z.shape[1])
    return np.stack(
        [(residual.predict(z + e) - residual.predict(z - e)) / (2 * step) for e in moves], -1
    )


def test_a_polynomial_is_found_exactly() -> None:
    z, y = data()
    fitted = Polynomial(3, 1e-12).fit(z, y)
    np.testing.assert_allclose(fitted.predict(z), y, atol=1e-6)
    assert np.all(fitted.predict(np.zeros((1, 3))) == 0)  # the equilibrium stays where it is


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
@pytest.mark.parametrize("offset", [False, True])
def test_derivatives_are_those_of_differences(degree, offset) -> None:
    z, y = data()
    fitted = Polynomial(degree, 1e-3, offset).fit(z, y)
    np.testing.assert_allclose(fitted.jacobian(z[:9]), differences(fitted, z[:9]), atol=1e-8)


def test_shrinkage_leads_to_the_linear_model_and_that_of_inputs_alone_does_too() -> None:
    z, y = data()
    sizes = [np.abs(Polynomial(2, each).fit(z, y).predict(z)).max() for each in (1e-6, 1, 1e6)]
    assert sizes[0] > 2 * sizes[1] > 100 * sizes[2]
    shrunk = Polynomial(3, 1e-9, inputs=(1, 1e12)).fit(z, y)
    changed = z.copy()
    changed[:, 2] = 0.7
    np.testing.assert_allclose(shrunk.predict(z), shrunk.predict(changed), atol=1e-2)


def test_monomials_are_counted_and_known_by_their_variables() -> None:
    monomials = Monomials(4, 3)
    assert monomials.values(np.ones((2, 4))).shape == (2, 4 + 10 + 20)
    held = monomials.holding(3)
    z = np.array([[2.0, 3.0, 5.0, 0.0]])
    np.testing.assert_array_equal(monomials.values(z)[0] == 0, held)


class Least:
    """Least squares, as scikit-learn would offer it."""

    def fit(self, z, y):
        self.weights = np.linalg.lstsq(z, y, rcond=None)[0]

    def predict(self, z):
        return z @ self.weights


def test_anything_with_fit_and_predict_will_do() -> None:
    z, y = data()
    fitted, linear = Regressor(Least).fit(z, y), Polynomial(1, 1e-12).fit(z, y)
    np.testing.assert_allclose(fitted.predict(z), linear.predict(z), atol=1e-6)
    np.testing.assert_allclose(fitted.jacobian(z[:5]), linear.jacobian(z[:5]), atol=1e-6)
