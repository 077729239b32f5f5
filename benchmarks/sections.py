"""The sections of the benchmark, in order."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
import torch as th

from benchmarks import (
    deployment,
    evaluation,
    exactness,
    gpu,
    large,
    long_horizons,
    memory,
    networks,
    offline,
    online,
    simulators,
    suite,
)
from benchmarks.problems import PROBLEMS, SMALLEST, Problem
from benchmarks.records import Bench, Figure, show, timed
from benchmarks.timing import Array

TITLES = {
    evaluation.ONE: "The law in numpy, one point",
    evaluation.MANY: "The law in numpy, 256 points",
    networks.FORWARD_ONE: "Actor in torch, batch of 1, without gradient",
    networks.FORWARD_MANY: "Actor in torch, batch of 256, without gradient",
    networks.PREDICT: "model.predict of one observation",
    networks.TRAIN: "One training step of DDPG, batch of 256",
    offline.SECTION: "Offline solution",
    exactness.SECTION: "Exactness",
    suite.SECTION: "Suite of problems",
    large.SECTION: "A large law",
    long_horizons.SECTION: "Unstable plants over long horizons",
    online.LAW: "The online law in numpy, one point",
    online.PREDICT: "The online law: model.predict of one observation",
    online.TRAIN: "The online law: one training step of DDPG, batch of 256",
    online.BUILT: "The online law: DDPG is built",
    online.EXACT: "The online law: exactness",
    deployment.SECTION: "Exported controllers of the reactor, one step",
    deployment.SMALL: "An exported controller of the reactor on an emulated microcontroller",
    simulators.SECTION: "Environments",
    memory.SECTION: "Memory",
    gpu.SECTION: "Processor and CUDA device",
}
PerProblem = Callable[[Bench, Problem], None]
EACH: dict[str, PerProblem] = {
    "law": evaluation.law,
    "actor": networks.actor,
    "train": networks.training,
    "solve": offline.offline,
    "exact": exactness.exactness,
    "memory": memory.memory,
}
WHOLE: dict[str, Callable[[Bench], None]] = {
    "suite": suite.suite,
    "large": large.large,
    "horizons": long_horizons.long_horizons,
    "online": online.online,
    "export": deployment.deployment,
    "env": simulators.simulators,
}
GPU = "gpu"
NAMES = (*EACH, *WHOLE, GPU)


def run(bench: Bench, names: Sequence[str]) -> None:
    """Run some of the sections, and print the tables as they come."""
    problems = [SMALLEST] if bench.quick else PROBLEMS
    for name in names:
        before, began = set(bench.figures.sections()), time.perf_counter()
        if name in WHOLE:
            WHOLE[name](bench)
        elif name == GPU:
            _devices(bench, problems)
        else:
            for problem in problems:
                EACH[name](bench, problem)
        for section in bench.figures.sections():
            if section not in before:
                show(bench.figures, section, TITLES[section], bench.console)
        bench.console.print(f"{name}: {time.perf_counter() - began:.0f} s\n")


def _devices(bench: Bench, problems: Sequence[Problem]) -> None:
    """Measure on a CUDA device too, where there is one."""
    if not th.cuda.is_available():
        bench.console.print("No CUDA device: the section gpu is skipped.")
        return
    for problem in (problems[0], problems[-1]):
        found: dict[tuple[str, int], Array] = {}
        for what, device, batch, seconds in gpu.measure(problem.law, bench.watch):
            row = f"{problem.regions:,} regions, {what}, {device}"
            bench.figures.add(timed(gpu.SECTION, f"batch of {batch:,}", {row: seconds}))
            if what == gpu.BACKWARD:
                found[device, batch] = seconds
        first = gpu.pays_from(found)
        text = "never" if first is None else f"from a batch of {first:,}"
        row = f"{problem.regions:,} regions: where cuda is faster"
        column = f"batch of {gpu.BATCHES[0]:,}"
        bench.figures.add([Figure(gpu.SECTION, row, column, np.zeros(1), "text", text)])
