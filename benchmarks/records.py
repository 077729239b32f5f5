"""What a benchmark found: rows of numbers that the report and the criteria are made from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from benchmarks.timing import Array, Stopwatch, quartiles, ratios

OURS = "ours"
"""How the names of our own rows begin; a section whose first row is none has no ratios."""
UNITS = {"s": 1.0, "ms": 1e3, "µs": 1e6}


@dataclass(frozen=True)
class Figure:
    """One number, with its spread where it has been measured several times.

    Attributes
    ----------
    section, name : str
        Where it belongs: the section and the row.
    column : str
        Mostly the number of regions of the problem.
    samples : ndarray, shape (k,)
        Seconds for times; bytes, counts or errors otherwise.
    kind : {"time", "bytes", "count", "error", "text"}
    """

    section: str
    name: str
    column: str
    samples: Array
    kind: str = "time"
    text: str = ""

    @property
    def middle(self) -> float:
        """The median."""
        return float(np.median(self.samples))

    def shown(self, base: Figure | None = None, *, spread: bool = True) -> str:
        """Return the median, and its quartiles or, with a base, how many times that it is."""
        if self.kind == "text":
            return self.text
        if self.kind == "count":
            return f"{self.middle:,.0f}"
        if self.kind == "error":
            return f"{self.middle:.1e}"
        if self.kind == "bytes":
            return size(self.middle)
        if base is None or base.kind != "time" or not base.name.startswith(OURS):
            return _spread(self.samples) if spread else seconds(self.middle)
        return f"{seconds(self.middle)}: {times(quartiles(ratios(self.samples, base.samples))[1])}"


class Figures:
    """All figures of a run, by section, name and column."""

    def __init__(self) -> None:
        self._all: dict[tuple[str, str, str], Figure] = {}

    def add(self, figures: Iterable[Figure]) -> None:
        """Add some; one of the same place takes the other's."""
        for each in figures:
            self._all[each.section, each.name, each.column] = each

    def get(self, section: str, name: str, column: str | int) -> Figure | None:
        """Return a figure, None where there is none."""
        return self._all.get((section, name, str(column)))

    def of(self, section: str) -> list[Figure]:
        """Return those of a section, in the order in which they came."""
        return [each for each in self._all.values() if each.section == section]

    def sections(self) -> list[str]:
        """Return the sections in the order in which they came."""
        return list(dict.fromkeys(each.section for each in self._all.values()))

    def rows(self, section: str, *, spread: bool = True) -> Iterator[tuple[str, list[str]]]:
        """Yield the name and the cells of each row of a section; the first row is the base."""
        own = self.of(section)
        columns = self.columns(section)
        names = list(dict.fromkeys(each.name for each in own))
        for name in names:
            cells = []
            for column in columns:
                figure = self.get(section, name, column)
                base = None if name.startswith(OURS) else self.get(section, names[0], column)
                cells.append(figure.shown(base, spread=spread) if figure else "")
            yield name, cells

    def columns(self, section: str) -> list[str]:
        """Return the columns of a section."""
        return list(dict.fromkeys(each.column for each in self.of(section)))


def timed(section: str, column: str | int, found: Mapping[str, Array]) -> list[Figure]:
    """Return the times of a group of tasks as figures."""
    return [Figure(section, name, str(column), samples) for name, samples in found.items()]


def show(figures: Figures, section: str, title: str, console: Console) -> None:
    """Print a section as a table."""
    table = Table(title=escape(title), title_justify="left")
    table.add_column("")
    for column in figures.columns(section):
        table.add_column(heading(column), justify="right")
    for name, cells in figures.rows(section):
        table.add_row(escape(name), *(escape(cell) for cell in cells))
    console.print(table)


def heading(column: str) -> str:
    """Return the heading of a column: numbers are numbers of regions."""
    return f"{int(column):,} regions" if column.isdigit() else column


def seconds(value: float) -> str:
    """Return a time with three digits and its unit."""
    unit = "µs" if value < 1e-3 else "ms" if value < 1 else "s"
    return f"{_digits(value * UNITS[unit])} {unit}"


def size(value: float) -> str:
    """Return a number of bytes with its unit."""
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{_digits(value)} {unit}"
        value /= 1000
    return f"{_digits(value)} GB"


def times(ratio: float) -> str:
    """Return a ratio."""
    return f"{_digits(ratio)}×"


def _digits(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _spread(samples: Array) -> str:
    low, middle, high = quartiles(samples)
    if len(samples) == 1:
        return seconds(middle)
    factor, unit = next((f, u) for u, f in UNITS.items() if seconds(middle).endswith(f" {u}"))
    return (
        f"{_digits(middle * factor)} {unit} ({_digits(low * factor)} to {_digits(high * factor)})"
    )


@dataclass
class Bench:
    """What a section works with.

    Attributes
    ----------
    watch : Stopwatch
    figures : Figures
    console : Console
    quick : bool
    slow : bool
        Whether to run what takes minutes.
    """

    watch: Stopwatch
    figures: Figures
    console: Console
    quick: bool = False
    slow: bool = False
