"""Balls, facets and vertices of polyhedra ``A x <= b`` with rows of unit length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from sb3_yann._validation import Array


@dataclass(frozen=True, eq=False)
class Region:
    """Where ``A theta <= b``, rows of unit length, ``U = gain theta + offset`` is optimal.

    Attributes
    ----------
    active_set : tuple of int
        The rows of the program that hold with equality, in ascending order.
    gain, offset, A, b : ndarray, shapes (v, n), (v,), (q, n) and (q,)
    inside : ndarray, shape (n,), optional
        A point well inside, if known.
    across : tuple, optional
        The active set beyond each row, None where there is none, or none is known.
    """

    active_set: tuple[int, ...]
    gain: Array
    offset: Array
    A: Array
    b: Array
    inside: Array | None = None
    across: tuple[tuple[int, ...] | None, ...] = ()

    def ball(self) -> tuple[Array, float]:
        """Return the center of a large ball inside, and its radius, negative if there is none."""
        if self.inside is not None:
            radius = float(np.min(self.b - self.A @ self.inside))
            if radius > 0:
                return self.inside, radius
        return largest_ball(self.A, self.b)


def largest_ball(A: Array, b: Array, facet: int | None = None) -> tuple[Array, float]:
    """Return center and radius (negative: none) of a bounded polyhedron or facet's largest ball."""
    from sb3_yann.control import _kernels

    found: Array = np.empty(A.shape[1] + 1)
    which, none = -1 if facet is None else facet, np.empty(0, dtype=np.int64)
    done = _kernels.region(*_plain(A, b), which, np.inf, found, none)
    if done != _kernels.OPTIMAL:
        rows, cost = np.column_stack([A, np.ones(len(b))]), np.append(np.zeros(A.shape[1]), 1.0)
        if facet is not None:
            rows[facet, -1] = 0.0
        found = _maximize(cost, rows, b, facet)
    return found[:-1], float(found[-1])


def farthest_point(
    A: Array,
    b: Array,
    direction: Array,
    inside: Array | None = None,
    seconds: float | None = None,
) -> Array:
    """Return the point (n,) of a bounded polyhedron that is farthest in one direction.

    Parameters
    ----------
    A, b, direction : ndarray, shapes (q, n), (q,) and (n,)
        The polyhedron, and where to.
    inside : ndarray, shape (n,), optional
        A point of it, with which it is found faster.
    seconds : float, optional
        Of a large polyhedron: HiGHS is asked, which gives up after so long, and returns any point.
    """
    if seconds is not None:
        return _maximize(np.asarray(direction, dtype=float), A, b, None, seconds)
    cost = np.array(direction, dtype=float)
    start = largest_ball(*_unit_rows(A, b))[0] if inside is None else inside
    if np.all(A @ start <= b):
        return np.asarray(farthest_points(A, b, start, cost[None])[0])
    return _maximize(cost, A, b, None)


def farthest_points(A: Array, b: Array, inside: Array, directions: Array) -> Array:
    """Return the points (k, n) of a bounded polyhedron that are farthest in each direction.

    Parameters
    ----------
    A, b, inside, directions : ndarray, shapes (q, n), (q,), (n,) and (k, n)
        The polyhedron, a point of it, and where to.
    """
    from sb3_yann.control import _kernels

    found, rows = np.empty_like(directions), _plain(A, b)
    if _kernels.support(*rows, inside, np.ascontiguousarray(directions), found) != _kernels.OPTIMAL:
        found = np.array([_maximize(each, A, b, None) for each in directions])
    return found


def facets(A: Array, b: Array, inside: Array, radius: float) -> NDArray[np.intp]:
    """Return the rows that bound a polyhedron with a ball of this radius about a point inside.

    Rows that only touch it may be among them, and duplicate rows are all kept.

    Parameters
    ----------
    A, b, inside, radius : ndarray, shapes (q, n), (q,) and (n,), and float
        The polyhedron, bounded, and the center and radius of the ball.
    """
    from sb3_yann.control import _kernels

    found, kept = np.empty(A.shape[1] + 1), np.ones(len(b), dtype=np.int64)
    if _kernels.region(*_plain(A, b), -1, 0.0, found, kept) == _kernels.OPTIMAL:
        return np.flatnonzero(kept)
    return _facets_one_by_one(A, b - A @ inside, radius)


def region(A: Array, b: Array, thinnest: float) -> tuple[Array, float, NDArray[np.intp], bool]:
    """Return a point inside a bounded polyhedron, its largest ball's radius, and its facets.

    Last comes whether some of these are equal. Where the radius is at most ``thinnest`` no facets
    are looked for.
    """
    from sb3_yann.control import _kernels

    found, kept = np.empty(A.shape[1] + 1), np.ones(len(b), dtype=np.int64)
    if _kernels.region(*_plain(A, b), -1, thinnest, found, kept) == _kernels.OPTIMAL:
        return found[:-1], float(found[-1]), np.flatnonzero(kept), bool(np.max(kept) > 1)
    inside, radius = largest_ball(A, b)
    return inside, radius, facets(A, b, inside, radius) if radius > thinnest else np.arange(0), True


def equal_rows(A: Array, slack: Array, radius: float) -> NDArray[np.bool_]:
    """Tell which half-spaces of a polyhedron of this radius are equal (q, q).

    ``slack`` (q,) is their distance from a point inside.
    """
    from sb3_yann.control._kernels import NOISE, SAME

    near = np.abs(slack[:, None] - slack) <= SAME * radius + NOISE
    # Seldom any: most pairs are told apart by their distance.
    first, second = np.nonzero(near)
    near[first, second] = np.abs(A[first] - A[second]).max(axis=1) <= SAME
    return np.asarray(near)


def _plain(A: Array, b: Array) -> tuple[Array, Array]:
    """Return arrays as the compiled functions take them."""
    return np.ascontiguousarray(A, dtype=float), np.ascontiguousarray(b, dtype=float)


def _unit_rows(A: Array, b: Array) -> tuple[Array, Array]:
    length = np.linalg.norm(A, axis=1)
    length[length == 0] = 1.0
    return A / length[:, None], b / length


def _maximize(
    cost: Array, A: Array, b: Array, equal: int | None, seconds: float | None = None
) -> Array:
    """Return the solution of a small linear program from HiGHS, for where our own search fails."""
    tied = np.arange(len(b)) == equal
    free, equal_rows = (A[~tied], b[~tied]), (A[tied], b[tied])
    options = (
        {}
        if seconds is None
        else {
            "time_limit": seconds,
            "primal_feasibility_tolerance": 1e-10,
            "dual_feasibility_tolerance": 1e-10,
        }
    )
    found = optimize.linprog(-cost, *free, *equal_rows, bounds=(None, None), options=options)
    if found.x is None and seconds is not None:
        return np.zeros(len(cost))
    if found.x is None:  # an empty facet
        return np.append(np.zeros(len(cost) - 1), -np.inf)
    return np.asarray(found.x)


def _facets_one_by_one(A: Array, b: Array, radius: float) -> NDArray[np.intp]:
    """Return the rows without which the polyhedron would be larger."""
    bounding = []
    for k in range(len(b)):
        relaxed = b.copy()
        relaxed[k] += radius
        if A[k] @ _maximize(A[k], A, relaxed, None) > b[k] + max(1e-6 * radius, 1e-13):
            bounding.append(k)
    return np.array(bounding, dtype=np.intp)
