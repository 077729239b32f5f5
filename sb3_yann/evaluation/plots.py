"""Tables and pictures of seeded episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.table import Table

from sb3_yann.evaluation.episodes import Episodes


def comparison_table(title: str, before: Episodes, after: Episodes) -> Table:
    """Return a `rich` table of the cost of each episode before and after, with the mean.

    The episodes must be those of the same seeds. A change for the worse is printed red.
    """
    table = Table("episode", "before", "after", "change", title=title)
    for column in table.columns[1:]:
        column.justify = "right"
    rows = [*zip(before.costs, after.costs, strict=True)]
    for number, (old, new) in enumerate(rows, start=1):
        table.add_row(str(number), f"{old:,.2f}", f"{new:,.2f}", _change(new - old))
    table.add_section()
    old, new = np.mean(rows, axis=0)
    percent = f" ({100 * (new - old) / old:+.1f} %)" if old > 0 else ""
    table.add_row("mean", f"{old:,.2f}", f"{new:,.2f}", _change(new - old) + percent)
    if before.violations.any() or after.violations.any():
        table.add_row("violations", str(before.violations.sum()), str(after.violations.sum()), "")
    return table


def summary_table(title: str, before: Episodes, after: Episodes) -> Table:
    """Return a `rich` table of mean and worst cost and of violations, for many episodes.

    The episodes must be those of the same seeds. The last rows compare them pair by pair: how
    many cost less or more by more than rounding (1e-6 of the cost), and the largest increase.
    """
    change = after.costs - before.costs
    same = 1e-6 * np.abs(before.costs)
    table = Table("", "before", "after", "change", title=title)
    for column in table.columns[1:]:
        column.justify = "right"
    for name, of in (("mean", np.mean), ("worst", np.max)):
        old, new = float(of(before.costs)), float(of(after.costs))
        percent = f" ({100 * (new - old) / old:+.1f} %)" if old > 0 else ""
        table.add_row(name, f"{old:,.2f}", f"{new:,.2f}", _change(new - old) + percent)
    violations = before.violations.sum(), after.violations.sum()
    table.add_row("violations", *map(str, violations), f"{violations[1] - violations[0]:+d}")
    table.add_section()
    for name, count in (("cheaper", change < -same), ("dearer", change > same)):
        table.add_row(f"{name} episodes", "", f"{count.sum()} of {len(change)}", "")
    table.add_row("largest increase", "", "", _change(max(change.max(), 0.0)))
    return table


def save_trajectories(
    path: str | PathLike[str],
    runs: Mapping[str, Episodes],
    states: Mapping[int, str],
    inputs: Sequence[str],
    dt: float,
    time_unit: str,
    limits: Mapping[int, tuple[float, str]] | None = None,
    references: Mapping[int, int] | None = None,
) -> Path:
    """Save a PNG of some states and all inputs over time, one color for each run.

    Parameters
    ----------
    path : path-like
        Folders are made as needed.
    runs : mapping of str to Episodes
        Every episode of every run is drawn.
    states : mapping of int to str
        The entries of the observation to draw, with their labels.
    inputs : sequence of str
        Labels of the inputs.
    dt : float
        Sampling time, in ``time_unit``.
    limits : mapping of int to (float, str), optional
        A limit of an entry of the observation, and its label.
    references : mapping of int to int, optional
        The entry of the observation that is the set-point of another, drawn as a dashed line.

    Returns
    -------
    Path
        Where the picture lies.
    """
    figure = Figure(figsize=(8, 2.4 * (len(states) + len(inputs))), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(states) + len(inputs), 1, sharex=True, squeeze=False)[:, 0]
    for color, (label, episodes) in enumerate(runs.items()):
        style = {"color": f"C{color}", "alpha": 0.7, "linewidth": 1.2}
        for k, (x, u) in enumerate(zip(episodes.observations, episodes.actions, strict=True)):
            style["label"] = label if k == 0 else "_nolegend_"
            for panel, i in zip(panels, states, strict=False):
                panel.plot(dt * np.arange(len(x)), x[:, i], **style)
                if references and i in references and color == 0:  # the same in every run
                    r = x[:, references[i]]
                    panel.step(dt * np.arange(len(x)), r, "k--", where="post", linewidth=1.0)
            for j, panel in enumerate(panels[len(states) :]):
                panel.step(dt * np.arange(len(u)), u[:, j], where="post", **style)
    for panel, i in zip(panels, states, strict=False):
        if limits and i in limits:
            panel.axhline(limits[i][0], color="black", linestyle="--", label=limits[i][1])
            panel.legend(loc="best")
    for panel, label in zip(panels, [*states.values(), *inputs], strict=True):
        panel.set_ylabel(label)
        panel.grid(alpha=0.3)
    panels[0].legend(loc="best")
    panels[-1].set_xlabel(f"time [{time_unit}]")
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(target, dpi=120)
    return target


def _change(value: float) -> str:
    value = round(value, 2) + 0.0  # no "-0.00"
    color = "red" if value >= 0.005 else "green" if value <= -0.005 else "white"
    return f"[{color}]{value:+,.2f}[/{color}]"
