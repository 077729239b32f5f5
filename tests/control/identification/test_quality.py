"""The notes on a fit: each number against its definition, and the edges where a note begins."""

from __future__ import annotations

import dataclasses
from itertools import product

import numpy as np
import pytest
from scipy import stats

from sb3_yann.control.identification.least_squares import Regression, regress
from sb3_yann.control.identification.residuals import (
    curvature_test,
    features,
    listed,
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


def test_a_weak_log_and_a_ridge_are_reported() -> None:
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
