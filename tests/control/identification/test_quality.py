"""The notes on a fit: each number against its definition, and the edges where a note begins."""

from __future__ import annotations

import dataclasses
from itertools import product

import numpy as np
import pytest
from scipy import stats

from sb3_yann.control.identification.least_squares import Regression, neighbors, regress
from sb3_yann.control.identification.residuals import (
    curvature_test,
    features,
    listed,
    project_out,
    quality_notes,
)
from sb3_yann.log import Episode


def log(steps: int = 300, curved: float = 0.0, noise: float = 0.1, seed: int = 0) -> Episode:
    """Return steps of a plant with two states, one input and one disturbance."""
    rng = np.random.default_rng(seed)
    driven, x = rng.uniform(-1, 1, (steps, 2)), np.zeros((steps + 1, 2))
    for k in range(steps):
        u, d = driven[k]
        x[k + 1] = [0.8 * x[k, 0] + u, 0.5 * x[k, 1] + 0.3 * x[k, 0] + d + curved * u * d]
        x[k + 1] += noise * rng.standard_normal(2)
    return Episode(x, driven)


SIZES = (2, 1, 1)


def fit(*episodes: Episode, ridge: float = 0.0, origin: np.ndarray | None = None) -> Regression:
    return regress([*episodes], SIZES, origin, ridge)


@pytest.mark.parametrize("passes", [False, True])
@pytest.mark.parametrize("ridge", [0.0, 30.0])
def test_a_regression_is_that_of_the_normal_equations(passes: bool, ridge: float) -> None:
    one, two = log(120), log(80, seed=1)
    origin = np.array([0.1, -0.2, 0.05, 0.3]) if passes else None
    found = fit(one, two, ridge=ridge, origin=origin)
    Z, Y = np.vstack([one.regressors, two.regressors]), np.vstack([one.states[1:], two.states[1:]])
    center = Z.mean(axis=0) if origin is None else origin
    reached = Y.mean(axis=0) if origin is None else origin[:2]
    spread = np.sqrt(np.mean((Z - center) ** 2, axis=0))
    S = (Z - center) / spread
    inverse = np.linalg.solve(S.T @ S + ridge * np.eye(4), S.T)
    np.testing.assert_allclose(found.coefficients, (inverse @ (Y - reached)).T / spread)
    np.testing.assert_allclose(found.center, center)
    np.testing.assert_allclose(found.reached, reached)
    np.testing.assert_allclose(found.spread, spread)
    left = Y - reached - (Z - center) @ found.coefficients.T
    freedom = 200 - (4 if passes else 5)
    assert (found.steps, found.degrees_of_freedom) == (200, freedom)
    np.testing.assert_allclose(found.covariance, left.T @ left / freedom)
    unscaled = inverse / spread[:, None]
    np.testing.assert_allclose(found.correlation, unscaled @ unscaled.T)
    errors = np.sqrt(np.outer(np.diag(found.covariance), np.diag(unscaled @ unscaled.T)))
    np.testing.assert_allclose(found.standard_errors, errors)
    sizes = np.linalg.svd(S, compute_uv=False)
    assert found.excitation == pytest.approx(sizes[-1] / sizes[0])
    pairs = sum(np.sum(each[1:] * each[:-1], axis=0) for each in (left[:120], left[120:]))
    np.testing.assert_allclose(found.autocorrelation, pairs / np.sum(left**2, axis=0))
    np.testing.assert_allclose(neighbors(left, [one, two]), found.autocorrelation)
    np.testing.assert_allclose(found.predict(Z), Y - left)


def test_as_many_steps_as_unknowns_are_too_few_and_one_more_is_enough() -> None:
    assert fit(log(6)).degrees_of_freedom == 1
    for episode, origin, unknowns in ((log(5), None, 5), (log(4), np.zeros(4), 4)):
        with pytest.raises(ValueError, match=f"{unknowns} steps to fit {unknowns} parameters"):
            fit(episode, origin=origin)
    assert fit(log(5), origin=np.zeros(4)).degrees_of_freedom == 1


