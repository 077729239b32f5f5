"""The callback that takes back what does not improve on the MPC that a policy started from."""

from sb3_yann.guard.callback import ImprovementGuard, restore_accepted
from sb3_yann.guard.record import Decision

__all__ = ["Decision", "ImprovementGuard", "restore_accepted"]
