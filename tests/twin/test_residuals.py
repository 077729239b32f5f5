"""Residuals: what they fit exactly, how they are shrunk, and their derivatives."""

from __future__ import annotations

from itertools import combinations_with_replacement
from types import SimpleNamespace

import numpy as np
import pytest

from sb3_yann.twin.residuals import Monomials, Polynomial, Regressor, ZeroResidual, as_polynomials


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


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("offset", [False, True])
def test_the_weights_are_those_of_a_ridge_regression_on_all_monomials(degree, offset) -> None:
    z, y = data(200, 3)
    powers = [p for d in range(1, degree + 1) for p in combinations_with_replacement(range(3), d)]
    F = np.column_stack([np.prod(z[:, p], axis=1) for p in map(list, powers)])
    monomials = Monomials(3, degree)
    np.testing.assert_allclose(monomials.values(z), F)
    held = [max(p) >= 1 for p in powers]
    np.testing.assert_array_equal(monomials.holding(1), held)
    ridge = np.where(held, 0.02 * 30, 0.02)
    if offset:
        F, ridge = np.column_stack([F, np.ones(len(F))]), np.append(ridge, 0.0)
    matrix = F.T @ F + 200 * np.diag(ridge)
    expected = np.linalg.solve(matrix, F.T @ (y + offset))
    fitted = Polynomial(degree, 0.02, offset, (2, 30.0)).fit(z, y + offset)
    np.testing.assert_allclose(fitted.weights, expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("offset", [False, True])
def test_a_stack_of_polynomials_says_what_each_of_them_says(offset) -> None:
    z, y = data()
    members = [Polynomial(3, each, offset).fit(z, y + 0.1) for each in (1e-3, 1e-1)]
    stack, at = Polynomial.stack(members), np.array([z[:7], z[7:14]])
    assert (stack.degree, stack.shrinkage, stack.offset) == (3, 1e-3, offset)
    for method in ("predict", "jacobian"):
        expected = [getattr(each, method)(rows) for each, rows in zip(members, at, strict=True)]
        np.testing.assert_allclose(getattr(stack, method)(at), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
@pytest.mark.parametrize("offset", [False, True])
def test_the_arrays_for_compiled_code_are_the_polynomials(degree, offset) -> None:
    z, y = data()
    members = [Polynomial(degree, each, offset).fit(z, y + 0.1) for each in (1e-3, 1e-1)]
    parents, variables, weights = as_polynomials(members, 3)
    values = [*z[0]]
    for parent, variable in zip(parents, variables, strict=True):
        values.append(values[parent] * z[0, variable])
    values += [1.0] * offset
    expected = [each.predict(z[:1])[0] for each in members]
    np.testing.assert_allclose(np.array(values) @ weights, expected)


def test_nothing_is_a_polynomial_without_weights_and_a_regressor_is_none() -> None:
    parents, variables, weights = as_polynomials([ZeroResidual(2), ZeroResidual(2)], 3)
    assert len(parents) == len(variables) == 0
    np.testing.assert_array_equal(weights, np.zeros((2, 3, 2)))
    z, y = data()
    for mixed in ([Regressor(Least)], [Polynomial(1, 1.0).fit(z, y), Regressor(Least)]):
        assert as_polynomials(mixed, 3) is None
    nothing = ZeroResidual(2)
    assert nothing.predict(z).shape == (400, 2) and nothing.jacobian(z).shape == (400, 2, 3)


def test_a_regressor_s_derivatives_are_central_differences() -> None:
    class Square(Least):
        def predict(self, z):
            return np.column_stack([z[:, 0] * z[:, 1], z[:, 2] ** 3])

    z, y = data(9)
    found = Regressor(Square).fit(z, y).jacobian(z)
    expected = np.zeros((9, 2, 3))
    expected[:, 0, 0], expected[:, 0, 1], expected[:, 1, 2] = z[:, 1], z[:, 0], 3 * z[:, 2] ** 2
    np.testing.assert_allclose(found, expected, atol=2e-8)
    one = Regressor(lambda: SimpleNamespace(fit=lambda z, y: None, predict=lambda z: z[:, 0]))
    assert one.fit(z, y[:, :1]).predict(z).shape == (9, 1)  # a flat answer will do
