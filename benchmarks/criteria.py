"""What was required of the speed, and whether the figures reach it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks import (
    evaluation,
    exactness,
    large,
    networks,
    offline,
    online,
    peers,
    simulators,
    suite,
)
from benchmarks.records import Figures, seconds, times
from benchmarks.timing import ratios


@dataclass(frozen=True)
class Criterion:
    """One line of the table.

    Attributes
    ----------
    what, required : str
    found : str
    holds : bool
    """

    what: str
    required: str
    found: str
    holds: bool

    @property
    def reached(self) -> str:
        """Return yes or no."""
        return "yes" if self.holds else "**no**"


def criteria(figures: Figures) -> list[Criterion]:
    """Return every requirement whose figures are there."""
    parts = (_law, _batch, _actor, _training, _exact, _suite, _solve, _large, _online, _steps)
    return [line for part in parts for line in part(figures)]


def _sizes(figures: Figures, section: str) -> list[int]:
    return sorted(int(each) for each in figures.columns(section) if each.isdigit())


def _faster(
    figures: Figures, section: str, peer: str, size: int, factor: float, ours: str = "ours"
) -> Iterator[Criterion]:
    """Yield whether the peer takes so many times as long, where both were measured."""
    mine, theirs = figures.get(section, ours, size), figures.get(section, peer, size)
    if mine is None or theirs is None:
        return
    ratio = float(np.median(ratios(theirs.samples, mine.samples)))
    shown = f"{times(ratio)} ({seconds(mine.middle)} against {seconds(theirs.middle)})"
    what = f"{section}, {size:,} regions"
    name = "" if ours == "ours" else f"{ours.partition(', ')[2]}: "
    yield Criterion(what, f"{name}{times(factor)} faster than {peer}", shown, ratio >= factor)


def _near(sizes: list[int], size: int) -> list[int]:
    """Return the measured size that is about the one that was named, if there is one."""
    return [each for each in sizes if 0.7 < each / size < 1.4]


def _law(figures: Figures) -> Iterator[Criterion]:
    sizes = _sizes(figures, evaluation.ONE)
    for peer, at_7, at_1900 in ((peers.PPOPT, 20, 1000), (peers.POINT_LOCATION, 5, 50)):
        for size, factor in ((7, at_7), (1900, at_1900)):
            for each in _near(sizes, size):
                yield from _faster(figures, evaluation.ONE, peer, each, factor)
    for each in sizes:
        yield from _faster(figures, evaluation.ONE, peers.DAQP, each, 2)


def _batch(figures: Figures) -> Iterator[Criterion]:
    sizes = _sizes(figures, evaluation.MANY)
    for each in sizes:
        yield from _faster(figures, evaluation.MANY, peers.DAQP, each, 8)
    for each in _near(sizes, 1900):
        yield from _faster(figures, evaluation.MANY, peers.LITERAL, each, 300)


def _at_most(
    figures: Figures, section: str, size: int, factor: float, peer: str = peers.MLP
) -> Iterator[Criterion]:
    mine, theirs = figures.get(section, "ours", size), figures.get(section, peer, size)
    if mine is None or theirs is None:
        return
    ratio = float(np.median(ratios(mine.samples, theirs.samples)))
    shown = f"{times(ratio)} ({seconds(mine.middle)} against {seconds(theirs.middle)})"
    what = f"{section}, {size:,} regions"
    yield Criterion(what, f"at most {times(factor)} {peer}", shown, ratio <= factor)


def _actor(figures: Figures) -> Iterator[Criterion]:
    section = networks.FORWARD_ONE
    sizes = _sizes(figures, section)
    for each in sizes:
        yield from _at_most(figures, section, each, 1.5)
    middles = [figure.middle for each in sizes if (figure := figures.get(section, "ours", each))]
    if len(middles) > 1:
        more = max(middles) / min(middles) - 1
        found = f"{100 * more:.0f} % ({seconds(min(middles))} to {seconds(max(middles))})"
        what = f"{section}, {sizes[0]:,} to {sizes[-1]:,} regions"
        yield Criterion(what, "within 20 %", found, more <= 0.2)


def _training(figures: Figures) -> Iterator[Criterion]:
    sizes = _sizes(figures, networks.TRAIN)
    for size, factor in ((7, 0.5), (4000, 1.5)):
        for each in _near(sizes, size):
            yield from _at_most(figures, networks.TRAIN, each, factor)


def _exact(figures: Figures) -> Iterator[Criterion]:
    section = exactness.SECTION
    sizes = _sizes(figures, section)
    rows = (exactness.UNCOVERED, exactness.MISPLACED, exactness.DOUBLED)
    for size in sizes:
        counts = [figure.middle for row in rows if (figure := figures.get(section, row, size))]
        points = figures.get(section, exactness.POINTS, size)
        error = figures.get(section, exactness.ERROR, size)
        if points is None or error is None:
            continue
        found = f"{sum(counts):,.0f} of {points.middle:,.0f}"
        what = f"{section}, {size:,} regions"
        yield Criterion(what, "no point uncovered, misplaced or doubled", found, sum(counts) == 0)
        shown = f"{error.middle:.1e}"
        yield Criterion(what, "error against a QP at most 1e-9", shown, error.middle <= 1e-9)


def _suite(figures: Figures) -> Iterator[Criterion]:
    rows = (suite.PROBLEMS, suite.FAILURES, suite.WRONG_LAWS, suite.ERROR)
    found = [figure.middle for row in rows if (figure := figures.get(suite.SECTION, row, "all"))]
    if len(found) == len(rows):
        count, failures, wrong, error = found
        shown = f"{failures:.0f} failures, {wrong:.0f} wrong laws of {count:.0f}"
        yield Criterion(
            suite.SECTION, "every problem solved, and right", shown, failures == wrong == 0
        )
        required = "error against a QP at most 1e-9"
        yield Criterion(suite.SECTION, required, f"{error:.1e}", error <= suite.WRONG)


def _solve(figures: Figures) -> Iterator[Criterion]:
    section = offline.SECTION
    for size in _sizes(figures, section):
        ours = figures.get(section, offline.OURS, size)
        if ours is None:
            continue
        rivals = [figures.get(section, f"ppopt {name}", size) for name in peers.SERIAL]
        theirs = [rival for rival in rivals if rival is not None]
        what = f"{section}, {size:,} regions"
        if theirs:
            best = min(theirs, key=lambda each: each.middle)
            shown = f"{seconds(ours.middle)} against {seconds(best.middle)} ({best.name})"
            required = "no slower than ppopt's best serial algorithm"
            yield Criterion(what, required, shown, ours.middle <= best.middle)
        if size > offline.SMALL:
            each = ours.middle / size
            yield Criterion(what, "at most 0.5 ms a region", seconds(each), each <= 5e-4)


def _large(figures: Figures) -> Iterator[Criterion]:
    for column in figures.columns(large.SECTION):
        for name, most, required in (
            (large.SOLVED, 30.0, "in 30 s"),
            (large.EACH, 5e-6, "at most 5 µs a point"),
        ):
            found = figures.get(large.SECTION, name, column)
            if found is not None:
                what, shown = f"{large.SECTION}, {column}", seconds(found.middle)
                yield Criterion(what, required, shown, found.middle <= most)


def _online(figures: Figures) -> Iterator[Criterion]:
    for column in figures.columns(online.PREDICT):
        predict, built = (
            figures.get(section, networks.OURS, column)
            for section in (online.PREDICT, online.BUILT)
        )
        ours, theirs = (
            figures.get(online.TRAIN, each, column) for each in (networks.OURS, peers.MLP)
        )
        error = figures.get(online.EXACT, online.ERROR, column)
        if not (predict and built and ours and theirs and error):
            continue
        wide = column.startswith("165")
        most = 15e-3 if wide else 1e-3
        yield Criterion(
            f"{online.PREDICT}, {column}", f"at most {seconds(most)}", seconds(predict.middle),
            predict.middle <= most,
        )  # fmt: skip
        ratio = float(np.median(ratios(ours.samples, theirs.samples)))
        shown = f"{seconds(ours.middle)}: {times(ratio)} {peers.MLP}"
        required = "at least 50 a second" if wide else f"at most {times(1.5)} {peers.MLP}"
        holds = ours.middle <= 0.02 if wide else ratio <= 1.5
        yield Criterion(f"{online.TRAIN}, {column}", required, shown, holds)
        shown = seconds(built.middle)
        yield Criterion(f"{online.BUILT}, {column}", "in 2 s", shown, built.middle <= 2)
        shown = f"{error.middle:.1e}"
        yield Criterion(f"{online.EXACT}, {column}", "at most 1e-6", shown, error.middle <= 1e-6)


def _steps(figures: Figures) -> Iterator[Criterion]:
    section, name = simulators.SECTION, simulators.CSTR
    time = figures.get(section, name, simulators.TIME)
    if time is not None:
        yield Criterion(name, "under 20 µs", seconds(time.middle), time.middle < 20e-6)
    for figure in figures.of(section):
        if figure.column.startswith(simulators.ERROR):
            what = f"{name}, {figure.column}"
            yield Criterion(what, "under 1e-6", f"{figure.middle:.1e}", figure.middle < 1e-6)
