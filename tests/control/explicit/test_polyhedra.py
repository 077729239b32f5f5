"""Polyhedra are the same whatever the lengths of their rows."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann.control.polyhedra import facets, farthest_point, farthest_points, largest_ball

TRIANGLE = np.array([[-1.0, 0.0], [0.0, -1.0], [0.6, 0.8]])
ROOM = np.array([0.0, 0.0, 2.4])
"""x, y >= 0 and 3 x + 4 y <= 12: corners at (0, 0), (4, 0) and (0, 3); the inner circle has 1."""
LENGTHS = np.array([[1.0, 1.0, 1.0], [5.0, 1e-3, 40.0]])


def test_the_largest_ball_of_a_triangle_of_3_4_and_5() -> None:
    center, radius = largest_ball(TRIANGLE, ROOM)
    assert center == pytest.approx([1, 1]) and radius == pytest.approx(1)
    middle, half = largest_ball(TRIANGLE, ROOM, facet=0)
    assert middle[0] == pytest.approx(0) and 0 < half <= 1.5


@pytest.mark.parametrize("lengths", LENGTHS)
@pytest.mark.parametrize(
    ("direction", "corner"), [([1, 0], [4, 0]), ([0, 1], [0, 3]), ([-1, -1], [0, 0])]
)
def test_the_farthest_point_is_a_corner(lengths, direction, corner) -> None:
    A, b = lengths[:, None] * TRIANGLE, lengths * ROOM
    for inside in (None, np.array([0.5, 0.5])):
        assert farthest_point(A, b, np.array(direction), inside) == pytest.approx(corner)
    both = farthest_points(A, b, np.array([0.5, 0.5]), np.array([direction, direction], float))
    assert both == pytest.approx(np.array([corner, corner]))


def test_rows_that_do_not_touch_are_no_facets() -> None:
    A = np.vstack([TRIANGLE, [[1.0, 0.0]]])
    for room, expected in ((5.0, [0, 1, 2]), (3.0, [0, 1, 2, 3])):
        assert facets(A, np.append(ROOM, room), np.ones(2), 1.0).tolist() == expected
