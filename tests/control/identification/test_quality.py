"""Curvature is named from its definition's edges on, and is not taken for noise."""

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
    driven = rng.uniform(-1, 1, (steps, 2))
    x = np.zeros((steps + 1, 2))
    for k in range(steps):
        u, d = driven[k]
        x[k + 1] = [0.8 * x[k, 0] + u, 0.5 * x[k, 1] + 0.3 * x[k, 0] + d + curved * u * d]
        x[k + 1] += noise * rng.standard_normal(2)
    return Episode(x, driven)


SIZES = (2, 1, 1)


def fit(episode: Episode) -> Regression:
    return regress([episode], SIZES, None, 0.0)


def explained(found: Regression, episodes: list[Episode]) -> tuple[np.ndarray, ...]:
    """Return the adjusted share that features explain, its chance, and what is left."""
    Z = np.vstack([each.regressors for each in episodes]) - found.center
    left = np.vstack([each.states[1:] for each in episodes]) - found.predict(Z + found.center)
    plain = np.hstack([np.ones((len(Z), 1)), Z])
    whole = np.hstack([plain, features(Z)])
    before, rest = (
        left - basis @ np.linalg.lstsq(basis, left, rcond=None)[0] for basis in (plain, whole)
    )
    free = len(Z) - whole.shape[1]
    q = whole.shape[1] - plain.shape[1]
    size = (before**2).sum(axis=0)
    remains = (rest**2).sum(axis=0)
    share = 1 - remains / free / (size / (free + q))
    return share, stats.f.sf((size - remains) / q / (remains / free), q, free), rest


def test_curvature_is_named_from_a_tenth_on_and_where_chance_does_not_explain_it() -> None:
    seen = set()
    for steps, curved, seed in product((50, 150, 900), (0.06, 0.1, 0.15), range(4)):
        episode = log(steps, curved, seed=seed)
        found = fit(episode)
        expected, chance, _ = explained(found, [episode])
        sure = chance[1] < 1e-3
        much = expected[1] > 0.1
        seen.add((bool(sure), bool(much)))
        named = curvature_test(found, [episode])[0][1]
        assert named == pytest.approx(expected[1] if sure and much else 0.0)
    assert len(seen) == 4


def test_what_curvature_explains_is_no_noise() -> None:
    colour = np.array([0.0, 0.3])
    for curved, noisy in ((0.0, True), (0.25, False), (1.0, False)):
        episode = log(curved=curved)
        found = dataclasses.replace(fit(episode), autocorrelation=colour)
        text = "\n".join(quality_notes(found, [episode], [], (colour, colour), 0.0))
        assert ("are correlated" in text) == noisy
        share = curvature_test(fit(episode), [episode])[0]
        percent = f"explain {listed(100 * share)} % of the residuals' variance"
        assert (percent in text) == (curved > 0)
    assert share[1] > 0.5 > curvature_test(fit(log(curved=0.25)), [log(curved=0.25)])[0][1] > 0.1