def explained(found: Regression, episodes: list[Episode]) -> tuple[np.ndarray, ...]:
    """Return the adjusted share that features explain, its chance, and what is left."""
    Z = np.vstack([each.regressors for each in episodes]) - found.center
    left = np.vstack([each.states[1:] for each in episodes]) - found.predict(Z + found.center)
    plain = np.hstack([np.ones((len(Z), 1)), Z])
    whole = np.hstack([plain, features(Z)])
    before, rest = (
        left - basis @ np.linalg.lstsq(basis, left, rcond=None)[0] for basis in (plain, whole)
    )
    free, q = len(Z) - whole.shape[1], whole.shape[1] - plain.shape[1]
    size, remains = (before**2).sum(axis=0), (rest**2).sum(axis=0)
    share = 1 - remains / free / (size / (free + q))
    return share, stats.f.sf((size - remains) / q / (remains / free), q, free), rest


def test_what_curvature_explains_is_the_adjusted_share_of_an_f_test() -> None:
    logs = [log(160, curved=0.5), log(140, curved=0.5, seed=1)]
    share, after = curvature_test(fit(*logs), logs)
    expected, chance, rest = explained(fit(*logs), logs)
    np.testing.assert_allclose(after, rest, atol=1e-10)
    assert share[1] == pytest.approx(expected[1]) and expected[1] > 0.5
    assert share[0] == 0 and chance[0] > 1e-3


def test_curvature_is_named_from_a_tenth_on_and_where_chance_does_not_explain_it() -> None:
    seen = set()
    for steps, curved, seed in product((50, 150, 900), (0.06, 0.1, 0.15), range(4)):
        episode = log(steps, curved, seed=seed)
        found = fit(episode)
        expected, chance, _ = explained(found, [episode])
        sure, much = chance[1] < 1e-3, expected[1] > 0.1
        seen.add((bool(sure), bool(much)))
        named = curvature_test(found, [episode])[0][1]
        assert named == pytest.approx(expected[1] if sure and much else 0.0)
    assert len(seen) == 4


