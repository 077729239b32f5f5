"""The callback that takes back what does not improve on the MPC that a policy started from."""

from sb3_yann.guard.callback import ImprovementGuard
from sb3_yann.guard.restoring import restore_accepted
from sb3_yann.guard.state import Decision

__all__ = ["Decision", "ImprovementGuard", "restore_accepted"]
