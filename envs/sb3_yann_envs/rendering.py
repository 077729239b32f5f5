"""Frames of the environments, drawn with Matplotlib's Agg canvas and without pyplot.

Matplotlib is imported on the first frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Frame = NDArray[np.uint8]

_ROD, _INPUT, _LIMIT = "tab:red", "tab:blue", "0.25"


def pendulum_frame(theta: float, torque: float, max_torque: float) -> Frame:
    """Return the picture of a pendulum, shape (400, 400, 3).

    The angle from upright is positive counter-clockwise. The arrow points the way the torque turns,
    and sweeps a right angle at the largest torque.
    """
    figure = _figure(4.0, 4.0)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), aspect="equal", xlim=(-1.3, 1.3), ylim=(-1.3, 1.3))
    axes.set_axis_off()
    rod = ([0.0, -math.sin(theta)], [0.0, math.cos(theta)])
    axes.plot(*rod, color=_ROD, lw=14, solid_capstyle="round")
    axes.plot([0.0], [0.0], "o", color="black", markersize=7)
    if torque:
        sweep = np.linspace(0.0, torque / max_torque * math.pi / 2, 30) + math.pi / 2
        x, y = 0.45 * np.cos(sweep), 0.45 * np.sin(sweep)
        axes.plot(x, y, color=_INPUT, lw=3)
        ahead = math.copysign(0.15, torque)
        tip = (x[-1] - ahead * math.sin(sweep[-1]), y[-1] + ahead * math.cos(sweep[-1]))
        head = {"arrowstyle": "-|>", "color": _INPUT, "mutation_scale": 25, "shrinkA": 0}
        axes.annotate("", tip, (x[-1], y[-1]), arrowprops=head)
    return _pixels(figure)


def reactor_frame(
    sample_time: float,
    temperatures: Sequence[float],
    inputs: Sequence[float],
    limit: float,
    max_input: float,
) -> Frame:
    """Return the history of a reactor episode, shape (400, 600, 3).

    Parameters
    ----------
    sample_time : float
        Sample time in h.
    temperatures : sequence of float, length k + 1
        Temperature in K at the start and after each of k steps.
    inputs : sequence of float, length k
        Input deviation of each step in kJ/(h m2 K).
    limit, max_input : float
        Temperature limit in K, and largest input deviation.
    """
    figure = _figure(6.0, 4.0)
    figure.set_layout_engine("constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    hours = sample_time * np.arange(len(temperatures))
    upper.plot(hours, temperatures, color=_ROD)
    upper.plot(hours[-1:], temperatures[-1:], "o", color=_ROD)
    upper.axhline(limit, color=_LIMIT, linestyle="--")
    place = (0.01, limit), (0, 3), ("axes fraction", "data"), "offset points"
    upper.annotate(f"limit {limit:g} K", *place, color=_LIMIT)
    # A fixed floor keeps the axis still while the temperature stays near its steady state.
    upper.set_ylim(min(465.0, min(temperatures) - 1.0), max(limit, *temperatures) + 2.5)
    upper.set_ylabel("temperature (K)")
    lower.stairs(inputs, hours, baseline=None, color=_INPUT)
    lower.set(ylim=(-1.1 * max_input, 1.1 * max_input), xlim=(0.0, max(1.0, hours[-1])))
    lower.set(ylabel="input deviation\n(kJ/(h m² K))", xlabel="time (h)")
    figure.align_ylabels()
    return _pixels(figure)


def _figure(width: float, height: float) -> Figure:
    """Return a figure of the given size in inches (at 100 dots each) that pyplot never sees."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=100)


def _pixels(figure: Figure) -> Frame:
    """Return the figure as RGB values of shape (height, width, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.array(canvas.buffer_rgba(), dtype=np.uint8)[:, :, :3].copy()  # type: ignore[no-untyped-call]
