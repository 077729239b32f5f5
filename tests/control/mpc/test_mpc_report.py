"""The report of a problem says in words what its law is."""

from __future__ import annotations

import numpy as np
import pytest

from general_problems import servo, solved
from sample_problems import input_bounds_only, small_mpc
from sb3_yann import Terminal


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


def test_the_same_seed_gives_the_same_text() -> None:
    mpc = solved("servo")
    assert mpc.report(samples=30, seed=1) == mpc.report(samples=30, seed=1)
    assert mpc.report(samples=30, seed=1) != mpc.report(samples=30, seed=2)


def test_a_number_of_samples_below_one_is_an_error() -> None:
    with pytest.raises(ValueError, match="samples = 0 must be a whole number of at least 1"):
        solved("servo").report(samples=0)
