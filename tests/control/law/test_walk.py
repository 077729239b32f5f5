"""A walk along a line finds the region that a scan of all regions finds; it needs no tree."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from partitions import edges
from sb3_yann.control import LinearModel, LinearMPC, PiecewiseAffine
from sb3_yann.control._kernels.law import walk_to

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


def scanned(law: PiecewiseAffine) -> PiecewiseAffine:
    law = replace(law, neighbors=UNKNOWN)
    law.__dict__["tree"] = None
    return law


def in_box(law: PiecewiseAffine, count: int, stretch: float = 1.0) -> np.ndarray:
    return np.random.default_rng(0).uniform(-4 * stretch, 4 * stretch, (count, law.n_theta))


@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("stretch", [1.0, 3.0])
def test_it_finds_the_region_of_a_scan_inside_and_outside(bounded: bool, stretch: float) -> None:
    law, points = chain(bounded), in_box(chain(), 5000, stretch)
    assert law.tree is None and law.n_regions > 50
    for name in ("locate", "in_domain", "__call__"):
        found, expected = getattr(law, name)(points), getattr(scanned(law), name)(points)
        assert np.array_equal(found, expected)
    if stretch == 1:
        assert law.in_domain(points).all() != bounded


def test_it_finds_the_region_of_a_scan_on_facets() -> None:
    law = chain()
    points, _ = edges(law, seed=0)
    assert np.array_equal(law.locate(points), scanned(law).locate(points))


def test_no_point_is_left_to_a_scan() -> None:
    law = chain()
    points = in_box(law, 2000)
    found = [walk_to(*law.packed, points, i) for i in range(len(points))]
    assert np.array_equal(found, law.locate(points))


def test_neighbors_share_the_facet_between_them() -> None:
    law = chain()
    owner = np.repeat(np.arange(law.n_regions), np.diff([*law.starts, law.n_halfspaces]))
    assert np.mean(law.neighbors >= 0) > 0.5
    for row in np.flatnonzero(law.neighbors >= 0):
        other = owner == law.neighbors[row]
        same = np.abs(law.A[other] + law.A[row]).max(axis=1) + np.abs(law.b[other] + law.b[row])
        assert same.min() < 1e-9


def test_where_neighbors_are_unknown_or_wrong_the_scan_finds_it() -> None:
    law, points = chain(), in_box(chain(), 500)
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
    law, points = chain(), in_box(chain(), 100)
    law.save(tmp_path / "law.npz")
    for other in (PiecewiseAffine.load(tmp_path / "law.npz"), pickle.loads(pickle.dumps(law))):
        assert np.array_equal(other.neighbors, law.neighbors)
        assert np.array_equal(other(points), law(points))
    none = np.empty(0, np.int64)
    replace(law, neighbors=none).save(tmp_path / "old.npz")
    old = PiecewiseAffine.load(tmp_path / "old.npz")
    assert old == law and old.neighbors.size == 0 and old.tree is not None
    assert np.array_equal(old(points), law(points))
