"""Which residual is chosen: candidates, what they are fitted to, and their free runs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from general_problems import solved
from sb3_yann.twin.dynamics import Coordinates
from sb3_yann.twin.log import Episode
from sb3_yann.twin.residuals import Monomials, Polynomial, ZeroResidual
from sb3_yann.twin.selection import (
    MORE_THAN_A_POLYNOMIAL,
    Candidate,
    FreeRuns,
    _alike,
    candidates,
    choose,
    fitted,
    held_out,
)
from twin_samples import problem
from twin_samples import random_episode as episode


@pytest.mark.parametrize(("kind", "degree"), [("linear", 1), ("quadratic", 2), ("cubic", 3)])
def test_polynomials_are_tried_with_each_shrinkage_and_that_of_inputs(kind, degree) -> None:
    found = candidates(problem(), [kind])
    expected = [(1e-6 * 10**i, factor) for i in range(7) for factor in (1.0, 30.0)]
    assert len(found) == len(expected)
    for each, (shrinkage, factor) in zip(found, expected, strict=True):
        made = each.make()
        assert made.degree == degree and made.shrinkage == pytest.approx(shrinkage)
        assert made.inputs == (1, factor) and made.offset is False
        freedom = degree - 2 * np.log10(shrinkage) - np.log10(factor)
        assert each.freedom == pytest.approx(freedom)
        ridge = f"{shrinkage:g} ({shrinkage * factor:g} of inputs)"
        assert each.name == f"{kind}, shrinkage {ridge}"


def test_where_theta_holds_set_points_a_residual_has_a_constant_term() -> None:
    mpc = solved("servo")
    kinds = ("linear", "cubic")
    made = [each.make() for each in candidates(mpc, kinds)]
    assert all(each.offset is True for each in made)
    plain = [each.make() for each in candidates(problem(), kinds)]
    assert not any(each.offset for each in plain)


def test_what_predicts_as_well_is_taken_in_the_order_of_its_freedom() -> None:
    class Own:
        """A regressor."""

    kinds = ["none", "cubic", Own]
    found = {each.name: each for each in candidates(problem(), kinds)}
    assert found["none"].freedom == -np.inf and found["Own"].freedom == np.inf
    cubic = [each.freedom for each in found.values() if each.name.startswith("cubic")]
    assert max(cubic) < MORE_THAN_A_POLYNOMIAL
    for wrong in ("cubic", []):
        with pytest.raises(ValueError, match="must be a list with at least one kind"):
            candidates(problem(), wrong)


def test_residuals_are_fitted_to_what_the_model_leaves_of_each_step() -> None:
    mpc = solved("servo with all of it")
    log = [episode(mpc, seed=seed) for seed in range(4)]
    box = Coordinates.of(mpc, log[1:])  # the first one lies outside of it in part
    made = [Polynomial(2, 1e-3), Polynomial(2, 1e-1), Polynomial(1, 1e-2, True), ZeroResidual(2)]
    z, y = [], []
    for each in log:
        theta, u = each.thetas[:-1], each.actions
        features = np.column_stack([theta[:, :2], theta[:, 3], u])
        z.append(np.clip(features, box.low, box.high) / box.scale)
        model = theta[:, :2] @ mpc.model.A.T + u @ mpc.model.B.T + theta[:, 3:4] @ mpc.model.E.T
        y.append(each.thetas[1:, :2] - model)
        for ours, expected in zip(box.regression(each), (z[-1], y[-1]), strict=True):
            np.testing.assert_allclose(ours, expected, atol=1e-12)
    found = fitted(mpc, box, log, made)
    assert found == made
    z_all, y_all = np.concatenate(z), np.concatenate(y)
    F = Monomials(4, 2).values(z_all)
    for residual, shrinkage in zip(found[:2], (1e-3, 1e-1), strict=True):
        matrix = F.T @ F + shrinkage * len(F) * np.eye(F.shape[1])
        np.testing.assert_allclose(
            residual.weights, np.linalg.solve(matrix, F.T @ y_all), rtol=1e-6
        )
    alone = Polynomial(1, 1e-2, True).fit(z_all, y_all)
    np.testing.assert_allclose(found[2].weights, alone.weights)


def test_errors_and_scores_are_means_over_episodes_and_over_horizons() -> None:
    by_episode = np.array([[[1.0, 2.0], [3.0, np.nan]], [[0.5, 0.5], [0.5, 2.0]]])
    found = FreeRuns(np.array([5, 10]), by_episode, ("a", "b"))
    expected = [[np.sqrt((1 + 9) / 2), 2.0], [0.5, np.sqrt((0.25 + 4) / 2)]]
    np.testing.assert_allclose(found.errors, expected)
    scores = [[np.log(2) / 2, np.log(3)], [np.log(0.5), 0.0]]
    np.testing.assert_allclose(found.scores, scores, atol=1e-9)


def runs(*scores: list[float]) -> FreeRuns:
    """Return free runs with these scores of each candidate, by episode."""
    return FreeRuns(np.array([5]), np.exp(np.array(scores))[:, :, None], ("",) * len(scores))


def test_the_least_free_is_taken_of_what_is_one_standard_error_from_the_best() -> None:
    freedom = np.array([1.0, 0.0, 2.0])
    behind = np.array([0.1, 0.2, 0.3, 0.0])
    error = behind.std(ddof=1) / 2  # of four episodes
    best = np.array([0.0, -3.0, 2.0, 1.0])
    for mean, chosen in ((0.99 * error, 1), (1.01 * error, 2)):
        near = best + behind - behind.mean() + mean
        assert runs([9.0] * 4, [*near], [*best]).choose(freedom) == chosen
    assert runs([1.0, 2.0], [1.0, 2.0]).choose(np.array([1.0, 0.0])) == 1


def test_an_episode_that_is_too_short_for_any_horizon_says_nothing() -> None:
    """An observer's may be: it loses a row where it begins amid an estimate."""
    found = runs([0.0, 9.0, 0.0], [1.0, 0.0, 1.1])
    assert found.choose(np.array([1.0, 0.0])) == 1
    found.by_episode[:, 1] = np.nan
    assert found.choose(np.array([1.0, 0.0])) == 0
    log = [episode(problem(), steps, seed) for seed, steps in enumerate((4, 20, 20))]
    some = candidates(problem(), ["none"])
    short = held_out(problem(), Coordinates.of(problem(), log), log, some)
    assert np.isnan(short.by_episode[:, 0]).all() and np.isfinite(short.by_episode[:, 1:]).all()


