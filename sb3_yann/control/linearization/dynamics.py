"""Linear models from equations, with the steady state solved for where it is not given."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann._validation import Array, check_array, check_positive, check_positive_vector, to_float
from sb3_yann.control.linear_system import LinearSystem, names, zero_order_hold
from sb3_yann.control.linearization.differences import (
    curvature,
    differences,
    idle_inputs,
    partly_known,
)
from sb3_yann.control.lqr import unreached


class Rate:
    """``dx/dt`` (n,) at a point ``[x, u, d]``, of an f of vectors of these sizes; n is the first.

    f returns dx/dt of shape (n,), (n, 1) or (1, n), or a list.
    """

    def __init__(self, f: Callable[..., ArrayLike], sizes: Sequence[int]) -> None:
        self.f = f
        self.sizes = tuple(sizes)

    def __call__(self, point: Array) -> Array:
        """Return dx/dt (n,) at ``[x, u, d]``."""
        parts = np.split(point, np.cumsum(self.sizes[:-1]))
        return _vector(self.f(*parts), self.sizes[0])


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


LONGEST = 0.01  # longest step of a difference, relative to the scale of its coordinate
STEADY = 1e-3  # largest motion of a steady state in one sample, relative to its scale
MOVES = 0.01  # the same relative to its own size: beyond it, a state smaller than 1 gets a warning
SOLVED = 1e-8  # largest motion in one sample of a steady state that was solved for
STARTS = (0.0, 1.0, -1.0, 0.1, 10.0)
"""Scales of the free entries from which the steady state is sought, in turn."""
ANOTHER = 1e-3  # distance, in scales, from which two steady states are different ones


def linearize_dynamics(
    f: Callable[..., ArrayLike],
    x_ss: ArrayLike,
    u_ss: ArrayLike,
    dt: float,
    d_ss: ArrayLike | None,
    scale: ArrayLike | None = None,
) -> LinearSystem:
    """Return the sampled linearization of `LinearModel.from_dynamics`, which documents the rest."""
    x, u = partly_known("x_ss", x_ss), partly_known("u_ss", u_ss)
    d = check_array("d_ss", [] if d_ss is None else d_ss, ("d",))
    dt = check_positive("dt", dt)
    labels = ["x", "u"] if d_ss is None else ["x", "u", "d"]
    if not callable(f):
        raise TypeError(f"f = {f!r} must be a function ({', '.join(labels)}) -> dx/dt.")
    sizes, given = (x.size, u.size, d.size), np.concatenate([x, u, d])
    rate = Rate(f, sizes[: len(labels)])
    size = _scale(given, x.size, scale)
    free = np.isnan(given)
    point, notes = _solve(rate, given, size, dt) if np.any(free) else (given, [])
    size = _scale(point, x.size, scale)
    check_array(f"f({', '.join(f'{name}_ss' for name in labels)})", rate(point), (x.size,))
    _require_steady(rate, point, size, dt, scale is not None)
    rounding = np.finfo(float).eps * np.maximum(np.abs(point), size)[: x.size] / dt
    found = differences(rate, point, LONGEST * size, rounding, names(sizes))
    A, B, E = _parts(found.value, sizes)
    A, B, E = zero_order_hold(A, B, E, dt)
    x, u, d = np.split(point, np.cumsum(sizes[:2]))
    notes += [*idle_inputs(B, 4), *curvature(found, names(sizes))]
    return LinearSystem(A, B, dt, x, u, E, d, tuple(notes))


def _solve(rate: Rate, given: Array, scale: Array, dt: float) -> tuple[Array, list[str]]:
    """Return the steady state with the free entries solved for, and notes on how sure it is."""
    free, n = np.isnan(given), rate.sizes[0]
    found: list[Array] = []
    best, least = given, np.inf
    for start in STARTS:
        point, moved = _solved_from(rate, np.where(free, start * scale, given), free, scale, dt)
        if moved < least:
            best, least = point, moved
        apart = [np.max(np.abs(point - other) / scale) > ANOTHER for other in found]
        if moved <= SOLVED and all(apart):
            found.append(point)
    if not found:
        raise ValueError(
            f"No steady state was found. The best is x_ss = {best[:n].tolist()}, the rest "
            f"{best[n:].tolist()}, which moves in one sample by {least:.2g} scales. Leave more "
            "entries free (NaN), give one that you know, or pass scale=..., how far each moves."
        )
    # A bioreactor that is washed out is at rest too, and no input brings it back.
    found.sort(key=lambda each: _is_lost(rate, each, _scale(each, n, scale[:n]), dt))
    notes = [f"Of the steady state {np.count_nonzero(free)} entries were solved for."]
    if np.count_nonzero(free) > n:
        notes[0] += f" The equations determine {n}: it is one of many. Give more entries."
    elif len(found) > 1:
        others = "; ".join(str([float(f"{v:.4g}") for v in other]) for other in found[1:])
        notes[0] += f" There are others, {others}: give an entry that tells them apart."
    return found[0], notes


def _parts(slopes: Array, sizes: Sequence[int]) -> list[Array]:
    """Return the derivatives by x, u and d."""
    return np.split(slopes, np.cumsum(sizes[:2]), axis=1)


def _is_lost(rate: Rate, point: Array, size: Array, dt: float) -> bool:
    """Tell whether a mode that does not decay is out of reach of the inputs at a steady state."""
    steps = np.diag(1e-4 * size)
    try:
        slopes = np.array([(rate(point + h) - rate(point - h)) / (2 * h.max()) for h in steps]).T
        A, B, E = _parts(slopes, rate.sizes)
        A, B, _ = zero_order_hold(A, B, E, dt)
        return unreached(A, B) is not None
    except (ArithmeticError, ValueError):  # no value next to it
        return True


def _solved_from(
    rate: Rate, start: Array, free: NDArray[np.bool_], scale: Array, dt: float
) -> tuple[Array, float]:
    """Return the point near a start that moves least, and its motion in scales; inf for none."""
    from scipy.optimize import least_squares

    n = rate.sizes[0]

    def at(z: Array) -> Array:
        point = start.copy()
        point[free] = z * scale[free]
        return point

    def moved(z: Array) -> Array:
        with np.errstate(all="ignore"):
            step = dt * rate(at(z)) / scale[:n]
        # Where f has no value, the search turns back.
        return np.asarray(np.nan_to_num(step, nan=1e3, posinf=1e3, neginf=-1e3))

    try:
        result = least_squares(moved, start[free] / scale[free], xtol=1e-14, ftol=1e-15, gtol=1e-15)
    except (ArithmeticError, ValueError):  # math functions raise where numpy's return NaN
        return start, np.inf
    return at(result.x), float(np.max(np.abs(result.fun)))


def _require_steady(rate: Rate, point: Array, size: Array, dt: float, scaled: bool) -> None:
    """Raise if the operating point moves too far in one sample; warn if that is not certain."""
    parts = np.split(point, np.cumsum(rate.sizes[:-1]))
    x, moved = parts[0], dt * np.abs(rate(point))
    if np.any(moved > STEADY * size[: x.size]):
        at = ", ".join(f"{k}_ss = {part.tolist()}" for k, part in zip("xud", parts, strict=False))
        raise ValueError(
            f"{at} is no steady state: in one sample of {dt:g} the state moves by "
            f"{moved.tolist()}, with a scale of {size[: x.size].tolist()}. Set entries to NaN to "
            "have them solved for."
        )
    if not scaled and np.any((moved > MOVES * np.abs(x)) & (x != 0) & (moved > 1e-8)):
        warnings.warn(
            f"In one sample of {dt:g} the steady state x_ss = {x.tolist()} moves by "
            f"{moved.tolist()}, much beside itself. Pass scale=..., how far each state moves.",
            stacklevel=4,
        )


def _scale(point: Array, n: int, scale: ArrayLike | None) -> Array:
    """Return the scale of each state, input and disturbance, completed by their sizes."""
    size: Array = np.maximum(np.nan_to_num(np.abs(point), nan=1.0), 1.0)
    if scale is None:
        return size
    given = to_float("scale", scale)
    k = point.size if given.shape == point.shape else n
    size[:k] = check_positive_vector("scale", given, k)
    return size
