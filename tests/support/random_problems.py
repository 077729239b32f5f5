"""Random problems with all parts in and out, and the regions of their laws."""

from typing import Any

import numpy as np
from hypothesis import assume, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sample_problems import half_spaces
from sb3_yann import (
    DisturbanceBounds,
    LinearModel,
    LinearMPC,
    OutputBounds,
    RateLimits,
    SoftBounds,
    Terminal,
    Tracking,
)
from sb3_yann.control import ExplicitLimitError, ExplicitSolutionError, OnlineLaw, PiecewiseAffine
from sb3_yann.control.polyhedra import largest_ball

Array = NDArray[np.float64]
Matrices = tuple[Array, Array, Array]

# States, inputs and horizon: few enough decisions to stay at some hundred regions.
SIZES = [(1, 1, 5), (2, 1, 2), (2, 1, 4), (1, 2, 2), (2, 2, 2), (3, 1, 3), (3, 2, 2), (4, 1, 3)]
MOST_REGIONS = 300
PARTS = ("tracking", "disturbance", "rate")


def examples(count: int) -> settings:
    """Run so many examples; by the profile "thorough" twenty times as many, and new ones."""
    thorough = settings.default is settings.get_profile("thorough")
    return settings(settings.default, max_examples=count * (20 if thorough else 1))


def _plant(rng: np.random.Generator, n: int, m: int, radius: float) -> Matrices:
    """A, B, E: a well-conditioned plant of this spectral radius, and one disturbance.

    An input moves the state at rest about as much as in a step.
    """
    while True:
        A, B, E = (rng.normal(size=(n, columns)) for columns in (n, m, 1))
        A *= radius / np.max(np.abs(np.linalg.eigvals(A)))
        reached = [B]
        for _ in range(n - 1):
            reached.append(A @ reached[-1])
        weakest = np.linalg.svd(np.hstack(reached), compute_uv=False)[-1]
        if weakest > 0.1 and np.linalg.svd(A - np.eye(n), compute_uv=False)[-1] > 0.1:
            return A, B, E


def _tracked(rng: np.random.Generator, A: Array, B: Array) -> Array:
    """One output (1, n) that the inputs hold with no more than twice its size."""
    C = rng.normal(size=(1, len(A)))
    gain = np.linalg.norm(C @ np.linalg.solve(np.eye(len(A)) - A, B))
    return np.asarray(C * max(1.0, 0.5 / gain))


def _between(rng: np.random.Generator, low: float, high: float, count: int) -> tuple[Array, Array]:
    """Asymmetric bounds about zero, (count,) each."""
    return -rng.uniform(low, high, count), rng.uniform(low, high, count)


def _bounds(rng: np.random.Generator, kind: str, x_unit: Array) -> dict[str, Any]:
    """Box of the states, and bounds of predicted states or outputs, hard or soft."""
    low, high = (x_unit * each for each in _between(rng, 1, 4, len(x_unit)))
    C = rng.normal(size=(1, len(x_unit))) / x_unit
    box = {"theta_min": low, "theta_max": high}
    inner = rng.uniform(0.3, 1.1, len(x_unit))
    states = {"x_min": low * inner, "x_max": high * inner}
    outputs = OutputBounds(C, -1.5, 1.0)
    if kind == "soft states":
        return {**states, "soft": SoftBounds(0.5 * x_unit, penalty=300.0)}
    if kind == "soft outputs":
        return {**box, "outputs": outputs, "soft": SoftBounds(y=1.0, penalty=300.0)}
    return {**box, **{"box": {}, "states": states, "outputs": {"outputs": outputs}}[kind]}


def _parts(
    rng: np.random.Generator, names: set[str], plant: Matrices, units: tuple[Array, Array]
) -> dict[str, Any]:
    """Reference, disturbance and rates, those that are named."""
    A, B, _ = plant
    x_unit, u_unit = units
    found = {}
    if "tracking" in names:
        found["tracking"] = Tracking(_tracked(rng, A, B) / x_unit, *_between(rng, 0.1, 1, 1))
    if "disturbance" in names:
        found["disturbances"] = DisturbanceBounds(*_between(rng, 0.05, 0.3, 1))
    if "rate" in names:
        weight = rng.choice([0.0, 1.0]) * np.diag(u_unit**-2)
        limits = (u_unit * each for each in _between(rng, 0.2, 1, len(u_unit)))
        found["rate"] = RateLimits(*limits, weight)
    return found


@st.composite
def problems(
    draw: st.DrawFn,
    n_regions: tuple[int, int] = (1, MOST_REGIONS),
    parts: tuple[str, ...] = PARTS,
    always: tuple[str, ...] = (),
) -> LinearMPC:
    """A solved problem: plant, units, bounds, and of the other parts some, or ``always``."""
    n, m, horizon = draw(st.sampled_from(SIZES))
    units = draw(st.sampled_from([0, 3]))  # powers of ten that states and inputs may span
    names = draw(st.sets(st.sampled_from(parts), max_size=2)) if parts else set()
    names |= set(always)
    kind = draw(st.sampled_from(["box", "states", "outputs", "soft states", "soft outputs"]))
    ends = draw(st.booleans())
    radius, gamma = draw(st.sampled_from([(0.6, 1.0), (0.95, 0.95), (1.2, 1.0), (0.95, 1.0)]))
    infeasible = draw(st.sampled_from(["nearest_region", "zero_input"]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    A, B, E = _plant(rng, n, m, radius)
    x_unit, u_unit = (10 ** (units * rng.uniform(-1, 1, size)) for size in (n, m))
    values: dict[str, Any] = {"horizon": horizon, "gamma": gamma, "infeasible": infeasible}
    values["Q"] = np.diag(rng.choice([0.1, 1.0, 10.0], n) / x_unit**2)
    values["R"] = np.diag(10 ** rng.uniform(-2, 1, m) / u_unit**2)
    values["u_min"], values["u_max"] = (u_unit * each for each in _between(rng, 0.3, 2, m))
    values |= _bounds(rng, kind, x_unit) | _parts(rng, names, (A, B, E), (x_unit, u_unit))
    if ends and not names:
        F = rng.normal(size=(2, n)) / x_unit
        values["terminal"] = Terminal(set=(F, rng.uniform(0.5, 3, 2)))
    A = x_unit[:, None] * A / x_unit
    B = x_unit[:, None] * B / u_unit
    E = x_unit[:, None] * E if "disturbance" in names else np.zeros((n, 0))
    mpc = LinearMPC(LinearModel(A, B, 1.0, E=E), **values)
    try:
        mpc.explicit(region_limit=n_regions[1])
    except (ExplicitLimitError, ExplicitSolutionError):  # too many regions, or too thin ones
        assume(False)
    assume(mpc.explicit().n_regions >= n_regions[0])
    return mpc


def in_box(mpc: LinearMPC, count: int, stretch: float = 1.0, seed: int = 0) -> Array:
    """Points (count, n) of the box of theta, or of one ``stretch`` times as wide."""
    middle = (mpc.theta_max + mpc.theta_min) / 2
    half = (mpc.theta_max - mpc.theta_min) / 2
    drawn = np.random.default_rng(seed).uniform(-1, 1, (count, mpc.n_theta))
    return np.asarray(middle + stretch * half * drawn)


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
