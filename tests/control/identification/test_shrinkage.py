"""The ridge of a weak log: free runs over what was held out choose it."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann.control.identification.least_squares import RIDGES, _free_run, regress, regularized
from sb3_yann.log import Episode
from sb3_yann.log import split_episodes as split

SIZES = (2, 1, 0)


def weak(noise: float = 0.02, steps: int = 150, seed: int = 0) -> Episode:
    """Return a log in which the second state all but follows the first."""
    rng = np.random.default_rng(seed)
    u, x = rng.uniform(-1, 1, (steps, 1)), np.zeros((steps + 1, 2))
    for k in range(steps):
        x[k + 1, 0] = 0.8 * x[k, 0] + u[k, 0]
        x[k + 1, 1] = x[k + 1, 0] + 0.001 * rng.standard_normal()
        x[k + 1] += noise * x[k + 1] ** 2
    return Episode(x, u)


def error(episode: Episode, fitted: list[Episode], ridge: float) -> float:
    """Free runs of fifty steps, in spreads of the states, a step's error a thousand at most."""
    found, squares = regress(fitted, SIZES, None, ridge), []
    for start in range(0, len(episode), 50):
        x = episode.states[start]
        for k in range(start, min(start + 50, len(episode))):
            x = found.predict(np.concatenate([x, episode.driven[k]])[None])[0]
            missed = np.abs(x - episode.states[k + 1]) / found.spread[:2]
            squares.append(np.minimum(missed, 1e3) ** 2)
    return float(np.sqrt(np.mean(squares)))


def test_the_ridge_of_the_best_free_runs_is_taken_and_told() -> None:
    fitted, tested = split([weak()], 0.4)
    found = regress(fitted, SIZES, None, 0.0)
    ridges = np.array([0.0, *RIDGES]) * found.steps
    errors = np.array([error(tested[0], fitted, ridge) for ridge in ridges])
    assert found.excitation < 0.01
    np.testing.assert_allclose(
        [_free_run(regress(fitted, SIZES, None, r), tested) for r in ridges], errors
    )
    best = int(np.argmin(errors))
    assert best > 0
    chosen, ridge, (note,) = regularized(found, fitted, tested, SIZES, None)
    assert ridge == pytest.approx(ridges[best])
    expected = regress(fitted, SIZES, None, ridge)
    np.testing.assert_array_equal(chosen.coefficients, expected.coefficients)
    said = f"miss by {errors[best]:.2g} spreads of the states, without it by {errors[0]:.2g}."
    assert said in note and f"A ridge of {ridge:.2g} was chosen" in note


def test_free_runs_as_blind_as_the_mean_refuse_the_log() -> None:
    fitted, (tested,) = split([weak()], 0.4)
    found = regress(fitted, SIZES, None, 0.0)
    other = Episode(np.random.default_rng(0).standard_normal(tested.states.shape), tested.driven)
    with pytest.raises(ValueError, match=r"with any ridge free runs .* miss by .* spreads"):
        regularized(found, fitted, [other], SIZES, None)
    assert _free_run(found, []) == 0.0
