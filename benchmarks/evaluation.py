"""The law in numpy, one point and 256 at once, against ppopt, online solvers and the network."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th

from benchmarks import peers
from benchmarks.problems import Array, Problem
from benchmarks.records import Bench, timed
from benchmarks.timing import Task
from sb3_yann.networks.paper_yann import PaperYann

ONE = "law, one point"
MANY = "law, batch of 256"
OURS = "ours"
LOCATE = "ours, location alone"
LARGEST_LITERAL = 1e9
"""Bytes beyond which the literal network is not built."""
LITERAL_WIDTH = 2
"""Nodes for each region and layer, the fewest it works with: more make it slower."""
BATCH = 256
Network = Callable[[Array], Array]
TOLERANCE = {peers.OSQP: 1e-3, peers.LITERAL: 1e-3}
"""By how much of the input range a peer may differ; 1e-6 if it is not named."""


def law(bench: Bench, problem: Problem) -> None:
    """Measure the law at one point and at 256, numpy in and out."""
    literal = literal_network(problem)
    _one_point(bench, problem, literal)
    _many_points(bench, problem, literal)


def _one_point(bench: Bench, problem: Problem, literal: Network | None) -> None:
    points = problem.points(512)
    rows = [*points]
    columns = [point[:, None] for point in points]
    tasks = {OURS: Task(problem.law, rows), LOCATE: Task(problem.law.locate, rows)}
    for name, function in _ppopt(problem):
        tasks[name] = Task(function, columns)
    program = problem.mpc.condensed()
    m = problem.law.n_inputs
    tasks[peers.DAQP] = Task(peers.daqp_online(program, m), rows)
    if (osqp := peers.osqp_online(program, m)) is not None:
        tasks[peers.OSQP] = Task(osqp, rows)
    if literal is not None:
        tasks[peers.LITERAL] = Task(lambda point: literal(point[None])[0], rows)
    _require_agreement(problem, points[:20], tasks)
    bench.figures.add(timed(ONE, problem.regions, bench.watch.compare(tasks)))


def _many_points(bench: Bench, problem: Problem, literal: Network | None) -> None:
    batches = [*problem.points(8 * BATCH).reshape(8, BATCH, -1)]
    solve = peers.daqp_online(problem.mpc.condensed(), problem.law.n_inputs)
    tasks = {OURS: Task(problem.law, batches), LOCATE: Task(problem.law.locate, batches)}
    tasks[peers.DAQP] = Task(lambda batch: np.array([solve(point) for point in batch]), batches)
    if literal is not None:
        tasks[peers.LITERAL] = Task(literal, batches)
    bench.figures.add(timed(MANY, problem.regions, bench.watch.compare(tasks)))


def literal_network(problem: Problem) -> Network | None:
    """Return the paper's network, float64 numpy in and out, None where it would be too large."""
    if peers.literal_bytes(problem.law, LITERAL_WIDTH) > LARGEST_LITERAL:
        return None
    network = PaperYann(problem.law, LITERAL_WIDTH)

    def evaluate(batch: Array) -> Array:
        with th.no_grad():
            return np.asarray(network(th.as_tensor(batch, dtype=th.float32)).numpy(), dtype=float)

    return evaluate


def _ppopt(problem: Problem) -> list[tuple[str, Callable[[Array], Any]]]:
    from ppopt.upop.point_location import PointLocation

    m = problem.law.n_inputs
    shipped = peers.ppopt_solution(problem.mpc.condensed(), problem.law, overlap=True)
    plain = type(shipped)(shipped.program, shipped.critical_regions, is_overlapping=False)
    found = [(peers.PPOPT, shipped), (peers.NO_OVERLAP, plain)]
    found.append((peers.POINT_LOCATION, PointLocation(shipped)))
    found.append((peers.POINT_LOCATION_NO_OVERLAP, PointLocation(plain)))
    return [(name, _first(each.evaluate, m)) for name, each in found]


def _first(evaluate: Callable[[Array], Any], m: int) -> Callable[[Array], Any]:
    def function(theta: Array) -> Any:
        U = evaluate(theta)
        return None if U is None else U[:m, 0]

    return function


def _require_agreement(problem: Problem, points: Array, tasks: dict[str, Task]) -> None:
    """Raise where a peer computes something else: it would be no peer."""
    law = problem.law
    for name in [name for name in tasks if name != LOCATE]:
        off = []
        for each, point in zip(tasks[name].inputs, points, strict=False):
            u = tasks[name].function(each)
            off.append(np.inf if u is None else np.max(np.abs(u - law(point))))
        relative = np.array(off) / np.min(law.u_max - law.u_min)
        # In single precision the network takes a point near a facet for one of no region.
        found = float(np.quantile(relative, 0.75 if name == peers.LITERAL else 1.0))
        if found > TOLERANCE.get(name, 1e-6):
            raise RuntimeError(
                f"{name} differs from the law of {problem.name} by {found:.1e} of the input range."
            )
