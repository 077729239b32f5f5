"""Bytes of laws and actors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from torch import nn

from benchmarks import peers
from benchmarks.evaluation import LITERAL_WIDTH
from benchmarks.networks import learner
from benchmarks.problems import Problem
from benchmarks.records import Bench, Figure
from sb3_yann import YannPolicy

SECTION = "memory"


def memory(bench: Bench, problem: Problem) -> None:
    """Count the bytes of what there is at one problem."""
    law = problem.law
    law(problem.points(1)[0])  # what compiled code takes is made when it is first needed
    found = {"law, with what finds its regions": sum(arrays(law.__dict__))}
    for name, policy in (("ours", YannPolicy), (peers.MLP, "MlpPolicy")):
        found[f"actor, {name}"] = module_bytes(learner(problem, policy).actor)
    network = f"{peers.LITERAL}, {LITERAL_WIDTH} nodes a region"
    found[network] = peers.literal_bytes(law, LITERAL_WIDTH)
    bench.figures.add(
        Figure(SECTION, name, str(problem.regions), np.array([float(value)]), "bytes")
        for name, value in found.items()
    )


def arrays(values: Mapping[str, Any]) -> Iterable[int]:
    """Yield the bytes of the arrays of an object, each once, with those of what it holds."""
    seen: set[int] = set()
    waiting: list[Any] = [*values.values()]
    while waiting:
        each = waiting.pop()
        if isinstance(each, np.ndarray):
            if id(each) not in seen:
                yield each.nbytes
            seen.add(id(each))
        elif isinstance(each, (tuple, list)):
            waiting += each
        elif type(each).__module__.startswith("sb3_yann"):
            waiting += vars(each).values()


def module_bytes(module: nn.Module) -> int:
    """Return the bytes of all parameters and buffers."""
    return sum(each.nbytes for each in (*module.parameters(), *module.buffers()))
