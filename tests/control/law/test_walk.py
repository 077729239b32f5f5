"""A walk along a line finds the region that a scan of all regions finds."""

import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fresh_process import run_python
from random_problems import (
    as_range,
    balls,
    edges,
    examples,
    in_box,
    kinds,
    mixture,
    problems,
    slacks,
    steepest,
    unit_half,
)
from sample_problems import braking
from sb3_yann import LinearModel, LinearMPC
from sb3_yann.control import PiecewiseAffine
from sparse_qp import room

UNKNOWN = np.empty(0, np.int64)


@cache
def chain(bounded: bool = False, infeasible: str = "nearest_region") -> PiecewiseAffine:
    """The law of two masses between walls; with bounds of the states a part is infeasible."""
    springs = np.array([[-2.0, 1.0], [1.0, -2.0]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [springs, np.zeros((2, 2))]])
    B = [[0.0], [0.0], [1.0], [0.0]]
    box = {"x_min": -4, "x_max": 4} if bounded else {"theta_min": -4, "theta_max": 4}
    return LinearMPC(
        LinearModel.from_continuous(A, B, 0.5),
        Q=np.eye(4), R=[[0.1]], horizon=4, u_min=-1, u_max=1, infeasible=infeasible, **box,
    ).explicit()  # fmt: skip


@cache
def cart() -> PiecewiseAffine:
    return braking().explicit()


LAWS = pytest.mark.parametrize("make", [chain, lambda: chain(bounded=True), cart])


def scanned(law: PiecewiseAffine) -> PiecewiseAffine:
    return replace(law, neighbors=UNKNOWN)


def around(law: PiecewiseAffine, count: int, stretch: float = 1.0) -> np.ndarray:
    drawn = np.random.default_rng(0).uniform(-stretch, stretch, (count, law.n_theta))
    return drawn * (law.theta_max - law.theta_min) / 2


@LAWS
@pytest.mark.parametrize("stretch", [1.0, 3.0])
def test_it_finds_the_region_of_a_scan_inside_and_outside(make, stretch: float) -> None:
    law = make()
    points = around(law, 5000, stretch)
    assert law.walks and law.n_regions > 50
    for name in ("locate", "in_domain", "__call__"):
        found = getattr(law, name)(points)
        expected = getattr(scanned(law), name)(points)
        assert np.array_equal(found, expected)
    if stretch == 1:
        assert law.in_domain(points).all() == (make is chain)


@LAWS
def test_it_finds_the_region_of_a_scan_on_facets(make) -> None:
    law = make()
    points, _ = edges(law, seed=0)
    assert np.array_equal(law.locate(points), scanned(law).locate(points))


def test_where_neighbors_are_unknown_or_wrong_the_scan_finds_it() -> None:
    law = chain()
    points = around(chain(), 500)
    random = np.random.default_rng(0)
    some = np.where(random.random(law.n_halfspaces) < 0.5, -1, law.neighbors)
    others = random.integers(-1, law.n_regions, law.n_halfspaces)
    for each in (some, others, 0 * others):
        assert np.array_equal(replace(law, neighbors=each)(points), law(points))


@pytest.mark.parametrize("wrong", [[0], [0.5] * 4, [-2, 0, 0, 0], [0, 0, 0, 2]])
def test_neighbors_that_lead_nowhere_are_refused(wrong) -> None:
    with pytest.raises(ValueError, match="neighbors must be 4 whole numbers"):
        PiecewiseAffine(
            np.zeros((2, 1, 1)), np.zeros((2, 1)), [[1.0], [-1.0]] * 2, [0.0, 1.0, 1.0, 0.0],
            [0, 2], [-1], [1], [-1], [1], disjoint=True, neighbors=wrong,
        )  # fmt: skip


def test_they_are_saved_and_copied_and_a_law_may_have_none(tmp_path: Path) -> None:
    law = chain()
    points = around(chain(), 100)
    law.save(tmp_path / "law.npz")
    for other in (PiecewiseAffine.load(tmp_path / "law.npz"), pickle.loads(pickle.dumps(law))):
        assert np.array_equal(other.neighbors, law.neighbors)
        assert np.array_equal(other(points), law(points))
    none = np.empty(0, np.int64)
    replace(law, neighbors=none).save(tmp_path / "old.npz")
    old = PiecewiseAffine.load(tmp_path / "old.npz")
    assert old == law and not old.walks
    assert np.array_equal(old(points), law(points))


