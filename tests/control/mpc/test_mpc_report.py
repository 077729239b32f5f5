"""The report of a problem says in words what its law is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from general_problems import LOADED, servo, solved
from sample_problems import input_bounds_only, small_mpc
from sample_problems import solved as sample_problem
from sb3_yann import LinearModel, LinearMPC, Terminal, Tracking
from sb3_yann.control.mpc.report import report


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


def test_soft_bounds_and_their_cost_are_named() -> None:
    text = solved("one of two states soft, soft outputs").report(samples=20)
    assert "Soft bounds: x[1], y[0]; a unit costs 300." in text


def test_it_shows_the_law_at_the_origin_first() -> None:
    text = solved("servo").report(samples=20)
    assert "(x[0], x[1], r[0]):\n  [0, 0, 0] -> u = [0]" in text.replace("-0]", "0]")


def test_a_seed_below_zero_is_named() -> None:
    with pytest.raises(ValueError, match="seed = -1 must be a whole number of at least 0"):
        solved("servo").report(seed=-1)


def test_the_same_seed_gives_the_same_text() -> None:
    mpc = solved("servo")
    assert mpc.report(samples=30, seed=1) == mpc.report(samples=30, seed=1)
    assert mpc.report(samples=30, seed=1) != mpc.report(samples=30, seed=2)


def test_a_number_of_samples_below_one_is_an_error() -> None:
    with pytest.raises(ValueError, match="samples = 0 must be a whole number of at least 1"):
        solved("servo").report(samples=0)


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


def test_the_shares_are_counted_along_fifty_steps_and_at_rest() -> None:
    mpc = servo(LOADED, horizon=1, u_min=-0.4, u_max=0.3, x_min=-3, x_max=3)
    law, text = mpc.explicit(), mpc.report(samples=200, seed=4)
    points = np.random.default_rng(4).uniform(mpc.theta_min, mpc.theta_max, (200, 4))
    feasible = points[law.in_domain(points)]
    reachable = np.mean([mpc.is_reachable(each[2:3], each[3:]) for each in points])
    kept = 0
    for theta in feasible:
        inside, at = True, theta
        for _ in range(50):
            at = mpc.predict(at, law(at))
            inside = inside and bool(law.in_domain(at))
            if not inside:
                break
        kept += inside
    assert 0 < kept < len(feasible) < 200 and 0 < reachable < 1
    assert f"Of 200 random parameters of the box\n  {len(feasible) / 2:.1f} % are feasible" in text
    assert f"  {100 * reachable:.1f} % have a reachable steady state;" in text
    share = f"{100 * kept / len(feasible):.1f} % stay feasible for 50 steps"
    assert f"of the feasible ones, {share} in closed loop on the model." in text


def test_the_share_of_a_bound_that_acts_is_that_of_the_inputs_on_it() -> None:
    mpc = servo(horizon=1, x_min=None, x_max=None, theta_min=-2, theta_max=2, u_min=-0.5)
    text = mpc.report(samples=300)
    points = np.random.default_rng(0).uniform(mpc.theta_min, mpc.theta_max, (300, 3))
    u = mpc.explicit()(points)[:, 0]
    for side, bound in (("lower", -0.5), ("upper", 2.0)):
        share = 100 * np.mean(np.abs(u - bound) < 1e-9)
        assert f"  {share:>4.1f} % u[0] at its {side} bound" in text and share > 0
    shares = [float(line.split()[0]) for line in text.splitlines() if "at its" in line]
    assert shares == sorted(shares, reverse=True)


def test_where_nothing_is_feasible_there_is_no_share() -> None:
    mpc = small_mpc(theta_min=-500, theta_max=500)
    text = mpc.report(samples=3)
    assert "  0.0 % are feasible;" in text and "of the feasible ones, none stay feasible" in text


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


def test_an_online_law_is_told_with_its_constraints_and_no_penalty_without_soft_bounds() -> None:
    mpc = solved("servo")
    law = mpc.online()
    text = report(mpc, law, 10)
    assert f"The law is solved online, with {law.n_constraints} constraints." in text
    assert "regions" not in text and "Soft bounds" not in text


def test_inputs_are_called_by_their_names() -> None:
    mpc = dataclasses.replace(
        solved("servo"), model=solved("servo").model.named(["a", "b"], ["valve"])
    )
    assert "-> valve = [" in mpc.report(samples=5)
