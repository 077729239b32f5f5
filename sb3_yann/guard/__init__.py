"""The callback that keeps only what is no worse than the MPC that a policy started from."""

from sb3_yann.compare import AcceptanceRule
from sb3_yann.guard.callback import ImprovementGuard, StepSize
from sb3_yann.guard.state import Decision, restore_accepted

__all__ = ["AcceptanceRule", "Decision", "ImprovementGuard", "StepSize", "restore_accepted"]
