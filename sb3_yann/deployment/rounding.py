"""How exact exported code is, and what its searches take for a tie or for inside."""

from __future__ import annotations

from typing import NamedTuple

from sb3_yann.deployment.describe import Arrays

PRECISIONS = ("double", "float")
ROOM = {"double": 1e-12, "float": 1e-5}
"""How far exported code may be off, in parts of an input's range."""


class Rounding(NamedTuple):
    """Tolerances of a search, in half-widths of the box of theta.

    Attributes
    ----------
    tolerance, tie : float
        So far outside a point counts as inside; slacks that differ by less, relative to 1 + their
        size, tie.
    surely_inside, clear, back : float
        As in the law's own compiled search.
    """

    tolerance: float
    tie: float
    surely_inside: float
    clear: float
    back: float


def rounding_of(data: Arrays, precision: str) -> Rounding:
    """Return the law's tolerances, or coarser ones in float, which knows a slack to some 1e-6."""
    if precision == "float":
        return Rounding(1e-5, 2e-6, 1e-5, 1e-4, 1e-5)
    tolerance, tie = map(float, data["tolerances"])
    return Rounding(tolerance, tie, 1e-9, 1e-6, 1e-9)
