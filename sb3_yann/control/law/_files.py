"""Laws as files of plain arrays."""

from __future__ import annotations

import os
from collections.abc import Mapping
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np


def write_arrays(path: str | PathLike[str], arrays: Mapping[str, Any]) -> None:
    """Write an ``.npz`` file as a whole: a reader never sees half of it."""
    part = f"{fspath(path)}.{os.getpid()}.part"  # another process may be writing the same
    try:
        with open(part, "wb") as file:
            np.savez(file, **arrays)
        os.replace(part, path)
    finally:
        Path(part).unlink(missing_ok=True)


def read_arrays(path: str | PathLike[str]) -> dict[str, Any]:
    """Return what an ``.npz`` file holds; raise ValueError where it is none."""
    data = np.load(path, allow_pickle=False)
    if isinstance(data, np.ndarray):
        raise ValueError("it is a single array")
    with data:
        return {name: data[name] for name in data.files}
