"""The walk from facet to facet finds the regions that ppopt finds, and that QPs say are there."""

import ast
import dataclasses
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from scipy import optimize

import general_problems
import sample_problems
from random_problems import examples, problems, slacks
from sample_problems import PROBLEMS, box_points, input_bounds_only, small_mpc, solved
from sb3_yann import LinearModel, LinearMPC, RateLimits, Terminal
from sb3_yann.control import ExplicitSolutionError
from sb3_yann.control._kernels import polyhedra as _kernels
from sb3_yann.control.explicit import solve as module
from sb3_yann.control.explicit.budget import BudgetTimer
from sb3_yann.control.polyhedra import Region, bounded_region, farthest_points, largest_ball
from sparse_qp import SparseQP, online_answers, relative_error

# Those that ppopt solves in about a second.
NAMES = [
    *("pendulum", "reactor", "benchmark", "terminal set", "a final state held to 1e-4"),
    *("every state bound twice", "a constraint that only touches", "inputs that do the same"),
    *("an input without effect", "unstable, part of the box infeasible", "nothing bounded"),
    *("origin outside the box", "states without weight", "cheap inputs", "one state"),
    *("states of 1e-9 and 1e7, inputs of 1e6", "four states, two inputs"),
    *("servo with rates", "soft states", "invariant with all of it", "two tanks, all parts"),
]


def problem(name: str) -> LinearMPC:
    return {**sample_problems.PROBLEMS, **general_problems.PROBLEMS}[name]()


def regions_of(mpc: LinearMPC, solver: str) -> list[Region]:
    units = module.ProgramUnits(mpc.condensed(), mpc.u_min, mpc.u_max)
    return module.critical_regions(units.scaled, solver, BudgetTimer())


def reaches_beyond(one: Region, other: Region) -> float:
    """How far the half-spaces of one region let a point get beyond those of another."""
    ends = farthest_points(one.A, one.b, one.ball()[0], other.A)
    return float(np.max(np.sum(ends * other.A, axis=1) - other.b))


def assert_same_regions(mpc: LinearMPC) -> None:
    ours = regions_of(mpc, "walk")
    theirs = regions_of(mpc, "ppopt")
    assert [one.active_set for one in ours] == [one.active_set for one in theirs]
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one.law, other.law, rtol=1e-9, atol=1e-9)
        assert max(reaches_beyond(one, other), reaches_beyond(other, one)) < 1e-8
        assert len(one.b) <= len(other.b)


@pytest.mark.parametrize("name", NAMES)
def test_regions_are_those_of_ppopt(name: str) -> None:
    assert_same_regions(problem(name))


@examples(10)
@given(problems(n_regions=(1, 40)))
def test_regions_of_random_problems_are_those_of_ppopt(mpc: LinearMPC) -> None:
    assert_same_regions(mpc)


def staircase(**changes: Any) -> LinearMPC:
    """From the lowest input to the highest in three steps, all of the largest size.

    The last of the five constraints on the four inputs holds with equality whenever the others do.
    """
    limits = {"u_min": -1, "u_max": 0.5, "rate": RateLimits(-0.5, 0.5), "horizon": 4}
    return input_bounds_only(
        LinearModel([[0.9, 0.4], [0, 0.8]], [[0], [1]], 1.0), **{**limits, **changes}
    )


def test_constraints_that_depend_on_each_other_share_a_region_without_overlap() -> None:
    # Where all five constraints of the staircase are tight, any four of them give the same law.
    mpc = staircase(theta_min=-20, theta_max=20)
    law = mpc.explicit()
    same = law.gains[:, :, :].reshape(law.n_regions, -1)
    assert len(np.unique(np.round(np.column_stack([same, law.offsets]), 9), axis=0)) > 1
    assert np.sum(slacks(law, box_points(mpc, 20000)) > 1e-9, axis=1).max() == 1


def test_a_region_thinner_than_a_millionth_of_the_box_is_found() -> None:
    slim = small_mpc(terminal=Terminal(set=([[1, 0], [-1, 0]], [1e-6, 1e-6])), horizon=3)
    law = slim.explicit()
    radii = [region.ball()[1] for region in regions_of(slim, "walk")]
    assert min(radii) < 1e-6
    points = np.array([region.ball()[0] for region in regions_of(slim, "walk")]) * 5
    inputs, feasible = online_answers(slim, points)
    assert feasible.all()
    assert relative_error(slim, law(points), inputs) <= 1e-9


