"""Laws as files of plain arrays."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike, fspath
from typing import Any, TypeVar

from sb3_yann._archive import read_arrays

Law = TypeVar("Law")


def read_law(kind: str, path: str | PathLike[str], build: Callable[[dict[str, Any]], Law]) -> Law:
    """Return what ``build`` makes of the arrays of an ``.npz`` file.

    Parameters
    ----------
    kind : str
        What the file should hold, for people.
    path : str or PathLike
        Where it lies.
    build : callable
        Takes the arrays by name.

    Raises
    ------
    OSError
        If there is no such file, or it cannot be read.
    ValueError
        If it holds nothing that can be built from, whatever is wrong with it.
    """
    try:
        return build(read_arrays(path))
    except OSError:
        raise
    except Exception as error:  # arrays of a stranger raise nearly all there is
        what = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        what = what or type(error).__name__
        raise ValueError(
            f"{fspath(path)} does not hold {kind} ({what}). Write it with law.save(path)."
        ) from None
