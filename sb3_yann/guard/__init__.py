"""The callback that takes back what does not improve on the MPC that a policy started from."""

from sb3_yann.guard.callback import ImprovementGuard
from sb3_yann.guard.record import Decision
from sb3_yann.guard.restoring import restore_accepted

__all__ = ["Decision", "ImprovementGuard", "restore_accepted"]
