"""A PiecewiseAffine law is defined everywhere, bounded, and survives files and copies."""

from __future__ import annotations

import copy
import dataclasses
import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sample_problems import (
    facet_points,
    solved,
    vertices,
)
from sb3_yann._archive import write_arrays
from sb3_yann.control import PiecewiseAffine

PLANAR = ["pendulum", "benchmark", "asymmetric input bounds", "two inputs", "terminal set"]


@cache
def law_of(name: str, infeasible: str = "nearest_region") -> PiecewiseAffine:
    return dataclasses.replace(solved(name).explicit(), infeasible=infeasible)


def far_points(law: PiecewiseAffine, seed: int = 0) -> np.ndarray:
    """Points (count, n) of every size from 1e-6 to 1e6 boxes, and on the axes."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(2000, law.n_theta)) * 10 ** rng.uniform(-6, 6, (2000, 1))
    axes = np.kron([1e6, -1e6, 0.0], np.eye(law.n_theta)).T
    return np.vstack([points, axes]) * (law.theta_max - law.theta_min)


@cache
def special_points(name: str) -> np.ndarray:
    law = law_of(name)
    corners = [vertices(law)] if law.n_theta == 2 else []
    return np.vstack([facet_points(law), *corners])


@pytest.mark.parametrize("name", [*PLANAR, "reactor", "states of 1e-9 and 1e7, inputs of 1e6"])
def test_facets_and_vertices_belong_to_the_domain(name: str) -> None:
    points = special_points(name)
    assert len(points) > 10
    assert law_of(name).in_domain(points).all()


@pytest.mark.parametrize("infeasible", ["nearest_region", "zero_input"])
@pytest.mark.parametrize("name", [*PLANAR, "reactor"])
def test_every_facet_and_vertex_has_exactly_the_input_of_its_one_region(
    name: str, infeasible: str
) -> None:
    law, points = law_of(name, infeasible), special_points(name)
    region = law.locate(points)
    for point, i, u in zip(points, region, law(points), strict=True):
        one = np.clip(law.gains[i] @ point + law.offsets[i], law.u_min, law.u_max)
        np.testing.assert_allclose(u, one, rtol=0, atol=1e-14 * np.max(law.u_max))


@pytest.mark.parametrize("batch", [(), (5,), (0,)])
def test_shapes_follow_those_of_theta(batch: tuple[int, ...]) -> None:
    law, theta = law_of("two inputs"), np.zeros((*batch, 2))
    assert law(theta).shape == (*batch, 2)
    assert np.shape(law.locate(theta)) == np.shape(law.in_domain(theta)) == batch


def test_nearest_is_the_clipped_law_of_the_region_violated_least() -> None:
    law = law_of("benchmark")
    points = far_points(law)
    infeasible = points[~law.in_domain(points)]
    assert len(infeasible) > 100
    i = law.locate(infeasible)
    affine = np.einsum("bmn,bn->bm", law.gains[i], infeasible) + law.offsets[i]
    np.testing.assert_array_equal(law(infeasible), np.clip(affine, -1, 1))


@pytest.mark.parametrize(
    ("name", "value"), [("asymmetric input bounds", 0.0), ("zero input not allowed", 0.2)]
)
def test_zero_is_no_input_outside_or_the_bound_nearest_to_it(name: str, value: float) -> None:
    law = law_of(name, "zero_input")
    points = far_points(law)
    infeasible = points[~law.in_domain(points)]
    assert len(infeasible) > 100
    np.testing.assert_array_equal(law(infeasible), value)


def test_saved_file_holds_plain_arrays(tmp_path: Path) -> None:
    law = law_of("pendulum")
    law.save(tmp_path / "law.npz")
    with np.load(tmp_path / "law.npz", allow_pickle=False) as data:
        names = {name for name in data if not name.startswith(("model_", "theta_ss"))}
        assert names == {field.name for field in dataclasses.fields(law)} | {"digest"}
        assert all(data[name].dtype != object for name in data)


def arrays_with(**changes: Any) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        law = law_of("pendulum")
        values = {field.name: getattr(law, field.name) for field in dataclasses.fields(law)}
        write_arrays(path, {**values, **changes})

    return write


GARBAGE: dict[str, Callable[[Path], Any]] = {
    "text": lambda path: path.write_text("garbage"),
    "another archive": lambda path: np.savez(path.open("wb"), gains=np.eye(2)),
    "NaN": arrays_with(offsets=np.full((7, 1), np.nan)),
    "words": arrays_with(b=np.full(32, "one")),
    "gains of another shape": arrays_with(gains=np.zeros((7, 2))),
    "rows that do not exist": arrays_with(starts=np.arange(7) + 100),
    "rows out of order": arrays_with(starts=np.array([0, 4, 2, 8, 12, 16, 20])),
    "no region": arrays_with(gains=np.zeros((0, 1, 2)), offsets=np.zeros((0, 1)), starts=[]),
    "crossed bounds": arrays_with(u_min=np.array([3.0])),
    "an unknown option": arrays_with(infeasible="mean"),
}


@pytest.mark.parametrize("content", GARBAGE)
@pytest.mark.filterwarnings("ignore:unclosed file")  # the writer of "another archive"
def test_file_that_holds_no_law_is_a_value_error(content: str, tmp_path: Path) -> None:
    path = tmp_path / "law.npz"
    GARBAGE[content](path)
    with pytest.raises(
        ValueError, match=r"(?s)law\.npz does not hold a PiecewiseAffine .*law\.save"
    ):
        PiecewiseAffine.load(path)


COPIES = [copy.copy, copy.deepcopy, lambda law: pickle.loads(pickle.dumps(law))]


@pytest.mark.parametrize("copied", [lambda law: law, *COPIES])
@pytest.mark.parametrize("name", ["gains", "starts", "theta_max"])
def test_arrays_are_read_only_in_every_copy(name: str, copied: Any) -> None:
    array = getattr(copied(law_of("pendulum")), name)
    with pytest.raises(ValueError, match="read-only"):
        array[...] = 0


@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(PiecewiseAffine) if f.compare])
def test_laws_that_differ_in_one_field_are_not_equal(name: str) -> None:
    law = law_of("pendulum")
    value = {"infeasible": "zero_input", "disjoint": False}.get(name)
    if value is None:
        value = getattr(law, name) + 0
        value.flat[-1] += 1 if name == "starts" else 1e-3
    assert dataclasses.replace(law, **{name: value}) != law


BAD_THETA: list[tuple[Any, type[Exception], str]] = [
    ([1.0], ValueError, r"theta has shape \(1,\), expected \(2,\) or \(batch, 2\)"),
    (1.0, ValueError, r"theta has shape \(\), expected \(2,\)"),
    (np.zeros((2, 2, 2)), ValueError, r"theta has shape \(2, 2, 2\), expected"),
    ([np.nan, 0], ValueError, "theta holds NaN or infinite"),
    ([[0, 0], [np.inf, 0]], ValueError, "theta holds NaN or infinite"),
    (["a", "b"], TypeError, "theta = .* is not an array of real numbers"),
    (np.array([1j, 0]), TypeError, "theta = .* is not an array of real numbers"),
    (np.ma.array([1.0, 0.0], mask=[1, 0]), ValueError, "theta has masked entries"),
]


@pytest.mark.parametrize(("theta", "error", "message"), BAD_THETA)
def test_theta_that_is_no_point_or_batch_is_named(
    theta: Any, error: type[Exception], message: str
) -> None:
    for call in ("__call__", "locate", "in_domain"):
        with pytest.raises(error, match=message):
            getattr(law_of("pendulum"), call)(theta)
