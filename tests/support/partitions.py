"""The regions of a law: what lies in them, on their facets, and the same ones in another order."""

import numpy as np
from numpy.typing import NDArray

from random_problems import in_box
from sample_problems import half_spaces
from sb3_yann import LinearMPC
from sb3_yann.control import OnlineLaw, PiecewiseAffine
from sb3_yann.control.polyhedra import largest_ball

Array = NDArray[np.float64]


def unit_half(law: PiecewiseAffine) -> Array:
    return np.asarray((law.theta_max - law.theta_min) / 2)


def balls(law: PiecewiseAffine) -> list[tuple[Array, float]]:
    """Center and radius, in half-widths of the box, of a large ball in each region."""
    half = unit_half(law)
    found = []
    for region in range(law.n_regions):
        A, b = half_spaces(law, region)
        center, radius = largest_ball(A * half, b.copy())
        found.append((half * center, radius))
    return found


def slacks(law: PiecewiseAffine, points: Array) -> Array:
    """How far each point lies inside each region, (count, p)."""
    return np.asarray(np.minimum.reduceat(law.b - points @ law.A.T, law.starts, axis=1))


def edges(law: PiecewiseAffine, seed: int, each: int = 4) -> tuple[Array, Array]:
    """Points (count, n) on facets, and the directions in which the region ends there."""
    half = unit_half(law)
    rng = np.random.default_rng(seed)
    points = []
    ways = []
    for region, (center, _) in enumerate(balls(law)):
        A, b = half_spaces(law, region)
        for way in half * rng.normal(size=(each, law.n_theta)):
            speed = A @ way
            reach = np.min((b - A @ center)[speed > 0] / speed[speed > 0])
            points.append(center + reach * way)
            ways.append(way / np.max(np.abs(way / half)))
    return np.array(points), np.array(ways)


def as_range(law: PiecewiseAffine | OnlineLaw, change: Array) -> Array:
    """Changes of the input (..., m) as shares of its range."""
    return np.asarray(np.abs(change) / (law.u_max - law.u_min))


def steepest(law: PiecewiseAffine) -> Array:
    """The most that an input moves, in ranges, where theta moves by a half-width each (m,)."""
    slopes = (np.abs(law.gains) * unit_half(law)).sum(axis=2).max(axis=0)
    return np.asarray(slopes / (law.u_max - law.u_min))


def kinds(mpc: LinearMPC) -> list[PiecewiseAffine | OnlineLaw]:
    return [mpc.explicit(), mpc.online()]


def mixture(mpc: LinearMPC, seed: int) -> Array:
    """Points in the box, beyond it, and on facets."""
    inside, beyond = (in_box(mpc, 100, stretch, seed) for stretch in (1.0, 3.0))
    return np.vstack([inside, beyond, edges(mpc.explicit(), seed, each=2)[0], 0 * inside[:1]])
