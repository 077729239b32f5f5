"""Whether the multi-parametric QP solves every problem of the suite, and solves it right."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from benchmarks.exactness import sample
from benchmarks.problems import Array
from benchmarks.records import Bench, Figure
from benchmarks.reference_qp import ReferenceQP
from benchmarks.suite_problems import SUITE, quietly
from sb3_yann.control import ExplicitSolutionError, LinearMPC, PiecewiseAffine

SECTION = "suite of problems"
PROBLEMS = "problems"
FAILURES = "failures"
WRONG_LAWS = "wrong laws"
ERROR = "largest error, of the input range"
AS_EVALUATED = "largest error with rounding and ties of the evaluation"
EACH = "time a region, with its check"
WRONG = 1e-9
"""An input that is further off is wrong, in units of the input range, beyond its rounding."""
ROUNDING = 4 * np.finfo(float).eps


@dataclass(frozen=True)
class Outcome:
    """What became of one problem.

    Attributes
    ----------
    name : str
    failure : str
        The message of the solver, empty if there is a law.
    regions : int
    seconds : float
        What the solution took with its check, of the processor's time.
    points : int
        Where the law was compared.
    error : float
        The largest distance from the reference, of the input range, and beyond what an evaluation
        leaves off: the rounding of ``gain theta + offset``, and the slope of the law times the
        distance at which regions tie.
    raw_error : float
        The same with what an evaluation leaves off.
    holes : int
        Points with a solution that the law says have none.
    """

    name: str
    failure: str = ""
    regions: int = 0
    seconds: float = 0.0
    points: int = 0
    error: float = 0.0
    raw_error: float = 0.0
    holes: int = 0

    @property
    def wrong(self) -> bool:
        """Return whether the law is wrong somewhere."""
        return self.error > WRONG or self.holes > 0


def names(large: bool) -> list[str]:
    """Return the problems of the suite, those with many hundreds of regions or all others."""
    many = ("N 5", "N 6", "N 7")
    return [
        name
        for name in SUITE
        if (name.startswith(("chain", "cart-pole")) and any(each in name for each in many)) == large
    ]


def suite(bench: Bench) -> None:
    """Examine the suite, a tenth of its smaller problems in the quick form."""
    chosen = names(large=False)[::10] if bench.quick else [*names(large=False), *names(large=True)]
    found = table(examine(name) for name in chosen)
    kinds = {ERROR: "error", AS_EVALUATED: "error", EACH: "time"}
    bench.figures.add(
        Figure(SECTION, row, "all", np.array([float(value)]), kinds.get(row, "count"))
        for row, value in found.items()
    )


def examine(name: str, count: int = 60) -> Outcome:
    """Solve a problem of the suite, and compare its law with the reference."""
    mpc = quietly(SUITE[name])
    began = time.process_time()
    try:
        law = mpc.explicit()
    except ExplicitSolutionError as error:
        return Outcome(name, str(error))
    seconds = time.process_time() - began
    return Outcome(name, "", law.n_regions, seconds, *compare(mpc, law, count))


def compare(mpc: LinearMPC, law: PiecewiseAffine, count: int) -> tuple[int, float, float, int]:
    """Return the number of points, the largest error without and with rounding, and the holes."""
    reference = ReferenceQP(mpc)
    width = law.u_max - law.u_min
    width = np.where(np.isfinite(width), width, 1.0)
    points = trials(law, count)
    found = [reference(point) for point in points]
    solved = np.array([each is not None for each in found])
    domain = law.in_domain(points)
    holes = int(np.count_nonzero(solved & ~domain & (depth(law, points) < -1e-6)))
    kept = solved & domain
    if not np.any(kept):
        return 0, 0.0, 0.0, holes
    points = points[kept]
    exact = np.array([found[i] for i in np.flatnonzero(kept)])
    off = np.abs(law(points) - exact)
    region = law.locate(points)
    half = (law.theta_max - law.theta_min) / 2
    slopes = np.abs(law.gains[region])
    terms = np.einsum("kmi,ki->km", slopes, np.abs(points)) + np.abs(law.offsets[region])
    rounding = ROUNDING * terms + law.tie_tolerance * np.max(np.abs(law.gains) @ half)
    beyond = np.maximum(off - rounding, 0.0)
    return len(points), float(np.max(beyond / width)), float(np.max(off / width)), holes


def trials(law: PiecewiseAffine, count: int) -> Array:
    """Return points all over the box, in regions, next to their facets and next to vertices."""
    on = sample(law, count)
    inner = on[np.argsort(-depth(law, on), kind="stable")[: max(1, count // 4)]]
    rng = np.random.default_rng(2)
    # A little towards a point well inside: next to the boundary of the feasible set, not on it.
    towards = inner[rng.integers(0, len(inner), len(on))]
    share = 10 ** rng.uniform(-9, -0.3, (len(on), 1))
    drawn = rng.uniform(law.theta_min, law.theta_max, (count // 4, law.n_theta))
    return np.concatenate([on + share * (towards - on), drawn])


def depth(law: PiecewiseAffine, points: Array) -> Array:
    """Return how far inside a region each point lies, in half-widths of the box, or outside."""
    return np.asarray(law._located(points)[1])


def table(outcomes: Iterable[Outcome]) -> dict[str, float]:
    """Return what is reported of all problems together."""
    every = list(outcomes)
    solved = [each for each in every if not each.failure]
    regions = sum(each.regions for each in solved)
    return {
        PROBLEMS: len(every),
        FAILURES: len(every) - len(solved),
        WRONG_LAWS: sum(each.wrong for each in solved),
        "points compared": sum(each.points for each in solved),
        ERROR: max((each.error for each in solved), default=0.0),
        AS_EVALUATED: max((each.raw_error for each in solved), default=0.0),
        "regions": regions,
        EACH: sum(each.seconds for each in solved) / max(regions, 1),
    }
