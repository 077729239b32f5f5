"""What there is to gain over an MPC, and of which kind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from sb3_yann._drawing import COLORS, as_figure, axes_or_new

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PARTS = (
    ("offset", "offset:\na disturbance observer"),
    ("model_error", "model error:\nre-identification"),
    ("nonlinearity", "nonlinearity\nand constraints"),
    ("total", "all of it"),
)


class HeadroomLike(Protocol):
    """What is drawn of a :class:`Headroom`: gains relative to the MPC's mean cost."""

    @property
    def offset(self) -> float:
        """What an observer gains."""

    @property
    def model_error(self) -> float:
        """What a re-identified model gains beyond that."""

    @property
    def nonlinearity(self) -> float:
        """The rest."""

    @property
    def total(self) -> float:
        """All of it."""

    @property
    def standard_error(self) -> float:
        """How far the total may be off."""

    @property
    def verdict(self) -> str:
        """What to do."""


def plot_headroom(found: HeadroomLike, axes: Axes | None = None) -> Axes:
    """Draw the parts of the gain one after the other, and their sum with its standard error.

    Examples
    --------
    >>> from sb3_yann import Headroom
    >>> import numpy as np
    >>> costs = np.array([10.0, 20.0])
    >>> found = Headroom(costs, costs, costs, costs - 0.5, 0.0, 0.0, 1 / 30, "learn", "a simulator")
    >>> [round(float(bar.get_width()), 2) for bar in plot_headroom(found).patches]
    [0.0, 0.0, 3.33, 3.33]
    """
    axes = axes_or_new(axes, 6.4, 2.6)
    begin = 0.0
    for k, (name, _) in enumerate(PARTS):
        whole = name == "total"
        value, start = 100 * getattr(found, name), 0.0 if whole else begin
        error = 100 * found.standard_error if whole else None
        axes.barh(k, value, left=start, color=COLORS[k], xerr=error, capsize=3, height=0.6)
        end = max(start, start + value) + (error or 0.0)
        axes.annotate(f"{value:+.2f} %", (end, k), (4, 0), textcoords="offset points", va="center")
        begin += value
    axes.set_yticks(range(len(PARTS)), [label for _, label in PARTS])
    axes.invert_yaxis()
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set(xlabel="gain over the MPC (% of its mean cost)", title=f"verdict: {found.verdict}")
    axes.margins(x=0.25)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    return axes


headroom_figure = as_figure(plot_headroom)
