"""Laws are computed in float64, networks in float32, whatever PyTorch's default type is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch as th


@contextmanager
def single_precision() -> Iterator[None]:
    """Make networks of float32 within, as SB3's replay buffer holds actions and rewards."""
    default = th.get_default_dtype()
    th.set_default_dtype(th.float32)
    try:
        yield
    finally:
        th.set_default_dtype(default)


class KeepsPrecision:
    """A module that moves to other devices, and refuses other types of numbers."""

    def _apply(self, fn: Callable[[th.Tensor], th.Tensor], recurse: bool = True) -> Any:
        for dtype in (th.float32, th.float64):
            if (asked := fn(th.zeros(1, dtype=dtype)).dtype) != dtype:
                raise TypeError(
                    f"{type(self).__name__} cannot become {asked}: the law is computed in float64 "
                    "and the networks in float32, to which the compiled loops and SB3's replay "
                    "buffer keep. Leave double(), float(), half() and to(dtype) out; to(device) "
                    "is fine."
                )
        return super()._apply(fn, recurse)  # type: ignore[misc]
