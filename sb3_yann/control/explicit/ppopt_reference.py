"""The critical regions of a quadratic program from ppopt, the reference for our own search."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control.explicit.budget import BudgetTimer
from sb3_yann.control.explicit.parametric_qp import ParametricQP
from sb3_yann.control.polyhedra import Region

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
        return [Region((), law[:, :-1], law[:, -1], *program.theta_rows())]

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
            one.A,
            one.b.ravel(),
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
