"""The callback that keeps only what is no worse than the MPC that a policy started from."""

from sb3_yann.guard.callback import ImprovementGuard
from sb3_yann.guard.options import AcceptanceRule, StepSize
from sb3_yann.guard.session import restore_accepted
from sb3_yann.guard.state import Decision

__all__ = ["AcceptanceRule", "Decision", "ImprovementGuard", "StepSize", "restore_accepted"]
