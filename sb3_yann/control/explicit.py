"""Solves a multi-parametric quadratic program off line, and checks the answer."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from sb3_yann.control._validation import Array
from sb3_yann.control.piecewise_affine import PiecewiseAffine


class ExplicitSolutionError(RuntimeError):
    """An explicit solution failed its check: it does not solve the program it came from."""


@dataclass(frozen=True, eq=False)
class ParametricQP:
    """``min_U 1/2 U'HU + (F theta + c)'U`` with ``G U <= w + S theta``, for theta in a box.

    Attributes
    ----------
    H : ndarray, shape (v, v)
        Positive definite.
    F : ndarray, shape (v, n)
    c : ndarray, shape (v,)
    G : ndarray, shape (rows, v)
    w : ndarray, shape (rows,)
    S : ndarray, shape (rows, n)
    theta_min, theta_max : ndarray, shape (n,)
    n_slacks : int, default 0
        How many of the last variables are slacks of soft constraints, and no inputs.
    """

    H: Array
    F: Array
    c: Array
    G: Array
    w: Array
    S: Array
    theta_min: Array
    theta_max: Array
    n_slacks: int = 0

    def solve(self, theta: Array) -> Array | None:
        """Return the optimal U (v,) at one theta (n,) from DAQP, or None where none is feasible."""
        import daqp

        upper = self.w + self.S @ theta
        fixed = ~np.any(self.G, axis=1)
        if np.any(upper[fixed] < -1e-11):  # a bound of theta alone
            return None
        upper = np.where(fixed, 1.0, upper)
        U, _, status, _ = daqp.solve(
            np.ascontiguousarray(self.H),
            self.F @ theta + self.c,
            np.ascontiguousarray(self.G),
            upper,
            np.full(upper.size, -1e30),
            np.zeros(upper.size, dtype=np.intc),
            primal_tol=1e-11,
        )
        return np.asarray(U) if status == 1 else None

    def scaled(self, center: Array, half: Array, reach: Array) -> ParametricQP:
        """Return the program in ``U / reach`` and ``(theta - center) / half``, with unit rows."""
        size = np.mean(np.diag(self.H) * reach**2)
        G, S = self.G * reach, self.S * half
        length = np.linalg.norm(np.hstack([G, S]), axis=1)
        length[length == 0] = 1.0
        return ParametricQP(
            H=self.H * np.outer(reach, reach) / size,
            F=self.F * np.outer(reach, half) / size,
            c=(self.c + self.F @ center) * reach / size,
            G=G / length[:, None],
            w=(self.w + self.S @ center) / length,
            S=S / length[:, None],
            theta_min=(self.theta_min - center) / half,
            theta_max=(self.theta_max - center) / half,
            n_slacks=self.n_slacks,
        )


@dataclass(frozen=True, eq=False)
class _Region:
    """Where ``A theta <= b``, rows of unit length, ``U = gain theta + offset`` is optimal."""

    active_set: tuple[int, ...]
    gain: Array
    offset: Array
    A: Array
    b: Array


def solve_explicit(
    program: ParametricQP, u_min: Array, u_max: Array, outside: str
) -> PiecewiseAffine:
    """Return the law of the first ``len(u_min)`` entries of U, with a region for each active set.

    The regions come from ppopt (combinatorial graph search with GLPK and DAQP), in the order of
    their active sets, fewest constraints first, so that a problem always gives the same law.

    Raises
    ------
    ValueError
        If the box of parameters is not bounded, or hardly any parameter in it is feasible.
    ExplicitSolutionError
        If the solution fails its check.
    """
    if not np.all(np.isfinite([program.theta_min, program.theta_max])):
        raise ValueError(
            "The law is computed over a bounded box of parameters, but theta_min = "
            f"{program.theta_min.tolist()} and theta_max = {program.theta_max.tolist()}. Pass "
            "finite theta_min and theta_max (or x_min and x_max), and where theta holds them, "
            "r_min and r_max, d_min and d_max, u_min and u_max."
        )
    m = len(u_min)
    center = (program.theta_max + program.theta_min) / 2
    half = (program.theta_max - program.theta_min) / 2
    # ppopt's tolerances are absolute: in units of the box and of the input range they mean the
    # same for every plant.
    width = (u_max - u_min) / 2
    steps = (len(program.c) - program.n_slacks) // m
    reach = np.tile(np.where(np.isfinite(width), width, 1.0), steps)
    reach = np.concatenate([reach, np.ones(program.n_slacks)])
    scaled = program.scaled(center, half, reach)
    _require_feasible(scaled)
    regions = _critical_regions(scaled)
    _check(scaled, regions, center, half)

    gains = np.stack([reach[:m, None] * region.gain[:m] / half for region in regions])
    offsets = np.stack([reach[:m] * region.offset[:m] for region in regions]) - gains @ center
    A = np.concatenate([region.A / half for region in regions])
    b = np.concatenate([region.b for region in regions]) + A @ center
    return PiecewiseAffine(
        gains=gains,
        offsets=offsets,
        A=A,
        b=b,
        starts=np.cumsum([0, *(len(region.b) for region in regions[:-1])]),
        u_min=u_min,
        u_max=u_max,
        theta_min=program.theta_min,
        theta_max=program.theta_max,
        outside=outside,
    )


def _critical_regions(program: ParametricQP) -> list[_Region]:
    """Return the critical regions of a program whose box is the unit box, sorted."""
    n = program.F.shape[1]
    box_A, box_b = np.vstack([np.eye(n), -np.eye(n)]), np.ones(2 * n)
    if not np.any(program.G):  # nothing binds U, which ppopt does not take
        law: Array = -np.linalg.solve(program.H, np.column_stack([program.F, program.c])).astype(
            float
        )
        A, b = np.vstack([box_A, -program.S]), np.concatenate([box_b, program.w])
        length = np.linalg.norm(A, axis=1)
        A, b = A[length > 0] / length[length > 0, None], b[length > 0] / length[length > 0]
        return [_Region((), law[:, :-1], law[:, -1], A, b)]

    # Rows without U bound theta: with them in the constraints ppopt's active sets degenerate.
    moving = np.any(program.G, axis=1) | ~np.any(program.S, axis=1)
    from ppopt.mp_solvers import mpqp_combi_graph
    from ppopt.mpqp_program import MPQP_Program
    from ppopt.solver import Solver

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # feasibility was checked, with a clearer message
        problem = MPQP_Program(
            A=program.G[moving],
            b=program.w[moving, None],
            c=program.c[:, None],
            H=program.F,
            Q=program.H,
            A_t=np.vstack([box_A, -program.S[~moving]]),
            b_t=np.concatenate([box_b, program.w[~moving]])[:, None],
            F=program.S[moving],
            solver=Solver({"lp": "glpk", "qp": "daqp"}),  # the defaults want a Gurobi licence
        )
        found = mpqp_combi_graph.solve(problem).critical_regions
    regions = [
        _Region(tuple(sorted(cr.active_set)), cr.A, cr.b.ravel(), cr.E, cr.f.ravel())
        for cr in found
    ]
    return sorted(regions, key=lambda region: (len(region.active_set), region.active_set))


def _require_feasible(program: ParametricQP) -> None:
    """Raise unless the feasible pairs (U, theta) have an interior (largest ball, HiGHS)."""
    v, n = program.F.shape
    rows = np.hstack([program.G, -program.S])
    rows = np.hstack([rows, np.linalg.norm(rows, axis=1, keepdims=True)])
    bounds = [(None, None)] * v + [(-1, 1)] * n + [(None, 1)]
    cost = np.zeros(v + n + 1)
    cost[-1] = -1
    ball = optimize.linprog(cost, A_ub=rows, b_ub=program.w, bounds=bounds)
    if ball.status != 0 or ball.x[-1] < 1e-9:
        raise ValueError(
            "The MPC problem is infeasible: no theta in its box (theta_min, theta_max) has inputs "
            "that keep every bound with room to spare. Widen x_min/x_max, u_min/u_max or the "
            "terminal set."
        )


def _check(program: ParametricQP, regions: list[_Region], center: Array, half: Array) -> None:
    """Check the regions against the program they came from, without trusting ppopt.

    An independent QP is solved at the innermost point of every region, which finds wrong thin
    regions that random points miss. At random points of the box, and at a point just across every
    facet, which finds thin gaps, the law must satisfy the Karush-Kuhn-Tucker conditions, and where
    no region lies the QP must be infeasible. Everything is in scaled units, so the tolerances are
    relative to the box and the input range.
    """
    if not regions:
        _fail("no region was found", center)
    for index, region in enumerate(regions):
        inner, _ = _innermost(region)
        U = program.solve(inner)
        if U is None or np.max(np.abs(U - region.gain @ inner - region.offset)) > 1e-6:
            _fail(f"the law of region {index} is not optimal inside it", inner * half + center)

    n = program.F.shape[1]
    points = [*np.random.default_rng(0).uniform(-1, 1, (200 * n, n))]
    points += [point for region in regions for point in _across_facets(region)]
    A, b = (np.concatenate([getattr(region, name) for region in regions]) for name in "Ab")
    starts = np.cumsum([0, *(len(region.b) for region in regions[:-1])])
    for point in points:
        slacks = np.minimum.reduceat(b - A @ point, starts)
        best = int(np.argmax(slacks))
        if slacks[best] >= 0:
            U = regions[best].gain @ point + regions[best].offset
            if _kkt_residual(program, point, U) > 1e-6:
                _fail(
                    f"the law of region {best} violates the KKT conditions", point * half + center
                )
        elif slacks[best] < -1e-6 and program.solve(point) is not None:
            _fail("no region covers a feasible parameter", point * half + center)


def _kkt_residual(program: ParametricQP, theta: Array, U: Array) -> float:
    """Return by how much U violates feasibility, or stationarity with multipliers >= 0."""
    slack = program.w + program.S @ theta - program.G @ U
    gradient = program.H @ U + program.F @ theta + program.c
    active = program.G[slack < 1e-7]
    stationarity = optimize.nnls(active.T, -gradient)[1] if len(active) else np.abs(gradient).max()
    size = 1 + np.abs(program.F @ theta + program.c).max()
    return float(max(-slack.min(initial=0.0), stationarity / size))


def _across_facets(region: _Region, step: float = 1e-5) -> Iterator[Array]:
    """Yield a point just across the middle of each facet of a region, inside the unit box."""
    for index, normal in enumerate(region.A):
        middle, distance = _innermost(region, facet=index)
        point = middle + step * normal
        # A half-space that only touches the region has no facet to cross.
        if distance > step and np.max(np.abs(point)) <= 1:
            yield point


def _innermost(region: _Region, facet: int | None = None) -> tuple[Array, float]:
    """Return the point of a region, or of one facet, farthest from its (other) half-spaces.

    With it comes the distance, negative for an empty facet (the rows have unit length).
    """
    n = region.A.shape[1]
    rows = np.hstack([region.A, np.ones((len(region.b), 1))])
    if facet is not None:
        rows[facet, -1] = 0.0
    cost = np.append(np.zeros(n), -1.0)
    ball = optimize.linprog(
        cost,
        A_ub=rows,
        b_ub=region.b,
        A_eq=None if facet is None else rows[[facet]],
        b_eq=None if facet is None else region.b[[facet]],
        bounds=[(None, None)] * (n + 1),
    )
    return np.asarray(ball.x[:n]), float(ball.x[-1])


def _fail(what: str, theta: Array) -> None:
    raise ExplicitSolutionError(
        f"The explicit solution failed its check: {what}, at theta = {theta.tolist()}. The problem "
        "is likely to be badly conditioned: shorten the horizon, or bring states and weights to "
        "similar magnitudes."
    )
