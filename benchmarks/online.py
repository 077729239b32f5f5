"""Laws that are solved online: one point, a batch, and the policies around them."""

from __future__ import annotations

from functools import partial

import numpy as np
from stable_baselines3 import DDPG

from benchmarks import networks, peers
from benchmarks.online_problems import PROBLEMS, OnlineProblem, worst_condition
from benchmarks.records import Bench, Figure, timed
from benchmarks.timing import Task
from sb3_yann import YannPolicy

LAW = "online law"
PREDICT = "online law, predict"
TRAIN = "online law, training step"
EXACT = "online law, exactness"
OURS = "ours, a new point"
KNOWN = "ours, a known point"
BATCH = "ours, each of 256 new points"
POINTS = "points"
CONDITIONS = "largest violation of optimality"
ERROR = "largest error of an input"
CHECKED = 10_000


def online(bench: Bench) -> None:
    """Measure all of the problems, or in the quick form the first."""
    for problem in PROBLEMS[:1] if bench.quick else PROBLEMS:
        _law(bench, problem)
        _policy(bench, problem)
        _exactness(bench, problem)


def _law(bench: Bench, problem: OnlineProblem) -> None:
    law = problem.law
    theta = problem.points(1024)
    solve = law.known.function
    law(theta)
    tasks = {
        OURS: Task(lambda each: solve(each[None]), [*theta]),
        KNOWN: Task(law, [*theta]),
        peers.DAQP: Task(peers.daqp_online(law.program, law.n_inputs), [*theta]),
    }
    found = bench.watch.compare(tasks)
    batch = bench.watch.compare({BATCH: Task(solve, [*theta.reshape(4, 256, -1)])})[BATCH]
    found[BATCH] = batch / 256
    bench.figures.add(timed(LAW, problem.name, found))


def _policy(bench: Bench, problem: OnlineProblem) -> None:
    models = {
        networks.OURS: networks.learner(problem, YannPolicy),
        peers.MLP: networks.learner(problem, "MlpPolicy"),
    }
    theta = problem.points(4096, seed=2).astype(np.float32)  # so many that few are known
    tasks = {name: Task(networks.predictor(model), [*theta]) for name, model in models.items()}
    bench.figures.add(timed(PREDICT, problem.name, bench.watch.compare(tasks)))
    tasks = {}
    for name, model in models.items():
        networks.fill(model, problem)
        _ask_what_is_stored(model, problem)
        tasks[name] = Task(partial(_train, model), [1])
    bench.figures.add(timed(TRAIN, problem.name, bench.watch.compare(tasks)))


def _ask_what_is_stored(model: DDPG, problem: OnlineProblem) -> None:
    """Evaluate the law at all observations of the buffer, as a policy has that acted there."""
    buffer = model.replay_buffer
    assert buffer is not None
    for seen in (buffer.observations, buffer.next_observations):
        problem.law(seen[:, 0])  # it is full


def _train(model: DDPG, steps: int) -> None:
    model.train(steps, networks.BATCH)


def _exactness(bench: Bench, problem: OnlineProblem) -> None:
    count = CHECKED if problem.law.n_theta < 100 and not bench.quick else 1000
    conditions, error = worst_condition(problem.law, problem.points(count, seed=3))
    found = ((POINTS, "count", count), (CONDITIONS, "error", conditions), (ERROR, "error", error))
    bench.figures.add(
        Figure(EXACT, name, problem.name, np.array([value]), kind) for name, kind, value in found
    )
