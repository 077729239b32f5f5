"""Unstable plants over long horizons: the law beside a program in which nothing is condensed."""

from __future__ import annotations

import warnings

import numpy as np

from benchmarks.records import Bench, Figure
from benchmarks.reference_qp import ReferenceQP
from sb3_yann.control import LinearModel, LinearMPC, RateLimits, SoftBounds, Tracking

SECTION = "long horizons"
ONLINE = "largest error of the online law, of half the input range"
EXPLICIT = "largest error of the explicit law, where it has at most 2,000 regions"
POINTS = "points compared"
POLES = (1.02, 1.2, 1.5, 2.0, 3.0)
HORIZONS = (20, 50, 100)
KINDS = ("one input", "two inputs", "soft bounds", "references", "rates", "all of them")
"""What the problems of a pole and a horizon have."""


def problem(pole: float, horizon: int, kind: str = KINDS[0], seed: int = 1) -> LinearMPC:
    """Return a problem of random states, bounded, one of whose modes has the pole."""
    rng = np.random.default_rng(seed)
    every = kind == KINDS[-1]
    n, m = (3, 2) if every or kind == "two inputs" else (2, 1)
    basis = rng.normal(size=(n, n))
    while np.linalg.cond(basis) > 20:
        basis = rng.normal(size=(n, n))
    poles = np.append(pole, rng.uniform(-0.9, 1.05, n - 1))
    A = basis @ np.diag(poles) @ np.linalg.inv(basis)
    soft, follow, slow = (every or kind == each for each in KINDS[2:5])
    return LinearMPC(
        LinearModel(A, rng.normal(size=(n, m)), dt=1.0),
        Q=np.eye(n),
        R=0.1 * np.eye(m),
        horizon=horizon,
        x_min=-10,
        x_max=10,
        u_min=-2,
        u_max=2,
        soft=SoftBounds(x=1, penalty=1e3) if soft else None,
        tracking=Tracking(np.eye(m, n), -0.1, 0.1) if follow else None,
        rate=RateLimits(-1, 1, R_du=0.1 * np.eye(m)) if slow else None,
    )


def errors(mpc: LinearMPC, count: int, explicit: bool) -> tuple[float, float, int]:
    """Return the largest errors of the online and the explicit law, and how many points count.

    Points are in the box, more of them in its middle. Those count where the reference is proved.
    """
    laws = [mpc.online()]
    if explicit:
        laws.append(mpc.explicit(region_limit=2000))
    reference = ReferenceQP(mpc)
    rng = np.random.default_rng(0)
    worst = np.zeros(2)
    compared = 0
    for _ in range(count):
        theta = rng.uniform(mpc.theta_min, mpc.theta_max) * rng.uniform() ** 2
        exact = reference(theta) if laws[0].in_domain(theta) else None
        if exact is None:
            continue
        compared += 1
        for i, law in enumerate(laws):
            off = float(np.max(np.abs(law(theta) - exact) / mpc.u_half))
            worst[i] = max(worst[i], off)
    return float(worst[0]), float(worst[1]), compared


def long_horizons(bench: Bench) -> None:
    """Compare the laws on a grid of poles and horizons; a corner of it in the quick form."""
    for pole in POLES[-1:] if bench.quick else POLES:
        for horizon in HORIZONS[:1] if bench.quick else HORIZONS:
            found = np.zeros(3)
            for kind in KINDS:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    own = errors(problem(pole, horizon, kind), 15, explicit=kind == KINDS[0])
                found = np.array([*np.maximum(found[:2], own[:2]), found[2] + own[2]])
            column = f"pole {pole:g}, N = {horizon}"
            rows = zip((ONLINE, EXPLICIT, POINTS), found, ("error", "error", "count"), strict=True)
            bench.figures.add(
                Figure(SECTION, name, column, np.array([value]), shown)
                for name, value, shown in rows
            )
