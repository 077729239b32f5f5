"""Laws as files of plain arrays."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Mapping
from os import PathLike, fspath
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

Law = TypeVar("Law")


def write_arrays(path: str | PathLike[str], arrays: Mapping[str, Any]) -> None:
    """Write an ``.npz`` file as a whole: a reader never sees half of it."""
    part = f"{fspath(path)}.{os.getpid()}.part"  # another process may be writing the same
    try:
        with open(part, "wb") as file:
            np.savez(file, **arrays)
        os.replace(part, path)
    finally:
        Path(part).unlink(missing_ok=True)


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
    with open(path, "rb") as file:
        try:
            return build(_arrays_of(file))
        except Exception as error:  # damaged files raise nearly all there is
            what = str(error) or type(error).__name__
            raise ValueError(
                f"{fspath(path)} does not hold {kind} ({what}). Write it with law.save(path)."
            ) from None


def _arrays_of(file: BinaryIO) -> dict[str, Any]:
    if not zipfile.is_zipfile(file):
        raise ValueError("it is no .npz file, or a part of one")
    file.seek(0)
    with np.load(file, allow_pickle=False) as data:
        return {name: data[name] for name in data.files}
