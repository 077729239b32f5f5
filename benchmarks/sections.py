"""The sections of the benchmark, in order."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from benchmarks import (
    deployment,
    evaluation,
    exactness,
    large,
    long_horizons,
    memory,
    networks,
    offline,
    online,
    processes,
    suite,
)
from benchmarks.problems import PROBLEMS, SMALLEST, Problem
from benchmarks.records import Bench, show

TITLES = {
    evaluation.ONE: "The law in numpy, one point",
    evaluation.MANY: "The law in numpy, 256 points",
    networks.FORWARD_ONE: "Actor in torch, batch of 1, without gradient",
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
    online.EXACT: "The online law: exactness",
    deployment.SECTION: "Exported controllers of the reactor, one step",
    deployment.SMALL: "An exported controller of the reactor on an emulated microcontroller",
    memory.SECTION: "Memory",
    processes.SECTION: "A simulator of 5 ms a step",
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
    "processes": processes.processes,
}
NAMES = (*EACH, *WHOLE)


def run(bench: Bench, names: Sequence[str]) -> None:
    """Run some of the sections, and print the tables as they come."""
    problems = [SMALLEST] if bench.quick else PROBLEMS
    for name in names:
        before = set(bench.figures.sections())
        began = time.perf_counter()
        if name in WHOLE:
            WHOLE[name](bench)
        else:
            for problem in problems:
                EACH[name](bench, problem)
        for section in bench.figures.sections():
            if section not in before:
                show(bench.figures, section, TITLES[section], bench.console)
        bench.console.print(f"{name}: {time.perf_counter() - began:.0f} s\n")
