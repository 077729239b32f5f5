"""A better policy from a twin or a simulator."""

from sb3_yann.improvement.improve import Improvement, improve
from sb3_yann.improvement.trial import Check

__all__ = ["Check", "Improvement", "improve"]
