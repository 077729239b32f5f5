"""What to know before training: whether the reward is the MPC's cost, and what there is to gain."""

from sb3_yann.audit.callback import CostAudit
from sb3_yann.audit.finding import (
    CostFinding,
    CostMismatchError,
    CostMismatchWarning,
    SteadyOffsetWarning,
)

__all__ = [
    "CostAudit",
    "CostFinding",
    "CostMismatchError",
    "CostMismatchWarning",
    "SteadyOffsetWarning",
]
