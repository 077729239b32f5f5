"""The evidence for a twin, number by number."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import check_grad

from sb3_yann import LinearMPC, RateLimits
from sb3_yann.twin import trust as trusts
from sb3_yann.twin.log import Episode, as_episodes
from sb3_yann.twin.network import UNITS, Network
from sb3_yann.twin.report import report
from sb3_yann.twin.residuals import Nothing
from sb3_yann.twin.selection import Candidate, FreeRuns
from twin_samples import log, problem, twin


def runs(*errors: list[float]) -> FreeRuns:
    """Return errors 1 and 10 steps ahead, of the given model first."""
    return FreeRuns(np.array([1, 10]), np.array(errors, float)[:, None], ("",) * len(errors))


def judged(found: FreeRuns, standing=(1.0, 1.0), **changes):
    """Return problems and advice on a log with nothing against it, but for the changes."""
    given = {
        "costs": (np.array([10.0, 20.0]), np.array([10.0, 20.0])),
        "inputs": (np.array([0.5]), np.array([0.5])),
        "n_episodes": 5,
        "beyond": (0.0, "x[0]"),
    }
    problems, advice = trusts.judge(found, np.array(standing), **(given | changes))
    return " ".join(problems), " ".join(advice)


GOOD = [0.1, 0.2]


def test_the_error_of_costs_is_relative_to_their_mean() -> None:
    assert trusts.relative_error(np.array([1.0, 7.0]), np.array([4.0, 3.0])) == pytest.approx(
        np.sqrt(12.5) / 3.5
    )
    assert trusts.relative_error(np.zeros(0), np.zeros(0)) == np.inf


def test_the_ratio_of_errors_is_that_of_the_chosen_one_to_the_given_model() -> None:
    found = runs([1.0, 2.0], [5.0, 5.0], [0.5, 0.25], [9.0, 9.0])
    given = dataclasses.replace(twin().trust, runs=found, chosen=2)
    assert given.error_ratio == pytest.approx(0.25)  # of 1/2 and 1/8


def test_every_episode_is_left_out_of_the_fit_that_predicts_it() -> None:
    rows: list[int] = []

    class Counts:
        predict, jacobian = Nothing(2).predict, Nothing(2).jacobian

        def fit(self, z, y):
            rows.append(len(z))
            return self

    x, u = np.zeros((41, 2)), np.zeros((40, 1))
    episodes = as_episodes(problem(), [(x[: n + 1], u[:n]) for n in (10, 25, 40)])
    choice = Candidate("counts", Counts, 0.0)
    coordinates = twin().dynamics.coordinates
    predicted, actual = trusts.held_out_costs(problem(), coordinates, episodes, choice)
    assert rows == [65, 50, 35]
    assert predicted.tolist() == actual.tolist() == [0.0, 0.0, 0.0]
    assert [
        len(each) for each in trusts.held_out_costs(problem(), coordinates, episodes[:1], choice)
    ] == [0, 0]


def test_rows_count_as_beyond_the_box_where_they_are_beyond_rounding() -> None:
    x = np.zeros((11, 2))
    x[:4, 0], x[4, 1], x[5, 1] = 3.1, -3.0 - 1e-7, -3.01  # the box is -3 to 3
    (episode,) = as_episodes(problem(), [(x, np.zeros((10, 1)))])
    np.testing.assert_allclose(trusts.beyond_the_box(problem(), (episode,)), [4 / 11, 1 / 11])


def test_what_an_input_does_of_its_own_is_what_no_linear_law_and_no_mpc_explains() -> None:
    rng = np.random.default_rng(0)
    x, own = rng.uniform(-1, 1, (401, 2)), 0.1 * rng.standard_normal((400, 1))
    feedback = 0.2 * x[:-1, :1] - 0.1 * x[:-1, 1:]
    (episode,) = as_episodes(problem(), [(x, feedback + own)])
    share, moves = trusts.excitation(problem(), (episode,))
    assert share == pytest.approx(np.var(own) / np.var(feedback + own), rel=0.05)
    assert moves == pytest.approx([np.std(feedback + own)])  # half the range is 1
    (closed,) = as_episodes(problem(), [(x, feedback)])
    assert trusts.excitation(problem(), (closed,))[0] < 1e-20


def test_a_sound_twin_has_nothing_against_it() -> None:
    assert judged(runs(GOOD)) == ("", "")


@pytest.mark.parametrize(
    ("ratio", "n", "problem", "advice"),
    [(1.9, 5, "", ""), (2.1, 5, "", "worse than 'nothing moves'"), (2.1, 1, "one episode", "Log"),
     (9.9, 5, "", "order of the columns"), (10.1, 5, "far worse than", "operating point")],
)  # fmt: skip
def test_a_model_of_another_plant_is_told_by_what_moves(ratio, n, problem, advice) -> None:
    found = judged(runs([ratio * 0.3, 0.1]), standing=(0.3, 50.0), n_episodes=n)
    assert problem in found[0] and advice in found[1]
    assert bool(problem) == bool(found[0]) and bool(advice) == bool(found[1])
    if ratio > 2 and n > 1:
        assert f"({0.3 * ratio:.3g} against 0.3 standard deviations)" in " ".join(found)


def test_the_edges_of_what_is_trusted() -> None:
    assert judged(runs(GOOD), beyond=(0.049, "x[0]")) == ("", "")
    assert "6 % of the logged x[0] lie beyond" in judged(runs(GOOD), beyond=(0.06, "x[0]"))[0]
    for error, refused in ((0.24, False), (0.26, True)):
        costs = np.array([10.0, 10.0]) * (1 + error), np.array([10.0, 10.0])
        said = judged(runs(GOOD), costs=costs)[0]
        assert bool(said) == refused
    assert said.endswith("held-out episodes err by 26 % of the mean; 25 % are the most.")
    assert "Log 5 episodes more" in judged(runs(GOOD), costs=costs)[1]
    inputs = np.array([0.019, 0.021, 0.0]), np.array([0.1, 0.1, 0.9e-4])
    problems, advice = judged(runs(GOOD), inputs=inputs)
    assert problems == "Input 2 never moves: what it does is not in the log."
    assert "Input 0 follows the MPC (1.90 % of its variance is its own)" in advice
    assert "Input 1" not in advice
    named = judged(runs(GOOD), inputs=inputs, names=["steam", "feed", "reflux"])
    assert "reflux never moves" in named[0] and "step test on reflux" in named[1]


def test_a_log_whose_theta_does_not_hold_the_input_before_is_told_by_its_share() -> None:
    given = problem()
    mpc = LinearMPC(
        given.model, Q=given.Q, R=given.R, horizon=3, u_min=-1, u_max=1,
        theta_min=[-3, -3], theta_max=[3, 3], rate=RateLimits(-0.5, 0.5),
    )  # fmt: skip
    u = np.linspace(-0.2, 0.2, 40)[:, None]
    thetas = np.hstack([np.zeros((41, 2)), np.vstack([[[0.0]], u])])
    assert trusts.foreign_previous(mpc, (Episode(thetas, u),)) == []
    thetas[5:15, 2] += 0.02
    (said,) = trusts.foreign_previous(mpc, (Episode(thetas, u),))
    assert said.startswith("In 25 % of the rows theta does not hold the input before it")
    assert trusts.foreign_previous(problem(), as_episodes(problem(), log(2))) == []


def test_the_report_shows_these_numbers() -> None:
    given = dataclasses.replace(
        twin().trust, predicted=np.array([10.0, 22.0]), actual=np.array([10.0, 20.0]),
        moves=np.array([0.123]), excitation=np.array([0.0456]), noise=np.array([0.01, 0.5]),
    )  # fmt: skip
    said = report(problem(), twin().episodes, "quadratic", given)
    assert "The log: 5 episodes, 300 steps." in said
    assert "  u[0]: 12.3 % of half the range, 4.56 %: its gain is known from the log" in said
    assert f"  error {100 * np.sqrt(2) / 15:.3g} % of the mean cost" in said
    assert "Sensor noise, at most (standard deviations): x[0] 0.01, x[1] 0.5." in said
    rests = dataclasses.replace(given, excitation=np.array([0.0199]))
    assert "1.99 %: its gain rests on the given B" in report(problem(), twin().episodes, "", rests)


@pytest.mark.parametrize("offset", [False, True])
def test_the_slope_of_a_networks_loss_is_that_of_its_value(offset) -> None:
    rng = np.random.default_rng(0)
    z, y, network = rng.normal(size=(30, 3)), rng.normal(size=(30, 2)), Network(rng, 0.1, offset)
    flat = rng.normal(size=(3 + 1 + 2) * UNITS + 2)
    free = slice(None) if offset else slice(0, -2)  # without one the constant does not move

    def at(part):
        whole = flat.copy()
        whole[free] = part
        return network._loss(whole, z, y)

    error = check_grad(lambda p: at(p)[0], lambda p: at(p)[1][free], flat[free])
    assert error < 1e-5 * np.linalg.norm(at(flat[free])[1])
    weights = network._parts(flat, 3, 2)
    zero = [np.zeros_like(each) for each in weights[2:]]
    silent = np.concatenate([flat[: 4 * UNITS], *(each.ravel() for each in zero)])
    decay = 0.1 * np.sum(weights[0] ** 2)
    assert network._loss(silent, z, y)[0] == pytest.approx(np.sum(y**2) / 30 + decay)