def test_squares_and_products_are_of_as_many_components_as_the_steps_allow() -> None:
    rng = np.random.default_rng(0)
    for steps, kept in ((12, 0), (23, 0), (24, 1), (35, 1), (36, 2), (51, 2), (52, 3), (300, 3)):
        found = features(rng.standard_normal((steps, 3)))
        assert found.shape == (steps, kept * (kept + 1) // 2 + kept)
    z = rng.standard_normal((400, 2)) * [3.0, 0.1]
    z -= z.mean(axis=0)
    found = features(np.column_stack([z, z[:, 0] + 10 * z[:, 1]]))  # two components in three
    assert found.shape == (400, 5)
    U = np.linalg.svd(
        np.column_stack([z, z[:, 0] + 10 * z[:, 1]])
        / np.sqrt(np.mean(np.column_stack([z, z[:, 0] + 10 * z[:, 1]]) ** 2, axis=0)),
        full_matrices=False,
    )[0][:, :2] * 20  # fmt: skip
    expected = [U[:, 0] ** 2, U[:, 0] * U[:, 1], U[:, 1] ** 2, U[:, 0] ** 3, U[:, 1] ** 3]
    np.testing.assert_allclose(np.abs(found), np.abs(np.column_stack(expected)), atol=1e-9)
    assert features(rng.standard_normal((2000, 15))).shape[1] == 12 * 13 // 2 + 12


def test_without_a_basis_nothing_of_it_is_left() -> None:
    rng = np.random.default_rng(0)
    basis, values = rng.standard_normal((50, 3)), rng.standard_normal((50, 2))
    same = np.column_stack([1e6 * basis[:, 0], basis[:, 1:], basis[:, 0] + basis[:, 1], 0 * values])
    expected = values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
    np.testing.assert_allclose(project_out(same, values), expected, atol=1e-12)


def told(found: Regression, episode: Episode, tested: int = 40, **changes: object) -> str:
    """Return the notes on a fit of which nothing is to be said, but for the changes."""
    sound = {
        "autocorrelation": np.zeros(2), "excitation": 0.5, "weakest": "u[0]",
    }  # fmt: skip
    fits = changes.pop("fits", (np.array([99.0, 98.0]), np.array([90.0, 80.0])))
    ridge = changes.pop("ridge", 0.0)
    held = [Episode(np.zeros((tested + 1, 2)), np.zeros((tested, 2)))] if tested else []
    given = dataclasses.replace(found, **(sound | changes))
    return "\n".join(quality_notes(given, [episode], held, fits, ridge))


def test_the_size_of_the_residuals_and_the_fits_are_stated() -> None:
    episode = log()
    found = fit(episode)
    text = told(found, episode)
    size = listed(np.sqrt(np.diag(found.covariance)))
    assert f"Fitted to 300 steps; one step differs from the prediction by {size} (st" in text
    ahead = "99, 98 % one step ahead, 90, 80 % 10 steps ahead."
    assert f"Fit over 40 steps held out, 100 % is perfect: {ahead}" in text
    assert text.count("\n") == 2  # these, and the poles
    assert "held out" not in told(found, episode, tested=0)


def test_a_fit_below_fifty_per_cent_is_poor() -> None:
    episode = log()
    found = fit(episode)
    for ten, poor in ((50.1, False), (49.9, True)):
        text = told(found, episode, fits=(np.array([10.0, 10.0]), np.array([99.0, ten])))
        assert ("Poor: 10 steps ahead" in text) == poor
    none = np.full(2, np.nan)
    text = told(found, episode, fits=(np.array([99.0, 98.0]), none))
    assert "99, 98 % one step ahead. No episode of them is 10 steps long." in text
    assert "The 40 steps held out tell no fit" in told(found, episode, fits=(none, none))


def test_a_weak_log_and_a_ridge_are_told() -> None:
    episode = log()
    found = fit(episode)
    for excitation, weak in ((0.0101, False), (0.0099, True)):
        text = told(found, episode, excitation=excitation)
        assert ("Weakly excited: u[0] moved 9.9e-03 times as much" in text) == weak
    assert "A ridge of 0.5 biases the entries towards zero." in told(found, episode, ridge=0.5)
    assert "ridge" not in told(found, episode)


def test_neighbors_are_correlated_from_three_standard_errors_on() -> None:
    episode = log()
    found = fit(episode)
    edge = 3 / np.sqrt(300)
    for own, noisy in ((0.99, False), (1.01, True), (-1.01, True)):
        text = told(found, episode, autocorrelation=np.array([0.0, own * edge]))
        assert ("of neighboring steps are correlated" in text) == noisy
    assert f"({listed(np.array([0.0, -1.01 * edge]))})" in text


def test_what_curvature_explains_is_no_noise() -> None:
    colour = np.array([0.0, 0.3])
    for curved, noisy in ((0.0, True), (0.25, False), (1.0, False)):
        episode = log(curved=curved)
        text = told(fit(episode), episode, autocorrelation=colour)
        assert ("are correlated" in text) == noisy
        share = curvature_test(fit(episode), [episode])[0]
        percent = f"explain {listed(100 * share)} % of the residuals' variance"
        assert (percent in text) == (curved > 0)
    assert share[1] > 0.5 > curvature_test(fit(log(curved=0.25)), [log(curved=0.25)])[0][1] > 0.1


def test_of_a_memory_of_inputs_nothing_is_told() -> None:
    episode = log()
    found = fit(episode)
    fits = np.array([99.0, 1.0]), np.array([90.0, 1.0])
    notes = quality_notes(found, [episode], [episode], fits, 0.0, 1)
    assert "99 % one step ahead, 90 % 10 steps ahead." in notes[1] and "Poor" not in notes[1]
    assert listed(np.sqrt(np.diag(found.covariance))[:1]) + " (standard" in notes[0]
