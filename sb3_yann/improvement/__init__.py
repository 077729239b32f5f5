"""What can be gained over an MPC, and a better policy from a twin or a simulator."""

from sb3_yann.improvement.confirmation import Check
from sb3_yann.improvement.improving import Improvement, improve
from sb3_yann.improvement.measuring import Headroom, headroom

__all__ = ["Check", "Headroom", "Improvement", "headroom", "improve"]
