"""Pictures of laws, policies, closed loops, decisions, headroom and twins.

A ``plot_...`` takes matplotlib's Axes, or makes a new figure, and returns the Axes; a
``..._figure`` has several panels and returns the figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, check_array, check_choice, check_type
from sb3_yann.control import LinearMPC, PiecewiseAffine
from sb3_yann.control.law_plot import (
    COLORS,
    LIMIT,
    SET_POINT,
    axes_or_new,
    legend_beside,
    new_figure,
    plot_law,
    require_regions,
)
from sb3_yann.control.linear_system import labels_of, with_units
from sb3_yann.control.mpc.report import ActiveConstraints
from sb3_yann.rollout import Trajectories, as_played

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "loops_figure",
    "plot_decisions",
    "plot_gains",
    "plot_headroom",
    "plot_regions",
    "plot_surface",
    "plot_twin",
    "surfaces_figure",
    "use_figure",
]
Runs = Mapping[str, Trajectories]
Quantity = int | str
Frame = tuple[ArrayLike, ArrayLike]
MAX_LINES = 6  # so many episodes are drawn one by one; of more, the median and bands


def _entry_of(problem: LinearMPC, quantity: Quantity, inputs: bool = False) -> int:
    """Return the entry of theta, or of [theta, u] with ``inputs``, of a name or an index."""
    names = [*problem.labels(), *(labels_of(problem.model)[1] if inputs else ())]
    if isinstance(quantity, str) and quantity in names:
        return names.index(quantity)
    if isinstance(quantity, int | np.integer) and 0 <= quantity < len(names):
        return int(quantity)
    raise ValueError(f"{quantity!r} is no entry: expected one of {names}, or its index.")


def inputs_of(problem: LinearMPC, policy: Any, theta: Array) -> Array:
    """Return the inputs (batch, m), in deviations, at theta (batch, n_theta), in deviations.

    ``policy`` is a law, which takes theta, or a model or YannPolicy, whose actor's layer does.
    """
    actor = getattr(getattr(policy, "policy", policy), "actor", None)
    if actor is None:
        return np.asarray(policy(theta), np.float64).reshape(len(theta), -1)
    bounds = problem.deviations
    scaled = actor.mu.frozen()(theta)
    return np.asarray((bounds.u_max + bounds.u_min) / 2 + problem.u_half * scaled)


# ---- Regions ----


def plot_regions(
    problem: LinearMPC,
    axes: Axes | None = None,
    *,
    entries: Sequence[Quantity] = (0, 1),
    at: ArrayLike | None = None,
    by: str = "law",
) -> Axes:
    """Draw the regions of the explicit law in the plane of two entries of theta.

    Parameters
    ----------
    problem : LinearMPC
        The one that has the law: explicit, else ValueError.
    axes : matplotlib Axes, optional
        Where to draw; a new figure's by default.
    entries : pair of int or str, default (0, 1)
        The coordinates to the right and up: indices, or names as in ``problem.labels()``.
    at : array_like, shape (n_theta,), optional
        The other entries, in plant units; the operating point by default.
    by : {"law", "constraint"}, default "law"
        What a color stands for: which inputs are constant in the region, or which constraints are
        active in its optimal plan.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> axes = plot_regions(problems.cstr(), entries=("C_B", "T"), by="constraint")
    >>> axes.get_xlabel()
    'C_B (mol/L)'
    """
    check_choice("by", by, ("law", "constraint"))
    chosen = [_entry_of(problem, each) for each in entries]
    name = ActiveConstraints(problem) if by == "constraint" else None
    labels = problem.labels(units=True)
    return plot_law(problem.law(), axes, entries=chosen, at=at, labels=labels, name=name)


# ---- Surfaces ----


class _Plane:
    """A grid of two entries of theta, in plant units; the others are at the operating point."""

    def __init__(
        self, problem: LinearMPC, entries: Sequence[Quantity], frame: Frame | None
    ) -> None:
        chosen = [_entry_of(problem, each) for each in entries]
        if len(chosen) != 2 or chosen[0] == chosen[1]:
            raise ValueError(f"entries = {[*entries]} must be two different entries of theta.")
        low = problem.theta_min[chosen]
        high = problem.theta_max[chosen]
        if frame is not None:
            low, high = (check_array("frame", each, (2,)) for each in frame)
        if not np.all(np.isfinite([low, high])) or np.any(low >= high):
            names = [problem.labels()[i] for i in chosen]
            raise ValueError(
                f"There is no frame to draw {names} in: the box goes from {low.tolist()} to "
                f"{high.tolist()}. Pass frame=(lower left, upper right)."
            )
        law = problem.law()
        points = 121 if isinstance(law, PiecewiseAffine) else 41  # a program for each of them
        self.grid = np.linspace(low, high, points, axis=1)
        shown = np.tile(problem.units.to_plant(problem.theta_rest), (points**2, 1))
        shown[:, chosen] = np.stack(np.meshgrid(*self.grid), axis=-1).reshape(-1, 2)
        self.theta = problem.units.to_deviations(shown)
        self.inside = law.in_domain(self.theta).astype(float).reshape(points, points)
        self.labels = [problem.labels(units=True)[i] for i in chosen]
        self.problem = problem
        self.name = with_units(problem.model)[1][0]

    def values(self, policy: Any) -> Array:
        """Return the first input of a policy on the grid."""
        u = self.problem.units.input_to_plant(inputs_of(self.problem, policy, self.theta))
        return np.reshape(u[:, 0], self.inside.shape)

    def draw(
        self, axes: Axes, u: Array, scale: tuple[float, float], colors: str = "cividis"
    ) -> Any:
        """Draw values in colors of a scale, and the border of where the MPC has a solution."""
        low, high = scale
        mesh = axes.pcolormesh(*self.grid, u, cmap=colors, vmin=low, vmax=high, rasterized=True)
        if not self.inside.all():
            axes.contour(*self.grid, self.inside, levels=[0.5], colors="black", linewidths=1.0)
        axes.set(xlabel=self.labels[0], ylabel=self.labels[1])
        return mesh


def plot_surface(
    problem: LinearMPC,
    policy: Any,
    axes: Axes | None = None,
    *,
    entries: Sequence[Quantity] = (0, 1),
    frame: Frame | None = None,
) -> Axes:
    """Draw the first input, in plant units, over two entries of theta.

    The other entries are at the operating point. A line surrounds where the MPC has a solution, if
    that is not everywhere.

    Parameters
    ----------
    problem : LinearMPC
        With the box of theta, names and units.
    policy : callable, model or YannPolicy
        A law takes theta (batch, n_theta) in deviations.
    axes, entries
        As of :func:`plot_regions`.
    frame : pair of array_like, shape (2,), optional
        The lower left and the upper right corner, in plant units; by default the box of theta.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> mpc = problems.clipped_pendulum()
    >>> axes = plot_surface(mpc, mpc.explicit())
    >>> float(abs(axes.collections[0].get_array()).max())
    2.0
    """
    plane = _Plane(problem, entries, frame)
    u = plane.values(policy)
    axes = axes_or_new(axes, 5.4, 4.2)
    axes.figure.colorbar(plane.draw(axes, u, (u.min(), u.max())), ax=axes, label=plane.name)
    return axes


def surfaces_figure(
    problem: LinearMPC,
    before: Any,
    after: Any,
    *,
    entries: Sequence[Quantity] = (0, 1),
    frame: Frame | None = None,
) -> Figure:
    """Return a figure of the control surface before, after, and of their difference.

    Parameters are those of :func:`plot_surface`. The first two panels share their colors.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> mpc = problems.clipped_pendulum()
    >>> figure = surfaces_figure(mpc, mpc.explicit(), lambda theta: 0 * theta[:, :1])
    >>> [panel.get_title() for panel in figure.axes[:3]]
    ['before', 'after', 'after - before']
    """
    figure = new_figure(10.2, 3.2)
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    plane = _Plane(problem, entries, frame)
    first = plane.values(before)
    second = plane.values(after)
    scale = min(first.min(), second.min()), max(first.max(), second.max())
    plane.draw(panels[0], first, scale)
    mesh = plane.draw(panels[1], second, scale)
    figure.colorbar(mesh, ax=[*panels[:2]], label=plane.name)
    rounding = 1e-4 * float(problem.u_half[0])  # is pale
    size = max(float(np.abs(second - first).max()), rounding)
    mesh = plane.draw(panels[2], second - first, (-size, size), "PuOr")
    figure.colorbar(mesh, ax=panels[2], label=f"change of {plane.name}")
    for panel, title in zip(panels, ("before", "after", "after - before"), strict=True):
        panel.set_title(title)
        panel.label_outer()
    return figure


# ---- Which regions are used ----


def use_figure(problem: LinearMPC, policy: Any, episodes: Trajectories) -> Figure:
    """Return a figure of the share of steps in each region, and of the distance from the MPC there.

    Regions are those visited most. The distance is the mean and the largest one, of the input that
    is farthest. ``policy`` is as of :func:`plot_surface`, and observations of the episodes are
    theta, in plant units. ValueError if the problem's law is solved online.

    Examples
    --------
    >>> from sb3_yann.evaluation import evaluate
    >>> from sb3_yann_envs import problems
    >>> mpc = problems.cstr()
    >>> played = evaluate(mpc.explicit(), "CSTR-v0", [0])
    >>> len(use_figure(mpc, mpc.explicit(), played).axes)
    2
    """
    law: Any = problem.law()
    require_regions(law)
    theta = np.concatenate([each[:-1] for each in episodes.observations])
    theta = problem.units.to_deviations(theta[np.isfinite(theta).all(axis=1)])
    apart = np.abs(inputs_of(problem, policy, theta) - law(theta)) / problem.u_half
    distance = 100 * apart.max(axis=1)
    regions, where, visits = np.unique(law.locate(theta), return_inverse=True, return_counts=True)
    order = np.argsort(-visits, kind="stable")[:30]  # in a picture of visits: those visited most
    mean = (np.bincount(where, weights=distance) / visits)[order]
    largest = [float(distance[where == k].max()) for k in order]
    figure = new_figure(6.8, 4.8)
    above, below = figure.subplots(2, 1, sharex=True)
    places = range(len(order))
    above.bar(places, 100 * visits[order] / len(theta), color=COLORS[5])
    above.set(ylabel="steps there (%)")
    below.bar(places, mean, color=COLORS[0], label="mean")
    below.plot(places, largest, "v", color=COLORS[1], markersize=5, label="largest")
    below.set(ylabel="distance from the MPC\n(% of half the range)")
    _hide_rounding(below, 0.01)
    below.set_ylim(bottom=0)
    below.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0)
    below.set_xticks(places, [str(each) for each in regions[order]])
    below.tick_params(axis="x", rotation=90 if len(places) > 15 else 0)
    left_out = len(regions) - len(order)
    more = f" ({left_out} more, visited less, are left out)" if left_out else ""
    below.set_xlabel(f"region{more}")
    for panel in (above, below):
        panel.grid(axis="y", alpha=0.3)
        panel.set_axisbelow(True)
    return figure


def _hide_rounding(axes: Axes, size: float) -> None:
    """Let an axis of differences reach so far from zero at least: rounding is not drawn large."""
    low, high = axes.get_ylim()
    if max(-low, high) < size:
        axes.set_ylim(-size, size)


# ---- Closed loops ----


def _check_runs(problem: LinearMPC, runs: Runs) -> dict[str, Trajectories]:
    """Return episodes by their names, else say what they are instead of episodes of theta."""
    check_type("runs", runs, Mapping, "a mapping of names to episodes: {'MPC': evaluate(...)}")
    found = {name: as_played(f"runs[{name!r}]", each) for name, each in runs.items()}
    if not found or not all(len(each.costs) for each in found.values()):
        raise ValueError("There are no episodes to draw: pass {name: evaluate(...)} of some seeds.")
    n = problem.n_theta
    m = problem.model.n_inputs
    for name, episodes in found.items():
        for x, u in episodes.pairs:
            if x.shape[1:] != (n,) or u.shape[1:] != (m,):
                raise ValueError(
                    f"An episode of {name!r} has observations {x.shape} and actions {u.shape}, but "
                    f"theta has {n} entries and there are {m} inputs."
                )
    return found


def loops_figure(
    problem: LinearMPC, runs: Runs, *, quantities: Sequence[Quantity] | None = None
) -> Figure:
    """Return a figure of quantities over time, in plant units, with limits and set-points.

    Up to six episodes are lines. Of more, a line is their median and a band holds 80 % of them; a
    panel below holds the differences of the other controllers from the first one, where all were
    played from the same starts. Where set-points differ between episodes, the distance from them is
    drawn. Where some episodes have ended, the others count.

    Parameters
    ----------
    problem : LinearMPC
        With the operating point, limits, names and units.
    runs : mapping of str to Trajectories
        By controller; their observations are theta.
    quantities : sequence of int or str, optional
        Entries of ``[theta, u]``: indices, or names as in ``problem.labels()``, or an input's; all
        states and inputs by default.

    Raises
    ------
    ValueError
        If there are no episodes, or these are not of the problem's theta and inputs.

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
    entries = [_entry_of(problem, each, inputs=True) for each in quantities]
    unit = problem.model.time_unit
    counts = {len(each.costs) for each in runs.values()}
    height = 2 if len(runs) > 1 and len(counts) == 1 and counts.pop() > MAX_LINES else 1
    columns = min(3, len(entries))
    rows = -(-len(entries) // columns) * height
    figure = new_figure(3.2 * columns + 0.4, 1.9 * rows + 0.6)
    panels = figure.subplots(rows, columns, squeeze=False)
    for k, entry in enumerate(entries):
        block, column = divmod(k, columns)
        own = panels[block * height : (block + 1) * height, column]
        _draw_loops(own[0], problem, runs, entry)
        if height > 1:
            _draw_differences(own[1], problem, runs, entry)
        own[-1].set_xlabel(f"time ({unit})" if unit else "time")
    for panel in panels[-height:, (len(entries) - 1) % columns + 1 :].ravel():
        panel.set_axis_off()
    found: dict[str, Any] = {}
    for panel in panels.ravel():
        handles, labels = panel.get_legend_handles_labels()
        found |= zip(labels, handles, strict=True)
    last = ("limit", "soft limit", "bound of the input", "set-point")
    found = dict(sorted(found.items(), key=lambda each: each[0] in last))
    columns = min(4, len(found)) if max(map(len, found)) < 24 else 2
    figure.legend(
        [*found.values()], [*found], loc="outside upper left", ncols=columns, frameon=False
    )
    return figure


def _draw_loops(axes: Axes, problem: LinearMPC, runs: Runs, entry: int) -> None:
    n = problem.n_theta
    reference = problem.set_points.get(entry, entry)
    label = [*problem.labels(units=True), *with_units(problem.model)[1]][entry]
    set_points: Array = np.empty((0, 0))
    if reference != entry:  # the last one belongs to a step that is not taken
        set_points = np.unique(_rows(next(iter(runs.values())), reference, n)[:, :-1], axis=0)
    differ = len(set_points) > 1
    every = [np.zeros(0), set_points.ravel()]
    for number, (name, episodes) in enumerate(runs.items()):
        rows = _rows(episodes, entry, n)
        if differ:
            rows = rows[:, :-1] - _rows(episodes, reference, n)[:, :-1]
        _draw_rows(axes, rows, problem.model.dt, number, entry >= n, name)
        every.append(rows.ravel())
    axes.grid(alpha=0.3)
    axes.set_ylabel(f"{label}\nless its set-point" if differ else label)
    if differ:
        axes.axhline(0, **SET_POINT)  # type: ignore[arg-type]
        return
    for row in set_points:
        time = problem.model.dt * np.arange(len(row))
        axes.plot(time, row, drawstyle="steps-post", label="set-point", **SET_POINT)  # type: ignore[arg-type]
    data = np.concatenate(every)
    _draw_limits(axes, problem, entry, data[np.isfinite(data)])


def _draw_differences(axes: Axes, problem: LinearMPC, runs: Runs, entry: int) -> None:
    """Draw by how much a quantity differs from the first controller's, from the same starts."""
    first, *others = (_rows(each, entry, problem.n_theta) for each in runs.values())
    for number, rows in enumerate(others, start=1):
        steps = min(first.shape[1], rows.shape[1])
        apart = rows[:, :steps] - first[:, :steps]
        _draw_rows(axes, apart, problem.model.dt, number, entry >= problem.n_theta)
    _hide_rounding(axes, 1e-4 * float(np.nanmax(first) - np.nanmin(first)))
    axes.axhline(0, color="black", linewidth=0.8)
    plain = [*problem.labels(), *labels_of(problem.model)[1]][entry]
    whole = [*problem.labels(units=True), *with_units(problem.model)[1]][entry]
    axes.set_ylabel(f"difference{whole.removeprefix(plain)}")
    axes.grid(alpha=0.3)


def _rows(episodes: Trajectories, entry: int, n_theta: int) -> Array:
    """Return an entry of [theta, u] in each episode (episodes, steps), NaN after its end."""
    k = entry - n_theta
    parts, column = (episodes.actions, k) if k >= 0 else (episodes.observations, entry)
    series = (each[:, column] for each in parts)
    return np.array([*zip_longest(*series, fillvalue=np.nan)]).T


def _draw_rows(
    axes: Axes, rows: Array, dt: float, number: int, held: bool, name: str = "_nolegend_"
) -> None:
    """Draw lines of a few episodes, ``held`` inputs as steps; of many median and band of 80 %."""
    time = dt * np.arange(rows.shape[1])
    color = COLORS[number % len(COLORS)]
    line: dict[str, Any] = {"color": color, "drawstyle": "steps-post" if held else "default"}
    if len(rows) <= MAX_LINES:
        for k, row in enumerate(rows):
            label = name if k == 0 else "_nolegend_"
            axes.plot(time, row, linewidth=1.1, alpha=0.85, label=label, **line)
        return
    low, middle, high = np.nanpercentile(rows, [10, 50, 90], axis=0)
    step: Any = "post" if held else None
    axes.fill_between(time, low, high, alpha=0.2, color=color, linewidth=0, step=step)
    label = name if name.startswith("_") else f"{name}, median of {len(rows)}, and 80 % of them"
    axes.plot(time, middle, linewidth=1.7, label=label, **line)


def _draw_limits(axes: Axes, problem: LinearMPC, entry: int, data: Array) -> None:
    """Draw limits no farther from the data than these are apart; others would flatten them."""
    k = entry - problem.n_theta
    sides: tuple[float, ...] = ()
    kind = "bound of the input"
    if k >= 0:
        sides = problem.u_min[k], problem.u_max[k]
    elif entry < problem.model.n_states:
        sides = problem.x_min[entry], problem.x_max[entry]
        kind = "soft limit" if problem.soft.penalty and problem.soft.x[entry] > 0 else "limit"
    width = max(float(np.ptp(data)), 1e-9 * float(np.abs(data).max()))
    for value in sides:
        if data.min() - width <= value <= data.max() + width:
            axes.axhline(value, label=kind, **LIMIT)  # type: ignore[arg-type]


def plot_gains(runs: Runs, axes: Axes | None = None) -> Axes:
    """Draw by how much the second controller's cost differs from the first one's, start by start.

    The starts are sorted by it. Where it costs more, the bar has the other color. ``runs`` are
    those of two controllers, from the same starts.
    """
    (first, before), (second, after) = runs.items()
    share = 100 * np.sort(after.costs - before.costs) / (abs(float(before.costs.mean())) or 1.0)
    axes = axes_or_new(axes, 6.4, 2.6)
    colors = [COLORS[2] if each <= 0 else COLORS[1] for each in share]
    axes.bar(np.arange(1, len(share) + 1), share, color=colors, width=0.8)
    axes.axhline(0, color="black", linewidth=0.8)
    _hide_rounding(axes, 0.01)
    axes.axhline(float(share.mean()), color="black", linestyle="--", linewidth=0.8, label="mean")
    axes.set(xlabel="start, sorted", ylabel=f"{second} minus {first}\n(% of {first}'s mean cost)")
    axes.locator_params(axis="x", integer=True)
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)
    legend_beside(axes)
    return axes


