"""Pictures of laws, closed loops, decisions and twins: each takes and returns matplotlib's Axes."""

from sb3_yann.evaluation.plots.decisions import decisions_figure, plot_decisions
from sb3_yann.evaluation.plots.fit import fit_figure, plot_fit
from sb3_yann.evaluation.plots.headroom import headroom_figure, plot_headroom
from sb3_yann.evaluation.plots.loops import loops_figure, plot_loop
from sb3_yann.evaluation.plots.regions import plot_regions, regions_figure
from sb3_yann.evaluation.plots.surface import plot_surface, surfaces_figure
from sb3_yann.evaluation.plots.trajectories import save_plant_trajectories, save_trajectories
from sb3_yann.evaluation.plots.use import RegionUse, plot_changes, plot_visits, use_figure
from sb3_yann.twin.plots import plot_costs, plot_free_runs, twin_figure

__all__ = [
    "RegionUse",
    "decisions_figure",
    "fit_figure",
    "headroom_figure",
    "loops_figure",
    "plot_changes",
    "plot_costs",
    "plot_decisions",
    "plot_fit",
    "plot_free_runs",
    "plot_headroom",
    "plot_loop",
    "plot_regions",
    "plot_surface",
    "plot_visits",
    "regions_figure",
    "save_plant_trajectories",
    "save_trajectories",
    "surfaces_figure",
    "twin_figure",
    "use_figure",
]
