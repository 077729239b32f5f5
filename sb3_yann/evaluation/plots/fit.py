"""How well an identified model runs along a log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._drawing import COLORS, axes_or_new, legend_above, new_figure
from sb3_yann._validation import Array, check_array, check_int
from sb3_yann.control import LinearModel
from sb3_yann.control.model.labels import with_units

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AHEAD = 10
"""Steps ahead that the model predicts from each measured state, beside the free run."""


def plot_fit(
    model: LinearModel,
    states: ArrayLike,
    actions: ArrayLike,
    axes: Axes | None = None,
    *,
    disturbances: ArrayLike | None = None,
    state: int = 0,
    time_unit: str = "",
) -> Axes:
    """Draw one measured state, the model's free run from the first row, and ten steps ahead.

    The legend tells the fit, ``100 (1 - |x - predicted| / |x - mean|)`` in percent.

    Parameters
    ----------
    model : LinearModel
        As of :func:`identify`: ``found.model``.
    states : array_like, shape (T + 1, n)
        An episode as the plant shows it, best one that the fit has not seen.
    actions : array_like, shape (T, m)
        As the plant takes them.
    axes : matplotlib Axes, optional
        Where to draw; a new figure's by default.
    disturbances : array_like, shape (T, d), optional
        As measured.
    state : int, default 0
        Which one.
    time_unit : str, optional
        Of ``model.dt``, for the label.

    Examples
    --------
    >>> model = LinearModel([[0.5]], [[1.0]], dt=1)
    >>> axes = plot_fit(model, [[0.0], [1.0], [1.5]], [[1.0], [1.0]])
    >>> axes.get_legend_handles_labels()[1]
    ['measured', 'free run, fit 100.0 %', '10 steps ahead, fit 100.0 %']
    """
    x, free, ahead = _predicted(model, states, actions, disturbances)
    if check_int("state", state, 0) >= model.n_states:
        raise ValueError(f"state = {state} must be below {model.n_states}, the number of states.")
    axes = axes_or_new(axes, 7.0, 3.2)
    time = model.dt * np.arange(len(x))
    axes.plot(time, x[:, state], color="black", linewidth=1.0, label="measured")
    for rows, name, color, style in (
        (free, "free run", COLORS[1], "-"),
        (ahead, f"{AHEAD} steps ahead", COLORS[0], "--"),
    ):
        label = f"{name}, fit {fit_of(x[:, state], rows[:, state]):.1f} %"
        axes.plot(time, rows[:, state], style, color=color, linewidth=1.2, label=label)
    span = float(np.ptp(x[:, state])) or 1.0
    axes.set_ylim(x[:, state].min() - span, x[:, state].max() + span)
    if np.all(np.abs(free[:, state] - x[:, state]) <= 0.3 * span):
        axes.autoscale(axis="y")
    axes.set(xlabel=f"time ({time_unit})" if time_unit else "time")
    axes.set_ylabel(with_units(model)[0][state])
    axes.grid(alpha=0.3)
    legend_above(axes)
    return axes


def fit_figure(
    model: LinearModel,
    states: ArrayLike,
    actions: ArrayLike,
    *,
    disturbances: ArrayLike | None = None,
    time_unit: str = "",
) -> Figure:
    """Return a figure of :func:`plot_fit` for each state.

    Parameters
    ----------
    model, states, actions, disturbances, time_unit
        As there.

    Examples
    --------
    >>> model = LinearModel([[0.5]], [[1.0]], dt=1)
    >>> len(fit_figure(model, [[0.0], [1.0], [1.5]], [[1.0], [1.0]]).axes)
    1
    """
    figure = new_figure(7.0, 2.1 * model.n_states + 0.4)
    panels = figure.subplots(model.n_states, 1, sharex=True, squeeze=False)[:, 0]
    own = {"disturbances": disturbances, "time_unit": time_unit}
    for i, panel in enumerate(panels):
        plot_fit(model, states, actions, panel, state=i, **own)  # type: ignore[arg-type]
        panel.label_outer()
    return figure


def fit_of(measured: Array, predicted: Array) -> float:
    """Return the fit of one state's series in percent; NaN where the state does not move."""
    moved = np.linalg.norm(measured[1:] - measured[1:].mean())
    missed = np.linalg.norm(measured[1:] - predicted[1:])
    return float(100 * (1 - missed / moved)) if moved > 0 else float("nan")


def _predicted(
    model: LinearModel, states: ArrayLike, actions: ArrayLike, disturbances: ArrayLike | None
) -> tuple[Array, Array, Array]:
    """Return measured states (T + 1, n), the free run, and what is predicted ten steps ahead."""
    x = check_array("states", states, ("T + 1", model.n_states))
    u = check_array("actions", actions, (len(x) - 1, model.n_inputs)) - model.u_ss
    shape = len(u), model.n_disturbances
    d = np.zeros(shape) + model.d_ss
    if disturbances is not None:
        d = check_array("disturbances", disturbances, shape)
    pushed = u @ model.B.T + (d - model.d_ss) @ model.E.T
    free, ahead = (np.array(x - model.x_ss) for _ in range(2))
    for k in range(len(u)):
        free[k + 1] = free[k] @ model.A.T + pushed[k]
    for end in range(1, len(x)):
        start = max(0, end - AHEAD)
        z = x[start] - model.x_ss
        for k in range(start, end):
            z = z @ model.A.T + pushed[k]
        ahead[end] = z
    return x, free + model.x_ss, ahead + model.x_ss
