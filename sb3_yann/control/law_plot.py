"""What all pictures share, and the regions of an explicit law in a plane, or on a line."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, check_array, half_widths
from sb3_yann.control.linear_system import labels_of, with_units

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442")
"""Okabe and Ito's, distinct with any color vision (*Color Universal Design*, 2008)."""
REST = "#D9D9D9"
LIMIT = {"color": "black", "linestyle": (0, (5, 2)), "linewidth": 1.0}
SET_POINT = {"color": "black", "linestyle": ":", "linewidth": 1.4}
Name = Callable[[int, Array], str]


def new_figure(width: float = 6.4, height: float = 4.0) -> Figure:
    """Return a figure that no window and no pyplot knows; sizes are in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # slow to import
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: str | PathLike[str], dpi: int) -> Path:
    """Write a picture, a PNG where the path has no suffix; return the path of what was written."""
    target = Path(path)
    target = target if target.suffix else target.with_name(f"{target.name}.png")
    target.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(target, dpi=dpi)
    return target


def axes_or_new(axes: Axes | None, width: float = 6.4, height: float = 4.0) -> Axes:
    """Return the axes that are given, or those of a new figure."""
    return new_figure(width, height).subplots() if axes is None else axes


def legend_beside(axes: Axes) -> None:
    """Put the legend to the right of the data; none where nothing has a label."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper left", bbox_to_anchor=(1.02, 1), borderaxespad=0, frameon=False)


def require_regions(law: Any) -> None:
    """Raise ValueError where a law is solved online."""
    if not hasattr(law, "starts"):
        raise ValueError(
            f"{law!r} is solved online and has no regions. Call explicit() of its LinearMPC, "
            "or draw its input by sb3_yann.evaluation.plots.plot_surface."
        )


def plot_law(
    law: Any,
    axes: Axes | None = None,
    *,
    entries: Sequence[int | str] = (0, 1),
    at: ArrayLike | None = None,
    labels: Sequence[str] | None = None,
    name: Name | None = None,
) -> Axes:
    """Draw the regions in the plane of two entries of theta, as the plant shows them.

    Of a law of one parameter the inputs are drawn over it, with a line where a region ends.

    Parameters
    ----------
    law : PiecewiseAffine
        With a bounded box of theta.
    axes : matplotlib Axes, optional
        Where to draw; a new figure's by default.
    entries : pair of int or str, default (0, 1)
        The coordinates to the right and up, by number or by name of a state.
    at : array_like, shape (n_theta,), optional
        The other entries, as the plant shows them; the operating point by default.
    labels : sequence of str, optional
        What entries of theta are called; by default the model's names.
    name : callable, optional
        From a region and a theta (n_theta,) inside it to what colors stand for. By default the
        inputs: which of them are constant there.

    Returns
    -------
    Axes
        Each region is a polygon whose ``get_gid()`` is its number, but for a single parameter.

    Raises
    ------
    ValueError
        If ``entries`` are not two different ones of theta, the box is not bounded there, or the
        law is solved online.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> axes = plot_law(problems.clipped_pendulum().explicit())
    >>> len(axes.patches), axes.get_xlabel()
    (7, 'angle (rad)')
    """
    require_regions(law)
    if law.n_theta == 1:
        return _draw_line(law, axes, labels)
    across, up = _entries(entries, law)
    zero = law.units.theta_ss
    point = zero if at is None else check_array("at", at, (law.n_theta,))
    polygons = slices(law, (across, up), point - zero)
    axes = axes_or_new(axes, 7.4, 4.4)
    shift = zero[[across, up]]
    name = name or _constant_inputs(law)
    named: dict[str, list[int]] = {}
    for i, polygon in polygons.items():
        theta = np.array(point - zero)
        theta[[across, up]] = polygon.mean(axis=0)
        named.setdefault(name(i, theta), []).append(i)
    _fill(axes, {i: polygon + shift for i, polygon in polygons.items()}, named)
    called = [*labels] if labels else _labels(law)
    low = law.theta_min[[across, up]] + shift
    high = law.theta_max[[across, up]] + shift
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    if sum(map(area, polygons.values())) < 0.999 * np.prod(high - low):
        axes.fill_between([], [], facecolor="white", edgecolor="0.6", label="no solution")
    axes.set(xlabel=called[across], ylabel=called[up])
    legend_beside(axes)
    return axes


def slices(law: Any, entries: tuple[int, int], at: Array) -> dict[int, Array]:
    """Return the polygon (k, 2) of each region that a plane through ``at`` cuts.

    The box is clipped by one half-plane after the other (Sutherland and Hodgman, *Communications of
    the ACM* 17, 1974).
    """
    low, high = _frame(law, entries)
    fixed = np.array(at, np.float64)
    fixed[[*entries]] = 0.0
    box = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    rows = law.A[:, [*entries]]
    levels = law.b - law.A @ fixed
    found = {}
    for i, (first, last) in enumerate(pairwise([*law.starts, len(law.b)])):
        polygon = _clipped(box, rows[first:last], levels[first:last])
        if len(polygon) > 2 and area(polygon) > 1e-9 * float(np.prod(high - low)):
            found[i] = polygon
    return found


def _frame(law: Any, entries: Sequence[int]) -> tuple[Array, Array]:
    """Return the ends of the box of theta in some entries."""
    low = law.theta_min[[*entries]]
    high = law.theta_max[[*entries]]
    if not np.all(np.isfinite([low, high])):
        raise ValueError(
            f"The law's box is not bounded in entries {list(entries)} of theta: there is no frame "
            "to draw. Choose others, or solve the problem for a bounded theta_min and theta_max."
        )
    return low, high


