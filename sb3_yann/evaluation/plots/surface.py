"""The control surface: an input over two coordinates, of one policy or as a difference of two."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._drawing import axes_or_new, new_figure
from sb3_yann._validation import Array, check_array
from sb3_yann.control import LinearMPC, PiecewiseAffine
from sb3_yann.control.model.labels import with_units
from sb3_yann.evaluation.plots._sources import Quantity, entry_of, inputs_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

Frame = tuple[ArrayLike, ArrayLike]
Values = tuple[Array, tuple[Array, Array], Array]
ROUNDING = 1e-4
"""A change of an input by less, in half-widths, is drawn pale."""
POINTS, FEW = 121, 41
"""Of the grid, in each direction; few where the law is solved at each point."""


def plot_surface(
    problem: LinearMPC,
    policy: Any,
    axes: Axes | None = None,
    *,
    entries: Sequence[Quantity] = (0, 1),
    at: ArrayLike | None = None,
    output: int = 0,
    minus: Any = None,
    frame: Frame | None = None,
) -> Axes:
    """Draw an input, as the plant takes it, over two entries of theta.

    A line surrounds where the MPC has a solution, if that is not everywhere.

    Parameters
    ----------
    problem : LinearMPC
        With the box of theta, names and units.
    policy : callable, model or YannPolicy
        A law takes theta (batch, n_theta) in deviations.
    axes : matplotlib Axes, optional
        Where to draw; a new figure's by default.
    entries : pair of int or str, default (0, 1)
        The coordinates to the right and up: indices, or names as in ``problem.labels()``.
    at : array_like, shape (n_theta,), optional
        The other entries, as the plant shows them; the operating point by default.
    output : int, default 0
        Which input.
    minus : callable, model or YannPolicy, optional
        What to subtract: then the difference is drawn, in colors that are symmetric about zero.
    frame : pair of array_like, shape (2,), optional
        The lower left and the upper right corner, as the plant shows them; by default the box of
        theta.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> mpc = problems.clipped_pendulum()
    >>> axes = plot_surface(mpc, mpc.explicit())
    >>> float(abs(axes.collections[0].get_array()).max())
    2.0
    """
    place = entries, at, output, frame
    own = _values(problem, policy, *place)
    axes, label = axes_or_new(axes, 5.4, 4.2), with_units(problem.model)[1][output]
    if minus is not None:
        own = own[0] - _values(problem, minus, *place)[0], *own[1:]
        size, label = _size(problem, own[0], output), f"change of {label}"
        mesh = _draw(axes, problem, entries, own, (-size, size), "PuOr")
    else:
        mesh = _draw(axes, problem, entries, own, _extent(own[0]))
    axes.figure.colorbar(mesh, ax=axes, label=label)
    return axes


def surfaces_figure(
    problem: LinearMPC,
    before: Any,
    after: Any,
    *,
    entries: Sequence[Quantity] = (0, 1),
    at: ArrayLike | None = None,
    output: int = 0,
    frame: Frame | None = None,
) -> Figure:
    """Return a figure of the control surface before, after, and of their difference.

    Parameters
    ----------
    problem : LinearMPC
        With the box of theta, names and units.
    before, after : callable, model or YannPolicy
        As of :func:`plot_surface`; the first two panels share their colors.
    entries, at, output, frame
        As there.

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
    first, second = (_values(problem, each, entries, at, output, frame) for each in (before, after))
    scale = _extent(np.stack([first[0], second[0]]))
    change = second[0] - first[0]
    size, label = _size(problem, change, output), with_units(problem.model)[1][output]
    _draw(panels[0], problem, entries, first, scale)
    mesh = _draw(panels[1], problem, entries, second, scale)
    figure.colorbar(mesh, ax=[*panels[:2]], label=label)
    own = change, *second[1:]
    mesh = _draw(panels[2], problem, entries, own, (-size, size), "PuOr")
    figure.colorbar(mesh, ax=panels[2], label=f"change of {label}")
    for panel, title in zip(panels, ("before", "after", "after - before"), strict=True):
        panel.set_title(title)
        panel.label_outer()
    return figure


def _size(problem: LinearMPC, change: Array, output: int) -> float:
    """Return the range of the colors of a change: rounding has none."""
    return max(float(np.abs(change).max()), ROUNDING * float(problem.u_half[output]))


def _extent(u: Array) -> tuple[float, float]:
    return float(np.min(u)), float(np.max(u))


def _draw(
    axes: Axes,
    problem: LinearMPC,
    entries: Sequence[Quantity],
    values: Values,
    scale: tuple[float, float],
    colors: str = "cividis",
) -> QuadMesh:
    """Draw values on the grid, and the border of where the MPC has a solution."""
    u, grid, inside = values
    low, high = scale
    mesh = axes.pcolormesh(*grid, u, cmap=colors, vmin=low, vmax=high, rasterized=True)
    if not inside.all():
        axes.contour(*grid, inside, levels=[0.5], colors="black", linewidths=1.0)
    labels = problem.labels(units=True)
    across, up = (labels[entry_of(problem, each)] for each in entries)
    axes.set(xlabel=across, ylabel=up)
    return mesh


def _values(
    problem: LinearMPC,
    policy: Any,
    entries: Sequence[Quantity],
    at: ArrayLike | None,
    output: int,
    frame: Frame | None,
) -> Values:
    """Return an input on the grid in plant units, the grid, and whether the MPC has a solution."""
    chosen = [entry_of(problem, each) for each in entries]
    if len(chosen) != 2 or chosen[0] == chosen[1]:
        raise ValueError(f"entries = {[*entries]} must be two different entries of theta.")
    if not 0 <= output < problem.model.n_inputs:
        raise ValueError(
            f"output = {output} must be an input, from 0 to {problem.model.n_inputs - 1}."
        )
    low, high = problem.deviations.theta_min[chosen], problem.deviations.theta_max[chosen]
    if frame is not None:
        low, high = (check_array("frame", each, (2,)) - problem.theta_ss[chosen] for each in frame)
    if not np.all(np.isfinite([low, high])) or np.any(low >= high):
        names = [problem.labels()[i] for i in chosen]
        raise ValueError(
            f"There is no frame to draw {names} in: the box goes from {low.tolist()} to "
            f"{high.tolist()}, about the operating point. Pass frame=(lower left, upper right)."
        )
    shown = problem.theta_ss if at is None else check_array("at", at, (problem.n_theta,))
    law = problem.law()
    points = POINTS if isinstance(law, PiecewiseAffine) else FEW
    steps = [np.linspace(a, b, points) for a, b in zip(low, high, strict=True)]
    theta = np.tile(shown - problem.theta_ss, (points**2, 1))
    theta[:, chosen] = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
    u = inputs_of(problem, policy, theta)[:, output] + problem.model.u_ss[output]
    inside = law.in_domain(theta).astype(float)
    x, y = (each + problem.theta_ss[i] for each, i in zip(steps, chosen, strict=True))
    shape = points, points
    return u.reshape(shape), (x, y), inside.reshape(shape)
