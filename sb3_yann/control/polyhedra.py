"""Balls, facets and farthest points of polyhedra ``A x <= b`` with rows of unit length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from sb3_yann._validation import Array


@dataclass(frozen=True, eq=False)
class Region:
    """Where ``A theta <= b``, rows of unit length, ``U = law [theta; 1]`` (v, n + 1) is optimal.

    The rows of ``active_set`` hold with equality, in ascending order. ``inside`` is a point well
    inside, if known. ``across`` are the active sets beyond each row, None where none is known.
    """

    active_set: tuple[int, ...]
    law: Array
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


def largest_ball(A: Array, b: Array, facet: int = -1) -> tuple[Array, float]:
    """Return center and radius (negative: none) of a bounded polyhedron or facet's largest ball."""
    from sb3_yann.control._kernels import polyhedra as kernels

    found: Array = np.empty(A.shape[1] + 1)
    no_facets = np.empty(0, dtype=np.int64)
    done = kernels.bounded_region(*_contiguous(A, b), facet, np.inf, found, no_facets)
    if done != kernels.OPTIMAL:
        rows = np.column_stack([A, np.arange(len(b)) != facet])
        found = _solve_lp(np.append(np.zeros(A.shape[1]), 1.0), rows, b, facet)
    return found[:-1], float(found[-1])


def farthest_points(
    A: Array, b: Array, inside: Array, directions: Array, seconds: float | None = None
) -> Array:
    """Return the points (k, n) of a bounded polyhedron that are farthest in directions (k, n).

    ``inside`` (n,) is a point of it. Of a large polyhedron HiGHS is asked, which gives up after so
    many seconds for each, and returns any point.
    """
    from sb3_yann.control._kernels import polyhedra as kernels

    found = np.empty_like(directions)
    rows = _contiguous(A, b)
    along = np.ascontiguousarray(directions)
    if seconds is not None or kernels.support(*rows, inside, along, found) != kernels.OPTIMAL:
        found = np.array([_solve_lp(each, A, b, seconds=seconds) for each in along])
    return found


def bounded_region(
    A: Array, b: Array, thinnest: float
) -> tuple[Array, float, NDArray[np.intp], bool]:
    """Return a point inside a bounded polyhedron, its largest ball's radius, and its facets.

    Last comes whether some of these are equal: all of those are kept. Where the radius is at most
    ``thinnest`` no facets are looked for.
    """
    from sb3_yann.control._kernels import polyhedra as kernels

    found = np.empty(A.shape[1] + 1)
    kept = np.ones(len(b), dtype=np.int64)
    done = kernels.bounded_region(*_contiguous(A, b), -1, thinnest, found, kept)
    if done == kernels.OPTIMAL:
        return found[:-1], float(found[-1]), np.flatnonzero(kept), bool(np.max(kept) > 1)
    inside, radius = largest_ball(A, b)
    bounding = []
    slack = b - A @ inside
    for k in range(len(b)) if radius > thinnest else ():
        # Without a facet the polyhedron would be larger.
        relaxed = slack.copy()
        relaxed[k] += radius
        if A[k] @ _solve_lp(A[k], A, relaxed) > slack[k] + max(1e-6 * radius, 1e-13):
            bounding.append(k)
    return inside, radius, np.array(bounding, dtype=np.intp), True


def equal_rows(A: Array, slack: Array, radius: float) -> NDArray[np.bool_]:
    """Tell which half-spaces of a polyhedron of this radius are equal (q, q).

    ``slack`` (q,) is their distance from a point inside.
    """
    from sb3_yann.control._kernels.polyhedra import SAME, SLACK_ROUNDING

    near = np.abs(slack[:, None] - slack) <= SAME * radius + SLACK_ROUNDING
    # Most pairs differ in their distance.
    first, second = np.nonzero(near)
    near[first, second] = np.abs(A[first] - A[second]).max(axis=1) <= SAME
    return np.asarray(near)


def _contiguous(A: Array, b: Array) -> tuple[Array, Array]:
    return np.ascontiguousarray(A, dtype=float), np.ascontiguousarray(b, dtype=float)


def _solve_lp(
    cost: Array, A: Array, b: Array, equal: int = -1, seconds: float | None = None
) -> Array:
    """Return the largest ``cost x`` by HiGHS, for large programs and where our own search fails."""
    tied = np.arange(len(b)) == equal
    options = {}
    if seconds is not None:
        options = {"time_limit": seconds}
        options |= {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    found = optimize.linprog(
        -np.asarray(cost),
        A_ub=A[~tied],
        b_ub=b[~tied],
        A_eq=A[tied],
        b_eq=b[tied],
        bounds=(None, None),
        options=options,
    )
    if found.x is not None:
        return np.asarray(found.x)
    if seconds is not None:
        return np.zeros(len(cost))
    return np.append(np.zeros(len(cost) - 1), -np.inf)  # an empty facet
