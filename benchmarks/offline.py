"""The offline solution, ours with its check, against ppopt's serial algorithms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks import peers
from benchmarks.problems import Problem
from benchmarks.records import Bench, Figure, timed
from benchmarks.timing import Array, Task
from sb3_yann.control import ParametricQP

SECTION = "offline solution"
OURS = "ours, with its check"
EACH = "ours, for each region"
SMALL = 300
"""Regions up to which ppopt takes seconds."""


def offline(bench: Bench, problem: Problem) -> None:
    """Measure the solution from the problem to the checked law."""
    regions = problem.regions
    slow = problem.regions > SMALL
    algorithms = peers.SERIAL if bench.slow or not slow else ()
    program = peers.ppopt_program(unit_box(problem.mpc.condensed(), problem))
    calls = {OURS: lambda: solve(problem)}
    calls |= {f"ppopt {name}": _ppopt(program, name, regions) for name in algorithms}
    tasks = {name: Task(lambda _, call=call: call(), [None]) for name, call in calls.items()}
    if slow:  # a peer that takes minutes runs once
        found = bench.watch.compare({OURS: tasks[OURS]})
        found |= {name: bench.watch.once(calls[name]) for name in calls if name != OURS}
    else:
        found = bench.watch.compare(tasks)
    bench.figures.add(timed(SECTION, regions, found))
    bench.figures.add([Figure(SECTION, EACH, str(regions), found[OURS] / regions)])


def solve(problem: Problem) -> int:
    """Solve anew, whatever has been solved before, and return the number of regions."""
    mpc = problem.make()
    return mpc.explicit().n_regions


def unit_box(program: ParametricQP, problem: Problem) -> ParametricQP:
    """Return the program in units of the box and the input range, which suits ppopt best."""
    law = problem.law
    middle = (law.theta_max + law.theta_min) / 2
    half = (law.theta_max - law.theta_min) / 2
    width: Array = (law.u_max - law.u_min) / 2
    return program.scaled(middle, half, np.tile(width, len(program.c) // len(width)))


def _ppopt(program: object, algorithm: str, regions: int) -> Callable[[], None]:
    def call() -> None:
        found = peers.ppopt_solve(program, algorithm)
        if found != regions:
            raise RuntimeError(f"ppopt's {algorithm} found {found} regions of {regions}.")

    return call
