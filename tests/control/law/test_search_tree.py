"""The tree finds the region that a scan of all regions finds, and only that changes its speed."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from partitions import edges
from sb3_yann._archive import read_arrays, write_arrays
from sb3_yann.control import LinearModel, LinearMPC, PiecewiseAffine
from sb3_yann.control._kernels.law import locate_batch
from sb3_yann.control.search_tree import build_tree


@cache
def many_regions(infeasible: str = "nearest_region") -> PiecewiseAffine:
    """The law of a cart with 125 regions, part of whose box has no solution."""
    model = LinearModel([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], 0.1)
    return LinearMPC(
        model, Q=np.eye(2), R=[[0.03]], horizon=6,
        x_min=[-5, -2], x_max=[5, 2], u_min=-1, u_max=1, infeasible=infeasible,
    ).explicit()  # fmt: skip


@cache
def two_masses() -> PiecewiseAffine:
    """The law of two masses on springs: 4 parameters, 2 inputs, and regions that are long.

    Its neighbors are left out: with them it has no tree.
    """
    springs = np.array([[-2.0, 1.0], [1.0, -2.0]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [springs, -0.1 * np.eye(2)]])
    B = np.vstack([np.zeros((2, 2)), np.eye(2)])
    law = LinearMPC(
        LinearModel.from_continuous(A, B, 0.5), Q=np.eye(4), R=np.eye(2), horizon=2,
        theta_min=[-8] * 4, theta_max=[8] * 4, u_min=[-1, -1], u_max=[1, 1],
    ).explicit()  # fmt: skip
    return replace(law, neighbors=np.empty(0, np.int64))


LAWS = pytest.mark.parametrize("make", [many_regions, two_masses])


def scanned(law: PiecewiseAffine, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    region, inside = np.empty(len(points), np.int64), np.empty(len(points))
    law = replace(law, neighbors=np.empty(0, np.int64))
    law.__dict__["tree"] = None
    locate_batch(*law.packed, np.ascontiguousarray(points), region, inside)
    return region, inside


def in_box(law: PiecewiseAffine, count: int, stretch: float = 1.0) -> np.ndarray:
    drawn = np.random.default_rng(0).uniform(-stretch, stretch, (count, law.n_theta))
    return drawn * (law.theta_max - law.theta_min) / 2 + (law.theta_max + law.theta_min) / 2


@LAWS
def test_laws_of_many_regions_have_a_tree_with_small_leaves(make) -> None:
    law = make()
    assert law.n_regions > 16
    assert law.tree is not None
    assert np.diff(law.tree.leaf_starts).max() < law.n_regions / 3
    depth = np.zeros(len(law.tree.children), dtype=int)
    for node, children in enumerate(law.tree.children):  # children come after their parents
        depth[children[children > 0]] = depth[node] + 1
    assert depth.max() + 1 < 3 * np.log2(law.n_regions)


@LAWS
@pytest.mark.parametrize("stretch", [1.0, 3.0])
def test_the_tree_finds_the_region_of_a_scan_inside_and_outside(make, stretch: float) -> None:
    law = make()
    points = in_box(law, 20_000, stretch)
    regions, inside = scanned(law, points)
    assert np.any(inside < 0) == (stretch > 1 or make is many_regions)
    found = law.locate(points)
    assert np.array_equal(found, regions)
    assert np.array_equal(law.in_domain(points), inside >= -law.tolerance)


@LAWS
def test_the_tree_finds_the_region_of_a_scan_on_facets(make) -> None:
    law = make()
    points, _ = edges(law, seed=0)
    assert np.array_equal(law.locate(points), scanned(law, points)[0])


def test_regions_that_overlap_go_by_the_largest_slack() -> None:
    """Of twenty intervals that reach into their neighbors each holds what it has the middle of."""
    middles = np.linspace(-0.95, 0.95, 20)
    law = PiecewiseAffine(
        np.zeros((20, 1, 1)), middles[:, None], np.tile([[1.0], [-1.0]], (20, 1)),
        np.column_stack([middles + 0.1, 0.1 - middles]).ravel(), 2 * np.arange(20),
        [-1], [1], [-1], [1],
    )  # fmt: skip
    assert law.tree is not None and not law.disjoint
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 1))
    nearest = np.abs(points - middles).argmin(axis=1)
    assert np.array_equal(law.locate(points), nearest)


def test_a_law_always_gets_the_same_tree() -> None:
    law = two_masses()
    again = build_tree(law.A, law.b, law.starts, law.theta_min, law.theta_max)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(vars(law.tree).values(), vars(again).values(), strict=True)
    )


def test_a_tree_is_saved_with_its_law_and_copied_with_it(tmp_path: Path, monkeypatch) -> None:
    law = many_regions()
    replace(law).save(tmp_path / "law.npz")  # one that has never been called
    copy = pickle.loads(pickle.dumps(replace(law)))
    law(np.zeros(law.n_theta))
    monkeypatch.setattr("sb3_yann.control.search_tree.build_tree", None)  # not built anew
    points = in_box(law, 100)
    for other in (PiecewiseAffine.load(tmp_path / "law.npz"), copy):
        assert other == law
        assert np.array_equal(other(points), law(points))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("tree_children", 10**6),
        ("tree_children", 0),
        ("tree_children", -(10**6)),
        ("tree_leaf_regions", 125),
        ("tree_leaf_starts", -1),
    ],
)
def test_a_file_with_a_tree_that_leads_nowhere_is_refused(tmp_path: Path, name, value) -> None:
    many_regions().save(tmp_path / "law.npz")
    arrays = read_arrays(tmp_path / "law.npz")
    arrays[name].flat[0] = value
    write_arrays(tmp_path / "law.npz", arrays)
    with pytest.raises(ValueError, match="search tree does not fit 125 regions"):
        PiecewiseAffine.load(tmp_path / "law.npz")


def test_a_law_that_no_hyperplane_parts_has_no_tree_and_is_saved_all_the_same(tmp_path) -> None:
    box = np.vstack([np.eye(2), -np.eye(2)])
    law = PiecewiseAffine(
        np.zeros((17, 1, 2)), np.zeros((17, 1)), np.tile(box, (17, 1)), np.ones(68),
        np.arange(17) * 4, [-1], [1], [-1, -1], [1, 1],
    )  # fmt: skip
    assert law.tree is None
    law.save(tmp_path / "law.npz")
    assert PiecewiseAffine.load(tmp_path / "law.npz") == law


def test_an_input_stays_within_its_bounds_where_numbers_overflow() -> None:
    law = PiecewiseAffine(
        [[[1e10, -1e10]]], [[0.0]], [[1.0, 0.0]], [1.0], [0], [-1], [1], [-1, -1], [1, 1]
    )
    assert law([1e300, 1e300]).tolist() == [0.0]


def test_overlapping_regions_tie_alike_in_a_tree_and_in_a_scan() -> None:
    law = many_regions()
    ends = np.append(law.starts, law.n_halfspaces)
    rows = np.concatenate([np.arange(ends[i], ends[i + 1]) for i in range(125) for _ in range(2)])
    counts = np.repeat(np.diff(ends), 2)
    twice = PiecewiseAffine(
        np.repeat(law.gains, 2, axis=0), np.repeat(law.offsets, 2, axis=0), law.A[rows],
        law.b[rows], np.append(0, np.cumsum(counts)[:-1]), law.u_min, law.u_max,
        law.theta_min, law.theta_max,
    )  # fmt: skip
    points = in_box(law, 2000)
    assert np.array_equal(twice.locate(points), scanned(twice, points)[0])
    assert np.array_equal(twice.locate(points), 2 * law.locate(points))


@pytest.mark.parametrize(
    "given",
    [
        [0.5, 0.1],
        (0.5, 0.1),
        np.array([0.5, 0.0, 0.1])[::2],
        np.array([0, 0]),
    ],
)
def test_theta_may_come_in_any_array_or_list(given) -> None:
    law = many_regions()
    expected = law(np.ascontiguousarray(given, dtype=float))
    frozen = np.array(given, dtype=float)
    frozen.setflags(write=False)
    assert np.array_equal(law(given), expected)
    assert np.array_equal(law(frozen), expected)
    assert np.array_equal(law(np.array([given, given], dtype=float))[1], expected)


@pytest.mark.parametrize("given", [[np.nan, 0.0], [0.0, np.inf], [0.0], [0.0] * 3, 0.0])
def test_theta_that_is_none_is_refused_also_where_compiled_code_sees_it_first(given) -> None:
    with pytest.raises(ValueError, match="theta"):
        many_regions()(np.array(given))


@pytest.mark.slow
def test_without_a_compiler_the_law_is_the_same() -> None:
    program = (
        "from test_search_tree import *; law = many_regions(); points = in_box(law, 200, 1.5)\n"
        "print(law(points).tobytes().hex(), law(points[0]).tobytes().hex())"
    )
    here = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    outputs = [
        subprocess.run(
            [sys.executable, "-c", program], env={**here, "NUMBA_DISABLE_JIT": off},
            capture_output=True, text=True, check=True, cwd=Path(__file__).parent,
        ).stdout
        for off in "01"
    ]  # fmt: skip
    assert outputs[0] == outputs[1]
