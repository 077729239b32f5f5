"""Logs of plants: one class for `identify`, `PlantTwin` and `Commissioning`."""

from sb3_yann.log.csv_file import SECONDS
from sb3_yann.log.episodes import (
    Arrays,
    Episode,
    as_matrices,
    in_names,
    require_one_state_more,
    split_episodes,
)
from sb3_yann.log.log import Log
from sb3_yann.log.readings import UNITS

__all__ = [
    "SECONDS",
    "UNITS",
    "Arrays",
    "Episode",
    "Log",
    "as_matrices",
    "in_names",
    "require_one_state_more",
    "split_episodes",
]
