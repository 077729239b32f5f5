"""Times of several functions that do the same, taken in turns."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
BLOCK = 1e-3
"""Seconds that one measurement lasts at least: long beside the clock, short beside a time slice."""


@dataclass(frozen=True)
class Task:
    """A function, and what it is called with, over and over."""

    function: Callable[[Any], object]
    inputs: Sequence[Any]


@dataclass
class Stopwatch:
    """Measures, and remembers how much of the time the process had a processor.

    Attributes
    ----------
    clock : callable
        Seconds; the wall's, or the processor's on a busy machine.
    repeats : int
        Measurements of each task, at most.
    seconds : float
        How long the measurements of a group of tasks may take; three of each are made anyway.
    """

    clock: Callable[[], float] = time.perf_counter
    repeats: int = 40
    seconds: float = 6.0
    spent: list[tuple[float, float]] = field(default_factory=list)

    def compare(self, tasks: Mapping[str, Task]) -> dict[str, Array]:
        """Return seconds per call of each task, shape (repeats,), measured in turns.

        What disturbs one measurement is likely to disturb its neighbors, so ratios of the tasks
        are taken turn by turn. Every function has run before, so that compilers and caches have
        done their work. All begin at the same input and go through them in the same order; in the
        time of a block a fast one meets more of them.
        """
        sizes = {name: self._block(task) for name, task in tasks.items()}
        found: dict[str, list[float]] = {name: [] for name in tasks}
        wall = time.perf_counter()
        cpu = time.process_time()
        for turn in range(self.repeats):
            for name, task in tasks.items():
                found[name].append(self._measure(task, sizes[name], turn * 7))
            if turn >= 2 and time.perf_counter() - wall > self.seconds:
                break
        self.spent.append((time.perf_counter() - wall, time.process_time() - cpu))
        return {name: np.array(each) for name, each in found.items()}

    def once(self, function: Callable[[], object]) -> Array:
        """Return the seconds of one call, shape (1,), for what takes long."""
        wall = time.perf_counter()
        cpu = time.process_time()
        start = self.clock()
        function()
        seconds = self.clock() - start
        self.spent.append((time.perf_counter() - wall, time.process_time() - cpu))
        return np.array([seconds])

    @property
    def share(self) -> float:
        """The share of the time in which a processor worked for the process; 1 is undisturbed."""
        wall, cpu = np.sum(self.spent, axis=0) if self.spent else (1.0, 1.0)
        return float(cpu / wall)

    def _block(self, task: Task) -> int:
        """Return how many calls last `BLOCK` seconds, after a few to warm up."""
        if self._measure(task, 1, 0) > 0.1:
            return 1
        once = min(self._measure(task, 3, k) for k in range(3))
        return int(np.clip(BLOCK / max(once, 1e-9), 1, 1000))

    def _measure(self, task: Task, calls: int, first: int) -> float:
        count = len(task.inputs)
        chosen = [task.inputs[(first + k) % count] for k in range(calls)]
        function = task.function
        start = self.clock()
        for each in chosen:
            function(each)
        return (self.clock() - start) / calls


def quartiles(samples: Array) -> tuple[float, float, float]:
    """Return the first quartile, the median and the third."""
    low, middle, high = np.quantile(samples, [0.25, 0.5, 0.75])
    return float(low), float(middle), float(high)


def ratios(samples: Array, base: Array) -> Array:
    """Return how many times `base` the samples are, turn by turn where there are as many turns."""
    if len(samples) == len(base):
        return np.asarray(samples / base)
    return np.asarray(samples / np.median(base))
