"""An MPC from a simulator alone, and the closed loop on a model."""

import itertools
import pickle
import re

import numpy as np
import pytest

from benchmarks.online_problems import wide_plant
from general_problems import PROBLEMS, servo, solved, two_tanks
from sample_plants import Plant, played
from sample_problems import input_bounds_only, small_mpc
from sb3_yann import LinearModel, LinearMPC, Log, RateLimits, Terminal, Tracking, identify
from sb3_yann.control import OnlineLaw, OnlineLawWarning
from sb3_yann.control.explicit import budget, solve
from sb3_yann.control.explicit.certificate import ExplicitSolutionError
from sb3_yann.control.mpc import linear_mpc


def test_a_simulation_is_the_law_on_its_model() -> None:
    mpc = small_mpc()
    thetas, inputs = mpc.simulate([-3, 1], 12)
    assert (thetas.shape, inputs.shape) == ((13, 2), (12, 1))
    np.testing.assert_allclose(inputs, mpc.explicit()(thetas[:-1]))
    np.testing.assert_allclose(thetas[1:], mpc.predict(thetas[:-1], inputs))
    assert np.abs(thetas[-1]).max() < 0.1


def test_r_stays_and_u_prev_follows() -> None:
    mpc = small_mpc(tracking=Tracking([0], -2, 2), rate=RateLimits(-0.5, 0.5))
    thetas, inputs = mpc.simulate([0, 0, 1.0, 0], 30)
    assert np.all(thetas[:, 2] == 1)
    np.testing.assert_array_equal(thetas[1:, 3], inputs[:, 0])
    assert abs(thetas[-1, 0] - 1) < 0.05


@pytest.mark.parametrize(("theta", "steps"), [([1, 2, 3], 5), ([0, 0], 0), ([0, np.nan], 5)])
def test_a_bad_start_is_named(theta: list[float], steps: int) -> None:
    with pytest.raises(ValueError, match=r"theta0|steps = 0"):
        small_mpc().simulate(theta, steps)


def test_a_problem_names_its_bounds() -> None:
    text = repr(small_mpc())
    assert "x_min=[-5, -5], x_max=[5, 5], u_min=[-1], u_max=[1]" in text
    assert "r_min" not in text
    assert "r_min=[" in repr(servo())


def heater() -> Plant:
    """Shows a temperature near 350 K, takes a power of 20 to 60 kW."""
    return Plant(lambda x, u: 350 + 0.9 * (x - 350) + 0.05 * (u - 40), (300, 400), (20, 60), 350)


def test_the_bounds_are_those_of_the_spaces_as_the_plant_shows_them() -> None:
    given = {"dt": 60.0, "x_ss": [350], "u_ss": [40], "state_names": ["T"], "time_unit": "s"}
    mpc = LinearMPC.from_env(heater, Q=[[1]], R=[[0.01]], horizon=3, **given)
    assert (mpc.model.state_names, mpc.model.time_unit) == (("T",), "s")
    np.testing.assert_allclose([mpc.model.A[0, 0], mpc.model.B[0, 0]], [0.9, 0.05], atol=1e-6)
    box = {"u_min": 20, "u_max": 60, "theta_min": 300, "theta_max": 400}
    assert mpc == LinearMPC(mpc.model, Q=[[1]], R=[[0.01]], horizon=3, **box)
    law = mpc.explicit()
    np.testing.assert_allclose(law.plant_input([350.0]), [40], atol=1e-6)
    assert 20 <= law.plant_input([390.0])[0] < 40


def test_what_is_given_counts_more_than_the_spaces() -> None:
    open_above = Plant(lambda x, u: 0.9 * x + u, (-9, np.inf), (-1, 1), 0)  # theta ends at x_max
    mpc = LinearMPC.from_env(open_above, Q=[[1]], R=[[1]], horizon=2, dt=1, x_min=[-5], x_max=[5])
    assert (mpc.theta_min, mpc.theta_max) == (-9, 5)
    mpc = LinearMPC.from_env("ClippedPendulum-v0", Q=np.eye(2), R=[[1]], horizon=2, u_max=1.5)
    assert mpc.u_max.tolist() == [1.5] and mpc.u_min.tolist() == [-2]
    with pytest.raises(TypeError, match="colour"):
        LinearMPC.from_env("ClippedPendulum-v0", Q=np.eye(2), R=[[1]], horizon=2, colour=1)


def test_what_identify_returns_is_a_model_for_it() -> None:
    u = np.random.default_rng(0).normal(size=(80, 1))
    x = played(lambda x, u: 0.8 * x + 0.5 * u, u, [0])
    found = identify(Log.from_arrays(x, u, 1.0), x_ss=[0], u_ss=[0])
    mpc = LinearMPC(found, Q=[[1]], R=[[1]], horizon=2, x_min=-5, x_max=5, u_min=-1, u_max=1)
    assert isinstance(mpc.model, LinearModel) and mpc.explicit()([5.0])[0] == pytest.approx(-1)


def test_it_names_every_parameter_with_its_box_and_meaning() -> None:
    text = solved("servo with all of it").report(samples=50)
    for line in (
        "Parameters of the law, 5,",
        "x[0]               -5 to 5          state 0",
        "r[0]               -1 to 1          reference of tracked output 0",
        "d[0]             -0.3 to 0.3        disturbance 0, constant over the horizon",
        "u_prev[0]          -1 to 2          input 0 of the step before",
    ):
        assert line in text


