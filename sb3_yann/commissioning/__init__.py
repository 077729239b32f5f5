"""From a plant's log to a better controller on the plant."""

from sb3_yann.commissioning.commissioning import Commissioning
from sb3_yann.commissioning.journal import Batch
from sb3_yann.commissioning.watchdog import Alarm, Watchdog

__all__ = ["Alarm", "Batch", "Commissioning", "Watchdog"]
