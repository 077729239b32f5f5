"""Pictures of closed loops, decisions, headroom and twins; those of laws are imported.

Each takes matplotlib's Axes, or makes a new figure, and returns the Axes; a ``..._figure`` returns
the figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._drawing import (
    COLORS,
    LIMIT,
    SET_POINT,
    as_figure,
    axes_or_new,
    legend_above,
    legend_beside,
    new_figure,
)
from sb3_yann._validation import Array, check_type, to_float
from sb3_yann.control import LinearMPC
from sb3_yann.control.model.labels import with_units
from sb3_yann.evaluation.law_plots import (
    Quantity,
    RegionUse,
    entry_of,
    plot_changes,
    plot_regions,
    plot_surface,
    plot_visits,
    regions_figure,
    surfaces_figure,
    use_figure,
)
from sb3_yann.rollout import Trajectories, as_played

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "RegionUse",
    "decisions_figure",
    "headroom_figure",
    "loops_figure",
    "plot_changes",
    "plot_costs",
    "plot_decisions",
    "plot_free_runs",
    "plot_headroom",
    "plot_loop",
    "plot_regions",
    "plot_surface",
    "plot_visits",
    "regions_figure",
    "surfaces_figure",
    "twin_figure",
    "use_figure",
]
Runs = Mapping[str, Trajectories]
MAX_LINES = 6  # so many episodes are drawn one by one; of more, the median and bands


def _check_runs(problem: LinearMPC, runs: Runs) -> dict[str, Trajectories]:
    """Return episodes by their names, else say what they are instead of episodes of theta."""
    check_type("runs", runs, Mapping, "a mapping of names to episodes: {'MPC': evaluate(...)}")
    found = {name: as_played(f"runs[{name!r}]", each) for name, each in runs.items()}
    if not found or not all(len(each.costs) for each in found.values()):
        raise ValueError("There are no episodes to draw: pass {name: evaluate(...)} of some seeds.")
    n, m = problem.n_theta, problem.model.n_inputs
    for name, episodes in found.items():
        for x, u in episodes.pairs:
            if x.shape[1:] != (n,) or u.shape[1:] != (m,):
                raise ValueError(
                    f"An episode of {name!r} has observations {x.shape} and actions {u.shape}, but "
                    f"theta has {n} entries and there are {m} inputs."
                )
    return found


# ---- Closed loops ----


def plot_loop(
    problem: LinearMPC,
    runs: Runs,
    quantity: Quantity,
    axes: Axes | None = None,
) -> Axes:
    """Draw one quantity over time, in plant units, with its limits and its set-point.

    Up to six episodes are lines. Of more, a line is their median, a dark band holds 80 % of them,
    and a light one all; of several controllers dashed lines are the edges of the dark one. Where
    some episodes have ended, the others count.

    Parameters
    ----------
    problem : LinearMPC
        With the operating point, limits, names and units.
    runs : mapping of str to Trajectories
        By controller; their observations are theta, their actions inputs.
    quantity : int or str
        An entry of ``[theta, u]``: its index, or a name as in ``problem.labels()``, or an input's.
    axes : matplotlib Axes, optional
        Where to draw; a new figure's by default.

    Raises
    ------
    ValueError
        If there are no episodes, or these are not of the problem's theta and inputs.

    Examples
    --------
    >>> from sb3_yann.evaluation import evaluate
    >>> from sb3_yann_envs import problems
    >>> mpc = problems.cstr()
    >>> axes = plot_loop(mpc, {"MPC": evaluate(mpc.explicit(), "CSTR-v0", range(2))}, "U")
    >>> axes.get_ylabel()
    'U (kJ/(h m² K))'
    """
    entry = entry_of(problem, quantity, inputs=True)
    runs = _check_runs(problem, runs)
    axes = axes_or_new(axes, 6.4, 3.0)
    _draw_loops([axes], problem, [runs], entry)
    legend_above(axes, columns=1 if len(runs) > 2 else 2)
    return axes


def loops_figure(
    problem: LinearMPC,
    runs: Runs,
    *,
    quantities: Sequence[Quantity] | None = None,
) -> Figure:
    """Return a figure of several quantities.

    Controllers share a panel; of more than six episodes each has its own, one below the other.

    Parameters
    ----------
    problem : LinearMPC
        With the operating point, limits, names and units.
    runs : mapping of str to Trajectories
        By controller, the first one uppermost; their observations are theta.
    quantities : sequence of int or str, optional
        As of :func:`plot_loop`; all states and inputs by default.

    Examples
    --------
    >>> from sb3_yann.evaluation import evaluate
    >>> from sb3_yann_envs import problems
    >>> mpc = problems.clipped_pendulum()
    >>> runs = {"MPC": evaluate(mpc.explicit(), "ClippedPendulum-v0", range(8))}
    >>> len(loops_figure(mpc, runs).axes)
    3
    """
    runs = _check_runs(problem, runs)
    if quantities is None:
        n = problem.n_theta
        quantities = [*range(problem.model.n_states), *range(n, n + problem.model.n_inputs)]
    entries = [entry_of(problem, each, inputs=True) for each in quantities]
    many = max(len(each.costs) for each in runs.values()) > MAX_LINES
    groups: list[Runs] = [{name: runs[name]} for name in runs] if many else [runs]
    columns = min(3, len(entries))
    rows = -(-len(entries) // columns) * len(groups)
    figure = new_figure(3.2 * columns + 0.4, 1.9 * rows + 0.6)
    panels = figure.subplots(rows, columns, squeeze=False)
    for k in range(rows // len(groups) * columns):
        block, column = divmod(k, columns)
        own = panels[block * len(groups) : (block + 1) * len(groups), column]
        if k >= len(entries):
            for panel in own:
                panel.set_axis_off()
            continue
        _draw_loops([*own], problem, groups, entries[k])
        for panel, group in zip(own, groups, strict=True):
            if column == 0 and many and len(groups) > 1:
                panel.set_title(next(iter(group)), loc="left", fontsize="medium")
    found: dict[str, Any] = {}
    for panel in panels.ravel():
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    last = ("limit", "soft limit", "bound of the input", "set-point")
    found = dict(sorted(found.items(), key=lambda each: each[0] in last))
    columns = min(4, len(found)) if max(map(len, found)) < 24 else 2
    figure.legend(
        [*found.values()], [*found], loc="outside upper left", ncols=columns, frameon=False
    )
    return figure


def _draw_loops(
    panels: Sequence[Axes], problem: LinearMPC, groups: Sequence[Runs], entry: int
) -> None:
    """Draw one quantity, of each group of controllers in a panel: they share their range."""
    n, number = problem.n_theta, 0
    reference = problem.set_points.get(entry, entry)
    every = [
        rows[np.isfinite(rows)]
        for group in groups
        for each in group.values()
        for rows in (_rows(each, entry, n), _rows(each, reference, n)[:, :-1])
    ]
    data = np.concatenate(every) if sum(map(len, every)) else np.array([0.0, 1.0])
    label = [*problem.labels(units=True), *with_units(problem.model)[1]][entry]
    for panel, group in zip(panels, groups, strict=True):
        for name, episodes in group.items():
            style: dict[str, Any] = {
                "color": COLORS[number % len(COLORS)],
                "drawstyle": "steps-post" if entry >= n else "default",
            }
            rows = _rows(episodes, entry, n)
            _draw_rows(panel, rows, problem.model.dt, style, name, len(group) == 1)
            number += 1
        if reference != entry:  # the last set-point belongs to a step that is not taken
            rows = np.unique(_rows(next(iter(group.values())), reference, n)[:, :-1], axis=0)
            style = dict(SET_POINT)
            if len(rows) > 1:
                style |= {"alpha": 0.7 if len(rows) <= MAX_LINES else 0.35, "linewidth": 0.8}
            time = problem.model.dt * np.arange(rows.shape[1])
            for k, row in enumerate(rows):
                style["label"] = "set-point" if k == 0 else "_nolegend_"
                panel.plot(time, row, drawstyle="steps-post", **style)
        _draw_limits(panel, problem, entry, float(data.min()), float(data.max()))
        panel.set_ylabel(label)
        panel.grid(alpha=0.3)
    unit = problem.model.time_unit
    panels[-1].set_xlabel(f"time ({unit})" if unit else "time")


def _rows(episodes: Trajectories, entry: int, n_theta: int) -> Array:
    """Return an entry of [theta, u] in each episode (episodes, steps), NaN after its end."""
    k = entry - n_theta
    parts, column = (episodes.actions, k) if k >= 0 else (episodes.observations, entry)
    series = [each[:, column] for each in parts]
    found = np.full((len(series), max(map(len, series))), np.nan)
    for row, each in zip(found, series, strict=True):
        row[: len(each)] = each
    return found


def _draw_rows(
    axes: Axes, rows: Array, dt: float, style: dict[str, Any], name: str, alone: bool
) -> None:
    """Draw lines of a few episodes; of many the median, and bands, or their edges beside others."""
    time = dt * np.arange(rows.shape[1])
    if len(rows) <= MAX_LINES:
        for k, row in enumerate(rows):
            label = name if k == 0 else "_nolegend_"
            axes.plot(time, row, linewidth=1.1, alpha=0.85, label=label, **style)
        return
    low, dark, middle, light, high = np.nanpercentile(rows, [0, 10, 50, 90, 100], axis=0)
    if alone:
        step = "post" if style["drawstyle"] == "steps-post" else None
        band: dict[str, Any] = {"color": style["color"], "linewidth": 0, "step": step}
        axes.fill_between(time, low, high, alpha=0.18, **band)
        axes.fill_between(time, dark, light, alpha=0.35, **band)
    else:
        for edge in (dark, light):
            axes.plot(time, edge, linewidth=0.9, linestyle="--", **style)
    what = "dark: 80 %, light: all" if alone else "dashed: 80 %"
    axes.plot(time, middle, linewidth=1.7, label=f"{name}, median of {len(rows)} ({what})", **style)


def _draw_limits(axes: Axes, problem: LinearMPC, entry: int, low: float, high: float) -> None:
    """Draw limits near the data, name those far away, and set the range of the axis."""
    k, model = entry - problem.n_theta, problem.model
    kind = ""
    sides = -np.inf, np.inf
    if k >= 0:
        sides = problem.u_min[k], problem.u_max[k]
        kind = "bound of the input"
    elif entry < model.n_states:
        sides = problem.x_min[entry], problem.x_max[entry]
        kind = "soft limit" if problem.soft.penalty and problem.soft.x[entry] > 0 else "limit"
    width = max(high - low, 1e-9 * max(abs(low), abs(high), 1.0))
    bottom, top = low, high
    for value, corner in zip(sides, ("bottom", "top"), strict=True):
        if not np.isfinite(value):
            continue
        if low - width <= value <= high + width:
            axes.axhline(value, label=kind, **LIMIT)  # type: ignore[arg-type]
            bottom, top = min(bottom, value), max(top, value)
        else:
            y, text = 0.04 if corner == "bottom" else 0.96, f"{kind}: {value:.4g}"
            place: dict[str, Any] = {"ha": "right", "va": corner, "transform": axes.transAxes}
            axes.text(0.98, y, text, fontsize=7, **place)
    room = 0.06 * max(top - bottom, width)
    axes.set_ylim(bottom - room, top + room)


# ---- Decisions of a guard ----


def plot_decisions(
    decisions: Sequence[Any], axes: Axes | None = None, *, training_costs: ArrayLike | None = None
) -> Axes:
    """Draw each candidate's mean cost by the verdict on it, the accepted policy's and the MPC's.

    A candidate far beyond the accepted policies, or without a cost, is drawn at the edge.

    Parameters
    ----------
    decisions : sequence of Decision
        As in ``guard.decisions``; of none a note says so.
    axes : matplotlib Axes, optional
        Where to draw; a new figure's by default.
    training_costs : array_like, shape (episodes,), optional
        Costs of the training episodes themselves, drawn behind.

    Examples
    --------
    >>> from sb3_yann import Decision
    >>> costs = {"candidate_cost": 3.0, "accepted_cost": 3.0, "mpc_cost": 4.0}
    >>> first = Decision(verdict="accepted", episode=1, **costs)
    >>> plot_decisions([first]).get_xlabel()
    'training episodes'
    """
    axes = axes_or_new(axes, 8.0, 3.8)
    axes.set(xlabel="training episodes", ylabel="mean cost")
    if not decisions:
        axes.text(0.5, 0.5, "no candidate was tried", ha="center", transform=axes.transAxes)
        return axes
    episodes = np.array([each.episode for each in decisions])
    costs, accepted, mpc = (
        np.array([getattr(each, name) for each in decisions], np.float64)
        for name in ("candidate_cost", "accepted_cost", "mpc_cost")
    )
    bottom, top = _range_of_costs(costs, accepted, mpc)
    if training_costs is not None:
        played = to_float("training_costs", training_costs)
        axes.plot(1 + np.arange(len(played)), played, ".", color="0.7", label="training episode")
    axes.step(episodes, accepted, where="post", color=COLORS[0], label="accepted policy")
    axes.plot(episodes, mpc, color="black", linestyle="--", linewidth=1.2, label="MPC")
    kinds = np.array(
        [
            each.verdict if each.verdict != "rejected" else f"rejected{each.restored:d}"
            for each in decisions
        ]
    )
    for kind, label, marker, color in (
        ("accepted", "accepted", "o", COLORS[2]),
        ("accepted in part", "accepted in part", "^", COLORS[4]),
        ("rejected0", "refused, plays on", "x", COLORS[3]),
        ("rejected1", "refused, policy restored", "X", COLORS[1]),
    ):
        own = kinds == kind
        if own.any():
            shown = np.clip(np.nan_to_num(costs[own], nan=np.inf), bottom, top)
            style: dict[str, Any] = {"color": color, "markersize": 6, "clip_on": False}
            axes.plot(episodes[own], shown, marker, label=label, **style)
    if beyond := int(np.sum(~((costs >= bottom) & (costs <= top)))):
        axes.plot([], [], " ", label=f"({beyond} beyond the scale,\ndrawn at its edge)")
    axes.set_ylim(bottom, top)
    axes.locator_params(axis="x", integer=True)
    axes.grid(alpha=0.3)
    legend_beside(axes)
    return axes


def _range_of_costs(costs: Array, accepted: Array, mpc: Array) -> tuple[float, float]:
    """Return the range of what was accepted, and of the candidates within two widths of it."""
    known = np.concatenate([accepted, mpc])
    known = known[np.isfinite(known)]
    if not known.size:
        known = costs[np.isfinite(costs)] if np.isfinite(costs).any() else np.zeros(1)
    low, high = float(known.min()), float(known.max())
    width = max(high - low, 0.02 * max(abs(low), abs(high)), 1e-12)
    near = costs[(costs >= low - 2 * width) & (costs <= high + 2 * width)]
    low, high = min([low, *near]), max([high, *near])
    room = 0.08 * max(high - low, width)
    return low - room, high + room


decisions_figure = as_figure(plot_decisions)


# ---- Headroom, and what a twin is worth ----


def plot_headroom(found: Any, axes: Axes | None = None) -> Axes:
    """Draw the parts of a :class:`Headroom` one after the other, and their sum with its error.

    Examples
    --------
    >>> from sb3_yann import Headroom
    >>> import numpy as np
    >>> costs = np.array([10.0, 20.0])
    >>> found = Headroom(costs, costs, costs, costs - 0.5, 0.0, 0.0, 1 / 30, "learn", "a simulator")
    >>> [round(float(bar.get_width()), 2) for bar in plot_headroom(found).patches]
    [0.0, 0.0, 3.33, 3.33]
    """
    parts = {
        "offset": "offset:\na disturbance observer",
        "model_error": "model error:\nre-identification",
        "nonlinearity": "nonlinearity\nand constraints",
        "total": "all of it",
    }
    axes, start = axes_or_new(axes, 6.4, 2.6), 0.0
    for k, name in enumerate(parts):
        value, error = 100 * getattr(found, name), None
        if name == "total":
            start, error = 0.0, 100 * found.standard_error
        axes.barh(k, value, left=start, color=COLORS[k], xerr=error, capsize=3, height=0.6)
        end = max(start, start + value) + (error or 0.0)
        axes.annotate(f"{value:+.2f} %", (end, k), (4, 0), textcoords="offset points", va="center")
        start += value
    axes.set_yticks(range(len(parts)), [*parts.values()])
    axes.invert_yaxis()
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set(xlabel="gain over the MPC (% of its mean cost)", title=f"verdict: {found.verdict}")
    axes.margins(x=0.25)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    return axes


headroom_figure = as_figure(plot_headroom)


def plot_costs(trust: Any, axes: Axes | None = None) -> Axes:
    """Draw the actual cost of each held-out episode over the predicted one.

    ``trust`` is ``twin.trust``. A trusted twin's costs lie between the dashed lines, on root mean
    square.
    """
    axes = axes_or_new(axes, 4.6, 4.2)
    if len(trust.actual):
        both = np.concatenate([trust.predicted, trust.actual])
        both = both[np.abs(both) <= 3 * np.abs(trust.actual).max()]  # a run that diverged is not
        ends = np.array([both.min(), both.max()])
        ends = ends + 0.08 * np.array([-1, 1]) * max(float(np.ptp(ends)), 1e-9)
        error = 0.25 * np.abs(trust.actual).mean()
        axes.plot(ends, ends, color="black", linewidth=1, label="as predicted")
        for side, label in ((-1, "25 % of the mean off"), (1, "_nolegend_")):
            axes.plot(ends, ends + side * error, "k--", linewidth=0.8, label=label)
        style: dict[str, Any] = {"color": COLORS[0], "alpha": 0.8, "label": "held-out episode"}
        axes.plot(trust.predicted, trust.actual, "o", **style)
        axes.set(xlim=ends, ylim=ends)
    axes.set(xlabel="predicted cost", ylabel="actual cost")
    axes.grid(alpha=0.3)
    legend_above(axes, columns=2)
    return axes


def plot_free_runs(trust: Any, axes: Axes | None = None) -> Axes:
    """Draw the error of free runs over held-out episodes by how many steps they look ahead."""
    from matplotlib.ticker import LogLocator

    axes, runs = axes_or_new(axes, 5.2, 4.2), trust.runs
    axes.set(xlabel="steps ahead", ylabel="error (standard deviations of the states)")
    if len(trust.actual):
        for name, errors, color, style in (
            ("twin", runs.errors[trust.chosen], COLORS[0], "o-"),
            ("linear model", runs.errors[0], COLORS[1], "s--"),
            ("nothing moves", trust.standing, COLORS[2], "^:"),
        ):
            axes.plot(runs.horizons, errors, style, color=color, label=name)
        axes.set(xscale="log", yscale="log")
        axes.set_xticks(runs.horizons, [str(each) for each in runs.horizons], minor=False)
        axes.set_xticks([], minor=True)
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")  # no powers of ten
        axes.yaxis.set_minor_formatter("")
    axes.grid(alpha=0.3)
    legend_above(axes)
    return axes


def twin_figure(trust: Any) -> Figure:
    """Return a figure of :func:`plot_costs` and :func:`plot_free_runs`."""
    figure = new_figure(9.2, 3.8)
    costs, runs = figure.subplots(1, 2)
    plot_costs(trust, costs)
    plot_free_runs(trust, runs)
    return figure
