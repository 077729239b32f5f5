"""Solves a multi-parametric quadratic program off line, and checks the answer."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from sb3_yann._validation import Array, check_choice, half_widths, warn
from sb3_yann.control.explicit.budget import BudgetTimer, effort_of_lp
from sb3_yann.control.explicit.certificate import Certificate, ExplicitSolutionError
from sb3_yann.control.explicit.facet_walk import walk
from sb3_yann.control.explicit.parametric_qp import (
    ParametricQP,
    moderated,
    row_norms,
    slacks_made_cheap,
)
from sb3_yann.control.law import PiecewiseAffine
from sb3_yann.control.polyhedra import Region


def solve_explicit(
    program: ParametricQP,
    u_min: Array,
    u_max: Array,
    infeasible: str,
    solver: str,
    timer: BudgetTimer,
) -> PiecewiseAffine:
    """Return the law of the first ``len(u_min)`` entries of U, with a region for each active set.

    The regions are in the order of their active sets, fewest constraints first. The program is in
    the units of the plant, and tolerances in those of the input range (m,), infinite where there is
    none. Its errors are those of :meth:`LinearMPC.explicit`.
    """
    check_choice("solver", solver, ("walk", "ppopt"))
    demanded = float(require_sane_sizes(program, u_min, u_max).max(initial=0.0))
    if demanded > 1e7:
        raise ExplicitSolutionError(
            "The box of theta is too wide for regions: in it the MPC asks for inputs "
            f"{demanded:.0e} times their range, expected are at most 1e7. Pass as theta_min and "
            "theta_max, or x_min and x_max, what the plant can reach; or use online(), which needs "
            "no regions."
        )
    timer.tick()
    try:
        units = ProgramUnits(program, u_min, u_max, timer)
        _require_feasible(units.scaled, timer)
        regions = critical_regions(units.scaled, solver, timer)
        regions = Certificate(
            units.scaled, regions, units.to_inputs, units.center, units.half, timer, demanded
        ).check()
    except ExplicitSolutionError as error:
        if solver == "walk":
            raise
        raise ExplicitSolutionError(f"{error} Or it is {solver}'s: try explicit().") from None
    except (np.linalg.LinAlgError, FloatingPointError) as error:
        fault = str(error).partition("\n")[0].rstrip(".")
        raise ExplicitSolutionError(
            f"No explicit law was found: the equations of a region have no solution in float64 "
            f"({fault}). Bring states, inputs and weights to similar magnitudes, shorten the "
            "horizon, or use online(), which needs no regions."
        ) from None
    return units.law(regions, infeasible)


def critical_regions(program: ParametricQP, solver: str, timer: BudgetTimer) -> list[Region]:
    """Return the critical regions of a program whose box is the unit box, sorted."""
    found = walk(program, timer) if solver == "walk" else ppopt_regions(program, timer)
    return sorted(found, key=lambda region: (len(region.active_set), region.active_set))


def load_kernels() -> None:
    """Load what is compiled; on a new machine this compiles, for longer than many a time limit."""
    for kernels in ("polyhedra", "law"):
        import_module(f"sb3_yann.control._kernels.{kernels}")


class ProgramUnits:
    """A program in units of its box and its input range, where tolerances suit every plant.

    Constraints that always hold with equality are eliminated. Theta is ``center + half`` (n,) times
    that of ``scaled``, and ``reach`` (v,) the units of U. ``to_inputs`` (m, k) is what of the
    variables of ``scaled`` is the first input, in units of its range.
    """

    def __init__(
        self, program: ParametricQP, u_min: Array, u_max: Array, timer: BudgetTimer | None = None
    ) -> None:
        m = len(u_min)
        self.program = program
        self.u_min = u_min
        self.u_max = u_max
        self.center = (program.theta_max + program.theta_min) / 2
        self.half = half_widths(program.theta_min, program.theta_max)
        scaled, self.reach = program.scaled(u_min, u_max, self.center)
        u_size = np.maximum(np.abs(u_min), np.abs(u_max)) / self.reach[:m]
        if program.feedback is not None:  # v = u - feedback theta
            box = np.maximum(np.abs(program.theta_min), np.abs(program.theta_max))
            u_size = u_size + np.abs(program.feedback) @ box / self.reach[:m]
        u_size = np.tile(u_size, (len(program.c) - program.n_slacks) // m)
        u_size = np.append(u_size, np.full(program.n_slacks, np.inf))
        scaled = scaled.without_short_rows(u_size).without_repeated_rows()
        self.to_inputs = np.eye(m, len(program.c))
        self.equalities = None
        if not _has_interior_point(scaled):
            self.equalities = _find_equalities(scaled, timer or BudgetTimer())
        if self.equalities is not None:
            scaled = self.equalities.eliminated(scaled)
            self.to_inputs = self.to_inputs @ self.equalities.free
        self.scaled = moderated(scaled)

    def law(self, regions: list[Region], infeasible: str) -> PiecewiseAffine:
        """Return the law of the first inputs in the units of the problem."""
        m = len(self.u_min)
        laws = [region.law for region in regions]
        if self.equalities is not None:  # of all of U in place of what is left of it
            laws = [self.equalities.free @ law + self.equalities.law for law in laws]
        inputs = np.stack([self.reach[:m, None] * law[:m] for law in laws])
        gains = inputs[..., :-1] / self.half
        offsets = inputs[..., -1] - gains @ self.center
        if self.program.feedback is not None:
            gains = gains + self.program.feedback
        A = np.concatenate([region.A / self.half for region in regions])
        # The region beyond each half-space, -1 where none is known; none at all for ppopt's.
        number = {region.active_set: i for i, region in enumerate(regions)}
        beyond = [
            -1 if active is None else number.get(active, -1)
            for region in regions
            for active in region.across
        ]
        return PiecewiseAffine(
            gains=gains,
            offsets=offsets,
            A=A,
            b=np.concatenate([region.b for region in regions]) + A @ self.center,
            starts=np.cumsum([0, *(len(region.b) for region in regions[:-1])]),
            u_min=self.u_min,
            u_max=self.u_max,
            theta_min=self.program.theta_min,
            theta_max=self.program.theta_max,
            infeasible=infeasible,
            disjoint=True,
            neighbors=np.array(beyond if len(beyond) == len(A) else [], dtype=np.int64),
        )


@dataclass(frozen=True, eq=False)
class Equalities:
    """``U = free y + law [theta; 1]`` for any y: what is left of U by equality constraints.

    ``free`` (v, k) is orthonormal, law (v, n + 1), and ``rows`` are the program's equalities.
    """

    free: Array
    law: Array
    rows: NDArray[np.intp]

    def eliminated(self, program: ParametricQP) -> ParametricQP:
        """Return the program in y, of unit rows.

        Of equalities that no U can meet, what is left binds theta. What is smaller than 1e-11 of
        what it is a sum of is zero.
        """
        n = program.F.shape[1]
        law = self.law[:, :n]
        at = self.law[:, n]
        size = np.linalg.norm(program.G, axis=1)
        G = program.G @ self.free
        G[np.linalg.norm(G, axis=1) <= 1e-11 * size] = 0.0
        G[self.rows] = 0.0
        limit = np.column_stack([program.S, program.w]) - program.G @ self.law
        S = limit[:, :n]
        w = limit[:, n]
        noise = 1e-11 * (1 + size * np.linalg.norm(self.law))
        S[np.linalg.norm(S, axis=1) <= noise] = 0.0
        w[~np.any(G, axis=1) & ~np.any(S, axis=1) & (np.abs(w) <= noise)] = 0.0
        length = row_norms(np.hstack([G, S]))
        return replace(
            program,
            H=self.free.T @ program.H @ self.free if np.any(self.free) else np.eye(1),
            F=self.free.T @ (program.F + program.H @ law),
            c=self.free.T @ (program.c + program.H @ at),
            G=G / length[:, None],
            S=S / length[:, None],
            w=w / length,
        )


def _find_equalities(program: ParametricQP, timer: BudgetTimer) -> Equalities | None:
    """Return what holds with equality wherever a program is feasible, None if nothing binds U so.

    A constraint that no feasible point keeps by more than 1e-9, in half-widths of the box, is an
    equality. Linear programs for the largest sum of slacks find the others.
    """
    v, n = program.F.shape
    inputs = v - program.n_slacks
    A = np.hstack([program.G, -program.S])
    left: NDArray[np.intp] = np.arange(len(A))
    while len(left):
        slacks = np.zeros((len(A), len(left)))
        slacks[left, np.arange(len(left))] = 1.0
        cost = np.concatenate([np.zeros(v + n), -np.ones(len(left))])
        # Of each row a little counts, so that none pays for another one.
        bounds = [(None, None)] * v + [(-1, 1)] * n + [(0, 1e-3)] * len(left)
        exact = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
        found = _linprog(cost, np.hstack([A, slacks]), program.w, bounds, timer, **exact)
        if found.x is None:
            return None
        room = (program.w - A @ found.x[: v + n])[left]
        if np.all(room <= 1e-9):
            break
        left = left[room <= 1e-9]
    left = left[np.any(program.G[left, :inputs], axis=1)]
    if not len(left):
        return None
    G = program.G[left]
    limit = np.column_stack([program.S, program.w])[left]
    # Slacks stay as they are: how steep a program is shows in their columns.
    free = linalg.block_diag(linalg.null_space(G[:, :inputs], rcond=1e-9), np.eye(program.n_slacks))
    if not free.size:
        free = np.zeros((inputs, 1))  # the equalities leave nothing to choose
    return Equalities(free, np.asarray(np.linalg.pinv(G, rcond=1e-9) @ limit), left)


def require_sane_sizes(program: ParametricQP, u_min: Array, u_max: Array) -> Array:
    """Raise where weights, the box of theta or an input's range make rounding hide the rest.

    Return which part of an input's range each entry of theta (n,) asks for in its box. Asked for
    more than 1e8 times their range, inputs are wrong, or feasible sets too thin to be found; asked
    for less than 1e-9 of it, constraints of states are too small beside it.
    """
    unit = 1 / np.sqrt(np.maximum(np.diag(program.H), 1e-300))
    H = unit[:, None] * program.H * unit
    for each in (program.H, H):  # both are factored
        try:
            np.linalg.cholesky(each)
        except np.linalg.LinAlgError:
            sizes = np.linalg.eigvalsh(each)
            raise ValueError(
                "The weights Q, R and the terminal cost differ so much that the quadratic program "
                f"has no unique solution to rounding: its Hessian has eigenvalues from "
                f"{sizes[0]:.1e} to {sizes[-1]:.1e}, and all must be positive. Pass a larger R, a "
                "shorter horizon, or states in other units."
            ) from None
    # Which part of its range each input is asked for by each entry of theta in its box, (m, n): the
    # largest of all steps where no constraint acts, 0 without a box or a range.
    m = len(u_min)
    gains = -(unit[:, None] * np.linalg.lstsq(H, unit[:, None] * program.F, rcond=None)[0])
    gains = gains[: len(program.c) - program.n_slacks]
    if program.feedback is not None:  # later steps are what is added to it
        gains = gains[:m] + program.feedback
    gains = np.abs(gains).reshape(-1, m, program.F.shape[1]).max(axis=0)
    width = program.theta_max / 2 - program.theta_min / 2
    box = np.where(np.isfinite(width), width, 0.0)
    bounded = np.isfinite(u_min) & np.isfinite(u_max)
    demanded = gains * box / half_widths(u_min, u_max)[:, None] * bounded[:, None]
    most = demanded.max(axis=1, initial=0.0)
    # A small part alone may be an input with next to no effect, whose bounds are as they should be.
    too_large = (0 < most) & (most < 1e-9) & (half_widths(u_min, u_max) > 1e9)
    for i in np.flatnonzero(too_large):
        raise ValueError(
            f"u_max[{i}] = {u_max[i]:g}, with u_min[{i}] = {u_min[i]:g}, is too large: expected "
            f"are bounds of which the MPC asks for more than {1e-9:g}, and it asks for "
            f"{most[i]:.0e} of these. Pass what the actuator can do, or inf for no bound."
        )
    if np.any(demanded > 1e8):
        i = int(np.argmax(demanded.max(axis=0)))
        raise ValueError(
            f"theta_min[{i}] = {program.theta_min[i]:g} and theta_max[{i}] = "
            f"{program.theta_max[i]:g} lie too far apart: in this box the MPC asks for inputs "
            f"{demanded.max():.0e} times their range, expected are at most {1e8:g}. Pass as "
            "theta_min and theta_max, or x_min and x_max, what the plant can reach; or inf for no "
            "bound, and use online()."
        )
    lessened: Array = np.zeros(0)
    if program.n_slacks and np.all(np.isfinite(width)):
        lessened = slacks_made_cheap(program.scaled(u_min, u_max, 0 * program.theta_min)[0])
    if np.any(lessened):
        warn(
            f"Soft bounds may be violated {lessened.max():.0e} times as far in theta's box as "
            "inputs move what they bound. So large a cost rounding would hide, and it is lessened: "
            "inputs may differ from those that the penalty asks for. Pass as theta_min and "
            "theta_max, or x_min and x_max, what the plant can reach, or a lower penalty."
        )
    return np.asarray(demanded.max(axis=0))


def _has_interior_point(program: ParametricQP) -> bool:
    """Tell whether the middle of the box is feasible with room: mostly, and a quick answer."""
    rows = np.hstack([program.G, -program.S])
    tighter = replace(program, w=program.w - 1e-6 * np.linalg.norm(rows, axis=1))
    return tighter.solve(np.zeros(program.F.shape[1])) is not None


def _require_feasible(program: ParametricQP, timer: BudgetTimer) -> None:
    """Raise unless the feasible pairs (U, theta) have an interior (largest ball, HiGHS)."""
    if _has_interior_point(program):
        return
    v, n = program.F.shape
    rows = np.hstack([program.G, -program.S])
    rows = np.hstack([rows, np.linalg.norm(rows, axis=1, keepdims=True)])
    bounds = [(None, None)] * v + [(-1, 1)] * n + [(None, 1)]
    ball = _linprog(np.append(np.zeros(v + n), -1.0), rows, program.w, bounds, timer)
    if ball.status != 0 or ball.x[-1] < 1e-9:
        raise ValueError(
            "The MPC problem is infeasible: no theta in its box has inputs that keep every bound "
            "with room to spare. Have bounds and operating point the same units? "
            "Widen x_min/x_max, u_min/u_max or the terminal set, or lengthen the horizon. Where "
            "only a line or a plane of theta is feasible, use online()."
        )


def _linprog(
    cost: Array, A: Array, b: Array, bounds: Any, timer: BudgetTimer, **options: Any
) -> Any:
    """Return HiGHS's answer to a linear program; raise ExplicitLimitError if time is over."""
    timer.tick(effort_of_lp(*A.shape))
    options["time_limit"] = timer.left()
    found = optimize.linprog(cost, A_ub=A, b_ub=b, bounds=bounds, options=options)
    timer.tick()
    return found


