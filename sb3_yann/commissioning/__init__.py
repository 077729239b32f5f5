"""From a plant's log to a better controller on the plant."""

from sb3_yann.commissioning.commissioning import Commissioning
from sb3_yann.commissioning.improve import Improvement, improve
from sb3_yann.commissioning.journal import Batch
from sb3_yann.commissioning.trial import Check
from sb3_yann.commissioning.watchdog import Alarm, Watchdog

__all__ = [
    "Alarm",
    "Batch",
    "Check",
    "Commissioning",
    "Improvement",
    "Watchdog",
    "improve",
]
