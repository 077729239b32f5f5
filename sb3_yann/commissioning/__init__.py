"""From a plant's log to a better controller on the plant."""

from sb3_yann.commissioning.improve import Improvement, improve
from sb3_yann.commissioning.search import Check

__all__ = ["Check", "Improvement", "improve"]
