"""Problems of the suite, terminal equalities too, are solved as a program in another form is."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from benchmarks.suite import WRONG, Outcome, compare, examine, names
from benchmarks.suite_problems import SUITE, chain, off_center, quietly
from reference_answers import online_answers, relative_error
from sample_problems import box_points
from sb3_yann import LinearModel, LinearMPC, SoftBounds, Terminal
from sb3_yann.control import PiecewiseAffine
from sb3_yann.control.explicit.solve import ProgramUnits

# One of each kind, what once failed first.
FEW = [
    *(
        "chain, dt 0.1, N 3, states within 2",
        "cart-pole, N 2, states within (0.9, 0.2, 2, 2), u 1.0",
    ),
    *("integrator, box (-2, 20), u 0.1, N 1", "integrator, box (-0.3, 100), u 0.02, N 3"),
    *(f"random, {kind}" for kind in ("states, 3", "invariant, 4", "soft, 1", "parts, 2")),
    *(
        "double integrator, invariant set, N 4",
        "quadruple tank, rates",
        "aircraft, pitch bounded, N 1",
    ),
]


def assert_right(outcome: Outcome) -> None:
    assert outcome.failure == ""
    assert outcome.holes == 0
    assert outcome.error <= WRONG
    assert outcome.points >= 10


@pytest.mark.parametrize("name", FEW)
def test_problems_of_each_kind_are_solved_and_right(name: str) -> None:
    assert_right(examine(name, 40))


@pytest.mark.nightly
@pytest.mark.parametrize("part", range(10))
def test_the_suite_is_solved_and_right(part: int) -> None:
    for name in names(large=False)[part::10]:
        if name not in FEW:
            assert_right(examine(name, 30))


@pytest.mark.parametrize("by", [1e-3, 1e-6])
def test_a_wrong_law_is_noticed(by: float) -> None:
    mpc = quietly(SUITE["double integrator, states within 5, N 2"])
    law = mpc.explicit()
    wrong = dataclasses.replace(law, gains=law.gains + by)
    assert compare(mpc, law, 60)[1] <= WRONG
    assert compare(mpc, wrong, 60)[1] > WRONG


def test_a_small_feasible_set_far_from_the_center_of_the_box_is_found() -> None:
    law = off_center(-2, 20, 0.1, 1).explicit()
    assert law.n_regions == 3
    assert law.in_domain([[-0.21], [-0.19], [0.0], [0.19], [0.21]]).tolist() == [0, 1, 1, 1, 0]


def test_a_bound_that_the_input_hardly_moves_bounds_theta_alone() -> None:
    # One step of 0.01 s moves the second mass by 0.01^4 / 24: a law for its bound is not to be had.
    mpc = chain(0.01, 2, 2.0)
    plain = mpc.condensed().scaled(np.zeros(4), mpc.theta_max, np.ones(2))
    units = ProgramUnits(mpc.condensed(), mpc.u_min, mpc.u_max)
    faint = np.any(plain.G, axis=1) & ~np.any(units.scaled.G, axis=1)
    assert 0 < np.count_nonzero(faint) < len(faint)
    moved = np.abs(plain.G).sum(axis=1)
    assert np.all(moved[faint] < 1e-7)
    np.testing.assert_allclose(units.scaled.w[faint], (plain.w - moved)[faint], rtol=1e-15)
    np.testing.assert_array_equal(units.scaled.w[~faint], plain.w[~faint])
    assert mpc.explicit().n_regions > 9


def test_a_bound_that_an_unbounded_input_moves_stays() -> None:
    mpc = chain(0.01, 2, 2.0)
    units = ProgramUnits(mpc.condensed(), np.array([-np.inf]), np.array([np.inf]))
    assert np.all(np.any(units.scaled.G, axis=1))


SLIDER = LinearModel([[1, 0.2], [0, 0.95]], [[0.02], [0.2]], dt=0.2)
MIXER = LinearModel([[1.1, 0.2], [0, 0.9]], [[1, 0.3], [0.2, 1]], dt=1.0)
FAST = LinearModel([[1.7, 0.2], [0, 0.9]], [[1, 0.3], [0.2, 1]], dt=1.0)
PLANES = np.vstack([np.eye(2), -np.eye(2)])
AT_REST = Terminal(set=(PLANES, np.zeros(4)))
AT_A_POINT = Terminal(set=(PLANES, [0.3, 0.1, -0.3, -0.1]))
AT_A_TIP = Terminal(set=([[1, 0.5], [0, 1], [-1, -1]], [0, 0, 0]))
ON_A_LINE = Terminal(set=([[1, 2], [-1, -2]], [0.3, -0.3]))

ENDS: dict[str, tuple[LinearModel, Terminal, dict[str, Any]]] = {
    "at rest": (SLIDER, AT_REST, {}),
    "at rest, with no input left to choose": (SLIDER, AT_REST, {"horizon": 2}),
    "on a line": (SLIDER, ON_A_LINE, {}),
    "at the tip of three half-spaces": (SLIDER, AT_A_TIP, {}),
    "at a point, two inputs": (MIXER, AT_A_POINT, {"horizon": 3}),
    "at a point, soft bounds": (
        MIXER, AT_A_POINT, {"horizon": 3, "soft": SoftBounds(x=0.5, penalty=500.0)},
    ),
    "at rest, an unstable plant": (FAST, AT_REST, {"horizon": 4}),
}  # fmt: skip


@pytest.mark.parametrize("name", ENDS)
def test_both_laws_hold_a_final_state_as_a_program_with_all_states_does(name: str) -> None:
    model, terminal, changes = ENDS[name]
    given: dict[str, Any] = {"Q": np.diag([1, 0.5]), "R": 0.2 * np.eye(model.n_inputs)}
    given |= {"horizon": 6, "x_min": -3, "x_max": 4, "u_min": -1, "u_max": 1.5}
    mpc = LinearMPC(model, **{**given, **changes}, terminal=terminal)
    law = mpc.law()
    assert isinstance(law, PiecewiseAffine)
    points = box_points(mpc, 400, seed=5) * np.geomspace(0.02, 1, 400)[:, None]
    inputs, feasible = online_answers(mpc, points)
    assert feasible.sum() > 20
    np.testing.assert_array_equal(law.in_domain(points), feasible)
    assert relative_error(mpc, law(points[feasible]), inputs) < 1e-9
    assert relative_error(mpc, mpc.online()(points[feasible]), inputs) < 1e-9


def test_an_equality_that_leaves_theta_a_line_is_refused_with_what_to_do() -> None:
    mpc = LinearMPC(
        SLIDER, Q=np.eye(2), R=[[1]], horizon=1, x_min=-3, x_max=3, u_min=-1, u_max=1,
        terminal=AT_REST,
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"infeasible: .* lengthen the horizon.*online\(\)"):
        mpc.explicit()
