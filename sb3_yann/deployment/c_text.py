"""Numbers, tables and comments as C has them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def literal(value: float, precision: str) -> str:
    """Return a number as C has it, exact in its precision."""
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return f"{shortest(value, precision)}{'f' if precision == 'float' else ''}"


def shortest(value: float, precision: str) -> str:
    """Return the shortest decimal number that is exact in the precision, with a point."""
    text = str(np.float32(value)) if precision == "float" else repr(float(value))
    head, exponent, tail = text.partition("e")
    return f"{head if '.' in head else f'{head}.0'}{exponent}{tail}"


def table(kind: str, name: str, values: NDArray[np.generic], precision: str) -> str:
    """Return the declaration of a constant array.

    Parameters
    ----------
    kind, name : str
        Its type and its name.
    values : ndarray
        Of any shape but an empty one.
    precision : {"double", "float"}
        Of its numbers.
    """
    sizes = "".join(f"[{each}]" for each in values.shape)
    return f"static const {kind} {name}{sizes} = {_nested(values, precision, 0)};"


def _nested(values: NDArray[np.generic], precision: str, depth: int) -> str:
    indent = "    " * (depth + 1)
    if values.ndim > 1:
        rows = f",\n{indent}".join(_nested(each, precision, depth + 1) for each in values)
        return f"{{\n{indent}{rows},\n{'    ' * depth}}}"
    whole = values.dtype.kind in "ib"
    texts = [str(int(each)) if whole else literal(float(each), precision) for each in values]
    lines, line = [], ""
    for text in texts:
        if line and len(line) + len(text) > 90 - len(indent):
            lines.append(line)
            line = ""
        line += f"{', ' if line else ''}{text}"
    body = f",\n{indent}".join([*lines, line])
    return f"{{{body}}}" if not lines else f"{{\n{indent}{body},\n{'    ' * depth}}}"


def comment(lines: list[str]) -> str:
    """Return lines of a comment in ASCII, which nothing in them can end."""
    plain = "\n".join(lines).encode("ascii", "backslashreplace").decode()
    safe = plain.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?").replace("??", "? ?")
    return "\n".join(f" * {line}".rstrip().rstrip("\\") for line in safe.splitlines())
