"""Checks of the arguments of a problem that are more than a shape."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import (
    Array,
    as_array,
    as_bounds,
    as_positive,
    as_symmetric,
    to_float,
)


def as_horizon(value: int) -> int:
    """Return the number of predicted steps, a whole number of at least 1."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"horizon = {value!r} must be a whole number of steps.")
    if value < 1:
        raise ValueError(f"horizon = {value} must be at least 1.")
    return int(value)


def as_outputs(name: str, value: ArrayLike | Sequence[int] | None, n_states: int) -> Array:
    """Return an output matrix (q, n) from a matrix or from a list of indices of states.

    Raises
    ------
    TypeError, ValueError
        If it is neither.
    """
    if value is None:
        return as_array(name, np.zeros((0, n_states)), (0, n_states))
    entries = to_float(name, value)
    if entries.ndim == 0:
        raise ValueError(f"{name} = {value!r} must be a list of indices of states: [{value}].")
    if entries.ndim != 1:
        return as_array(name, value, ("q", n_states))
    whole = all(isinstance(i, (int, np.integer)) and not isinstance(i, bool) for i in value)  # type: ignore[union-attr]
    if not whole or np.any(entries < 0) or np.any(entries >= n_states):
        raise ValueError(
            f"{name} = {value!r} must be indices of states, whole numbers from 0 to "
            f"{n_states - 1}, or an output matrix as a list of rows, [[...], [...]]."
        )
    return as_array(name, np.eye(n_states)[entries.astype(int)], ("q", n_states))


def require_bounded_thing(
    name: str, lower: ArrayLike | None, upper: ArrayLike | None, size: int
) -> None:
    """Raise where bounds are given of something that the problem does not have."""
    given = any(bound is not None and np.size(bound) for bound in (lower, upper))
    if size == 0 and given:
        owner = {"r": "tracked", "d": "E of the model", "y": "outputs"}[name]
        raise ValueError(f"{name}_min or {name}_max is given, but there is no {owner}.")


def as_rate_weight(value: ArrayLike | None, n_inputs: int) -> Array:
    """Return the weight S (m, m) of the input's rate, zeros for None."""
    return as_symmetric("S", np.zeros((n_inputs, n_inputs)) if value is None else value, n_inputs)


def as_linear_cost(
    value: tuple[ArrayLike, ArrayLike] | None, n_states: int, n_inputs: int
) -> tuple[Array, Array]:
    """Return the linear stage cost as (q, r) of shapes (n,) and (m,), zeros for None."""
    if value is None:
        value = (np.zeros(n_states), np.zeros(n_inputs))
    try:
        q, r = value
    except (TypeError, ValueError):
        raise TypeError(
            f"linear_cost = {value!r} must be a pair (q, r) of arrays for q'x + r'u."
        ) from None
    return as_array("linear_cost q", q, (n_states,)), as_array("linear_cost r", r, (n_inputs,))


def as_softness(name: str, value: ArrayLike | None, lower: Array, upper: Array) -> Array:
    """Return the unit of violation (size,) of soft bounds, 0 where they are hard.

    A single number is for the entries that have a bound.

    Raises
    ------
    ValueError
        If one is negative, or for something without a bound.
    """
    array, size = to_float(name, 0.0 if value is None else value), len(lower)
    bounded = np.isfinite(lower) | np.isfinite(upper)
    if array.ndim == 0:
        array = np.where(bounded, array, 0.0) if np.any(bounded) else np.full(size, float(array))
    array = as_array(name, array, (size,))
    if np.any(array < 0):
        raise ValueError(
            f"{name} = {array.tolist()} holds the violations that count as one unit, 0 where the "
            "bound is hard: no entry may be negative."
        )
    if value is not None and np.any(to_float(name, value) > 0) and not np.any(array[bounded] > 0):
        what = name[0]
        raise ValueError(
            f"{name} = {value!r}, but there is no bound to soften: pass {what}_min or {what}_max."
        )
    if np.any(array[~bounded] > 0):
        i = int(np.argmax((array > 0) & ~bounded))
        raise ValueError(f"{name} = {value!r} softens entry {i}, which has no bound: make it 0.")
    return array


def as_soft_penalty(value: float | None, *softness: Array) -> float:
    """Return the cost of one unit of violation; 0 where nothing is soft.

    Raises
    ------
    ValueError
        If something is soft and there is no cost, or the other way round.
    """
    soft = any(np.any(unit) for unit in softness)
    if not soft:
        if value:
            raise ValueError(
                f"soft_penalty = {value!r}, but nothing is soft: pass x_soft or y_soft as well."
            )
        return 0.0
    if value is None:
        raise ValueError(
            "soft_penalty is missing: x_soft and y_soft ask for the cost of one unit of "
            "violation. Above the largest sum of multipliers of the hard problem, the soft one "
            "breaks no bound without need; try 1e3 times the stage cost at the bound."
        )
    return as_positive("soft_penalty", value)


def as_box(
    name: str,
    values: tuple[ArrayLike | None, ArrayLike | None],
    default: tuple[Array, Array],
    size: int,
) -> tuple[Array, Array]:
    """Return bounds of the first entries of theta, from those of a part or of all of theta.

    Parameters
    ----------
    name : str
    values : pair of array_like or None
        Lower and upper bound, each a number, (k,) for the part or (size,) for all of theta, as a
        problem stores it; of the latter the first k are taken.
    default : pair of ndarray, shape (k,)
    size : int
    """
    k = len(default[0])
    parts: list[ArrayLike] = []
    for value, fallback in zip(values, default, strict=True):
        part = fallback if value is None else to_float(name, value)
        parts.append(part[:k] if part.shape == (size,) else part)
    return as_bounds(name, parts[0], parts[1], k)


def as_half_spaces(
    value: tuple[ArrayLike, ArrayLike] | None, n_states: int, n_theta: int
) -> tuple[Array, Array]:
    """Return a terminal set as (F, g) of shapes (c, n_theta) and (c,), from one of x or theta."""
    if value is None:
        return np.zeros((0, n_theta)), np.zeros(0)
    try:
        F, g = value if not isinstance(value, str) else ()
    except (TypeError, ValueError):
        got = repr(value) if isinstance(value, str) else type(value).__name__
        raise TypeError(
            "terminal_set must be a pair (F, g) of arrays for F x_N <= g, or 'invariant', "
            f"got {got}."
        ) from None
    rows = to_float("terminal_set F", F)
    if rows.shape[1:] != (n_theta,):
        rows = as_array("terminal_set F", rows, ("rows", n_states))
        rows = np.pad(rows, ((0, 0), (0, n_theta - n_states)))
    rows = as_array("terminal_set F", rows, ("rows", n_theta))
    return rows, as_array("terminal_set g", g, (rows.shape[0],))
