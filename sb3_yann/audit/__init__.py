"""What to know before training: whether an env shows, takes and pays what the problem says."""

from sb3_yann.audit.callback import CostAudit
from sb3_yann.audit.reward import CostFinding, CostMismatchError, CostMismatchWarning

__all__ = ["CostAudit", "CostFinding", "CostMismatchError", "CostMismatchWarning"]
