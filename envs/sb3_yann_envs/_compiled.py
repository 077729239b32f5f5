"""Compiled functions of the envs, which do without `sb3_yann` and so without its `_numba`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(signature: str) -> Callable[[F], F]:
    """Return a decorator that compiles a function for given types, and keeps the machine code.

    What it calls must be in the same file: numba looks at no other to tell whether the machine code
    is up to date. It returns numbers only: to return an array, numba runs Python code, in which a
    Ctrl-C becomes a SystemError.
    """

    def compile_it(function: F) -> F:
        try:
            result: Any = numba.njit(signature, cache=True, error_model="numpy")(function)
        except Exception:  # no folder to write to, a full disk, a damaged file
            result = numba.njit(signature, error_model="numpy")(function)
        return cast(F, result)

    return compile_it
