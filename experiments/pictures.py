"""Learning curves, and what the learning cost, as one PNG for each plant."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import reduce
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from experiments.measures import DRAWING, IMPROVED, MPC, OBSERVER, OURS
from experiments.runner import Outcome, Run
from sb3_yann._validation import Array

# Okabe and Ito's colors, distinct with any color vision; ours is always the first.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
STYLES = ("-", "--", "-.", ":")
MARKERS = "osD^vPX"
RIVALS = ("bioreactor", "pH", "van de Vusse's reactor", "worn tank, set-points", "reactor")
"""Plants of the README's picture, on which the MPC with an observer is tried as well."""


def save_pictures(outcomes: Mapping[Run, Outcome], folder: Path) -> dict[str, Path]:
    """Save ``results-<plant>.png`` for each plant with an MPC and a learner, and return them."""
    folder.mkdir(parents=True, exist_ok=True)
    saved: dict[str, Path] = {}
    for plant in dict.fromkeys(run.plant for run in outcomes):
        of_plant = {run: outcome for run, outcome in outcomes.items() if run.plant == plant}
        fixed = {run.learner: out for run, out in of_plant.items() if run.episodes == 0}
        learners = _learners(of_plant)
        if MPC in fixed and learners:
            words = re.sub(r"[^\w]+", "-", plant).strip("-").lower()
            saved[plant] = folder / f"results-{words}.png"
            _picture(plant, learners, fixed).savefig(saved[plant], dpi=120)
    return saved


