"""The callback that compares the env's reward with the stage cost of the problem."""

from sb3_yann.audit.callback import CostAudit
from sb3_yann.audit.finding import CostFinding, CostMismatchError, CostMismatchWarning

__all__ = ["CostAudit", "CostFinding", "CostMismatchError", "CostMismatchWarning"]
