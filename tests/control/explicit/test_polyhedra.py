"""Polyhedra are the same whatever the lengths of their rows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

from sb3_yann.control._kernels import polyhedra as _kernels
from sb3_yann.control.polyhedra import (
    bounded_region,
    farthest_point,
    farthest_points,
    largest_ball,
)

"""x, y >= 0 and 3 x + 4 y <= 12: corners at (0, 0), (4, 0) and (0, 3); the inner circle has 1."""


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
        for inside in (middle, middle + 9.0):
            found = farthest_point(A, b, direction, inside)
            assert direction @ found == pytest.approx(top, rel=1e-6)
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


@pytest.mark.usefixtures("search")
def test_an_empty_polyhedron_has_no_radius() -> None:
    A = np.vstack([np.eye(2), -np.eye(2)])
    _, radius = largest_ball(A, np.array([1.0, -2.0, 1.0, 1.0]))
    assert radius == pytest.approx(-0.5)
