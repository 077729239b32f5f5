"""What to know before training: whether an env shows, takes and pays what the problem says."""

from sb3_yann.audit.meaning import CostMismatchError, CostMismatchWarning
from sb3_yann.audit.reward import CostAudit, CostFinding

__all__ = ["CostAudit", "CostFinding", "CostMismatchError", "CostMismatchWarning"]
