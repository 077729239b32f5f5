"""A tree of hyperplanes that finds the region of a point without asking every region.

After Tøndel, Johansen & Bemporad (2003), "Evaluation of piecewise affine control via binary search
tree", with vertices in place of their linear programs, and leaves of a few regions each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import HalfspaceIntersection, QhullError

from sb3_yann._numba import Integers, compiled
from sb3_yann._validation import Array
from sb3_yann.control.polyhedra import largest_ball

OVERLAP = 1e-8
"""A region that passes a hyperplane by less, in half-widths of the box, is not on its far side."""


@dataclass(frozen=True, eq=False)
class SearchTree:
    """Where ``normals[k] theta <= levels[k]`` go on with ``children[k, 0]``, else with the other.

    A child of -1 - j is leaf j, which lists every region that has an interior there.

    Attributes
    ----------
    normals : ndarray, shape (nodes, n)
    levels : ndarray, shape (nodes,)
    children : ndarray of int, shape (nodes, 2)
    leaf_starts : ndarray of int, shape (leaves + 1,)
        Where each leaf begins in ``leaf_regions``.
    leaf_regions : ndarray of int
    """

    normals: Array
    levels: Array
    children: Integers
    leaf_starts: Integers
    leaf_regions: Integers

    def checked(self, n_theta: int, n_regions: int) -> SearchTree:
        """Return the tree, or raise ValueError if a search of it may leave it or those regions."""
        nodes = self.levels.size
        leaves = self.leaf_starts.size - 1
        children, starts, regions = self.children, self.leaf_starts, self.leaf_regions
        if not (
            all(each.dtype.kind == "i" for each in (children, starts, regions))
            and all(each.dtype.kind == "f" for each in (self.normals, self.levels))
            and nodes > 0
            and leaves > 0
            and starts.ndim == regions.ndim == 1
            and self.levels.shape == (nodes,)
            and self.normals.shape == (nodes, n_theta)
            and children.shape == (nodes, 2)
            and np.all(np.isfinite(self.levels))
            and np.all(np.isfinite(self.normals))
            and np.all((children > np.arange(nodes)[:, None]) | (children < 0))
            and np.all((children >= -leaves) & (children < nodes))
            and starts[0] == 0
            and starts[-1] == len(regions)
            and np.all(np.diff(starts) >= 0)
            and np.all((regions >= 0) & (regions < n_regions))
        ):
            raise ValueError(f"its search tree does not fit {n_regions} regions")
        return self


@dataclass(frozen=True)
class _Polytopes:
    """Regions by their half-spaces, row after row, and by their vertices, in a box of [-1, 1].

    ``middles`` are the means of the vertices, ``radii`` the largest distances from these.
    """

    A: Array
    b: Array
    row_starts: Integers
    vertices: Array
    vertex_starts: Integers
    middles: Array
    radii: Array


def build_tree(
    A: Array,
    b: Array,
    starts: Integers,
    theta_min: Array,
    theta_max: Array,
    advance: Callable[[int], None] = lambda count: None,
) -> SearchTree:
    """Return a tree for the regions of a :class:`PiecewiseAffine`, the same for the same law.

    Vertices tell on which side a region lies. Rounding may move some: a search has to check its
    result by the slack.

    Parameters
    ----------
    A, b, starts, theta_min, theta_max : ndarray, shapes (q, n), (q,), (p,), (n,) and (n,)
        The half-spaces of the law, the first row of each region, and the box, bounded.
    advance : callable, optional
        Gets 1 for each region and 0 for each node; what it raises ends the work.
    """
    middle = (theta_max + theta_min) / 2
    half = (theta_max - theta_min) / 2
    regions = _polytopes(A * half, b - A @ middle, np.append(starts, len(b)), advance)
    tree = _split_all(regions, np.random.default_rng(0), advance)
    normals = tree.normals / half
    return replace(tree, normals=normals, levels=tree.levels + normals @ middle)


def _polytopes(
    A: Array, b: Array, row_starts: Integers, advance: Callable[[int], None]
) -> _Polytopes:
    length = np.linalg.norm(A, axis=1)
    length[length == 0] = 1.0
    A = A / length[:, None]
    b = b / length
    corners = []
    for first, last in pairwise(row_starts):
        corners.append(vertices(A[first:last], b[first:last]))
        advance(1)
    counts = np.array([len(each) for each in corners])
    vertex_starts = np.append(0, np.cumsum(counts, dtype=np.int64))
    points = np.ascontiguousarray(np.concatenate(corners))
    middles = np.add.reduceat(points, vertex_starts[:-1]) / counts[:, None]
    distance = np.linalg.norm(points - np.repeat(middles, counts, axis=0), axis=1)
    radii = np.maximum.reduceat(distance, vertex_starts[:-1])
    return _Polytopes(A, b, row_starts, points, vertex_starts, middles, radii)


def _split_all(
    regions: _Polytopes, random: np.random.Generator, advance: Callable[[int], None]
) -> SearchTree:
    """Return a tree whose nodes are split until four regions, or too many nodes, are left.

    Thin regions make trees grow without bound: two nodes for each region are the most.
    """
    p, n = regions.middles.shape
    rows: list[int] = []
    children: list[list[int]] = []
    leaves: list[Integers] = []
    # The fullest node first, and of those the oldest: a number, its regions, its parent and side.
    waiting: list[tuple[int, int, Integers, int, int]] = [
        (-p, 0, np.arange(p, dtype=np.int64), -1, 0)
    ]
    order = 0
    while waiting:
        advance(0)
        _, _, inside, parent, side = heappop(waiting)
        full = len(rows) >= 2 * p or len(inside) <= 4
        split = None if full else _best_split(regions, inside, random)
        if parent >= 0:
            children[parent][side] = -1 - len(leaves) if split is None else len(rows)
        if split is None:
            leaves.append(np.sort(inside))
            continue
        row, *parts = split
        for which, part in enumerate(parts):
            order += 1
            heappush(waiting, (-len(part), order, part, len(rows), which))
        rows.append(row)
        children.append([0, 0])
    return SearchTree(
        normals=regions.A[rows].reshape(-1, n),
        levels=regions.b[rows],
        children=np.array(children, dtype=np.int64).reshape(-1, 2),
        leaf_starts=np.cumsum([0, *map(len, leaves)], dtype=np.int64),
        leaf_regions=np.concatenate(leaves),
    )


def _best_split(
    regions: _Polytopes, inside: Integers, random: np.random.Generator
) -> tuple[int, Integers, Integers] | None:
    """Return a row of A and the regions on either side, None where no row parts them.

    Of 32 facets drawn from up to 16 regions it is the one that leaves the smaller halves.
    """
    chosen = random.choice(inside, min(16, len(inside)), replace=False)
    first = np.tile(regions.row_starts[chosen], 2)
    rows = random.integers(first, np.tile(regions.row_starts[chosen + 1], 2))
    sides = np.empty((len(rows), len(inside)), np.uint8)
    shapes = regions.vertices, regions.vertex_starts, regions.middles, regions.radii
    _sides(*shapes, inside, regions.A[rows], regions.b[rows], sides)
    below = (sides & 1).sum(axis=1)
    above = (sides >> 1).sum(axis=1)
    larger = np.maximum(below, above)
    best = int(np.lexsort((below + above, larger))[0])
    if larger[best] >= len(inside):
        return None
    return int(rows[best]), inside[(sides[best] & 1) > 0], inside[(sides[best] >> 1) > 0]


@compiled(
    "void(float64[:, ::1], int64[::1], float64[:, ::1], float64[::1], int64[::1], "
    "float64[:, ::1], float64[::1], uint8[:, ::1])"
)
def _sides(
    points: Array,
    vertex_starts: Integers,
    middles: Array,
    radii: Array,
    inside: Integers,
    normals: Array,
    levels: Array,
    sides: NDArray[np.uint8],
) -> None:
    """Write for each hyperplane and region: 1 below it, 2 above it, 3 on both sides."""
    n = points.shape[1]
    for c in range(len(levels)):
        for k in range(len(inside)):
            i = inside[k]
            middle = -levels[c]
            for j in range(n):
                middle += normals[c, j] * middles[i, j]
            if abs(middle) >= radii[i]:
                sides[c, k] = 1 if middle < 0 else 2
                continue
            side = 0
            for vertex in range(vertex_starts[i], vertex_starts[i + 1]):
                distance = -levels[c]
                for j in range(n):
                    distance += normals[c, j] * points[vertex, j]
                side |= 1 if distance < -OVERLAP else 0
                side |= 2 if distance > OVERLAP else 0
            sides[c, k] = side if side else 3


def vertices(A: Array, b: Array) -> Array:
    """Return the vertices (k, n) of ``{A z <= b, -1 <= z <= 1}``, rows of unit length.

    Of a set too thin for that, those of the box: it may lie anywhere.
    """
    n = A.shape[1]
    rows = np.vstack([A, np.eye(n), -np.eye(n)])
    bounds = np.concatenate([b, np.ones(2 * n)])
    if n == 1:
        ends = bounds / np.where(rows[:, 0] == 0, np.inf, rows[:, 0])
        return np.array([[np.max(ends[rows[:, 0] < 0])], [np.min(ends[rows[:, 0] > 0])]])
    inner, _ = largest_ball(rows, bounds)
    try:
        found = HalfspaceIntersection(np.column_stack([rows, -bounds]), inner).intersections
        found = found[np.all(np.isfinite(found), axis=1)]
    except QhullError:
        found = np.empty((0, n))
    if len(found) <= n:
        return np.stack(np.meshgrid(*[[-1.0, 1.0]] * n), axis=-1).reshape(-1, n)
    return np.asarray(np.clip(found, -1, 1))
