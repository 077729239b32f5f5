"""What all pictures share: colors, figures without a window, legends beside the data."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442")
"""Okabe and Ito's, distinct with any color vision (*Color Universal Design*, 2008)."""
REST = "#D9D9D9"
LIMIT = {"color": "black", "linestyle": (0, (5, 2)), "linewidth": 1.0}
SET_POINT = {"color": "black", "linestyle": ":", "linewidth": 1.4}


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


def legend_beside(axes: Axes, title: str | None = None) -> None:
    """Put the legend to the right of the data; none where nothing has a label."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(
            title=title, loc="upper left", bbox_to_anchor=(1.02, 1), borderaxespad=0, frameon=False
        )
