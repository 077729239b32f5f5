"""Checks of user input that name the value, what was expected and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class NonFiniteWarning(RuntimeWarning):
    """An observation, a reward, an action or a gradient is not a finite number."""


def as_array(name: str, value: ArrayLike, shape: Sequence[int | str]) -> Array:
    """Return ``value`` as a read-only float64 array of ``shape``; a letter leaves a size free.

    Raises
    ------
    TypeError
        If ``value`` does not convert to real numbers.
    ValueError
        If the shape is another one or an entry is NaN or infinite.
    """
    array = to_float(name, value)
    if array.ndim != len(shape) or any(
        isinstance(want, int) and got != want for got, want in zip(array.shape, shape, strict=True)
    ):
        wanted = ", ".join(map(str, shape)) if len(shape) > 1 else f"{shape[0]},"
        hint = (
            " Write a matrix as a list of rows, [[...], [...]]."
            if array.ndim < len(shape) == 2
            else ""
        )
        raise ValueError(f"{name} has shape {array.shape}, expected ({wanted}).{hint}")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} holds NaN or infinite entries: {array.tolist()}.")
    return _frozen(array)


def as_symmetric(name: str, value: ArrayLike, size: int, *, definite: bool = False) -> Array:
    """Return ``value`` as a symmetric positive (semi-)definite ``(size, size)`` matrix.

    Raises
    ------
    ValueError
        If it is not symmetric, or an eigenvalue is negative (or zero where ``definite``).
    """
    matrix = as_array(name, value, (size, size))
    scale = max(float(np.max(np.abs(matrix))), np.finfo(float).tiny)
    if np.max(np.abs(matrix - matrix.T)) > 1e-9 * scale:
        raise ValueError(
            f"{name} is not symmetric: {matrix.tolist()}. Pass ({name} + {name}.T) / 2."
        )
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    if definite and smallest <= 0:
        raise ValueError(
            f"{name} must be positive definite, its smallest eigenvalue is {smallest:g}. "
            "Give every input a positive weight."
        )
    if smallest < -1e-9 * scale:
        raise ValueError(
            f"{name} must be positive semi-definite, its smallest eigenvalue is {smallest:g}."
        )
    return _frozen((matrix + matrix.T) / 2)


def as_bounds(
    name: str, lower: ArrayLike | None, upper: ArrayLike | None, size: int
) -> tuple[Array, Array]:
    """Return lower and upper bounds of shape ``(size,)``; a scalar is for all entries.

    ``None`` is no bound.

    Raises
    ------
    ValueError
        If the shape is another one, an entry is NaN, or a lower bound is not below its upper bound.
    """
    low = _bound(f"{name}_min", lower, size, -np.inf)
    high = _bound(f"{name}_max", upper, size, np.inf)
    if np.any(low >= high):
        i = int(np.argmax(low >= high))
        raise ValueError(
            f"{name}_min must lie below {name}_max, but entry {i} has "
            f"{name}_min = {low[i]:g} and {name}_max = {high[i]:g}."
        )
    return low, high


def as_positive(name: str, value: float) -> float:
    """Return ``value`` as a finite float above zero."""
    number = _number(name, value)
    if not (np.isfinite(number) and number > 0):
        raise ValueError(f"{name} = {value!r} must be a finite number above 0.")
    return number


def as_discount(value: float) -> float:
    """Return ``value`` as a discount factor in (0, 1]."""
    number = _number("gamma", value)
    if not 0 < number <= 1:
        raise ValueError(f"gamma = {value!r} must lie in (0, 1].")
    return number


def to_float(name: str, value: Any) -> Array:
    """Return ``value`` as a new float64 array of any shape.

    Raises
    ------
    TypeError
        If it does not convert to real numbers.
    """
    try:
        if np.iscomplexobj(value):
            raise TypeError("it is complex")
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"{name} = {_short(value)} is not an array of real numbers ({error})."
        ) from None


def _short(value: Any) -> str:
    """Return the representation of a value, without the middle of a long one."""
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:120]} ... {text[-40:]}"


class ReadOnlyArrays:
    """Keeps the arrays of a frozen dataclass read-only in its copies and after unpickling."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        for value in state.values():
            for array in value if isinstance(value, tuple) else (value,):
                if isinstance(array, np.ndarray):
                    array.setflags(write=False)
        self.__dict__.update(state)


def same_fields(one: Any, other: Any, names: Sequence[str]) -> bool:
    """Tell whether the named attributes of two objects are equal, arrays entry by entry."""
    return all(_same(getattr(one, name), getattr(other, name)) for name in names)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, tuple):
        return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))
    return bool(np.array_equal(one, other))


def _bound(name: str, value: ArrayLike | None, size: int, missing: float) -> Array:
    if value is None:
        return _frozen(np.full(size, missing))
    array = to_float(name, value)
    if array.ndim == 0:
        array = np.full(size, float(array))
    if array.shape != (size,):
        raise ValueError(f"{name} has shape {array.shape}, expected ({size},) or a single number.")
    if np.any(np.isnan(array)):
        raise ValueError(f"{name} holds NaN: {array.tolist()}. Use inf for 'no bound'.")
    return _frozen(array)


def _number(name: str, value: float) -> float:
    array = to_float(name, value)
    if array.size != 1:
        raise ValueError(f"{name} = {value!r} must be a single number.")
    return float(array.reshape(()))


def _frozen(array: Array) -> Array:
    array[array == 0] = 0.0  # -0.0 equals 0.0 but has other bytes; equal objects share a hash
    array.setflags(write=False)
    return array