def save_in_short(outcomes: Mapping[Run, Outcome], folder: Path) -> list[Path]:
    """Save ``in-short.png``, the README's picture: learning beside the best linear controller.

    A panel for each plant whose MPC was tried with an observer (offset-free) and improved: the cost
    of each tested start in parts of the MPC's from the same start, sorted for each controller.
    """
    panels = {name: found for name in RIVALS if (found := _shares(outcomes, name))}
    if not panels:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    columns = 3  # so that it can be read on a phone
    rows = -(-(len(panels) + 1) // columns)
    figure = Figure(figsize=(8.4, 2.7 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    for axes, (name, found) in zip(grid, panels.items(), strict=False):
        for k, (label, (shares, mean)) in enumerate(found.items()):
            style = {"color": COLORS[k], "linestyle": STYLES[k], "label": label}
            axes.plot(np.arange(1, len(shares) + 1), np.sort(shares), **style)
            words = {"color": COLORS[k], "transform": axes.transAxes}
            axes.text(0.05, 0.9 - 0.09 * k, f"mean cost {100 * mean:+.1f} %", **words)
        axes.axhline(1, color="black", linewidth=1, label=MPC)
        axes.set(title=name, xlabel="starts, sorted for each", ylim=(0, 1.6))
        axes.grid(alpha=0.3)
    figure.supylabel("cost / the MPC's from the same start")
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    handles, labels = grid[0].get_legend_handles_labels()
    grid[-1].legend(handles, labels, loc="center", frameon=False)
    path = folder / "in-short.png"
    figure.savefig(path, dpi=130)
    return [path]


def _shares(outcomes: Mapping[Run, Outcome], plant: str) -> dict[str, tuple[Array, float]]:
    """Return each controller's costs in parts of the MPC's, and how its mean differs."""
    costs = {}
    for label, learner in (("policy learnt from the MPC", IMPROVED), ("offset-free MPC", OBSERVER)):
        found = [
            out.test_costs
            for run, out in outcomes.items()
            if (run.plant, run.learner) == (plant, learner)
        ]
        if not found:
            return {}
        mpc, costs[label] = np.median(found, axis=0)
    return {name: (each / mpc, float(each.mean() / mpc.mean() - 1)) for name, each in costs.items()}


def _learners(outcomes: Mapping[Run, Outcome]) -> dict[str, list[Outcome]]:
    """Return the runs of each learner, ours first; its variants have a table and no curve.

    Nor have algorithms whose policy draws its actions: some of them go on for ten times as long.
    """
    found: dict[str, list[Outcome]] = {}
    for run in sorted(outcomes, key=lambda run: run.learner != OURS):
        variant = run.learner != OURS and run.learner.startswith(OURS)
        if run.episodes and not variant and run.learner not in DRAWING:
            found.setdefault(run.learner, []).append(outcomes[run])
    return found


def _picture(
    plant: str, learners: Mapping[str, list[Outcome]], fixed: Mapping[str, Outcome]
) -> Figure:
    figure = Figure(figsize=(14, 4.8), layout="constrained")
    FigureCanvasAgg(figure)
    curves, closer, costs = figure.subplots(1, 3)
    base = float(fixed[MPC].test_costs[-1].mean())
    tested = {name: _tests(runs, base) for name, runs in learners.items()}
    excess = {name: _excess(runs, base) for name, runs in learners.items()}
    for k, name in enumerate(learners):
        label = f"{name} ({len(learners[name])} seeds)"
        _band(curves, *tested[name], k, label)
        _band(closer, *tested[name], k, label)
        _band(costs, *excess[name], k, label)
    for k, (name, outcome) in enumerate(fixed.items()):
        level = float(outcome.test_costs[-1].mean()) / base
        color = "black" if k < 3 else "gray"  # there are three kinds of lines
        style = {"color": color, "linestyle": STYLES[1 + k % 3], "linewidth": 1}
        for axes in (curves, closer):
            axes.axhline(level, label=name, zorder=1, **style)
    costs.axhline(0, color="black", linewidth=1, label="as the MPC", zorder=1)
    gap = 1 - min(1.0, *(float(fixed[name].test_costs[-1].mean()) / base for name in fixed))
    closer.set_ylim(1 - 1.3 * (gap or 0.1), 1 + 0.7 * (gap or 0.1))
    _scales(curves, costs, tested, excess)
    curves.set(title=f"{plant}: test cost", ylabel="mean test cost / that of the MPC")
    closer.set(title="the same, around the MPC", ylabel="mean test cost / that of the MPC")
    costs.set(title="what the learning cost", ylabel="excess cost so far / one episode of the MPC")
    for axes in (curves, closer, costs):
        axes.set_xlabel("training episodes")
        axes.grid(alpha=0.3)
    handles, labels = curves.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _tests(runs: list[Outcome], base: float) -> tuple[Array, Array]:
    """Return the checkpoints that all seeds share, and their relative costs (seeds, k)."""
    shared = reduce(np.intersect1d, [run.checkpoints for run in runs])
    means = [run.test_costs[np.isin(run.checkpoints, shared)].mean(axis=1) for run in runs]
    return shared.astype(float), np.array(means) / base


def _excess(runs: list[Outcome], base: float) -> tuple[Array, Array]:
    length = min(len(run.training_costs) for run in runs)
    more = [(run.training_costs - run.training_mpc_costs)[:length] for run in runs]
    sums = np.cumsum(np.reshape(more, (len(runs), length)), axis=1) / base
    return np.arange(length + 1.0), np.hstack([np.zeros((len(runs), 1)), sums])


def _band(axes: Axes, x: Array, y: Array, k: int, label: str) -> None:
    """Draw the median over the seeds, and the band from the first to the third quartile."""
    low, middle, high = np.quantile(y, [0.25, 0.5, 0.75], axis=0)
    color = COLORS[k % len(COLORS)]
    style = STYLES[k % len(STYLES)]
    marker = {"marker": MARKERS[k % len(MARKERS)], "markersize": 4, "markevery": 0.12}
    axes.plot(x, middle, label=label, color=color, linestyle=style, zorder=9 - k, **marker)
    axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)


def _scales(
    curves: Axes,
    costs: Axes,
    tested: Mapping[str, tuple[Array, Array]],
    excess: Mapping[str, tuple[Array, Array]],
) -> None:
    """Use logarithmic axes where one learner would flatten the others."""
    medians = np.concatenate([np.median(y, axis=0) for _, y in tested.values()])
    if np.all(medians > 0) and medians.max() > 5 * medians.min():
        curves.set_yscale("log")
        curves.yaxis.set_major_formatter("{x:g}")
        curves.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.2, 0.6)))
    ends = [abs(float(np.median(y[:, -1]))) for _, y in excess.values()]
    if max(ends) > 5:
        costs.set_yscale("symlog", linthresh=1)
        costs.yaxis.set_major_formatter("{x:g}")
