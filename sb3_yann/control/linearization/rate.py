"""Equations ``dx/dt = f(x, u)`` as a function of vectors, however they write their columns."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, to_float

CALLING = (IndexError, TypeError, ValueError)
"""What a function of columns (n, 1) raises where it gets vectors (n,)."""


class Rate:
    """``dx/dt`` (n,) at a point ``[x, u, d]``; f takes and returns vectors or columns.

    Parameters
    ----------
    f : callable
        Takes x, u and perhaps d; returns dx/dt of shape (n,), (n, 1) or (1, n), or a list.
    sizes : sequence of int
        The sizes of what f takes; n is the first.

    Examples
    --------
    >>> rate = Rate(lambda x, u: [[x[1, 0]], [u[0, 0]]], (2, 1))
    >>> rate.choose(np.ones(3))  # it takes columns
    >>> rate(np.array([1.0, 2.0, 3.0]))
    array([2., 3.])
    """

    def __init__(self, f: Callable[..., ArrayLike], sizes: Sequence[int]) -> None:
        self.f, self.sizes, self.columns = f, tuple(sizes), False

    def __call__(self, point: Array) -> Array:
        """Return dx/dt (n,) at ``[x, u, d]``."""
        parts = np.split(point, np.cumsum(self.sizes[:-1]))
        if self.columns:
            parts = [part[:, None] for part in parts]
        return _vector(self.f(*parts), self.sizes[0])

    def choose(self, point: Array) -> None:
        """Find out at a point whether f takes vectors (n,) or columns (n, 1).

        Raises
        ------
        ValueError
            If f returns no n numbers for either; or what f itself raises for vectors.
        """
        self.columns = False
        try:
            self(point)
        except CALLING as error:
            self.columns = True
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of a trial that may be no use
                    self(point)
            except CALLING:
                self.columns = False
                raise error from None


def _vector(value: Any, size: int) -> Array:
    """Return what f returned as a vector (n,)."""
    try:
        array = to_float("f(x, u)", value)
    except TypeError:
        if not isinstance(value, (list, tuple)):
            raise
        # A list of numbers and of arrays with one entry.
        array = np.concatenate([np.ravel(to_float("f(x, u)", each)) for each in value])
    if array.shape not in ((size,), (size, 1), (1, size)):
        raise ValueError(
            f"f returned the shape {array.shape}, expected ({size},) or ({size}, 1): dx/dt of each "
            "state."
        )
    return array.reshape(size)
