"""Solves a multi-parametric quadratic program off line, and checks the answer."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from scipy.spatial import QhullError

from sb3_yann._validation import Array, check_choice, half_widths
from sb3_yann.control.explicit.budget import BudgetTimer, SolveBudget, effort_of_lp
from sb3_yann.control.explicit.certificate import Certificate, ExplicitSolutionError
from sb3_yann.control.explicit.equalities import Equalities
from sb3_yann.control.explicit.facet_walk import walk
from sb3_yann.control.explicit.parametric_qp import ParametricQP
from sb3_yann.control.explicit.ppopt_reference import ppopt_regions
from sb3_yann.control.explicit.steep import solvable
from sb3_yann.control.law import PiecewiseAffine
from sb3_yann.control.polyhedra import Region

KERNELS = (
    "sb3_yann.control._kernels.polyhedra",
    "sb3_yann.control._kernels.law",
    "sb3_yann.control.search_tree",
)
"""What a search needs that is compiled."""
ABSURD, LITTLE = 1e8, 1e-9
"""Asked for more input ranges in their box, laws are wrong, or feasible sets too thin to be seen;
asked for less of a range, constraints of states are too faint beside it."""


def solve_explicit(
    program: ParametricQP,
    u_min: Array,
    u_max: Array,
    infeasible: str,
    solver: str = "walk",
    timer: BudgetTimer | None = None,
) -> PiecewiseAffine:
    """Return the law of the first ``len(u_min)`` entries of U, with a region for each active set.

    The regions are in the order of their active sets, fewest constraints first.

    Parameters
    ----------
    program : ParametricQP
        In the units of the plant.
    u_min, u_max : ndarray, shape (m,)
        The input range, in which tolerances are measured; infinite where there is none.
    infeasible : {"nearest_region", "zero_input"}
        See :class:`PiecewiseAffine`.
    solver : {"walk", "ppopt"}
        Our walk from facet to facet, or ppopt, tens of times slower.
    timer : BudgetTimer, optional
        Gives up at a limit.

    Its errors are those of :meth:`LinearMPC.explicit`.
    """
    check_choice("solver", solver, ("walk", "ppopt"))
    _require_box(program)
    require_sane_sizes(program, u_min, u_max)
    timer = timer or BudgetTimer(SolveBudget())
    timer.tick()
    try:
        return _solved(ProgramUnits(program, u_min, u_max, timer), infeasible, solver, timer)
    except ExplicitSolutionError as error:
        if solver == "walk":
            raise
        raise ExplicitSolutionError(f"{error} Or it is {solver}'s: try explicit().") from None
    except (np.linalg.LinAlgError, QhullError, FloatingPointError) as error:
        fault = str(error).partition("\n")[0].rstrip(".")
        raise ExplicitSolutionError(
            f"No explicit law was found: the equations of a region have no solution in float64 "
            f"({fault}). Bring states, inputs and weights to similar magnitudes, shorten the "
            "horizon, or use online(), which needs no regions."
        ) from None


def load_kernels() -> None:
    """Load what is compiled; on a new machine this compiles, for longer than many a time limit."""
    for kernels in KERNELS:
        import_module(kernels)


def _solved(
    units: ProgramUnits, infeasible: str, solver: str, timer: BudgetTimer
) -> PiecewiseAffine:
    """Return the law of a program in its units, checked, with its search tree."""
    _require_feasible(units.scaled, timer)
    regions = _critical_regions(units.scaled, solver, timer)
    certificate = Certificate(
        units.scaled, regions, units.to_inputs, units.center, units.half, timer
    )
    regions = certificate.check()
    law = units.law(regions, infeasible)
    if not law.walks:
        timer.stage("Search tree", "and checked", law.n_regions)
        # Each region's vertices, and the nodes: by trial.
        effort = 2e-4 * 2.0 ** max(0, law.n_theta - 4)
        law.grow_tree(lambda count: timer.advance(count, count * effort))
    return law


def _critical_regions(program: ParametricQP, solver: str, timer: BudgetTimer) -> list[Region]:
    """Return the critical regions of a program whose box is the unit box, sorted."""
    found = walk(program, timer) if solver == "walk" else ppopt_regions(program, timer)
    return sorted(found, key=lambda region: (len(region.active_set), region.active_set))


class ProgramUnits:
    """A program in units of its box and its input range, where tolerances suit every plant.

    Constraints that always hold with equality are eliminated.

    Parameters
    ----------
    program, u_min, u_max
        As in :func:`solve_explicit`.
    timer : BudgetTimer, optional
        Ends the search for equalities.
    """

    def __init__(
        self,
        program: ParametricQP,
        u_min: Array,
        u_max: Array,
        timer: BudgetTimer | None = None,
    ) -> None:
        timer = timer or BudgetTimer(SolveBudget())
        self.center = (program.theta_max + program.theta_min) / 2
        self.half = half_widths(program.theta_min, program.theta_max)
        steps = (len(program.c) - program.n_slacks) // len(u_min)
        reach = np.tile(half_widths(u_min, u_max), steps)
        self.reach = np.concatenate([reach, np.ones(program.n_slacks)])
        self.program, self.input_range = program, (u_min, u_max)
        most = np.maximum(np.abs(u_min), np.abs(u_max)) / reach[: len(u_min)]
        if program.feedback is not None:  # v = u - feedback theta
            box = np.maximum(np.abs(program.theta_min), np.abs(program.theta_max))
            most = most + np.abs(program.feedback) @ box / reach[: len(u_min)]
        most = np.concatenate([np.tile(most, steps), np.full(program.n_slacks, np.inf)])
        scaled = program.scaled(self.center, self.half, self.reach)
        scaled = scaled.without_faint_rows(most)
        self.equalities = None
        if not _has_room(scaled):
            self.equalities = Equalities.of(
                scaled, lambda A, b, left: _room(A, b, left, scaled, timer)
            )
        if self.equalities is not None:
            scaled = self.equalities.eliminated(scaled)
        self.scaled = solvable(scaled)
        self.to_inputs = np.eye(len(u_min), len(program.c))
        if self.equalities is not None:
            self.to_inputs = self.to_inputs @ self.equalities.free

    def law(self, regions: list[Region], infeasible: str) -> PiecewiseAffine:
        """Return the law of the first inputs in the units of the problem."""
        m, reach, half = len(self.input_range[0]), self.reach, self.half
        if self.equalities is not None:
            regions = [self.equalities.with_all_of_U(region) for region in regions]
        gains = np.stack([reach[:m, None] * region.gain[:m] / half for region in regions])
        offsets = np.stack([reach[:m] * region.offset[:m] for region in regions])
        A = np.concatenate([region.A / half for region in regions])
        b = np.concatenate([region.b for region in regions]) + A @ self.center
        starts = np.cumsum([0, *(len(region.b) for region in regions[:-1])])
        ranges = *self.input_range, self.program.theta_min, self.program.theta_max
        offsets = offsets - gains @ self.center
        if self.program.feedback is not None:
            gains = gains + self.program.feedback
        beyond = _neighbors(regions)
        return PiecewiseAffine(gains, offsets, A, b, starts, *ranges, infeasible, True, beyond)


def _neighbors(regions: list[Region]) -> NDArray[np.int64]:
    """Return the region beyond each half-space, -1 where none is known; empty for no region."""
    number = {region.active_set: i for i, region in enumerate(regions)}
    beyond = [
        -1 if active is None else number.get(active, -1)
        for region in regions
        for active in region.across
    ]
    known = len(beyond) == sum(len(region.b) for region in regions)
    return np.array(beyond if known else [], dtype=np.int64)


def _require_box(program: ParametricQP) -> None:
    if not np.all(np.isfinite([program.theta_min, program.theta_max])):
        raise ValueError(
            f"The law needs a bounded box of theta, not {program.theta_min.tolist()} to "
            f"{program.theta_max.tolist()}. Pass finite theta_min and theta_max (or x_min and "
            "x_max), and where theta holds them, r_min and r_max, d_min and d_max, u_min and u_max."
        )


def asked_of_inputs(program: ParametricQP, u_min: Array, u_max: Array) -> Array:
    """Return which part of each input's range an entry of theta asks for in its box, (m, n).

    That is the largest of all steps where no constraint acts. It is 0 without a box of theta.
    """
    m, count = len(u_min), len(program.c) - program.n_slacks
    unit = 1 / np.sqrt(np.diag(program.H))
    H, F = unit[:, None] * program.H * unit, unit[:, None] * program.F
    gains = -(unit[:, None] * np.linalg.lstsq(H, F, rcond=None)[0])[:count]
    if program.feedback is not None:  # later steps are what is added to it
        gains = gains[:m] + program.feedback
    gains = np.abs(gains).reshape(-1, m, program.F.shape[1]).max(axis=0)
    width = program.theta_max / 2 - program.theta_min / 2
    box = np.where(np.isfinite(width), width, 0.0)
    return np.asarray(gains * box / half_widths(u_min, u_max)[:, None])


def _require_one_minimum(program: ParametricQP) -> None:
    """Raise where the program has no unique solution but for rounding."""
    unit = 1 / np.sqrt(np.maximum(np.diag(program.H), 1e-300))
    for H in (program.H, unit[:, None] * program.H * unit):  # both are factored
        try:
            np.linalg.cholesky(H)
        except np.linalg.LinAlgError:
            raise ValueError(
                "The weights Q, R and the terminal cost differ so much that the quadratic program "
                f"has no unique solution to rounding: its Hessian has eigenvalues from "
                f"{np.linalg.eigvalsh(H)[0]:.1e} to {np.linalg.eigvalsh(H)[-1]:.1e}, and all must "
                "be positive. Pass a larger R, a shorter horizon, or states in other units."
            ) from None


def require_sane_sizes(program: ParametricQP, u_min: Array, u_max: Array) -> None:
    """Raise where weights, the box of theta or an input's range make rounding hide the rest.

    Parameters
    ----------
    program, u_min, u_max
        As in :func:`solve_explicit`.
    """
    _require_one_minimum(program)
    bounded = np.isfinite(u_min) & np.isfinite(u_max)
    asked = asked_of_inputs(program, u_min, u_max) * bounded[:, None]
    most, width = asked.max(axis=1, initial=0.0), half_widths(u_min, u_max)
    # A small part alone may be an input with next to no effect, whose bounds are as they should be.
    for i in np.flatnonzero((0 < most) & (most < LITTLE) & (width > 1 / LITTLE)):
        raise ValueError(
            f"u_max[{i}] = {u_max[i]:g}, with u_min[{i}] = {u_min[i]:g}, is too large: expected "
            f"are bounds of which the MPC asks for more than {LITTLE:g}, and it asks for "
            f"{most[i]:.0e} of these. Pass what the actuator can do, or inf for no bound."
        )
    if np.any(asked > ABSURD):
        i = int(np.argmax(asked.max(axis=0)))
        raise ValueError(
            f"theta_min[{i}] = {program.theta_min[i]:g} and theta_max[{i}] = "
            f"{program.theta_max[i]:g} lie too far apart: in this box the MPC asks for inputs "
            f"{asked.max():.0e} times their range, expected are at most {ABSURD:.0e}. Pass as "
            "theta_min and theta_max, or x_min and x_max, what the plant can reach; or inf for no "
            "bound, and use online()."
        )


def _with_room(program: ParametricQP) -> ParametricQP:
    """Return the program with each constraint moved in by a millionth."""
    rows = np.hstack([program.G, -program.S])
    return replace(program, w=program.w - 1e-6 * np.linalg.norm(rows, axis=1))


def _has_room(program: ParametricQP) -> bool:
    """Tell whether the middle of the box is feasible with room: mostly, and soon told."""
    return _with_room(program).solve(np.zeros(program.F.shape[1])) is not None


def _require_feasible(program: ParametricQP, timer: BudgetTimer) -> None:
    """Raise unless the feasible pairs (U, theta) have an interior (largest ball, HiGHS)."""
    if _has_room(program):
        return
    v, n = program.F.shape
    rows = np.hstack([program.G, -program.S])
    rows = np.hstack([rows, np.linalg.norm(rows, axis=1, keepdims=True)])
    bounds = [(None, None)] * v + [(-1, 1)] * n + [(None, 1)]
    cost = np.zeros(v + n + 1)
    cost[-1] = -1
    ball = _linprog(cost, rows, program.w, bounds, timer)
    if ball.status != 0 or ball.x[-1] < 1e-9:
        raise ValueError(
            "The MPC problem is infeasible: no theta in its box has inputs that keep every bound "
            "with room to spare. Widen x_min/x_max, u_min/u_max or the terminal set, or lengthen "
            "the horizon. Where only a line or a plane of theta is feasible, use online()."
        )


def _room(
    A: Array, b: Array, left: NDArray[np.intp], program: ParametricQP, timer: BudgetTimer
) -> Array | None:
    """Return how much room some rows have where the sum of these is largest, None if infeasible."""
    v, n = program.F.shape
    count = len(left)
    slack = np.zeros((len(b), count))
    slack[left, np.arange(count)] = 1.0
    cost = np.concatenate([np.zeros(v + n), -np.ones(count)])
    # Of each row a little counts, so that none pays for another one.
    bounds = [(None, None)] * v + [(-1, 1)] * n + [(0, 1e-3)] * count
    exact = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    found = _linprog(cost, np.hstack([A, slack]), b, bounds, timer, **exact)
    return None if found.x is None else np.asarray((b - A @ found.x[: v + n])[left])


def _linprog(
    cost: Array, A: Array, b: Array, bounds: Any, timer: BudgetTimer, **options: Any
) -> Any:
    """Return HiGHS's answer to a linear program; raise ExplicitLimitError if time is over."""
    timer.tick(effort_of_lp(*A.shape))
    options["time_limit"] = timer.left()
    found = optimize.linprog(cost, A_ub=A, b_ub=b, bounds=bounds, options=options)
    timer.tick()
    return found
