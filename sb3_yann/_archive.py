"""Files of plain arrays that are checked as they are read: this file needs numpy alone.

An archive is an ``.npz`` file as `numpy.savez` writes it, with one entry more: a digest of all
others. Nothing in it is executed. `numpy.load` reads it too, unchecked.
"""

from __future__ import annotations

import math
import os
import stat
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from io import BytesIO
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np

DIGEST = "digest"
STORED_KINDS = "biufU"  # of arrays: numbers, truth values and text
MAX_SIZE = 2**32
"""Bytes of a file. What is larger is refused: a reader holds all of it in memory."""


def digest_of(arrays: Mapping[str, Any]) -> str:
    """Return 64 characters that tell these arrays from others: names, shapes, types and numbers.

    It shows accidents. Who can write a file can write its digest too.
    """
    found = sha256()
    for name in sorted(arrays):
        each = np.asarray(arrays[name])
        found.update(f"{name} {each.shape} {each.dtype.str}\n".encode())
        found.update(each.tobytes())
    return found.hexdigest()


@contextmanager
def atomic_write(path: str | PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, which replaces ``path`` on leaving.

    After an exception ``path`` stays as it was, and nothing is left behind. The data are on the
    disk before the file is renamed, so a crash leaves the old file or the new one.
    """
    target = Path(path)
    if target.exists() and not target.is_file():
        raise OSError(f"{target} is a folder or a device, not a file that can be replaced.")
    part = target.with_name(f"{target.name}.{os.getpid()}.part")  # others may write the same
    try:
        yield part
        with part.open("r+b") as file:
            os.fsync(file.fileno())
        os.replace(part, target)
    finally:
        part.unlink(missing_ok=True)


def write_arrays(path: str | PathLike[str], arrays: Mapping[str, Any]) -> None:
    """Write arrays and their digest as a whole: a reader never sees half of a file.

    OSError if it cannot be written, and what was there before stays; ValueError if it would be
    larger than what is read, TypeError if an array is one of objects.
    """
    size = sum(np.asarray(each).nbytes for each in arrays.values())
    if size > 0.99 * MAX_SIZE:
        raise ValueError(
            f"{fspath(path)} would hold {size} bytes, more than {MAX_SIZE} are not read."
        )
    if wrong := [
        k for k, each in arrays.items() if np.asarray(each).dtype.kind not in STORED_KINDS
    ]:
        raise TypeError(f"{fspath(path)}: {wrong} hold no numbers, truth values or text.")
    with atomic_write(path) as part, part.open("wb") as file:
        np.savez(file, **{**arrays, DIGEST: digest_of(arrays)})


def read_arrays(path: str | PathLike[str]) -> dict[str, Any]:
    """Return the arrays of a file by name, after a check that they are those that were written.

    It takes a few times the memory that the file takes on the disk, whatever is in it. OSError if
    it cannot be read, ValueError if anything else is wrong with it.
    """
    found = os.stat(path)
    if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):
        raise ValueError("it is no file but a device or a pipe")
    if found.st_size > MAX_SIZE:
        raise ValueError(f"it has {found.st_size} bytes, more than {MAX_SIZE} are not read")
    with open(path, "rb") as file:
        content = file.read(found.st_size)
    if not zipfile.is_zipfile(BytesIO(content)):
        raise ValueError("it is no .npz file, or a part of one")
    try:
        arrays = _entries(content)
    except ValueError:
        raise
    except Exception as error:  # damaged archives raise nearly all there is
        raise ValueError(str(error) or type(error).__name__) from None
    if DIGEST not in arrays:
        raise ValueError("it has no digest: it was not written by this version")
    if str(arrays.pop(DIGEST)) != digest_of(arrays):
        raise ValueError("it has changed since it was written: its digest is another one")
    return arrays


def _entries(content: bytes) -> dict[str, Any]:
    """Return all arrays of an archive, none of them larger than the archive."""
    with zipfile.ZipFile(BytesIO(content)) as archive:
        members = archive.infolist()
        stored = all(
            each.compress_type == zipfile.ZIP_STORED and each.file_size == each.compress_size
            for each in members
        )
        if not stored or sum(each.file_size for each in members) > len(content):
            raise ValueError("its entries are compressed or overlap")
        names = [each.filename.removesuffix(".npy") for each in members]
        if len({*names}) < len(names):
            raise ValueError("two of its entries have the same name")
        return {
            name: _array(name, archive.read(each))
            for name, each in zip(names, members, strict=True)
        }


def _array(name: str, content: bytes) -> Any:
    """Return the array of an entry; its header must fit what follows."""
    file = BytesIO(content)
    formats: Any = np.lib.format
    formats.read_magic(file)
    shape, by_columns, kind = formats.read_array_header_1_0(file)
    if kind.kind not in STORED_KINDS:
        raise ValueError(f"{name} is no array of numbers, truth values or text")
    if len(content) - file.tell() != math.prod(shape) * kind.itemsize or not kind.itemsize:
        raise ValueError(f"{name} is not as large as its header says")
    array = np.frombuffer(content, kind, math.prod(shape), file.tell()).copy()
    return array.reshape(shape, order="F" if by_columns else "C")