# ---- Decisions of a guard ----


def plot_decisions(decisions: Sequence[Any], axes: Axes | None = None) -> Axes:
    """Draw what each candidate changes of the MPC's mean cost, and what the accepted policy does.

    The verdict is the mark; pale ones are estimated from a part of the starts. The line is what
    an accepted policy costs on all of them. A candidate far beyond the accepted policies, or
    without a cost, is drawn at the edge. Of no decisions a note says so.
    """
    axes = axes_or_new(axes, 8.0, 3.8)
    axes.set(xlabel="training episodes", ylabel="change of the mean cost\nagainst the MPC (%)")
    if not decisions:
        axes.text(0.5, 0.5, "no candidate was tried", ha="center", transform=axes.transAxes)
        return axes
    episodes = np.array([each.episode for each in decisions])
    mpc = np.array([each.mpc_cost for each in decisions], np.float64)
    costs, accepted = (
        100 * (np.array([getattr(each, name) for each in decisions]) - mpc) / (np.abs(mpc) + 1e-300)
        for name in ("candidate_cost", "accepted_cost")
    )
    in_part = np.array([each.played[0] < each.played[2] for each in decisions])
    bottom, top = _range_of_costs(costs, accepted)
    whole = [i if each.played[1] >= each.played[2] else -1 for i, each in enumerate(decisions)]
    latest = np.maximum.accumulate(whole)
    known = np.where(latest >= 0, accepted[latest], np.nan)
    axes.step(episodes, known, where="post", color=COLORS[0], label="accepted policy")
    axes.axhline(0, color="black", linestyle="--", linewidth=1.2, label="MPC")
    shown = np.clip(np.nan_to_num(costs, nan=np.inf), bottom, top)
    kinds = np.array([each.verdict for each in decisions])
    refused = kinds == "rejected"
    restored = np.array([each.restored for each in decisions])
    for own, label, marker, color in (
        (kinds == "accepted", "accepted", "o", COLORS[2]),
        (kinds == "accepted in part", "accepted in part", "^", COLORS[4]),
        (refused & ~restored, "refused, plays on", "x", COLORS[3]),
        (refused & restored, "refused, policy restored", "X", COLORS[1]),
    ):
        if own.any():
            style: dict[str, Any] = {"color": color, "markersize": 6, "clip_on": False}
            for which, alpha in ((own & ~in_part, 1.0), (own & in_part, 0.35)):
                name = label if alpha == 1 else "_nolegend_"
                axes.plot(episodes[which], shown[which], marker, label=name, alpha=alpha, **style)
    if in_part.any():
        axes.plot([], [], "o", color="0.2", alpha=0.35, label="pale: from a part\nof the starts")
    if beyond := int(np.sum(~((costs >= bottom) & (costs <= top)))):
        axes.plot([], [], " ", label=f"({beyond} beyond the scale,\ndrawn at its edge)")
    axes.set_ylim(bottom, top)
    axes.locator_params(axis="x", integer=True)
    axes.grid(alpha=0.3)
    legend_beside(axes)
    return axes