def area(polygon: Array) -> float:
    """Return the area of a polygon (k, 2): the shoelace formula."""
    x, y = polygon.T
    return float(abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2)


def _clipped(polygon: Array, rows: Array, levels: Array) -> Array:
    """Return the part (k, 2) of a convex polygon where ``rows z <= levels``."""
    for row, level in zip(rows, levels, strict=True):
        room = level - polygon @ row
        if np.all(room >= 0):
            continue
        after = np.roll(polygon, -1, axis=0)
        beyond = np.roll(room, -1)
        kept = []
        for z, next_z, here, there in zip(polygon, after, room, beyond, strict=True):
            if here >= 0:
                kept.append(z)
            if (here >= 0) != (there >= 0):
                kept.append(z + (next_z - z) * here / (here - there))
        polygon = np.array(kept).reshape(-1, 2)
        if len(polygon) < 3:
            break
    return polygon


def _draw_line(law: Any, axes: Axes | None, labels: Sequence[str] | None) -> Axes:
    """Draw the inputs over the only parameter."""
    low, high = (float(side[0]) for side in _frame(law, [0]))
    zero = law.units.theta_ss[0]
    inputs = with_units(law.model)[1] if law.model else [f"u[{k}]" for k in range(law.n_inputs)]
    ends = np.unique(np.clip(law.b / law.A[:, 0], low, high)[law.A[:, 0] != 0])
    theta = np.unique(np.concatenate([np.linspace(low, high, 401), ends]))
    axes = axes_or_new(axes, 7.4, 4.4)
    for k, line in enumerate(np.asarray(law(theta[:, None]) + law.units.u_ss).T):
        axes.plot(theta + zero, line, color=COLORS[k % len(COLORS)], label=inputs[k])
    for end in ends[(ends > low) & (ends < high)]:
        axes.axvline(end + zero, color=REST, linewidth=0.5)
    called = [*labels] if labels else _labels(law)
    axes.set(xlim=(low + zero, high + zero), xlabel=called[0])
    if law.n_inputs == 1:
        axes.set(ylabel=inputs[0])
    else:
        legend_beside(axes)
    return axes


def _entries(entries: Sequence[int | str], law: Any) -> tuple[int, int]:
    n = law.n_theta
    names = [] if law.model is None else labels_of(law.model)[0]
    chosen: list[Any] = [names.index(each) if each in names else each for each in entries]
    whole = all(isinstance(each, int | np.integer) and 0 <= each < n for each in chosen)
    if len(chosen) != 2 or not whole or chosen[0] == chosen[1]:
        raise ValueError(
            f"entries = {[*entries]} must be two different entries of theta, from 0 to {n - 1}"
            f"{', or names of ' + ', '.join(names) if names else ''}."
        )
    return int(chosen[0]), int(chosen[1])


def _labels(law: Any) -> list[str]:
    states = [] if law.model is None else with_units(law.model)[0]
    return states + [f"theta[{i}]" for i in range(len(states), law.n_theta)]


def _constant_inputs(law: Any) -> Name:
    """Return what names a region by the inputs that do not move in it."""
    m = law.n_inputs
    rest = law.units.u_ss
    names = labels_of(law.model)[1] if law.model else [f"u[{k}]" for k in range(m)]
    units = (law.model and law.model.units[law.model.n_states :]) or [""] * m
    size = np.abs(law.gains).max(axis=(0, 2)) + 1e-300
    digits = 12 - np.ceil(np.log10(half_widths(law.u_min, law.u_max) + np.abs(rest))).astype(int)

    def name(i: int, theta: Array) -> str:
        constant = np.flatnonzero(np.abs(law.gains[i]).max(axis=1) <= 1e-9 * size)
        values = {k: round(float(law.offsets[i][k] + rest[k]), digits[k]) + 0.0 for k in constant}
        parts = [f"{names[k]} = {value:.4g} {units[k]}".strip() for k, value in values.items()]
        return ", ".join(parts) or ("the input moves" if m == 1 else "the inputs move")

    return name


def _fill(axes: Axes, polygons: dict[int, Array], named: dict[str, list[int]]) -> None:
    """Fill polygons, those of one name in one color; the smallest share a gray.

    Numbers are for up to 60 regions, and not for slivers.
    """
    from matplotlib.patches import Polygon

    sizes = {i: area(polygon) for i, polygon in polygons.items()}
    ranked = sorted(named, key=lambda each: -sum(sizes[i] for i in named[each]))
    others = len(ranked) - len(COLORS)
    for rank, each in enumerate(ranked):
        color = COLORS[rank] if rank < len(COLORS) else REST
        label = textwrap.fill(each, 34)
        if rank == len(COLORS) and others > 1:
            label = f"{others} others"
        elif rank > len(COLORS):
            label = "_nolegend_"
        for i in named[each]:
            patch = Polygon(
                polygons[i], facecolor=color, alpha=0.6, edgecolor="black", linewidth=0.5
            )
            patch.set(label=label, gid=str(i))
            axes.add_patch(patch)
            label = "_nolegend_"
            if sizes[i] > 0.004 * sum(sizes.values()) and len(polygons) <= 60:
                x, y = polygons[i].mean(axis=0)
                axes.text(x, y, str(i), ha="center", va="center", fontsize=8)