def test_regions_that_overlap_go_by_the_largest_slack() -> None:
    """Of twenty intervals that reach into their neighbors each holds what it has the middle of."""
    middles = np.linspace(-0.95, 0.95, 20)
    law = PiecewiseAffine(
        np.zeros((20, 1, 1)), middles[:, None], np.tile([[1.0], [-1.0]], (20, 1)),
        np.column_stack([middles + 0.1, 0.1 - middles]).ravel(), 2 * np.arange(20),
        [-1], [1], [-1], [1],
    )  # fmt: skip
    assert not law.disjoint
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 1))
    nearest = np.abs(points - middles).argmin(axis=1)
    assert np.array_equal(law.locate(points), nearest)


def test_without_a_compiler_the_law_is_the_same(tmp_path: Path) -> None:
    cart().save(tmp_path / "law.npz")
    program = (
        "import sys, numpy as np; from sb3_yann.control import PiecewiseAffine\n"
        "law = PiecewiseAffine.load(sys.argv[1])\n"
        "points = np.random.default_rng(0).uniform(-7.5, 7.5, (200, 2))\n"
        "print(law(points).tobytes().hex(), law(points[0]).tobytes().hex())"
    )
    compiled, plain = (
        run_python(program, tmp_path / "law.npz", NUMBA_DISABLE_JIT=off)[0] for off in "01"
    )
    assert compiled == plain


SEEDS = st.integers(0, 2**32 - 1)


@examples(8)
@given(problems(), SEEDS)
def test_regions_cover_what_is_feasible_and_nothing_else(mpc: LinearMPC, seed: int) -> None:
    law = mpc.explicit()
    online = mpc.online()
    points = in_box(mpc, 15, seed=seed)
    at_edge, ways = edges(law, seed, each=1)
    across = (at_edge + 1e-3 * ways)[:5]
    for theta in np.vstack([points, across[np.all(across <= law.theta_max, axis=1)]]):
        if np.any(theta < law.theta_min):
            continue
        free = room(mpc, theta)
        if abs(free) > 1e-6:  # what is nearer HiGHS does not tell
            assert law.in_domain(theta) == (free > 0)
            assert online.in_domain(theta) == (free > 0)


@examples(8)
@given(problems(), SEEDS)
def test_no_two_regions_overlap(mpc: LinearMPC, seed: int) -> None:
    law = mpc.explicit()
    rng = np.random.default_rng(seed)
    assert np.sum(slacks(law, in_box(mpc, 1000, seed=seed)) > 1e-9, axis=1).max() <= 1
    for region, (center, radius) in enumerate(balls(law)):
        assert radius > 0
        ball = rng.normal(size=(20, law.n_theta))
        ball *= rng.uniform(0, 0.99, (20, 1)) * radius / np.linalg.norm(ball, axis=1)[:, None]
        holders = slacks(law, center + unit_half(law) * ball)
        assert np.all(holders[:, region] > 0)
        assert np.sum(holders > 1e-9, axis=1).max() <= 1


@examples(8)
@given(problems(), SEEDS, st.sampled_from([1e-9, 1e-6, 1e-3]))
def test_law_has_no_jump_in_the_feasible_set(mpc: LinearMPC, seed: int, step: float) -> None:
    law = mpc.explicit()
    at, ways = edges(law, seed)
    one = at - step * ways
    other = at + step * ways
    # The feasible set is convex: from one to the other the input follows the gains on the way.
    for each in kinds(mpc):
        kept = each.in_domain(one) & each.in_domain(other)
        change = as_range(law, each(one) - each(other))[kept]
        assert np.all(change <= 2 * step * steepest(law) + 1e-9)


@examples(8)
@given(problems(), SEEDS)
def test_size_and_order_of_a_batch_change_no_bit(mpc: LinearMPC, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for law, points in (
        (mpc.explicit(), mixture(mpc, seed)),
        (mpc.online(), mixture(mpc, seed)[::5]),
    ):
        whole = law(points)
        order = rng.permutation(len(points))
        anew = pickle.loads(pickle.dumps(law))  # an online law remembers its answers
        np.testing.assert_array_equal(anew(points[order]), whole[order])
        alone = pickle.loads(pickle.dumps(law))
        np.testing.assert_array_equal([alone(each) for each in points[order]], whole[order])
        np.testing.assert_array_equal(law.in_domain(points[order]), law.in_domain(points)[order])


@examples(8)
@given(problems(), st.data(), st.sampled_from([np.float32, np.float64]))
def test_every_number_has_an_input_within_its_bounds(mpc: LinearMPC, data, dtype) -> None:
    width = 8 * np.dtype(dtype).itemsize
    numbers = st.floats(width=width, allow_nan=False, allow_infinity=False)
    rows = st.lists(numbers, min_size=mpc.n_theta, max_size=mpc.n_theta)
    points = np.array(data.draw(st.lists(rows, min_size=1, max_size=6)), dtype)
    for law in kinds(mpc):
        u = law(points)
        assert np.all((law.u_min <= u) & (u <= law.u_max))
        np.testing.assert_array_equal(law(points[0]), u[0])
