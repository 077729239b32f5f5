"""Which residual is chosen: candidates, what they are fitted to, and their free runs."""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
import pytest

from general_problems import solved
from sb3_yann.twin.dynamics import Coordinates
from sb3_yann.twin.log import Episode
from sb3_yann.twin.selection import (
    FreeRuns,
    Setting,
    candidates,
    held_out,
    ridge,
)
from twin_samples import random_episode as episode


@pytest.mark.parametrize("name", ["regulator with rates", "servo with all of it"])
@pytest.mark.parametrize("degree", [1, 2])
def test_weights_are_those_of_a_ridge_regression_on_what_the_model_leaves(name, degree) -> None:
    mpc = solved(name)
    log = [episode(mpc, seed=seed) for seed in range(4)]
    box = Coordinates.of(mpc, log[1:])  # the first one lies outside of it in part
    (found,) = ridge(box, log, [Setting(degree, 1e-3, 30.0)])
    z, y = (np.concatenate(each) for each in zip(*map(box.regression, log), strict=True))
    k = z.shape[1]
    constant = mpc.layout.has_constants
    powers = [p for d in range(1, degree + 1) for p in combinations_with_replacement(range(k), d)]
    F = np.column_stack([np.prod(z[:, p], axis=1) for p in map(list, powers)])
    weight = np.array([1e-3 * (30 if k - 1 in p else 1) for p in powers])
    if constant:
        F = np.column_stack([F, np.ones(len(F))])
        weight = np.append(weight, 0.0)
    solution = np.linalg.solve(F.T @ F + len(F) * np.diag(weight), F.T @ y)
    np.testing.assert_allclose(found.predict(z), F @ solution, rtol=1e-4, atol=1e-8)
    at_rest = found.predict(np.zeros((1, k)))
    np.testing.assert_allclose(at_rest, solution[-1:] if constant else 0.0, atol=1e-7)


def runs(*scores: list[float]) -> FreeRuns:
    """Return free runs with these scores of each candidate, by episode."""
    return FreeRuns(np.array([5]), np.exp(np.array(scores))[:, :, None])


def test_the_first_is_taken_of_what_is_one_standard_error_from_the_best() -> None:
    behind = np.array([0.1, 0.2, 0.3, 0.0])
    error = behind.std(ddof=1) / 2  # of four episodes
    best = np.array([0.0, -3.0, 2.0, 1.0])
    for mean, chosen in ((0.99 * error, 1), (1.01 * error, 2)):
        near = best + behind - behind.mean() + mean
        assert runs([9.0] * 4, [*near], [*best]).choose() == chosen
    assert runs([1.0, 2.0], [1.0, 2.0]).choose() == 0
    assert runs([0.0, 0.0], [2.0, 2.0], [1.0, 1.0]).choose(1) == 2


def test_a_free_run_s_error_is_that_of_the_model_from_twenty_logged_states() -> None:
    mpc = solved("servo with a disturbance")
    log = [episode(mpc, 45, seed) for seed in range(2)]
    log.append(episode(mpc, 9, 3))  # too short for most horizons
    box = Coordinates.of(mpc, log)
    found = held_out(box, log, candidates(box, log, []))
    assert found.horizons.tolist() == [5, 7, 12, 18, 28, 45]
    A = mpc.model.A
    B = mpc.model.B
    E = mpc.model.E
    for i, each in enumerate(log):
        horizons = [h for h in found.horizons if h <= len(each)]
        last = len(each) - horizons[-1]
        squares = np.zeros((0, len(horizons), 2))
        for start in np.unique(np.linspace(0, last, 20).astype(int)):
            x = each.thetas[start, :2]
            path = []
            for k in range(horizons[-1]):
                d = each.thetas[start + k, 3:4]
                u = each.actions[start + k]
                x = A @ x + B @ u + E @ d
                path.append(((x - each.thetas[start + k + 1, :2]) / box.units) ** 2)
            squares = np.append(squares, [np.array(path)[np.array(horizons) - 1]], axis=0)
        expected = np.sqrt(squares.mean(axis=(0, 2)))
        np.testing.assert_allclose(found.by_episode[0, i, : len(horizons)], expected)
        assert np.isnan(found.by_episode[0, i, len(horizons) :]).all()


def test_a_true_model_is_kept_and_a_single_piece_is_compared_with_nothing() -> None:
    mpc = solved("servo")
    thetas, inputs = zip(*(mpc.simulate([x, -1.0, 0.5], 12) for x in (2.0, 1.0, -2.0)), strict=True)
    log = [*map(Episode, thetas, inputs)]
    box = Coordinates.of(mpc, log)
    some = candidates(box, log, ["linear"])
    runs_of = held_out(box, log, some)
    assert runs_of.choose() == 0 and runs_of.choose(1) >= 1
    assert np.isinf(held_out(box, log[:1], some).errors).all()
