"""The decorator that compiles, and the check whether kept machine code is out of date."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from sb3_yann._progress import say

Integers = NDArray[np.int64]
F = TypeVar("F", bound=Callable[..., Any])
compiles_apart = False  # whether this process compiles for another


def compiled_sources(package: Path) -> list[Path]:
    """Return this file and all files of a package that hold compiled functions."""
    held = (each for each in sorted(package.rglob("*.py")) if b"\n@compiled(" in each.read_bytes())
    return [Path(__file__), *held]


# One stamp for all files: their functions call each other.
SOURCES = hashlib.sha256(
    b"".join(each.read_bytes() for each in compiled_sources(Path(__file__).parent))
).hexdigest()


def compiled(*signatures: str, fastmath: bool = False) -> Callable[[F], F]:
    """Return a decorator that compiles a function for the given types, and keeps the machine code.

    A function with signatures refuses other types. A function without any is part of its callers.
    ``fastmath`` lets sums be taken in any order, several terms at a time.

    What Python calls returns a plain number or nothing, and writes arrays to those it is given. To
    return an array, numba runs Python code behind Python's back: a Ctrl-C there is a SystemError.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    options["fastmath"] = {"reassoc", "contract", "nsz"} if fastmath else False

    def compile_it(function: F) -> Any:
        if not signatures or numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
            return numba.njit(**options)(function)
        try:
            return _compile(numba.njit(**options)(function), signatures, keep=True)
        except Exception:  # no folder to write to, a full disk, a damaged file
            return _compile(numba.njit(**options)(function), signatures, keep=False)

    return compile_it


def _compile(dispatcher: Any, signatures: Sequence[str], keep: bool) -> Any:
    if keep:
        dispatcher.enable_caching()
        # numba looks at the function's own file; what it calls may have changed in another.
        kept = dispatcher._cache._cache_file
        if not hasattr(kept, "_source_stamp"):  # another numba: rather slow than out of date
            raise AttributeError("numba keeps no stamp of the sources.")
        kept._source_stamp = SOURCES
        codegen = dispatcher.targetctx.codegen()
        keys = {dispatcher._cache._index_key(each, codegen) for each in signatures}
        if not keys <= set(kept._load_index()):
            _say(keep=True)
            if dispatcher.targetoptions["fastmath"] and not compiles_apart:
                _compile_apart(Path(dispatcher.py_func.__code__.co_filename).parent)
    for signature in signatures:
        dispatcher.compile(signature)
    dispatcher.disable_compile()
    if not keep:
        _say(keep)
    return dispatcher


@cache
def _compile_apart(folder: Path) -> None:
    """Let another process compile the files of a folder, so that this one loads them.

    What one process compiles shares functions, what it loads does not, and with ``fastmath`` two
    copies sum in different orders: a training would depend on who compiled.
    """
    if not Path(sys.executable or "").stem.lower().startswith(("python", "pypy")):
        return  # it belongs to another program, which this would begin
    package = Path(__file__).parent
    files = [each for each in compiled_sources(package)[1:] if each.parent == folder]
    parts = [each.relative_to(package.parent).with_suffix("").parts for each in files]
    code = f"import sys; sys.path[:] = {[*map(str, sys.path)]}; from sb3_yann import _numba; "
    code += f"_numba.compiles_apart = True; import {', '.join(map('.'.join, parts))}"
    with suppress(OSError):  # then this process compiles
        subprocess.run([sys.executable, "-c", code], stdin=subprocess.DEVNULL, capture_output=True)


@cache
def _say(keep: bool) -> None:
    """Say once what takes the time."""
    how_often = (
        "once after an installation" if keep else "at each start, for its folder takes no file"
    )
    words = f"sb3-yann compiles its inner loops ({how_often}): about a minute in all."
    say(words, sys.stderr)
