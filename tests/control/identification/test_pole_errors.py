"""How far poles lie apart is what drawing the coefficients again gives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from sb3_yann.control.identification.dead_time import _chance
from sb3_yann.control.identification.least_squares import (
    Regression,
    pole_errors,
    pole_note,
    regress,
)
from sb3_yann.log import Episode

REAL = np.array([[0.9, 0.2], [0.0, 0.7]])
TURNING = np.array([[0.8, 0.3], [-0.3, 0.7]])


def fitted(A: np.ndarray, noise: float = 0.02, steps: int = 400, n_inputs: int = 1) -> Regression:
    """Return the fit of a plant whose last input has no effect if there are two."""
    rng = np.random.default_rng(0)
    n, u = len(A), rng.normal(size=(steps, n_inputs))
    x, mixed = np.zeros((steps + 1, n)), np.eye(n) + 0.5 * np.eye(n, k=1)
    for k in range(steps):
        x[k + 1] = A @ x[k] + u[k, 0] + noise * mixed @ rng.normal(size=n)
    return regress([Episode(x, u)], (n, n_inputs, 0), None, 0.0)


@pytest.mark.parametrize("A", [REAL, TURNING], ids=["real", "complex"])
def test_standard_errors_are_those_of_drawn_coefficients(A) -> None:
    found = fitted(A)
    poles, errors = pole_errors(found, 2)
    rng, size = np.random.default_rng(1), 1e-3  # so small that the first order is all there is
    left = np.linalg.cholesky(found.covariance)
    right = np.linalg.cholesky(found.correlation[:2, :2])
    moves = size * left @ rng.normal(size=(20_000, 2, 2)) @ right.T
    drawn = np.linalg.eigvals(found.coefficients[:, :2] + moves)
    nearest = np.abs(drawn[:, :, None] - poles).argmin(1)
    moved = np.take_along_axis(drawn, nearest, 1) - poles
    assert np.sqrt(np.mean(np.abs(moved) ** 2, 0)) / size == pytest.approx(errors, rel=0.03)


def test_a_single_pole_is_as_uncertain_as_its_coefficient() -> None:
    found = fitted(np.array([[0.8]]))
    poles, errors = pole_errors(found, 1)
    assert poles == pytest.approx(found.coefficients[0, :1])
    assert errors == pytest.approx(found.standard_errors[0, :1])


def test_the_note_has_one_pole_of_a_pair_and_95_percent() -> None:
    found = fitted(TURNING)
    poles, errors = pole_errors(found, 2)
    expected = f"{poles[0].real:.4g} ± {abs(poles[0].imag):.4g}i within {1.96 * errors[0]:.2g}."
    assert pole_note(found, 2) == f"Poles with 95 % confidence, under process noise: {expected}"


def test_a_pole_that_may_lie_outside_the_circle_is_counted_and_a_wide_one_is_not_stated() -> None:
    note = pole_note(fitted(np.diag([0.995, 0.5]), noise=0.3, steps=40), 2)
    assert " 1 that decay in the model may be unstable in the plant" in note
    assert "hardly known" in pole_note(fitted(np.array([[0.3]]), noise=5.0, steps=12), 1)


def test_the_chance_of_no_effect_is_that_of_the_t_test_where_there_is_one_state() -> None:
    found = fitted(np.array([[0.8]]), noise=0.3, n_inputs=2, steps=60)
    t = found.coefficients[0, 2] / found.standard_errors[0, 2]
    expected = 2 * stats.t.sf(abs(t), found.degrees_of_freedom)
    assert _chance(found, 1, 2) == pytest.approx(expected, rel=1e-6)


def test_the_chance_of_no_effect_is_spread_evenly_where_there_is_none() -> None:
    rng, chances = np.random.default_rng(2), []
    for _ in range(300):
        log = Episode(rng.normal(size=(13, 2)), rng.normal(size=(12, 2)))
        found = regress([log], (2, 2, 0), None, 0.0)
        chances.append(_chance(found, 2, 3))
    assert stats.kstest(chances, "uniform").pvalue > 0.01