_PATCHING = threading.RLock()


def ppopt_regions(program: ParametricQP, timer: BudgetTimer) -> list[Region]:
    """Return the critical regions of a program with unit rows whose box is the unit box.

    They come from ppopt's combinatorial graph search (Arnström et al.,
    https://arxiv.org/abs/2404.05511), with DAQP for its linear programs too. Their number is
    known only at the end.
    """
    if not np.any(program.G):  # nothing binds U, which ppopt does not take
        timer.count()
        law = -np.linalg.solve(program.H, np.column_stack([program.F, program.c])).astype(float)
        return [Region((), law, *program.theta_rows())]

    # Rows without U bound theta: with them in the constraints ppopt's active sets degenerate.
    moving = np.any(program.G, axis=1) | ~np.any(program.S, axis=1)
    theta_A, theta_b = program.theta_rows()
    from ppopt.mp_solvers import mpqp_combi_graph
    from ppopt.mpqp_program import MPQP_Program

    with warnings.catch_warnings(), _solvers(timer) as solver:
        warnings.simplefilter("ignore")  # feasibility was checked, with a clearer message
        problem = MPQP_Program(
            A=program.G[moving],
            b=program.w[moving, None],
            c=program.c[:, None],
            H=program.F,
            Q=program.H,
            A_t=theta_A,
            b_t=theta_b[:, None],
            F=program.S[moving],
            solver=solver,
        )
        found = mpqp_combi_graph.solve(problem).critical_regions
    timer.count(len(found))
    # Which row of the program each row is that ppopt has kept.
    ours = np.column_stack([program.G, -program.S, program.w])
    theirs = np.column_stack([problem.A, -problem.F, problem.b])
    distance = np.abs(theirs[:, None] - ours[None]).max(axis=2)
    rows = np.argmax(distance < 1e-9 + distance.min(axis=1, keepdims=True), axis=1)
    return [
        Region(
            tuple(sorted(int(rows[k]) for k in one.active_set)),
            np.column_stack([one.A, one.b]),
            one.E.astype(float),  # with one parameter they are whole numbers
            one.f.ravel().astype(float),
        )
        for one in found
    ]


