"""Seeded episodes, tables and pictures."""

from sb3_yann.evaluation.tables import comparison_table, summary_table
from sb3_yann.rollout import Trajectories, evaluate

__all__ = [
    "Trajectories",
    "comparison_table",
    "evaluate",
    "summary_table",
]
