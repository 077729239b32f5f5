"""Balls, facets and vertices of polyhedra ``A x <= b`` with rows of unit length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from sb3_yann._validation import Array

# DAQP stops up to 1e-6 from the largest ball: smaller balls need tighter settings.
THIN = 1e-5
# In polyhedra with a smaller ball DAQP's own search for redundant rows loses facets.
SLIM = 1e-4


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
    """

    active_set: tuple[int, ...]
    gain: Array
    offset: Array
    A: Array
    b: Array
    inside: Array | None = None

    def ball(self) -> tuple[Array, float]:
        """Return the center of a large ball inside, and its radius, negative if there is none."""
        if self.inside is not None:
            radius = float(np.min(self.b - self.A @ self.inside))
            if radius > 0:
                return self.inside, radius
        return largest_ball(self.A, self.b)


def largest_ball(A: Array, b: Array, facet: int | None = None) -> tuple[Array, float]:
    """Return center and radius (negative: none) of a bounded polyhedron or facet's largest ball."""
    rows = np.empty((len(b), A.shape[1] + 1))
    rows[:, :-1], rows[:, -1] = A, 1.0
    if facet is not None:
        rows[facet, -1] = 0.0
    cost = np.zeros(rows.shape[1])
    cost[-1] = -1.0
    point = _minimize(cost, rows, b, facet)
    if abs(point[-1]) < THIN:
        point = _minimize(cost, rows, b, facet, eta_prox=1e-14, iter_limit=1000)
    return point[:-1], float(point[-1])


def farthest_point(A: Array, b: Array, direction: Array) -> Array:
    """Return the point of a bounded polyhedron that is farthest in one direction."""
    return _minimize(-np.asarray(direction, dtype=float), A, b, None)


def _minimize(cost: Array, A: Array, b: Array, equal: int | None, **settings: float) -> Array:
    """Return the solution of a small linear program from DAQP, or where that fails from HiGHS."""
    import daqp

    sense = np.zeros(len(b), dtype=np.intc)
    if equal is not None:
        sense[equal] = 5
    # Proximal steps make it a linear program; DAQP ends them at the exact vertex.
    point, _, status, _ = daqp.solve(
        None, cost, A, b, None, sense, primal_tol=1e-12, eps_prox=1e-2, **settings
    )
    if status == 1:
        return np.asarray(point)
    tied = np.arange(len(b)) == equal
    free, equal_rows = (A[~tied], b[~tied]), (A[tied], b[tied])
    found = optimize.linprog(cost, *free, *equal_rows, bounds=(None, None))
    if found.x is None:  # an empty facet
        return np.append(np.zeros(len(cost) - 1), -np.inf)
    return np.asarray(found.x)


def facets(A: Array, b: Array, inside: Array, radius: float) -> NDArray[np.intp]:
    """Return the rows that bound a polyhedron with a ball of this radius about a point inside.

    Rows that only touch it may be among them, and duplicate rows are all kept.

    Parameters
    ----------
    A, b, inside, radius : ndarray, shapes (q, n), (q,) and (n,), and float
        The polyhedron, bounded, and the center and radius of the ball.
    """
    slack = b - A @ inside
    if radius < SLIM:
        if np.min(slack) < 0.5 * radius:
            return _facets_one_by_one(A, slack, radius)
        A, slack, radius = _rounded(A, slack)
    import daqp

    # DAQP's tolerance is absolute: in units of the radius it suits small and large polyhedra.
    return np.flatnonzero(daqp.minrep(np.ascontiguousarray(A), slack / radius) != 1)


def _rounded(A: Array, slack: Array) -> tuple[Array, Array, float]:
    """Return a thin polyhedron ``A z <= slack`` with Dikin's ellipsoid as unit ball, and 1."""
    scaled = A / slack[:, None]
    L = np.linalg.cholesky(scaled.T @ scaled)
    rows = np.linalg.solve(L, A.T).T
    length = np.linalg.norm(rows, axis=1)
    return rows / length[:, None], slack / length, 1.0


def _facets_one_by_one(A: Array, b: Array, radius: float) -> NDArray[np.intp]:
    """Return the rows without which the polyhedron would be larger."""
    bounding = []
    for k in range(len(b)):
        relaxed = b.copy()
        relaxed[k] += radius
        farthest = _minimize(-A[k], A, relaxed, None, eta_prox=1e-14, iter_limit=1000)
        if A[k] @ farthest > b[k] - max(1e-6 * radius, 1e-13):
            bounding.append(k)
    return np.array(bounding, dtype=np.intp)