@contextmanager
def _solvers(timer: BudgetTimer) -> Iterator[Any]:
    """Give ppopt DAQP in place of GLPK, which it also calls past its solver object."""
    from ppopt import solver
    from ppopt.solver_interface import solver_interface

    def solve_lp(c: Any, A: Any, b: Any, equal: Any = None, *_: Any) -> Any:
        timer.tick()
        return _solve_lp(c, A, b, equal)

    with _PATCHING:
        shipped = [(module, module.solve_lp_cvxopt) for module in (solver, solver_interface)]
        try:
            for module, _ in shipped:
                module.solve_lp_cvxopt = solve_lp
            yield solver.Solver({"lp": "glpk", "qp": "daqp"})
        finally:
            for module, function in shipped:
                module.solve_lp_cvxopt = function


def _solve_lp(c: Array | None, A: Array, b: Array, equal: list[int] | None) -> Any:
    """Return ppopt's answer to ``min c'z``, or the shortest z, with ``A z <= b`` and equal rows."""
    import daqp
    from ppopt.solver_interface.solver_interface_utils import SolverOutput

    n = A.shape[1]
    sense = np.zeros(len(b), dtype=np.intc)
    sense[list(equal or ())] = 5
    cost = np.zeros(n) if c is None else np.ravel(c).astype(float)
    # With a cost, proximal steps solve the linear program.
    H = None if np.any(cost) else np.eye(n)
    settings = {"eps_prox": 1e-2} if np.any(cost) else {}
    A = np.ascontiguousarray(A, dtype=float)
    b = np.ravel(b).astype(float)
    point, value, status, _ = daqp.solve(
        H, cost, A, b, np.full(len(b), -1e30), sense, primal_tol=1e-9, **settings
    )
    return SolverOutput(value, np.asarray(point), None, None, None) if status == 1 else None
