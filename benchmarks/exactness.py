"""Whether the law is total, single-valued and right: a million points, and quadratic programs."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from benchmarks.peers import centers
from benchmarks.problems import Array, Problem
from benchmarks.records import Bench, Figure
from sb3_yann.control import PiecewiseAffine

SECTION = "exactness"
POINTS = "points: random, on facets, at vertices"
UNCOVERED = "uncovered: feasible, and outside every region by 1e-8"
MISPLACED = "misplaced: located in a region that does not hold them to 1e-8"
DOUBLED = "doubled: inside two regions by 1e-8"
ERROR = "largest error against a QP, of the input range"
AT_MOST = 200_000
"""Points for which a QP decides whether they should have been covered."""


def exactness(bench: Bench, problem: Problem) -> None:
    """Count what is uncovered, misplaced or doubled, and compare with online programs."""
    law = problem.law
    count = 10_000 if bench.quick else 1_000_000
    points = sample(law, count)
    held, covered = scan(points, law)
    beyond = np.flatnonzero(~covered)
    region = np.concatenate([law.locate(part) for part in np.array_split(points, count // 1000)])
    lost = (slack_in(points, region, law) < -law.tolerance) & covered
    found: dict[str, tuple[float, str]] = {
        POINTS: (len(points), "count"),
        UNCOVERED: (_feasible(problem, points[beyond[:AT_MOST]]), "count"),
        MISPLACED: (np.count_nonzero(lost), "count"),
        DOUBLED: (np.count_nonzero(held > 1), "count"),
        ERROR: (largest_error(problem, points, 300 if bench.quick else 10_000), "error"),
    }
    bench.figures.add(
        Figure(SECTION, name, str(problem.regions), np.array([float(value)]), kind)
        for name, (value, kind) in found.items()
    )


def sample(law: PiecewiseAffine, count: int, seed: int = 0) -> Array:
    """Return random points of the box, points on facets and vertices of regions, shuffled.

    From inside a region a ray goes to one of its facets; along that to the next, and so on: after
    n facets it is at a vertex. The points on the way lie on faces of every dimension.
    """
    rng = np.random.default_rng(seed)
    n = law.n_theta
    middle = (law.theta_max + law.theta_min) / 2
    half = (law.theta_max - law.theta_min) / 2
    each = count // (n + 1)
    region = np.arange(each) % law.n_regions
    points = [rng.uniform(law.theta_min, law.theta_max, (count - n * each, n))]
    A = law.A * half
    b = law.b - law.A @ middle
    at = ((centers(law) - middle) / half)[region]
    basis = np.zeros((each, n, n))  # orthonormal normals of the facets that each is on
    for k in range(n):
        direction = rng.standard_normal((each, n))
        for _ in range(2):
            direction -= np.einsum("bki,bk->bi", basis, np.einsum("bki,bi->bk", basis, direction))
        at, row = shoot(at, direction, region, A, b, law.starts)
        normal = A[row]
        for _ in range(2):
            normal = normal - np.einsum("bki,bk->bi", basis, np.einsum("bki,bi->bk", basis, normal))
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        basis[:, k] = normal / np.where(length > 1e-9, length, 1.0)
        points.append(middle + half * at)
    return np.clip(np.concatenate(points), law.theta_min, law.theta_max)


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def shoot(
    at: Array,
    direction: Array,
    region: NDArray[np.int64],
    A: Array,
    b: Array,
    starts: NDArray[np.int64],
) -> tuple[Array, NDArray[np.int64]]:
    """Return where rays from points within regions leave them, and through which half-space."""
    end = at.copy()
    rows = np.zeros(len(at), dtype=np.int64)
    for i in range(len(at)):
        first = starts[region[i]]
        last = starts[region[i] + 1] if region[i] + 1 < len(starts) else len(b)
        nearest = np.inf
        for j in range(first, last):
            speed = 0.0
            slack = b[j]
            for k in range(at.shape[1]):
                speed += A[j, k] * direction[i, k]
                slack -= A[j, k] * at[i, k]
            # Facets that the point is on already are parallel to the direction, to rounding.
            if speed > 1e-9 and max(slack, 0.0) / speed < nearest:
                nearest = max(slack, 0.0) / speed
                rows[i] = j
        if nearest < np.inf:
            for k in range(at.shape[1]):
                end[i, k] += nearest * direction[i, k]
    return end, rows


def scan(points: Array, law: PiecewiseAffine) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return how many regions hold each point in their interior, and whether any holds it at all.

    A plain scan of all regions, which has nothing from the law's own search but its arrays. The
    rows of each region are tried in the order in which they rule out most.
    """
    few = points[:: max(1, len(points) // 500)]
    share = np.mean(law.b - few @ law.A.T >= 0, axis=0)
    region = np.repeat(np.arange(law.n_regions), np.diff([*law.starts, law.n_halfspaces]))
    order = np.lexsort((share, region))
    return _scan(
        np.ascontiguousarray(points.T), law.A[order], law.b[order], law.starts, law.tolerance
    )


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _scan(
    points: Array, A: Array, b: Array, starts: NDArray[np.int64], tolerance: float
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    n, count = points.shape
    inside = np.zeros(count, dtype=np.int64)
    covered = np.zeros(count, dtype=np.bool_)
    block = 1024
    slack = np.empty(block)
    left = np.empty(block, dtype=np.int64)
    for first in range(0, count, block):
        x = points[:, first : first + block]
        size = x.shape[1]
        for r in range(len(starts)):
            last = starts[r + 1] if r + 1 < len(starts) else len(b)
            left_over = size
            for i in range(size):
                left[i] = i
                slack[i] = np.inf
            for j in range(starts[r], last):
                kept = 0
                for i in range(left_over):
                    own = b[j]
                    for k in range(n):
                        own -= A[j, k] * x[k, left[i]]
                    # Written in any case and counted where it holds: no branch to mispredict.
                    left[kept] = left[i]
                    slack[kept] = min(slack[i], own)
                    kept += own >= -tolerance
                left_over = kept
                if kept == 0:
                    break
            for i in range(left_over):
                inside[first + left[i]] += slack[i] > tolerance
                covered[first + left[i]] = True
    return inside, covered


def slack_in(points: Array, region: NDArray[np.int64], law: PiecewiseAffine) -> Array:
    """Return the smallest slack of each point in the region that is named for it."""
    found = np.empty(len(points))
    ends = np.append(law.starts[1:], law.n_halfspaces)
    order = np.argsort(region, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(region[order])) + 1):
        r = region[part[0]]
        rows = slice(law.starts[r], ends[r])
        found[part] = np.min(law.b[rows] - points[part] @ law.A[rows].T, axis=1)
    return found


def _feasible(problem: Problem, points: Array) -> int:
    program = problem.mpc.condensed()
    return sum(program.solve(point) is not None for point in points)


def largest_error(problem: Problem, points: Array, count: int) -> float:
    """Return the largest distance from an online QP at a sample of the points, of the range."""
    law = problem.law
    program = problem.mpc.condensed()
    m = problem.law.n_inputs
    chosen = np.random.default_rng(1).choice(points, count, replace=False)
    chosen = chosen[law.in_domain(chosen)] if law.n_regions < 500 else chosen
    U = [program.solve(point) for point in chosen]
    inside = np.array([each is not None for each in U])
    exact = np.array([each[:m] for each in U if each is not None])
    parts = np.array_split(chosen[inside], max(1, len(exact) // 500))
    ours = np.concatenate([law(part) for part in parts])
    return float(np.max(np.abs(ours - exact) / (law.u_max - law.u_min)))
