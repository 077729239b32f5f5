"""Closed loops of several controllers in plant units: lines of a few episodes, bands of many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_yann._drawing import COLORS, LIMIT, SET_POINT, axes_or_new, legend_above, new_figure
from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.model.labels import with_units
from sb3_yann.evaluation.episodes import Episodes
from sb3_yann.evaluation.plots._sources import Quantity, entry_of
from sb3_yann.evaluation.plots.trajectories import shifted

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FEW = 6
"""So many episodes are drawn one by one; of more, the median and bands."""
COLUMNS = 3
REFERENCES = ("limit", "soft limit", "bound of the input", "set-point")
NEAR = 1.0
"""A limit is drawn where it is at most so many widths of the data beyond them."""


def plot_loop(
    problem: LinearMPC,
    runs: Mapping[str, Episodes],
    quantity: Quantity,
    axes: Axes | None = None,
    *,
    time_unit: str = "",
    absolute: bool = False,
) -> Axes:
    """Draw one quantity over time, as the plant shows it, with its limits and its set-point.

    Up to six episodes are lines. Of more, a line is their median, a dark band holds 80 % of them,
    and a light one all; of several controllers dashed lines are the edges of the dark one. Where
    some episodes have ended, the others count.

    Parameters
    ----------
    problem : LinearMPC
        With the operating point, limits, names and units.
    runs : mapping of str to Episodes
        By controller; their observations are theta, their actions inputs.
    quantity : int or str
        An entry of ``[theta, u]``: its index, or a name as in ``problem.labels()``, or an input's.
    axes : matplotlib Axes, optional
        Where to draw; a new figure's by default.
    time_unit : str, optional
        Of ``model.dt``, for the label.
    absolute : bool, default False
        Whether the episodes are in the plant's units already.

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
    whole = _in_plant_units(problem, runs, absolute)
    axes = axes_or_new(axes, 6.4, 3.0)
    for color, (name, episodes) in enumerate(whole.items()):
        own = _rows(problem, episodes, entry), problem.model.dt, entry >= problem.n_theta
        _draw(axes, *own, COLORS[color % len(COLORS)], name, len(runs) == 1)
    _draw_set_points(axes, problem, next(iter(whole.values())), entry)
    _draw_limits(axes, problem, entry, _range(problem, whole, entry))
    axes.set(xlabel=f"time ({time_unit})" if time_unit else "time", ylabel=_label(problem, entry))
    axes.grid(alpha=0.3)
    legend_above(axes, columns=1 if len(runs) > 2 else 2)
    return axes


