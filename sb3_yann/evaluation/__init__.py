"""Seeded episodes, tables and pictures."""

from sb3_yann.evaluation.plots import save_plant_trajectories, save_trajectories
from sb3_yann.evaluation.tables import comparison_table, summary_table
from sb3_yann.rollout import Trajectories, evaluate

__all__ = [
    "Trajectories",
    "comparison_table",
    "evaluate",
    "save_plant_trajectories",
    "save_trajectories",
    "summary_table",
]
