"""Where a fitted plant rests: solved where the data tell it, and nowhere else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sb3_yann.control.identification.fit import _system
from sb3_yann.control.identification.least_squares import Regression, operating_point

A = np.array([[0.8, 0.1], [0.0, 0.6]])
B = np.array([[0.2, 0.0], [0.1, 0.4]])
E = np.array([[0.3], [0.1]])
SIZES = (2, 2, 1)
CENTER = np.array([5.0, -3.0, 1.0, 2.0, 0.5])


def found(drift: Any = (0.01, -0.02), **changes: Any) -> Regression:
    """Return a fit whose plant moves by the drift at the mean of the data."""
    given: dict[str, Any] = {
        "coefficients": np.hstack([A, B, E]),
        "standard_errors": np.full((2, 5), 1e-3),
        "center": CENTER,
        "reached": CENTER[:2] + np.array(drift),
        "spread": np.array([0.5, 2.0, 0.1, 1.0, 0.3]),
        "factors": np.ones(5),
        "correlation": np.eye(5),
        "covariance": 1e-6 * np.eye(2),
        "autocorrelation": np.zeros(2),
        "degrees_of_freedom": 95,
        "steps": 100,
        "excitation": 0.5,
        "weakest": "u[0]",
    }
    return Regression(**(given | changes))


def moved(fit: Regression, point: np.ndarray) -> np.ndarray:
    """Return by how much the plant moves at a point."""
    return fit.predict(point[None])[0] - point[: len(fit.reached)]


def test_a_state_that_is_not_given_is_the_steady_state_of_inputs_and_disturbances() -> None:
    fit = found()
    point = operating_point(fit, SIZES, (None, None, None))
    np.testing.assert_array_equal(point[2:], CENTER[2:])
    np.testing.assert_allclose(moved(fit, point), 0, atol=1e-12)
    u, d = np.array([1.1, 1.8]), np.array([0.6])
    point = operating_point(fit, SIZES, (None, u, d))
    np.testing.assert_array_equal(point[2:], [1.1, 1.8, 0.6])
    np.testing.assert_allclose(moved(fit, point), 0, atol=1e-12)
    assert np.ptp(point[:2] - CENTER[:2]) > 0


def test_inputs_that_are_not_given_hold_a_given_state() -> None:
    fit, x = found(), np.array([5.1, -2.9])
    point = operating_point(fit, SIZES, (x, None, None))
    np.testing.assert_array_equal(point[:2], x)
    assert point[4] == CENTER[4]
    np.testing.assert_allclose(moved(fit, point), 0, atol=1e-12)


def test_where_state_and_inputs_are_given_nothing_is_solved() -> None:
    x, u = np.array([5.1, -2.9]), np.array([1.1, 1.8])
    point = operating_point(found(), SIZES, (x, u, None))
    np.testing.assert_array_equal(point, [*x, *u, CENTER[4]])


def test_an_integrator_keeps_its_mean_and_the_inputs_hold_it() -> None:
    turns = np.array([[1.0, 0.0], [0.0, 0.6]])
    fit = found(coefficients=np.hstack([turns, B, E]))
    point = operating_point(fit, SIZES, (None, None, None))
    assert point[0] == CENTER[0] and point[2] != CENTER[2]
    np.testing.assert_allclose(moved(fit, point), 0, atol=1e-12)
    # With the inputs given nothing can hold it.
    held = operating_point(fit, SIZES, (None, CENTER[2:4], None))
    assert held[0] == CENTER[0]
    np.testing.assert_allclose(moved(fit, held), [0.01, 0.0], atol=1e-12)


@pytest.mark.parametrize(("ratio", "known"), [(5.2, True), (4.8, False)])
def test_a_pole_five_standard_errors_from_one_does_not_integrate(ratio: float, known: bool) -> None:
    """Of one state and one input, so that the direction is the state's own."""
    fit = found(
        drift=(0.01,), center=np.zeros(2), reached=np.array([0.01]), spread=np.array([2.0, 3.0]),
        coefficients=np.array([[0.9, 0.5]]), standard_errors=np.array([[0.1 / ratio, 1e-3]]),
        covariance=np.eye(1),
    )  # fmt: skip
    x, u = operating_point(fit, (1, 1, 0), (None, None, np.zeros(0)))
    if known:
        assert (x, u) == (pytest.approx(0.1), 0.0)
    else:
        assert (x, u) == (0.0, pytest.approx(-0.02))
    (x, u) = operating_point(fit, (1, 1, 0), (None, np.zeros(1), np.zeros(0)))
    assert x == pytest.approx(0.1 if known else 0.0) and u == 0.0


@pytest.mark.parametrize(("spreads", "taken"), [(4.9, True), (5.1, False)])
def test_a_steady_state_more_than_five_spreads_away_is_not_taken(
    spreads: float, taken: bool
) -> None:
    fit = found(drift=(0.0, 0.0))
    left, sizes, right = np.linalg.svd((A - np.eye(2)) * [0.5, 2.0] / np.array([[0.5], [2.0]]))
    # Along the second direction only.
    drift = -spreads * sizes[1] * left[:, 1] * [0.5, 2.0]
    fit = found(drift=drift)
    point = operating_point(fit, SIZES, (None, CENTER[2:4], None))
    expected = CENTER[:2] + taken * spreads * right[1] * [0.5, 2.0]
    np.testing.assert_allclose(point[:2], expected, atol=1e-9)


def test_a_drift_of_three_standard_errors_is_told_and_kept() -> None:
    """The plant's next state is uncertain by its residuals and by its coefficients."""
    point = CENTER + np.array([0.1, 0.2, 0.3, -0.4, 0.5])
    zero = found(drift=(0.0, 0.0))
    away = (point - CENTER) ** 2
    doubt = np.sqrt(1e-6 / 100 + (1e-3) ** 2 * away.sum())
    rest = moved(zero, point)
    parts = np.split(point, [2, 4])
    for size, told in ((2.9, False), (3.1, True)):
        fit = found(drift=-rest + [0.0, size * doubt])
        system = _system(fit, SIZES, parts, 1.0, [0, 0])
        assert (system.drift is not None) == told
        assert any("moves by" in each for each in system.notes) == told
    np.testing.assert_allclose(system.drift, [0.0, 3.1 * doubt], atol=1e-12)
    np.testing.assert_array_equal(np.hstack([system.A, system.B, system.E]), np.hstack([A, B, E]))
    np.testing.assert_array_equal(np.concatenate([system.x_ss, system.u_ss, system.d_ss]), point)


@pytest.mark.parametrize(("spreads", "told"), [(4.9, False), (-4.9, False), (5.1, True)])
def test_a_point_more_than_five_spreads_away_is_extrapolated(spreads: float, told: bool) -> None:
    x = CENTER[:2] + np.array([0.0, spreads * 2.0])
    system = _system(found(), SIZES, (x, CENTER[2:4], CENTER[4:]), 1.0, [0, 0])
    assert any("x_ss[1] lies far outside the data" in each for each in system.notes) == told
