"""Tables and numbers in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def table(header: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1) -> str:
    """Return a table in Markdown, with the first columns to the left and the others to the right.

    Parameters
    ----------
    header : sequence of str
        The cells of the first row.
    rows : iterable of sequence of str
        The cells of the others.
    texts : int
        How many columns go to the left.
    """
    lines = [header, [*["---"] * texts, *["---:"] * (len(header) - texts)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number(value: float | None, digits: int = 2, sign: str = "") -> str:
    """Return a number for a cell: a dash for None, a power of ten where it is large."""
    if value is None:
        return "—"
    if not np.isfinite(value) or abs(value) >= 1e5:
        return f"{value:{sign}.2e}"
    return f"{round(value, digits) + 0.0:{sign},.{digits}f}"


def spread(values: Sequence[float] | NDArray[np.float64], digits: int = 2, sign: str = "+") -> str:
    """Return the median and the range for a cell."""
    figures = np.median(values), np.min(values), np.max(values)
    middle, low, high = (number(float(each), digits, sign) for each in figures)
    return f"{middle} ({low} to {high})"


def quote(text: str, page: Path, first: str, last: str) -> bool:
    """Put the text between the marks of a page; return whether it has them."""
    old = page.read_text(encoding="utf-8") if page.exists() else ""
    before, begin, rest = old.partition(first)
    _, end, after = rest.partition(last)
    if not (begin and end):
        return False
    page.write_text(f"{before}{first}\n{text}\n\n{last}{after}", encoding="utf-8")
    return True