class Counts:
    """A residual of nothing that notes what it was fitted to."""

    seen: list[int]

    def __init__(self) -> None:
        self.predict, self.jacobian = ZeroResidual(2).predict, ZeroResidual(2).jacobian

    def fit(self, z: Any, y: Any) -> Counts:
        self.seen.append(len(z))
        return self


def test_each_episode_is_left_out_once_in_five_folds() -> None:
    class Own(Counts):
        seen: list[int] = []

    lengths = [10, 11, 12, 13, 14, 15, 16]
    log = [episode(problem(), steps, seed) for seed, steps in enumerate(lengths)]
    box = Coordinates.of(problem(), log)
    found = held_out(problem(), box, log, [Candidate("own", Own, 0.0)])
    folds = [(0, 5), (1, 6), (2,), (3,), (4,)]
    assert Own.seen == [sum(lengths) - sum(lengths[i] for i in fold) for fold in folds]
    assert found.names == ("own",) and found.by_episode.shape[:2] == (1, 7)
    assert found.horizons.tolist() == [5, 6, 7, 8, 10, 13]  # up to the median length


@pytest.mark.parametrize(
    ("steps", "horizons"),
    [(5, [5]), (30, [5, 7, 10, 14, 20, 30]), (130, [5, 9, 16, 30, 54, 100])],
)
def test_free_runs_are_as_long_as_the_median_episode_and_a_hundred_steps_at_most(
    steps, horizons
) -> None:
    log = [episode(problem(), steps, seed) for seed in range(2)]
    found = held_out(problem(), Coordinates.of(problem(), log), log, candidates(
        problem(), ["none"]))  # fmt: skip
    assert found.horizons.tolist() == horizons
    assert np.isfinite(found.by_episode).all()


