"""The report of a problem says in words what its law is."""

from __future__ import annotations

import numpy as np
import pytest

from general_problems import servo, solved
from sample_problems import input_bounds_only, small_mpc
from sample_problems import solved as sample_problem
from sb3_yann import LinearModel, LinearMPC, Terminal, Tracking


def test_it_names_every_parameter_with_its_box_and_meaning() -> None:
    text = solved("servo with all of it").report(samples=50)
    for line in (
        "Parameters of the law, 5,",
        "x[0]               -5 to 5          state 0",
        "r[0]               -1 to 1          reference of tracked output 0",
        "d[0]             -0.3 to 0.3        disturbance, constant over the horizon 0",
        "u_prev[0]          -1 to 2          input of the step before 0",
    ):
        assert line in text


def test_it_counts_regions_half_spaces_and_rows_of_the_terminal_set() -> None:
    mpc = solved("invariant")
    law, text = mpc.explicit(), mpc.report(samples=50)
    assert f"{law.n_regions} regions and {law.n_halfspaces} half-spaces" in text
    assert f"The terminal set has {len(mpc.terminal.set[1])} half-spaces." in text
    assert "There is no terminal set." in small_mpc().report(samples=10)


def test_shares_are_those_of_the_box() -> None:
    mpc = small_mpc(terminal=Terminal(set=([[1, 1], [-1, -1]], [0.5, 0.7])))
    rng = np.random.default_rng(0)
    points = rng.uniform(mpc.theta_min, mpc.theta_max, (500, 2))
    share = 100 * mpc.explicit().in_domain(points).mean()
    assert f"{share:.1f} % are feasible" in mpc.report()
    everywhere = input_bounds_only().report(samples=20)
    assert "100.0 % are feasible" in everywhere


def test_an_invariant_terminal_set_shows_as_a_closed_loop_that_stays_feasible() -> None:
    assert "100.0 % stay feasible" in solved("invariant").report(samples=100)


def test_active_constraints_are_shares_of_the_feasible_parameters() -> None:
    text = servo(x_min=None, x_max=None, theta_min=-1, theta_max=1, u_max=50).report(samples=100)
    assert "% u[0] at its lower bound" in text
    assert "never: u[0] at its upper bound" in text


def test_a_seed_below_zero_is_named() -> None:
    with pytest.raises(ValueError, match="seed = -1 must be a whole number of at least 0"):
        solved("servo").report(seed=-1)


def test_boxes_and_points_are_as_the_plant_shows_them_where_it_does_not_rest_at_zero() -> None:
    model = LinearModel([[0.9]], [[0.1]], 2.5, x_ss=[300.0], u_ss=[40.0], state_names=["T"])
    mpc = LinearMPC(
        model, Q=[[1]], R=[[1]], horizon=3, u_min=38, u_max=43, theta_min=295, theta_max=307,
        tracking=Tracking([0], 299, 302),
    )  # fmt: skip
    lines = mpc.report(samples=20).splitlines()
    assert lines[0] == (
        "Parameters of the law, 2, in plant units; the operating point is in brackets:"
    )
    assert lines[1].split() == "T 295 to 307 [300] state 0".split()
    assert lines[2].split()[-9:] == "299 to 302 [300] reference of tracked output 0".split()
    assert "Horizon: 3 steps of 2.5." in lines
    at = next(i for i, line in enumerate(lines) if line.startswith("The law at a few parameters"))
    assert lines[at + 1] == "  [300, 300] -> u = [40]"
    rng, law = np.random.default_rng(0), mpc.explicit()
    own = mpc.deviations
    points = rng.uniform(own.theta_min, own.theta_max, (20, 2))
    for line, theta in zip(lines[at + 2 :], points, strict=False):
        shown = ", ".join(f"{each:.4g}" for each in theta + 300)
        assert line == f"  [{shown}] -> u = [{law(theta)[0] + 40:.4g}]"
    assert len(lines) == at + 5


def test_a_parameter_without_a_solution_is_said_to_be_none() -> None:
    text = sample_problem("origin outside the box").report(samples=20)
    assert "\n  [0, 0] -> u = " in text and text.count("(not feasible)") == 1
    assert "not feasible" not in solved("servo").report(samples=20)


def test_a_plant_beside_its_model_is_told_of_where_nothing_estimates_it() -> None:
    hint = "There is no integral action"
    for name, told in (
        ("servo", True),
        ("servo with a disturbance", False),
        ("regulator with a disturbance", False),
        ("invariant", True),
    ):
        assert (hint in solved(name).report(samples=5)) == told
    assert hint not in small_mpc().report(samples=5)
    assert "headroom(mpc, env) plays it" in solved("servo").report(samples=5)