def polygon(seed: int, rows: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """Return a bounded polyhedron of unit rows about a point near the origin."""
    rng = np.random.default_rng(seed)
    A = np.vstack([rng.normal(size=(rows, 3)), np.eye(3), -np.eye(3)])
    A /= np.linalg.norm(A, axis=1, keepdims=True)
    return A, np.append(rng.uniform(0.3, 1.5, rows), np.full(6, 1.0))


@pytest.fixture(params=[False, True], ids=["own search", "HiGHS"])
def search(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Search by our own code, and by the one that stands in for it."""
    if request.param:
        for name in ("bounded_region", "support"):
            monkeypatch.setattr(_kernels, name, lambda *_: -1)


@pytest.mark.usefixtures("search")
@pytest.mark.parametrize("seed", range(2))
def test_balls_corners_and_facets_are_those_of_linear_programs(seed: int) -> None:
    A, b = polygon(seed)
    one = np.column_stack([A, np.ones(len(b))])
    best = optimize.linprog([0, 0, 0, -1], A_ub=one, b_ub=b, bounds=(None, None))
    middle, radius = largest_ball(A, b)
    assert radius == pytest.approx(-best.fun, rel=1e-6)
    assert np.min(b - A @ middle) == pytest.approx(radius, rel=1e-6)
    directions = np.random.default_rng(seed).normal(size=(5, 3))
    far = farthest_points(A, b, middle, directions)
    for direction, point in zip(directions, far, strict=True):
        top = -optimize.linprog(-direction, A_ub=A, b_ub=b, bounds=(None, None)).fun
        assert direction @ point == pytest.approx(top, rel=1e-6)
        assert np.max(A @ point - b) < 1e-7
        (timed,) = farthest_points(A, b, middle, direction[None], seconds=10)
        assert direction @ timed == pytest.approx(top, rel=1e-6)
    bounding = []
    for k in range(len(b)):
        others = np.arange(len(b)) != k
        free = optimize.linprog(-A[k], A_ub=A[others], b_ub=b[others], bounds=(None, None))
        if free.status != 0 or -free.fun > b[k] + 1e-9:
            bounding.append(k)
    found, size, rows, equal = bounded_region(A, b, 1e-9)
    assert rows.tolist() == bounding and size == pytest.approx(radius, rel=1e-6)
    assert np.min(b - A @ found) > 0.5 * radius and isinstance(equal, bool)
    for k in bounding[:3]:
        at, width = largest_ball(A, b, k)
        assert A[k] @ at == pytest.approx(b[k], abs=1e-7)
        rest = np.delete(b - A @ at, k)
        assert rest.min() == pytest.approx(width, rel=1e-5)


Regions = list[Any]
THIN = "a final state held to 1e-4"
DROPS = {"pendulum": 7, THIN: 15}


def error_of(
    monkeypatch: pytest.MonkeyPatch, name: str, spoil: Callable[[Regions], Regions]
) -> tuple[str, np.ndarray]:
    """Solve with spoilt regions; return the error's message and the theta that it names."""
    with monkeypatch.context() as patch:
        find = module.critical_regions
        patch.setattr(module, "critical_regions", lambda *args: spoil(find(*args)))
        with pytest.raises(ExplicitSolutionError, match="failed its check: ") as error:
            PROBLEMS[name]().explicit()
    theta = re.search(r"theta = (\[.*?\])", str(error.value))
    assert theta is not None
    return str(error.value), np.array(ast.literal_eval(theta.group(1)))


def with_changed_gain(regions: Regions, index: int, factor: float) -> Regions:
    law = regions[index].law.copy()
    law[:, :-1] = law[:, :-1] * factor + factor - 1
    changed = dataclasses.replace(regions[index], law=law)
    return [*regions[:index], changed, *regions[index + 1 :]]


@pytest.mark.parametrize(
    ("name", "index"), [(name, i) for name, count in DROPS.items() for i in range(count)]
)
def test_a_dropped_region_is_found_and_theta_lies_in_it(
    name: str, index: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    message, theta = error_of(monkeypatch, name, lambda found: found[:index] + found[index + 1 :])
    assert "no region covers a feasible parameter" in message
    assert solved(name).explicit().locate(theta) == index


@pytest.mark.parametrize(("name", "index"), [("pendulum", 0), ("pendulum", 6), ("reactor", 3)])
def test_a_gain_off_by_a_thousandth_is_found(
    name: str, index: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    message, theta = error_of(
        monkeypatch, name, lambda found: with_changed_gain(found, index, 1.001)
    )
    assert f"the law of region {index} is not optimal inside it" in message
    assert solved(name).explicit().locate(theta) == index


@pytest.mark.parametrize("beyond", [3e-9, 9e-9])
def test_a_region_that_reaches_a_hair_too_far_is_trimmed(
    beyond: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = solved("benchmark").explicit()
    find = module.critical_regions

    def spoil(*args: Any) -> Regions:
        first, *rest = find(*args)
        inner = np.all(np.abs(first.A) < 0.999, axis=1)  # not a bound of theta
        return [dataclasses.replace(first, b=first.b + beyond * inner), *rest]

    monkeypatch.setattr(module, "critical_regions", spoil)
    law = PROBLEMS["benchmark"]().explicit()
    assert law.n_regions == right.n_regions
    more = len(law.b) - len(right.b)
    assert more > 0 and len(law.neighbors) == len(law.b)
    # The true conditions of the region are among its half-spaces again, with what lies beyond.
    own, known = (each.starts[1] for each in (law, right))
    for k in range(known):
        off = np.abs(law.A[:own] - right.A[k]).max(axis=1) + np.abs(law.b[:own] - right.b[k])
        (same,) = np.flatnonzero(off < 1e-12)
        assert law.neighbors[same] == right.neighbors[k]
    np.testing.assert_array_equal(law.A[own:], right.A[known:])


@pytest.mark.parametrize("change", [0.25, 0.4, 0.5])
@pytest.mark.parametrize(("pole", "low"), [(0.8, 0), (-0.5, 0), (1.0, -1)])
def test_rates_that_divide_the_range_leave_no_gap(pole: float, low: float, change: float) -> None:
    """Rates and bounds are tight together, and several constraints share a facet."""
    plant = LinearModel([[pole]], [[0.5]], dt=1)
    own = {"u_min": low, "u_max": 1, "x_min": -3, "x_max": 3}
    for horizon, weight in ((4, 0.0), (4, 0.05), (5, 0.0)):
        rate = RateLimits(-change, change, R_du=[[weight]])
        mpc = LinearMPC(plant, Q=[[1]], R=[[0.01]], horizon=horizon, rate=rate, **own)
        theta = np.random.default_rng(0).uniform(mpc.theta_min, mpc.theta_max, (200, 2))
        law = mpc.explicit()
        inside = law.in_domain(theta)
        assert inside.sum() > 100
        np.testing.assert_allclose(law(theta[inside]), mpc.online()(theta[inside]), atol=1e-8)


def test_a_region_that_is_there_twice_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    message, theta = error_of(monkeypatch, "benchmark", lambda regions: [*regions, regions[3]])
    assert "region 3 and region 9 are the same" in message
    assert solved("benchmark").explicit().locate(theta) == 3


@pytest.mark.parametrize("gap", [1e-3, 1e-6])
@pytest.mark.parametrize("name", ["benchmark", "reactor"])
def test_a_thin_gap_between_two_regions_is_found(
    name: str, gap: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoil(regions: Regions) -> Regions:
        inner = np.all(np.abs(regions[0].A) < 0.999, axis=1)  # not a bound of theta
        b = regions[0].b - gap * inner * (np.cumsum(inner) == 1)
        return [dataclasses.replace(regions[0], b=b), *regions[1:]]

    message, theta = error_of(monkeypatch, name, spoil)
    assert "no region covers a feasible parameter" in message
    assert SparseQP(solved(name))(theta) is not None


@pytest.mark.parametrize("reach", [1e-2, 1e-5])
@pytest.mark.parametrize("index", [0, 3])
def test_one_half_space_that_reaches_a_little_too_far_is_found(
    index: int, reach: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoil(regions: Regions) -> Regions:
        b = regions[index].b.copy()
        b[0] += reach
        return [*regions[:index], dataclasses.replace(regions[index], b=b), *regions[index + 1 :]]

    message, _ = error_of(monkeypatch, "benchmark", spoil)
    assert f"the law of region {index} violates the KKT conditions" in message


def test_the_regions_of_ppopt_are_checked_too(monkeypatch: pytest.MonkeyPatch) -> None:
    find = module.critical_regions
    monkeypatch.setattr(module, "critical_regions", lambda *args: find(*args)[1:])
    with pytest.raises(ExplicitSolutionError, match="no region covers a feasible parameter"):
        PROBLEMS["benchmark"]().explicit("ppopt")


def test_a_failed_check_is_not_kept_as_a_law(monkeypatch: pytest.MonkeyPatch) -> None:
    mpc = PROBLEMS["benchmark"]()
    with monkeypatch.context() as patch:
        patch.setattr(module, "critical_regions", lambda *args: [])
        with pytest.raises(ExplicitSolutionError):
            mpc.explicit()
    assert mpc.explicit().n_regions == 9
