"""What a twin is worth, in pictures: predicted and actual costs, and errors of free runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sb3_yann._drawing import COLORS, axes_or_new, legend_above, new_figure
from sb3_yann.twin.trust import COST_ERROR, Trust

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_costs(trust: Trust, axes: Axes | None = None) -> Axes:
    """Draw the actual cost of each held-out episode over the predicted one.

    A trusted twin's costs lie between the dashed lines, on root mean square.
    """
    axes = axes_or_new(axes, 4.6, 4.2)
    if len(trust.actual):
        both = np.concatenate([trust.predicted, trust.actual])
        both = both[
            np.abs(both) <= 3 * np.abs(trust.actual).max()
        ]  # a run that blew up is left out
        ends = np.array([both.min(), both.max()])
        ends = ends + 0.08 * np.array([-1, 1]) * max(float(np.ptp(ends)), 1e-9)
        error = COST_ERROR * np.abs(trust.actual).mean()
        axes.plot(ends, ends, color="black", linewidth=1, label="as predicted")
        for side, label in ((-1, "25 % of the mean off"), (1, "_nolegend_")):
            axes.plot(ends, ends + side * error, "k--", linewidth=0.8, label=label)
        own = {"color": COLORS[0], "alpha": 0.8, "label": "held-out episode"}
        axes.plot(trust.predicted, trust.actual, "o", **own)  # type: ignore[arg-type]
        axes.set(xlim=ends, ylim=ends)
    axes.set(xlabel="predicted cost", ylabel="actual cost")
    axes.grid(alpha=0.3)
    legend_above(axes, columns=2)
    return axes


def plot_free_runs(trust: Trust, axes: Axes | None = None) -> Axes:
    """Draw the error of free runs over held-out episodes by how many steps they look ahead."""
    from matplotlib.ticker import LogLocator

    axes, runs = axes_or_new(axes, 5.2, 4.2), trust.runs
    rows = (
        ("twin", runs.errors[trust.chosen], COLORS[0], "o-"),
        ("linear model", runs.errors[0], COLORS[1], "s--"),
        ("nothing moves", trust.standing, COLORS[2], "^:"),
    )
    for name, errors, color, style in rows if len(trust.actual) else ():
        axes.plot(runs.horizons, errors, style, color=color, label=name)
    axes.set(xlabel="steps ahead", ylabel="error (standard deviations of the states)")
    if len(trust.actual):
        axes.set(xscale="log", yscale="log")
        axes.set_xticks(runs.horizons, [str(each) for each in runs.horizons], minor=False)
        axes.set_xticks([], minor=True)
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")  # no powers of ten
        axes.yaxis.set_minor_formatter("")
    axes.grid(alpha=0.3)
    legend_above(axes)
    return axes


def draw_twin(trust: Trust, axes: tuple[Axes, Axes] | None = None) -> tuple[Axes, Axes]:
    """Draw :func:`plot_costs` and :func:`plot_free_runs`, and return their axes."""
    costs, runs = new_figure(9.2, 3.8).subplots(1, 2) if axes is None else axes
    return plot_costs(trust, costs), plot_free_runs(trust, runs)


def twin_figure(trust: Trust) -> Figure:
    """Return a figure of :func:`plot_costs` and :func:`plot_free_runs`."""
    found: Figure = draw_twin(trust)[0].figure  # type: ignore[assignment]
    return found
