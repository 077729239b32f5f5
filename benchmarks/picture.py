"""Cost against number of regions, as one PNG."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas

from benchmarks import evaluation, networks
from benchmarks.records import Figures
from benchmarks.timing import quartiles
from experiments.pictures import COLORS, MARKERS, STYLES

PANELS = (
    (evaluation.ONE, "law, one point (numpy)"),
    (evaluation.MANY, "law, 256 points (numpy)"),
    (networks.FORWARD_ONE, "actor, one observation (torch)"),
    (networks.TRAIN, "training step of DDPG, batch of 256"),
)
NAME = "performance.png"


def save_picture(figures: Figures, folder: Path) -> Path | None:
    """Save the picture of what was measured at more than one size; None if nothing was."""
    panels = [panel for panel in PANELS if figures.of(panel[0])]
    if not panels:
        return None
    canvas = Canvas(figsize=(4.6 * len(panels), 4.8), layout="constrained")
    FigureCanvasAgg(canvas)
    styles: dict[str, int] = {}
    for axes, (section, title) in zip(
        canvas.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
    ):
        _panel(axes, figures, section, styles)
        axes.set(title=title, xlabel="regions", ylabel="seconds", xscale="log", yscale="log")
        axes.grid(alpha=0.3, which="both")
    handles = {
        label: handle
        for axes in canvas.axes
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    canvas.legend(
        handles.values(),
        handles.keys(),
        loc="outside lower center",
        ncols=len(panels),
        frameon=False,
    )
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / NAME
    canvas.savefig(path, dpi=120)
    return path


def _panel(axes: Axes, figures: Figures, section: str, styles: dict[str, int]) -> None:
    sizes = [column for column in figures.columns(section) if column.isdigit()]
    for name in dict.fromkeys(each.name for each in figures.of(section)):
        found = [(int(size), figures.get(section, name, size)) for size in sizes]
        there = [(size, figure) for size, figure in found if figure is not None]
        k = styles.setdefault(name, len(styles))
        x = [size for size, _ in there]
        low, middle, high = zip(*(quartiles(figure.samples) for _, figure in there), strict=True)
        style = {"color": COLORS[k % len(COLORS)], "linestyle": STYLES[k // len(COLORS)]}
        axes.plot(x, middle, label=name, marker=MARKERS[k % len(MARKERS)], markersize=4, **style)
        axes.fill_between(x, low, high, color=style["color"], alpha=0.2, linewidth=0)
