"""Limits of a long search, and its progress."""
from __future__ import annotations
class Watch:
    def step(self, n): pass
