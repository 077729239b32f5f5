"""What can be gained over an MPC, and a better policy from a twin or a simulator."""

from sb3_yann.improvement.gains import Headroom
from sb3_yann.improvement.improving import Improvement, improve
from sb3_yann.improvement.measuring import headroom
from sb3_yann.improvement.trial import Check

__all__ = ["Check", "Headroom", "Improvement", "headroom", "improve"]
