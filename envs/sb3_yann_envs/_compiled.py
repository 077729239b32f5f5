"""Compiled functions for what is stepped millions of times."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Return the function compiled at its first call, with the machine code kept on disk.

    What it calls must be in the same file: numba does not look at others when it decides whether
    the machine code is still that of the source.
    """
    try:
        result: Any = numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # there is no folder to write to
        result = numba.njit(error_model="numpy")(function)
    return cast(F, result)