def test_it_counts_regions_half_spaces_and_rows_of_the_terminal_set() -> None:
    mpc = solved("invariant")
    law = mpc.explicit()
    text = mpc.report(samples=100)
    assert "100.0 % stay feasible" in text
    assert f"{law.n_regions} regions and {law.n_halfspaces} half-spaces" in text
    assert f"The terminal set has {len(mpc.terminal.set[1])} half-spaces." in text
    assert "There is no terminal set." in small_mpc().report(samples=10)


def test_shares_are_those_of_the_box() -> None:
    mpc = small_mpc(terminal=Terminal(set=([[1, 1], [-1, -1]], [0.5, 0.7])))
    points = np.random.default_rng(0).uniform(mpc.theta_min, mpc.theta_max, (500, 2))
    share = 100 * mpc.explicit().in_domain(points).mean()
    assert f"{share:.1f} % are feasible" in mpc.report()
    assert "100.0 % are feasible" in input_bounds_only().report(samples=20)
    moving = servo(parametric_bounds=["u_max"], tracking=Tracking([0], -1, 1, preview=1))
    points = np.random.default_rng(0).uniform(moving.theta_min, moving.theta_max, (500, 5))
    r, _, u_max = points[:, 2:5].T
    kept = moving.is_reachable(r[:, None]) & (r * moving.steady_states.u[0] <= u_max)
    assert 0 < kept.mean() < 0.9
    text = moving.report()
    assert f"{100 * kept.mean():.1f} % have a reachable steady state" in text
    assert "output 0\n" in text and "output 0, 1 sample ahead and after\n" in text


def test_active_constraints_are_shares_of_the_feasible_parameters() -> None:
    text = servo(x_min=None, x_max=None, theta_min=-1, theta_max=1, u_max=50).report(samples=100)
    assert "% u[0] at its lower bound" in text
    assert "never: u[0] at its upper bound" in text


def test_states_that_hardly_count_are_named() -> None:
    text = small_mpc(Q=[[4, 0], [0, 1e-3]], theta_min=[-3, -2], theta_max=[3, 2]).report(samples=5)
    assert re.search(r": x\[0\] 36, x\[1\] 0.004, u\[0\] .*\n  Little beside others: x\[1\]", text)


def test_a_plant_beside_its_model_is_told_of_where_nothing_estimates_it() -> None:
    hint = "There is no integral action"
    for name, told in (
        ("servo", True),
        ("servo with a disturbance", True),  # which is measured
        ("regulator with a disturbance", False),
        ("invariant", True),
    ):
        assert (hint in solved(name).report(samples=5)) == told
    assert hint not in small_mpc().report(samples=5)
    assert "headroom(mpc, env) plays it" in solved("servo").report(samples=5)


def test_auto_is_the_online_law_beyond_the_budget_and_says_so_once(monkeypatch) -> None:
    monkeypatch.setattr(linear_mpc, "REGIONS", 2)
    mpc = servo()
    with pytest.warns(
        OnlineLawWarning, match="more than region_limit = 2.*not as Structured"
    ) as caught:
        law = mpc.law()
    assert caught[0].filename == __file__
    assert isinstance(law, OnlineLaw)
    assert mpc.law() is law  # a warning would be an error
    assert isinstance(pickle.loads(pickle.dumps(mpc)).law(), OnlineLaw)


def test_regions_of_a_very_large_program_are_not_looked_for(monkeypatch) -> None:
    monkeypatch.setattr(LinearMPC, "_solved", None)
    with pytest.warns(OnlineLawWarning, match="801 constraints on 165 parameters, too many"):
        assert isinstance(wide_plant().law(), OnlineLaw)


def test_what_was_solved_or_chosen_is_kept_whatever_its_size(monkeypatch) -> None:
    monkeypatch.setattr(linear_mpc, "REGIONS", 2)
    mpc = servo()
    explicit = mpc.explicit()
    assert mpc.law() is explicit
    assert mpc.law("online") is mpc.online()
    assert mpc.law("explicit") is explicit
    mpc = servo()
    assert isinstance(mpc.law("online"), OnlineLaw)
    assert "The law is solved online, with" in mpc.report(samples=20)
    monkeypatch.setattr(LinearMPC, "_solved", None)
    assert isinstance(mpc.law(), OnlineLaw)
    mpc.value_matrix(0.99)
    with pytest.raises(ValueError, match="kind"):
        mpc.law("implicit")


def test_auto_gives_up_by_what_it_counts_and_not_by_the_clock(monkeypatch) -> None:
    monkeypatch.setattr(linear_mpc, "EFFORT", 0.01)
    messages = set()
    for speed in (0.0, 100.0):
        clock = itertools.count()
        monkeypatch.setattr(budget.time, "monotonic", lambda: next(clock) * speed)  # noqa: B023
        with pytest.warns(OnlineLawWarning, match="more effort") as caught:
            assert isinstance(two_tanks(rate=RateLimits(-0.8, 0.9)).law(), OnlineLaw)
        messages.add(str(caught[0].message).partition(" regions")[0])
    assert len(messages) == 1


def test_auto_takes_the_online_law_where_the_search_fails(monkeypatch) -> None:
    def failing(*args, **kwargs):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(solve, "walk", failing)
    with pytest.raises(ExplicitSolutionError, match="similar magnitudes"):
        servo().explicit()
    with pytest.warns(OnlineLawWarning, match="no solution in float64"):
        assert isinstance(servo().law(), OnlineLaw)


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_value_of_both_laws_is_the_same(name) -> None:
    other = PROBLEMS[name]()
    other.law("online")
    expected = solved(name).value_matrix(0.95)
    assert np.abs(other.value_matrix(0.95) - expected).max() <= 1e-9 * np.abs(expected).max()
