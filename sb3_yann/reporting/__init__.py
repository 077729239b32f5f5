"""What was made, how it was checked, and what came of it: one page for an engineer to sign."""

from sb3_yann.reporting.assemble import report

__all__ = ["report"]