def test_a_free_run_s_error_is_that_of_the_model_from_twenty_logged_states() -> None:
    mpc = solved("servo with a disturbance")
    log = [episode(mpc, 45, seed) for seed in range(2)]
    log.append(episode(mpc, 9, 3))  # too short for most horizons
    box = Coordinates.of(mpc, log)
    found = held_out(mpc, box, log, candidates(mpc, ["none"]))
    assert found.horizons.tolist() == [5, 7, 12, 18, 28, 45]
    A, B, E = mpc.model.A, mpc.model.B, mpc.model.E
    for i, each in enumerate(log):
        horizons = [h for h in found.horizons if h <= len(each)]
        last = len(each) - horizons[-1]
        squares = np.zeros((0, len(horizons), 2))
        for start in np.unique(np.linspace(0, last, 20).astype(int)):
            x, path = each.thetas[start, :2], []
            for k in range(horizons[-1]):
                d, u = each.thetas[start + k, 3:4], each.actions[start + k]
                x = A @ x + B @ u + E @ d
                path.append(((x - each.thetas[start + k + 1, :2]) / box.units) ** 2)
            squares = np.append(squares, [np.array(path)[np.array(horizons) - 1]], axis=0)
        expected = np.sqrt(squares.mean(axis=(0, 2)))
        np.testing.assert_allclose(found.by_episode[0, i, : len(horizons)], expected)
        assert np.isnan(found.by_episode[0, i, len(horizons) :]).all()


def test_a_run_that_blows_up_has_a_large_error_and_not_none() -> None:
    class Bursts(Counts):
        seen: list[int] = []

        def __init__(self) -> None:
            self.predict = lambda z: np.full((len(z), 2), np.inf)

    log = [episode(problem(), 20, seed) for seed in range(3)]
    some = [Candidate("bursts", Bursts, 0.0), *candidates(problem(), ["none"])]
    found = held_out(problem(), Coordinates.of(problem(), log), log, some)
    np.testing.assert_array_equal(found.by_episode[0], 1e6)
    assert np.all(found.by_episode[1] < 1e6)


def test_those_before_the_first_are_compared_and_never_chosen() -> None:
    mpc = solved("servo")
    thetas, inputs = zip(*(mpc.simulate([x, -1.0, 0.5], 12) for x in (2.0, 1.0, -2.0)), strict=True)
    log = [*map(Episode, thetas, inputs)]
    box = Coordinates.of(mpc, log)
    some = candidates(mpc, ["none", "linear"])
    runs_of, chosen = choose(mpc, box, log, some, 0)
    assert chosen == 0 and len(runs_of.names) == 15  # the model is true
    free = np.array([each.freedom for each in some])
    runs_of, chosen = choose(mpc, box, log, some, 1)
    assert chosen == 1 + FreeRuns(
        runs_of.horizons, runs_of.by_episode[1:], runs_of.names[1:]
    ).choose(free[1:])
    assert len(runs_of.names) == 15
    for first in (0, 3):
        runs_of, chosen = choose(mpc, box, log[:1], some, first)
        assert chosen == first and np.isinf(runs_of.errors).all()


def test_residuals_of_a_kind_and_degree_are_stepped_as_one() -> None:
    made = [ZeroResidual(2), Polynomial(1, 1.0), Polynomial(2, 1.0), Polynomial(1, 2.0), Counts()]
    made += [Counts(), ZeroResidual(2)]
    assert _alike(made) == [[0], [1, 3], [2], [4], [5], [6]]
