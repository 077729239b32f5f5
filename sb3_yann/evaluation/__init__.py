"""Seeded episodes, tables of them before and after training, and pictures."""

from __future__ import annotations

from io import StringIO
from typing import TYPE_CHECKING

import numpy as np

from sb3_yann.rollout import Trajectories, as_played, evaluate

if TYPE_CHECKING:
    from rich.table import Table

__all__ = [
    "Trajectories",
    "comparison_table",
    "evaluate",
    "summary_table",
]
WIDTH = 100  # letters in a line of a table that is printed


def comparison_table(title: str, before: Trajectories, after: Trajectories) -> Table:
    """Return a `rich` table of the cost of each episode before and after, with the mean.

    The episodes must be those of the same seeds. A change for the worse is printed red.

    Examples
    --------
    >>> from sb3_yann.evaluation import evaluate
    >>> none, full = (evaluate(lambda _, u=u: [u], "CSTR-v0", [0, 1]) for u in (0.0, 1.0))
    >>> comparison_table("no input, full input", none, full).row_count
    3
    """
    table = _table("episode", title)
    _require_pairs(before, after)
    rows = [*zip(before.costs, after.costs, strict=True)]
    for number, (old, new) in enumerate(rows, start=1):
        table.add_row(str(number), f"{old:,.2f}", f"{new:,.2f}", _change(new - old))
    table.add_section()
    _compare(table, "mean", *np.mean(rows, axis=0))
    if before.violations.any() or after.violations.any():
        table.add_row("violations", str(before.violations.sum()), str(after.violations.sum()), "")
    return table


def summary_table(title: str, before: Trajectories, after: Trajectories) -> Table:
    """Return a `rich` table of mean and worst cost and of violations, for many episodes.

    The episodes must be those of the same seeds. The last rows compare them pair by pair: how
    many cost less or more by more than rounding (1e-6 of the cost), and the largest increase.

    Examples
    --------
    >>> from sb3_yann.evaluation import evaluate
    >>> none, full = (evaluate(lambda _, u=u: [u], "CSTR-v0", [0, 1]) for u in (0.0, 1.0))
    >>> summary_table("no input, full input", none, full).row_count
    6
    """
    _require_pairs(before, after)
    change = after.costs - before.costs
    same = 1e-6 * np.abs(before.costs)
    table = _table("", title)
    for name, of in (("mean", np.mean), ("worst", np.max)):
        _compare(table, name, float(of(before.costs)), float(of(after.costs)))
    violations = before.violations.sum(), after.violations.sum()
    table.add_row("violations", *map(str, violations), f"{violations[1] - violations[0]:+d}")
    table.add_section()
    for name, count in (("less", change < -same), ("more", change > same)):
        table.add_row(f"episodes that cost {name}", "", f"{count.sum()} of {len(change)}", "")
    table.add_row("largest increase", "", "", _change(max(change.max(), 0.0)))
    return table


def _require_pairs(before: Trajectories, after: Trajectories) -> None:
    """Raise unless there are episodes, and as many before as after."""
    counts = [len(as_played(*each).costs) for each in (("before", before), ("after", after))]
    if counts[0] != counts[1] or not counts[0]:
        raise ValueError(
            f"before has {counts[0]} episodes and after {counts[1]}; they must be those of the "
            "same seeds, one at least. Pass both what evaluate returns for these seeds."
        )


def _table(rows: str, title: str) -> Table:
    from rich.console import Console  # not before it is used
    from rich.table import Table

    class PrintedTable(Table):
        """A table that `print` shows too, without colors."""

        def __str__(self) -> str:
            console = Console(file=StringIO(), width=WIDTH, color_system=None)
            with console.capture() as shown:
                console.print(self)
            return shown.get()

    table = PrintedTable(rows, "before", "after", "change", title=title)
    for column in table.columns[1:]:
        column.justify = "right"
    return table


def _compare(table: Table, name: str, old: float, new: float) -> None:
    percent = f" ({100 * (new - old) / old:+.1f} %)" if old > 0 else ""
    table.add_row(name, f"{old:,.2f}", f"{new:,.2f}", _change(new - old) + percent)


def _change(value: float) -> str:
    value = round(value, 2) + 0.0  # no "-0.00"
    color = "red" if value >= 0.005 else "green" if value <= -0.005 else "white"
    return f"[{color}]{value:+,.2f}[/{color}]"
