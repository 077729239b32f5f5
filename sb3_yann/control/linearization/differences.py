"""Jacobians by extrapolated central differences, with what they showed."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, to_float

LEVELS = 6
RATIO = 4.0
"""Number of steps that approach a point, and how much shorter each is than the one before."""
NOISE_FLOOR = 100.0
"""Effects below so many times the noise are none. Hundreds of operations of an integrator round
ten times as much as one does, and a plant that forgets a state within a sample shows only that."""


@dataclass(frozen=True, eq=False)
class Jacobian:
    """A Jacobian (r, c), and what its differences showed.

    It is exactly zero where not above its own error; ``dropped`` is the largest entry set to zero.
    ``change`` (c,) are errors of the longest ``steps`` (c,), relative to the column, NaN without a
    value. ``doubt`` is the largest error left: how far two step sizes agree.
    """

    value: Array
    dropped: float
    steps: Array
    change: Array
    doubt: float


class NotSmoothError(ValueError):
    """The function has a kink, a jump or no value next to the point, in coordinate `column`."""

    def __init__(self, column: int, reason: str, no_value: bool = False) -> None:
        super().__init__(reason)
        self.column = column
        self.no_value = no_value


def jacobian(
    f: Callable[[Array], Array],
    point: Array,
    steps: Array,
    noise: Array,
    actual: Callable[[Array], Array] = lambda z: z,
) -> Jacobian:
    """Return the derivatives of f, from points (c,) to values (r,), by Richardson extrapolation.

    Each entry takes the extrapolation that agrees best with its neighbor over shorter steps:
    Ridders (1982), *Advances in Engineering Software* 4, 75-76. ``steps`` (c,) are the longest,
    ``noise`` (r,) is the error of each value, and ``actual`` the point at which f is evaluated for
    a given one, e.g. its float32 rounding. f is NaN where it has no value. NotSmoothError where it
    has a kink or a jump at the point, or no value next to it.
    """
    begin = actual(point)
    center = f(begin)
    columns = [_column(f, center, begin, i, steps[i], noise, actual) for i in range(point.size)]
    value, error, change = (np.array(part) for part in zip(*columns, strict=True))
    lost = np.abs(value) <= error
    dropped = float(np.max(np.abs(value[lost]), initial=0.0))
    largest = np.max(np.abs(value), axis=1)
    doubt = np.max(np.max(error, axis=1) / np.where(largest > 0, largest, np.inf), initial=0.0)
    return Jacobian(np.where(lost, 0.0, value).T, dropped, steps, change, float(doubt))


def _column(
    f: Callable[[Array], Array],
    center: Array,
    point: Array,
    i: int,
    longest: float,
    noise: Array,
    actual: Callable[[Array], Array],
) -> tuple[Array, Array, float]:
    """Return the derivatives with respect to coordinate i, their errors, and the change."""
    ahead = []
    behind = []
    spans = []
    for level in range(LEVELS):
        offset = np.zeros(point.size)
        offset[i] = longest / RATIO**level
        above = actual(point + offset)
        below = actual(point - offset)
        if above[i] <= point[i] or below[i] >= point[i]:
            break  # the step is lost in the rounding of the point
        ahead.append((f(above) - center) / (above[i] - point[i]))
        behind.append((center - f(below)) / (point[i] - below[i]))
        spans.append(above[i] - below[i])
    one = np.array(ahead)
    other = np.array(behind)
    span = np.array(spans)[:, None]
    valid = np.all(np.isfinite(one) & np.isfinite(other), axis=1) if spans else np.zeros(0, bool)
    if np.count_nonzero(valid) < 3:
        raise NotSmoothError(i, "it has no finite value on one of its sides", True)
    far = bool(valid[0])
    one = one[valid]
    other = other[valid]
    span = span[valid]
    slope = (one + other) / 2
    # Unequal sides (a point that is rounded) would leave a first-order error in the mean.
    value, error = _extrapolated(slope, RATIO**2, 2 * noise / span)
    kink, doubt = _extrapolated(one - other, RATIO, 4 * noise / span)
    steepest = np.max(np.abs(value) + np.abs(kink) / 2)
    floor = np.max(2 * noise / span[0])
    if np.any((np.abs(kink) > 5 * doubt) & (np.abs(kink) > 0.01 * steepest)):
        raise NotSmoothError(i, "its slopes to the two sides differ (a kink)")
    if np.max(error) > max(0.2 * np.max(np.abs(value)), NOISE_FLOOR * floor):
        raise NotSmoothError(i, "its slope has no limit for short steps (a jump or noise)")
    scale = np.max(np.abs(value))
    change = np.max(np.abs(slope[0] - value)) / scale if scale > 0 else 0.0
    return value, error, float(change) if far else np.nan


def _extrapolated(levels: Array, power: float, rounding: Array) -> tuple[Array, Array]:
    """Return the limits of the levels (k, r), whose errors fall by `power`, and their errors."""
    limits = (power * levels[1:] - levels[:-1]) / (power - 1)
    errors = np.abs(np.diff(limits, axis=0)) + 2 * rounding[1:-1]
    best = np.argmin(errors, axis=0)
    rows = np.arange(levels.shape[1])
    return limits[best, rows], errors[best, rows]


SHORTER = 64.0  # factor by which steps shrink where a function has no value next to the point


def differences(
    f: Callable[[Array], Array],
    point: Array,
    steps: Array,
    rounding: Array,
    labels: list[str],
    actual: Callable[[Array], Array] = lambda z: z,
) -> Jacobian:
    """Return the `jacobian` with shorter steps where f has no value; name a coordinate without."""
    shortest = steps / SHORTER**2
    steps = steps.copy()
    while True:
        try:
            return jacobian(f, point, steps, rounding, actual)
        except NotSmoothError as error:
            i = error.column
            reason = str(error)
            if not error.no_value or steps[i] <= shortest[i]:
                break
            steps[i] /= SHORTER
    raise ValueError(
        f"The plant cannot be linearized at {point.tolist()}: along {labels[i]}, {reason}, with "
        f"steps up to {steps[i]:.3g}. Clipping, dry friction, angles that wrap and too long steps "
        "do this: pass scale=..., move the operating point, or use LinearModel.from_data."
    )


def partly_known(name: str, value: ArrayLike) -> Array:
    """Return a vector in which NaN stands for what is to be solved for."""
    array = to_float(name, value)
    if array.ndim != 1 or not array.size or np.any(np.isinf(array)):
        raise ValueError(
            f"{name} has shape {array.shape} and the entries {array.tolist()}; expected a vector "
            "of finite numbers, or NaN where the steady state is to be solved for; one at least."
        )
    return array


def idle_inputs(B: Array, stacklevel: int) -> list[str]:
    """Return a note on inputs without effect, and warn of them."""
    idle = np.flatnonzero(~np.any(B, axis=0))
    if not idle.size:
        return []
    note = (
        f"{', '.join(f'u[{i}]' for i in idle)} has no effect on the next state. With a delay or an "
        "actuator, make the inputs on their way part of the state; leave out an idle input."
    )
    warnings.warn(note, stacklevel=stacklevel)
    return [note]


def curvature(found: Jacobian, labels: list[str]) -> list[str]:
    """Return notes on dropped entries, strong nonlinearity, and what has no effect."""
    notes = []
    if found.dropped > 0:
        notes.append(
            f"Derivatives that are not above their rounding error (at most {found.dropped:.1e}) "
            "were set to zero."
        )
    for i, change in enumerate(found.change):
        if not change <= 0.1:
            what = "it has no value there" if np.isnan(change) else f"slopes differ by {change:.0%}"
            notes.append(
                f"The plant is not smooth within {found.steps[i]:.3g} of the operating point "
                f"along {labels[i]}: {what}."
            )
        elif not np.any(found.value[:, i]) and not labels[i].startswith("u"):
            notes.append(f"{labels[i]} has no effect on the next state.")
    return notes
