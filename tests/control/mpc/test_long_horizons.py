"""Unstable plants over long horizons lose no digits, and where they would, an error says so."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy import linalg

from benchmarks.long_horizons import KINDS, errors, problem
from sb3_yann import LinearModel, LinearMPC, Terminal
from sb3_yann.control import OnlineLaw

BOX = {"x_min": -8, "x_max": 8, "u_min": -1.5, "u_max": 1.5}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("pole", "horizon"), [(1.03, 30), (1.4, 25), (1.7, 60), (2.8, 40)])
def test_the_online_law_is_that_of_a_program_that_keeps_all_states(pole, horizon, kind) -> None:
    error, _, compared = errors(problem(pole, horizon, kind, seed=3), 6, explicit=False)
    assert compared and error < 1e-8


@pytest.mark.parametrize(("pole", "horizon"), [(2.4, 8), (1.9, 20), (1.6, 24)])
def test_so_is_the_explicit_law(pole, horizon) -> None:
    mpc = problem(pole, horizon, seed=5)
    online, explicit, compared = errors(mpc, 12, explicit=True)
    assert compared and max(online, explicit) < 1e-8


@pytest.mark.parametrize("horizon", [15, 45, 90])
def test_without_active_constraints_the_law_is_the_regulator(horizon) -> None:
    A, B = np.array([[1.7, 0.2], [0.0, 0.6]]), np.array([[0.4], [1.0]])
    Q, R = np.diag([2.0, 0.5]), np.array([[0.3]])
    P = linalg.solve_discrete_are(A, B, Q, R)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    mpc = LinearMPC(LinearModel(A, B, dt=1), Q=Q, R=R, horizon=horizon, **BOX)
    assert np.abs(mpc.online().gain([0.0, 0.0]) + K).max() < 1e-10


def test_a_stable_plant_is_condensed_in_its_inputs() -> None:
    mpc = LinearMPC(LinearModel([[0.9]], [[1.0]], dt=1), Q=[[1]], R=[[1]], horizon=40, **BOX)
    assert mpc.condensed().feedback is None
    assert problem(1.9, 20).condensed().feedback is not None


def test_a_discounted_and_a_short_sighted_problem_keep_their_laws() -> None:
    model = LinearModel([[1.8, 0.3], [0, 1.1]], [[0], [1]], dt=1)
    for options in ({"gamma": 0.9}, {"terminal": Terminal(cost=np.zeros((2, 2)))}):
        mpc = LinearMPC(model, Q=np.eye(2), R=[[1]], horizon=60, **BOX, **options)
        error, _, compared = errors(mpc, 8, explicit=False)
        assert compared and error < 1e-8


def test_a_law_about_a_feedback_survives_a_file_and_a_pickle(tmp_path) -> None:
    law = problem(2.2, 30, "rates").online()
    law.save(tmp_path / "law.npz")
    theta = np.random.default_rng(0).uniform(law.theta_min, law.theta_max, (20, law.n_theta)) / 3
    for other in (OnlineLaw.load(tmp_path / "law.npz"), pickle.loads(pickle.dumps(law))):
        np.testing.assert_array_equal(other(theta), law(theta))
        np.testing.assert_array_equal(other.gain(theta[0]), law.gain(theta[0]))


def test_beyond_its_reach_the_law_is_bounded_and_keeps_the_inputs_bounds() -> None:
    law = problem(2.5, 30).online()
    theta = np.random.default_rng(1).uniform(-1e3, 1e3, (30, 2))
    u = law(theta)
    assert not law.in_domain(theta).all()
    assert np.isfinite(u).all() and np.abs(u).max() <= 2.0


@pytest.mark.parametrize("kind", ["online", "explicit"])
def test_where_digits_are_lost_an_error_names_the_horizon_and_the_pole(kind) -> None:
    nearly = LinearModel([[2, 0], [0, 1.9999]], [[1], [1]], dt=1)
    mpc = LinearMPC(nearly, Q=np.eye(2), R=[[1]], horizon=90, **BOX)
    with pytest.raises(ValueError, match=r"horizon = 90 and the pole 2 of the model"):
        mpc.law(kind)


def test_where_the_problems_own_gains_do_not_stabilize_another_one_does() -> None:
    """A mode on the unit circle without a weight has no Riccati gain; the law needs none."""
    model = LinearModel([[1.8, 0], [0, 1]], [[1], [0.5]], dt=1)
    short = Terminal(cost=np.zeros((2, 2)))
    mpc = LinearMPC(model, Q=np.diag([1, 0]), R=[[1]], horizon=70, terminal=short, **BOX)
    error, _, compared = errors(mpc, 8, explicit=False)
    assert compared and error < 1e-8


def test_a_mode_that_no_input_reaches_may_grow_beside_one_that_is_steadied() -> None:
    model = LinearModel([[1.7, 0.2], [0, 1.01]], [[1], [0]], dt=1)
    mpc = LinearMPC(model, Q=np.eye(2), R=[[1]], horizon=70, gamma=0.95, **BOX)
    error, _, compared = errors(mpc, 8, explicit=False)
    assert compared and error < 1e-8


@pytest.mark.parametrize("cost", [1e7, 1e11])
def test_a_large_terminal_cost_is_no_loss_of_digits(cost) -> None:
    model = LinearModel([[2.3, 0.3], [0, 0.5]], [[1], [1]], dt=1)
    stiff = Terminal(cost=cost * np.eye(2))
    mpc = LinearMPC(model, Q=np.eye(2), R=[[1]], horizon=50, terminal=stiff, **BOX)
    error, _, compared = errors(mpc, 8, explicit=False)
    assert compared and error < 1e-8


def test_a_mode_that_grows_and_costs_nothing_is_named_with_the_horizon() -> None:
    model = LinearModel([[2.1, 0], [0, 0.5]], [[1], [1]], dt=1)
    blind = Terminal(cost=np.zeros((2, 2)))
    mpc = LinearMPC(model, Q=np.diag([0, 1]), R=[[1]], horizon=55, terminal=blind, **BOX)
    with pytest.raises(ValueError, match=r"horizon = 55 and the pole 2\.1 .*a weight in Q"):
        mpc.online()
