"""The callback that keeps a policy from ever being worse than the MPC it started from."""

from sb3_yann.guard.callback import ImprovementGuard
from sb3_yann.guard.record import Decision

__all__ = ["Decision", "ImprovementGuard"]