def _range_of_costs(costs: Array, accepted: Array) -> tuple[float, float]:
    """Return the range of 0 and what was accepted, and of the candidates within two widths."""
    known = np.append(accepted[np.isfinite(accepted)], 0.0)
    width = max(float(np.ptp(known)), 0.02 * float(np.abs(known).max()), 0.01)
    near = (costs >= known.min() - 2 * width) & (costs <= known.max() + 2 * width)
    shown = np.append(known, costs[near])
    room = 0.08 * max(float(np.ptp(shown)), width)
    return float(shown.min()) - room, float(shown.max()) + room


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
    axes = axes_or_new(axes, 6.4, 2.6)
    start = 0.0
    for k, name in enumerate(parts):
        value = 100 * getattr(found, name)
        error = 100 * found.standard_error if name == "total" else None
        start = 0.0 if name == "total" else start
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


def plot_twin(trust: Any, axes: Sequence[Axes] | None = None) -> tuple[Axes, Axes]:
    """Draw held-out costs over predicted ones, and errors of free runs by steps ahead.

    ``trust`` is ``twin.trust``. A trusted twin's costs lie between the dashed lines, on root mean
    square.
    """
    from matplotlib.ticker import LogLocator

    if axes is None:
        axes = new_figure(9.2, 3.8).subplots(1, 2)
    costs, runs = axes
    costs.set(xlabel="predicted cost", ylabel="actual cost")
    runs.set(xlabel="steps ahead", ylabel="error (standard deviations of the states)")
    if len(trust.actual):
        both = np.concatenate([trust.predicted, trust.actual])
        both = both[np.abs(both) <= 3 * np.abs(trust.actual).max()]  # a run that diverged is not
        ends = np.array([both.min(), both.max()])
        ends = ends + 0.08 * np.array([-1, 1]) * max(float(np.ptp(ends)), 1e-9)
        error = 0.25 * np.abs(trust.actual).mean()
        costs.plot(ends, ends, color="black", linewidth=1, label="as predicted")
        for side, label in ((-1, "25 % of the mean off"), (1, "_nolegend_")):
            costs.plot(ends, ends + side * error, "k--", linewidth=0.8, label=label)
        style: dict[str, Any] = {"color": COLORS[0], "alpha": 0.8, "label": "held-out episode"}
        costs.plot(trust.predicted, trust.actual, "o", **style)
        costs.set(xlim=ends, ylim=ends)
        horizons = trust.runs.horizons
        for name, errors, color, line in (
            ("twin", trust.runs.errors[trust.chosen], COLORS[0], "o-"),
            ("linear model", trust.runs.errors[0], COLORS[1], "s--"),
            ("nothing moves", trust.standing, COLORS[2], "^:"),
        ):
            runs.plot(horizons, errors, line, color=color, label=name)
        runs.set(xscale="log", yscale="log")
        runs.set_xticks(horizons, [str(each) for each in horizons], minor=False)
        runs.set_xticks([], minor=True)
        runs.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        runs.yaxis.set_major_formatter("{x:g}")  # no powers of ten
        runs.yaxis.set_minor_formatter("")
    for panel in (costs, runs):
        panel.grid(alpha=0.3)
        if panel.get_legend_handles_labels()[0]:
            panel.legend(loc="lower left", bbox_to_anchor=(0, 1.01), frameon=False, ncols=3)
    return costs, runs
