r"""Keeps solved laws on disk, so that a large problem is solved once on a machine.

The folder is that of the platform for caches (``~/.cache/sb3-yann``, ``~/Library/Caches/sb3-yann``
or ``%LOCALAPPDATA%\sb3-yann``), or the one that the environment variable ``SB3_YANN_CACHE`` names;
``SB3_YANN_CACHE=off`` (or ``0``) keeps nothing. Any file in it may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import warnings
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from zipfile import ZipFile

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control.explicit.parametric_qp import ParametricQP
from sb3_yann.control.law.piecewise_affine import PiecewiseAffine

VARIABLE = "SB3_YANN_CACHE"
# Raise it when the same problem would give another law, or the file another format.
FORMAT = 2


def cache_folder() -> Path | None:
    """Return the folder of solved laws, which need not exist, or None where it is turned off."""
    chosen = os.environ.get(VARIABLE, "").strip()
    if chosen.lower() in ("off", "0"):
        return None
    if chosen:
        folder = os.path.expanduser(chosen)
        return None if folder.startswith("~") else Path(folder)  # of a user who is not there
    home = os.path.expanduser("~")
    if home == "~":  # no home folder is known
        return None
    if sys.platform == "darwin":
        return Path(home, "Library", "Caches", "sb3-yann")
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path(home, "AppData", "Local"), "sb3-yann")
    return Path(os.environ.get("XDG_CACHE_HOME") or Path(home, ".cache"), "sb3-yann")


def cache_key(program: ParametricQP, u_min: Array, u_max: Array, outside: str, solver: str) -> str:
    """Return the same name for the same problem only: a hash of all that the law depends on."""
    content = hashlib.sha256(f"{FORMAT} {solver} {outside} {program.n_slacks}".encode())
    arrays = [getattr(program, field.name) for field in fields(program)]
    for array in (*arrays, u_min, u_max):
        if isinstance(array, np.ndarray):
            values = array.astype("<f8") + 0.0  # -0.0 is 0.0
            content.update(f"{values.shape}".encode() + values.tobytes())
    return content.hexdigest()


def load_law(key: str) -> PiecewiseAffine | None:
    """Return the law of this name, None where there is none; warn where it cannot be read."""
    path = _path(key)
    try:
        if path is None or not path.is_file():
            return None
        with ZipFile(path) as archive:  # first: of a damaged file numpy leaves a handle open
            damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"{damaged} in it is damaged")
        return PiecewiseAffine.load(path)
    except PermissionError:
        return None
    except Exception as error:  # whatever stands in a damaged file, the problem can be solved
        warn_of(key, str(error))
        return None


def warn_of(key: str, reason: str) -> None:
    """Warn that a file of the cache is not used."""
    warnings.warn(
        f"{_path(key)} is not used, and the problem is solved again: {reason}",
        RuntimeWarning,
        stacklevel=2,
    )


def store_law(key: str, law: PiecewiseAffine) -> None:
    """Write a law under this name. A folder that cannot be written to is none: nothing happens."""
    path = _path(key)
    if path is None:
        return
    part = ""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # A name of its own: others may be writing the same law at this moment.
        handle, part = tempfile.mkstemp(prefix=f"{key}.", suffix=".new", dir=path.parent)
        os.close(handle)
        law.save(part)
        os.replace(part, path)
    except (OSError, MemoryError):
        pass  # the law itself is there
    finally:
        with suppress(OSError):
            os.unlink(part)  # nothing, once it has been renamed


def _path(key: str) -> Path | None:
    folder = cache_folder()
    return None if folder is None else folder / f"{key}.npz"
