"""What ours is compared with, each in its fastest form that we know of."""

from __future__ import annotations

import contextlib
import functools
import io
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from sb3_yann._validation import Array
from sb3_yann.control import ParametricQP, PiecewiseAffine
from sb3_yann.control.polyhedra import largest_ball

PPOPT = "ppopt evaluate, as shipped"
NO_OVERLAP = "ppopt evaluate, overlap flag off"
POINT_LOCATION = "ppopt PointLocation (numba), as shipped"
POINT_LOCATION_NO_OVERLAP = "ppopt PointLocation (numba), overlap flag off"
DAQP = "online daqp"
OSQP = "online osqp, 1e-6"
LITERAL = "literal network (torch)"
MLP = "MlpPolicy 256-256"
SERIAL = ("combinatorial_graph", "graph", "geometric")
OSQP_TOLERANCE = 1e-6


def ppopt_program(program: ParametricQP) -> Any:
    """Return ppopt's form of a program, on GLPK and DAQP."""
    from ppopt.mpqp_program import MPQP_Program
    from ppopt.solver import Solver

    n = len(program.theta_min)
    moving = np.any(program.G, axis=1) | ~np.any(program.S, axis=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return MPQP_Program(
            A=program.G[moving],
            b=program.w[moving, None],
            c=program.c[:, None],
            H=program.F,
            Q=program.H,
            A_t=np.vstack([np.eye(n), -np.eye(n), -program.S[~moving]]),
            b_t=np.concatenate([program.theta_max, -program.theta_min, program.w[~moving]])[
                :, None
            ],
            F=program.S[moving],
            solver=Solver({"lp": "glpk", "qp": "daqp"}),
        )


def ppopt_solution(program: ParametricQP, law: PiecewiseAffine, overlap: bool) -> Any:
    """Return ppopt's solution object with the regions of a law, whoever found these.

    Each region's law of all variables comes from the constraints that are active at its center.
    """
    from ppopt.critical_region import CriticalRegion
    from ppopt.solution import Solution

    regions = []
    ends = [*law.starts[1:], law.n_halfspaces]
    nothing = np.zeros((0, law.n_theta)), np.zeros((0, 1))
    for start, end, center in zip(law.starts, ends, centers(law), strict=True):
        gain, offset = affine_law(program, center)
        E = np.ascontiguousarray(law.A[start:end])
        f = law.b[start:end, None]
        regions.append(CriticalRegion(gain, offset[:, None], *nothing, E, f, []))
    return Solution(ppopt_program(program), regions, is_overlapping=overlap)


def affine_law(program: ParametricQP, theta: Array) -> tuple[Array, Array]:
    """Return gain (v, n) and offset (v,) of the optimal U around a point inside a region."""
    U = program.solve(theta)
    if U is None:
        raise RuntimeError(f"The program has no solution at theta = {theta.tolist()}, in a region.")
    scale = np.linalg.norm(np.hstack([program.G, program.S]), axis=1)
    slack = (program.w + program.S @ theta - program.G @ U) / np.where(scale > 0, scale, 1.0)
    active = (slack < 1e-9) & np.any(program.G, axis=1)
    free = -np.linalg.solve(program.H, np.column_stack([program.F, program.c]))
    G = program.G[active]
    if len(G):
        toward = np.linalg.solve(program.H, G.T)
        excess = G @ free - np.column_stack([program.S, program.w])[active]
        free = free - toward @ np.linalg.lstsq(G @ toward, excess, rcond=None)[0]
    return np.ascontiguousarray(free[:, :-1]), free[:, -1]


@functools.cache
def centers(law: PiecewiseAffine) -> Array:
    """Return the point of each region that lies farthest inside, shape (p, n)."""
    middle = (law.theta_max + law.theta_min) / 2
    half = (law.theta_max - law.theta_min) / 2
    # rows of unit length
    A = law.A * half
    b = law.b - law.A @ middle
    ends = [*law.starts[1:], law.n_halfspaces]
    found = [
        largest_ball(A[start:end], b[start:end])[0]
        for start, end in zip(law.starts, ends, strict=True)
    ]
    return np.asarray(middle + half * np.array(found))


def daqp_online(program: ParametricQP, inputs: int) -> Callable[[Array], Array | None]:
    """Return a function that solves the program at one theta, set up once, by DAQP."""
    import daqp

    G, bound = _moving(program)
    F = program.F
    c = program.c
    S = program.S[bound]
    w = program.w[bound]
    model = daqp.Model()
    model.setup(np.ascontiguousarray(program.H), c.copy(), G, w + 1.0, np.full(len(w), -1e30))

    def solve(theta: Array) -> Array | None:
        model.update(f=F @ theta + c, bupper=w + S @ theta)
        U, _, status, _ = model.solve()
        return U[:inputs] if status == 1 else None

    return solve


def osqp_online(program: ParametricQP, inputs: int) -> Callable[[Array], Array | None] | None:
    """Return the same by OSQP, warm-started as it does by itself; None where it is missing."""
    try:
        import osqp
    except ModuleNotFoundError:
        return None
    G, bound = _moving(program)
    F = program.F
    c = program.c
    S = program.S[bound]
    w = program.w[bound]
    solver = osqp.OSQP()
    solver.setup(
        sparse.csc_matrix(np.triu(program.H)), c, sparse.csc_matrix(G), np.full(len(w), -np.inf),
        w + 1.0, verbose=False, eps_abs=OSQP_TOLERANCE, eps_rel=OSQP_TOLERANCE, max_iter=100_000,
    )  # fmt: skip

    def solve(theta: Array) -> Array | None:
        solver.update(q=F @ theta + c, u=w + S @ theta)
        result = solver.solve()
        return result.x[:inputs] if result.info.status_val == 1 else None

    return solve


def _moving(program: ParametricQP) -> tuple[Array, NDArray[np.bool_]]:
    """Return the rows that bind U; rows without U bound theta alone, which an input has not."""
    bound = np.any(program.G, axis=1)
    return np.ascontiguousarray(program.G[bound]), bound


def literal_bytes(law: PiecewiseAffine, width: int) -> int:
    """Return the memory that the literal network of a law takes, single precision."""
    p = law.n_regions
    q = law.n_halfspaces
    m = law.n_inputs
    n = law.n_theta
    suppress = 2 * p * m * (p + 2 * p * m + p * width + 1)
    entries = q * (n + 1) + p * (q + 1) + p * p + 2 * p * m * (n + 1) + suppress
    return 4 * (entries + 2 * p * m * m + p * width * (n + 1) + (p * width) ** 2)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Swallow what ppopt prints."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def ppopt_solve(program: Any, algorithm: str) -> int:
    """Solve with a serial algorithm of ppopt, and return the number of regions."""
    from ppopt.critical_region import CriticalRegion
    from ppopt.mp_solvers.solve_mpqp import mpqp_algorithm, solve_mpqp
    from ppopt.utils.chebyshev_ball import chebyshev_ball

    def is_full_dimension(region: Any) -> bool:
        ball = chebyshev_ball(region.E, region.f, deterministic_solver="glpk")
        return ball is not None and ball.sol[-1] > 1e-8

    shipped = CriticalRegion.is_full_dimension
    # It asks Gurobi, whatever solver was chosen: the same question, put to GLPK.
    CriticalRegion.is_full_dimension = is_full_dimension
    try:
        with quiet():
            return len(solve_mpqp(program, mpqp_algorithm[algorithm]).critical_regions)
    finally:
        CriticalRegion.is_full_dimension = shipped