def loops_figure(
    problem: LinearMPC,
    runs: Mapping[str, Episodes],
    *,
    quantities: Sequence[Quantity] | None = None,
    time_unit: str = "",
    absolute: bool = False,
) -> Figure:
    """Return a figure of several quantities.

    Controllers share a panel; of more than six episodes each has its own, one below the other.

    Parameters
    ----------
    problem : LinearMPC
        With the operating point, limits, names and units.
    runs : mapping of str to Episodes
        By controller, the first one uppermost; their observations are theta.
    quantities : sequence of int or str, optional
        As of :func:`plot_loop`; all states and inputs by default.
    time_unit : str, optional
        Of ``model.dt``, for the label.
    absolute : bool, default False
        Whether the episodes are in the plant's units already.

    Examples
    --------
    >>> from sb3_yann.evaluation import evaluate
    >>> from sb3_yann_envs import problems
    >>> mpc = problems.clipped_pendulum()
    >>> runs = {"MPC": evaluate(mpc.explicit(), "ClippedPendulum-v0", range(8))}
    >>> len(loops_figure(mpc, runs, time_unit="s").axes)
    3
    """
    whole = _in_plant_units(problem, runs, absolute)
    n = problem.n_theta
    given = [*range(problem.model.n_states), *range(n, n + problem.model.n_inputs)]
    shown = [entry_of(problem, each, inputs=True) for each in given]
    if quantities is not None:
        shown = [entry_of(problem, each, inputs=True) for each in quantities]
    apart = max(len(each.costs) for each in whole.values()) > FEW
    groups = [{name: whole[name]} for name in whole] if apart else [whole]
    columns = min(COLUMNS, len(shown))
    blocks = -(-len(shown) // columns)
    rows = blocks * len(groups)
    figure = new_figure(3.2 * columns + 0.4, 1.9 * rows + 0.6)
    panels = figure.subplots(rows, columns, squeeze=False)
    for k in range(blocks * columns):
        block, column = divmod(k, columns)
        own = panels[block * len(groups) : (block + 1) * len(groups), column]
        if k >= len(shown):
            for panel in own:
                panel.set_axis_off()
            continue
        _draw_block(own, problem, groups, shown[k], time_unit, column == 0)
    _legend(figure, panels)
    return figure


def _draw_block(
    panels: Any,
    problem: LinearMPC,
    groups: Sequence[Mapping[str, Episodes]],
    entry: int,
    time_unit: str,
    titled: bool,
) -> None:
    """Draw one quantity, of each group in a panel of its own: they share their range."""
    colors = count()
    whole = {name: each for group in groups for name, each in group.items()}
    for panel, group in zip(panels, groups, strict=True):
        for name, episodes in group.items():
            own = _rows(problem, episodes, entry), problem.model.dt, entry >= problem.n_theta
            _draw(panel, *own, COLORS[next(colors) % len(COLORS)], name, len(group) == 1)
        _draw_set_points(panel, problem, next(iter(group.values())), entry)
        _draw_limits(panel, problem, entry, _range(problem, whole, entry))
        panel.set_ylabel(_label(problem, entry))
        panel.grid(alpha=0.3)
        if titled and len(groups) > 1:
            panel.set_title(next(iter(group)), loc="left", fontsize="medium")
    panels[-1].set_xlabel(f"time ({time_unit})" if time_unit else "time")


def _legend(figure: Figure, panels: Any) -> None:
    found: dict[str, Any] = {}
    for panel in panels.ravel():
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    found = dict(sorted(found.items(), key=lambda each: each[0] in REFERENCES))
    columns = min(4, len(found)) if max(map(len, found)) < 24 else 2
    figure.legend(
        [*found.values()], [*found], loc="outside upper left", ncols=columns, frameon=False
    )


def _in_plant_units(
    problem: LinearMPC, runs: Mapping[str, Episodes], absolute: bool
) -> dict[str, Episodes]:
    if not runs or not all(len(each.costs) for each in runs.values()):
        raise ValueError("There are no episodes to draw: pass {name: evaluate(...)} of some seeds.")
    shift = (0 * problem.theta_ss, 0 * problem.model.u_ss)
    shift = shift if absolute else (problem.theta_ss, problem.model.u_ss)
    return {name: shifted(name, each, *shift) for name, each in runs.items()}


def _label(problem: LinearMPC, entry: int) -> str:
    return [*problem.labels(units=True), *with_units(problem.model)[1]][entry]


def _rows(problem: LinearMPC, episodes: Episodes, entry: int) -> Array:
    """Return the quantity in each episode (episodes, steps), NaN after its end."""
    k = entry - problem.n_theta
    series = [u[:, k] if k >= 0 else x[:, entry]
              for x, u in zip(episodes.observations, episodes.actions, strict=True)]  # fmt: skip
    found = np.full((len(series), max(map(len, series))), np.nan)
    for row, each in zip(found, series, strict=True):
        row[: len(each)] = each
    return found


def _draw(
    axes: Axes, rows: Array, dt: float, held: bool, color: str, name: str, alone: bool
) -> None:
    """Draw lines of a few episodes; of many the median, and bands, or their edges beside others."""
    time = dt * np.arange(rows.shape[1])
    line: dict[str, Any] = {"color": color, "drawstyle": "steps-post" if held else "default"}
    if len(rows) <= FEW:
        for k, row in enumerate(rows):
            label = name if k == 0 else "_nolegend_"
            axes.plot(time, row, linewidth=1.1, alpha=0.85, label=label, **line)
        return
    low, dark, middle, light, high = np.nanpercentile(rows, [0, 10, 50, 90, 100], axis=0)
    if alone:
        band: dict[str, Any] = {"color": color, "linewidth": 0, "step": "post" if held else None}
        axes.fill_between(time, low, high, alpha=0.18, **band)
        axes.fill_between(time, dark, light, alpha=0.35, **band)
    else:
        for edge in (dark, light):
            axes.plot(time, edge, linewidth=0.9, linestyle="--", **line)
    what = "dark: 80 %, light: all" if alone else "dashed: 80 %"
    axes.plot(time, middle, linewidth=1.7, label=f"{name}, median of {len(rows)} ({what})", **line)


def _draw_set_points(axes: Axes, problem: LinearMPC, episodes: Episodes, entry: int) -> None:
    """Draw the set-point of a state: one line where all episodes have the same."""
    at = problem.set_points.get(entry)
    if at is None:
        return
    rows = _rows(problem, episodes, at)[:, :-1]  # not that of a step which nobody takes
    time = problem.model.dt * np.arange(rows.shape[1])
    known = np.unique(rows, axis=0)
    faint = {"alpha": 0.7 if len(known) <= FEW else 0.35, "linewidth": 0.8}
    style = SET_POINT if len(known) == 1 else {**SET_POINT, **faint}
    for k, row in enumerate(known):
        label = "set-point" if k == 0 else "_nolegend_"
        axes.plot(time, row, drawstyle="steps-post", label=label, **style)  # type: ignore[arg-type]


def limits_of(problem: LinearMPC, entry: int) -> tuple[float, float, str]:
    """Return the limits of an entry of ``[theta, u]`` as the plant shows it, and what they are."""
    k, n = entry - problem.n_theta, problem.model.n_states
    if k >= 0:
        rest = problem.model.u_ss[k]
        return float(problem.u_min[k] + rest), float(problem.u_max[k] + rest), "bound of the input"
    if entry >= n:
        return -np.inf, np.inf, ""
    rest, soft = problem.model.x_ss[entry], problem.soft.penalty and problem.soft.x[entry] > 0
    kind = "soft limit" if soft else "limit"
    return float(problem.x_min[entry] + rest), float(problem.x_max[entry] + rest), kind


def _range(problem: LinearMPC, runs: Mapping[str, Episodes], entry: int) -> tuple[float, float]:
    """Return the range of the data of all controllers, the set-point's included."""
    entries = [entry, problem.set_points.get(entry, entry)]
    every = [_rows(problem, each, k)[:, : None if k == entry else -1]
             for each in runs.values() for k in entries]  # fmt: skip
    finite = np.concatenate([rows[np.isfinite(rows)] for rows in every])
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)


def _draw_limits(axes: Axes, problem: LinearMPC, entry: int, data: tuple[float, float]) -> None:
    """Draw limits near the data, name those far away, and set the range of the axis."""
    low, high = data
    width = max(high - low, 1e-9 * max(abs(low), abs(high), 1.0))
    *sides, kind = limits_of(problem, entry)
    bottom, top = low, high
    for value, corner in zip(sides, ("bottom", "top"), strict=True):
        if not np.isfinite(value):
            continue
        if low - NEAR * width <= value <= high + NEAR * width:
            axes.axhline(value, label=kind, **LIMIT)  # type: ignore[arg-type]
            bottom, top = min(bottom, value), max(top, value)
        else:
            axes.text(
                0.98, 0.04 if corner == "bottom" else 0.96, f"{kind}: {value:.4g}", fontsize=7,
                ha="right", va=corner, transform=axes.transAxes,
            )  # fmt: skip
    room = 0.06 * max(top - bottom, width)
    axes.set_ylim(bottom - room, top + room)
