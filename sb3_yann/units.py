"""Plant units and deviations: the only place that converts one into the other, and knows scales.

A problem whose model has an operating point takes and shows plant units; one whose model has none
is in its own coordinates. Deviations are what laws, observers and networks compute with.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann._validation import Array, ReadOnlyArrays, finite_sizes, frozen, half_widths

FLOAT32_ROUNDING = 1e-6
"""Half-widths, or a relative difference, that float32 observations and actions make."""
KEPT_ROUNDING = 2.5e-7
"""What float32 moves an action in [-1, 1] by: no row of a kept set is broken by as little."""


@dataclass(frozen=True, eq=False)
class Units(ReadOnlyArrays):
    """The operating point of a problem in plant units: what deviations count from.

    Attributes
    ----------
    theta_ss : ndarray, shape (n_theta,)
        Theta at the operating point: x_ss, C x_ss, d_ss, u_ss.
    u_ss : ndarray, shape (m,)

    Examples
    --------
    >>> units = Units(np.array([350.0]), np.array([2.0]))
    >>> units.to_deviations([351.0]), units.input_to_plant([0.5])
    (array([1.]), array([2.5]))
    """

    theta_ss: Array
    u_ss: Array

    @cached_property
    def shifted(self) -> bool:
        """Whether there is an operating point other than zero."""
        return bool(np.any(self.theta_ss) or np.any(self.u_ss))

    def to_deviations(self, shown: ArrayLike) -> Array:
        """Return theta in deviations, (..., n_theta), or (..., n) where only states are given."""
        values = np.asarray(shown, np.float64)
        return values - self.theta_ss[: values.shape[-1]] if self.shifted else values

    def to_plant(self, theta: ArrayLike) -> Array:
        """Return theta in plant units, (..., n_theta), or (..., n) where only states are given."""
        values = np.asarray(theta, np.float64)
        return _raised(values, self.theta_ss[: values.shape[-1]]) if self.shifted else values

    def input_to_deviations(self, u: ArrayLike) -> Array:
        """Return inputs (..., m) in deviations."""
        values = np.asarray(u, np.float64)
        return values - self.u_ss if self.shifted else values

    def input_to_plant(self, u: ArrayLike) -> Array:
        """Return inputs (..., m) as the plant takes them."""
        values = np.asarray(u, np.float64)
        return _raised(values, self.u_ss) if self.shifted else values


def _raised(values: Array, rest: Array) -> Array:
    """Return deviations from a rest in plant units: what cancels but for rounding is zero."""
    found = values + rest
    return np.where(np.abs(found) <= 1e-13 * np.abs(rest), 0.0, found)


def fields_in_deviations(problem: Any) -> dict[str, Any]:
    """Return the fields of the same problem about zero: its model has no operating point then."""
    model = problem.model
    tracking = problem.tracking
    outputs = problem.outputs
    disturbances = problem.disturbances
    terminal = problem.terminal
    mixed = problem.mixed
    price = problem.price
    r_ss = tracking.C @ model.x_ss
    y_ss = outputs.C @ model.x_ss
    mixed_ss = mixed.F @ model.x_ss + mixed.G @ model.u_ss
    spent = price.x @ model.x_ss + price.u @ model.u_ss
    shifted = {
        "x_min": problem.x_min - model.x_ss,
        "x_max": problem.x_max - model.x_ss,
        "u_min": problem.u_min - model.u_ss,
        "u_max": problem.u_max - model.u_ss,
        "theta_min": problem.theta_min - problem.theta_ss,
        "theta_max": problem.theta_max - problem.theta_ss,
    }
    if isinstance(terminal.set, tuple):  # else it is still to be found
        rows, ends = terminal.set
        at = problem.theta_ss[: rows.shape[1]]
        terminal = replace(terminal, set=(rows, ends - rows @ at))
    return {
        **{name: getattr(problem, name) for name in problem.__dataclass_fields__},
        **{name: frozen(value) for name, value in shifted.items()},
        "model": model.about_zero(),
        "terminal": terminal,
        "tracking": replace(tracking, r_min=tracking.r_min - r_ss, r_max=tracking.r_max - r_ss),
        "outputs": replace(outputs, y_min=outputs.y_min - y_ss, y_max=outputs.y_max - y_ss),
        "disturbances": replace(
            disturbances,
            d_min=disturbances.d_min - model.d_ss,
            d_max=disturbances.d_max - model.d_ss,
        ),
        "mixed": replace(mixed, low=mixed.low - mixed_ss, high=mixed.high - mixed_ss),
        "price": replace(price, constant=price.constant + spent),
    }


@dataclass(frozen=True, eq=False)
class ActionUnits(ReadOnlyArrays):
    """How an env takes the inputs of a problem: ``action = scale * u + shift``, u in deviations.

    ``kind`` is "plant" for plant units, or "normalized" for [-1, 1] as the range of the input.
    """

    kind: str
    scale: Array
    shift: Array

    @classmethod
    def of(cls, problem: Any, low: NDArray[Any], high: NDArray[Any]) -> ActionUnits | None:
        """Return what bounds (m,) of the env's actions say; None where they fit nothing.

        They may be rounded to their own type.
        """
        u_min = problem.u_min
        u_max = problem.u_max
        u_ss = problem.model.u_ss
        half = half_widths(u_min, u_max)
        if same_bounds((low, high), (u_min, u_max), half):
            return cls("plant", np.ones_like(u_ss), u_ss.copy())
        finite = bool(np.all(np.isfinite([u_min, u_max])))
        one = np.ones_like(u_ss)
        if finite and same_bounds((low, high), (-one, one), one):
            # In deviations: with zero for the operating point nothing is rounded.
            middle = ((u_max - u_ss) + (u_min - u_ss)) / 2
            return cls("normalized", 1 / half, -middle / half)
        return None

    def action(self, u: ArrayLike) -> Array:
        """Return the env's action for an input in deviations, (m,) or (batch, m)."""
        return np.asarray(self.scale * np.asarray(u, np.float64) + self.shift)

    def input(self, action: ArrayLike) -> Array:
        """Return the input in deviations for an action of the env, (m,) or (batch, m)."""
        return np.asarray((np.asarray(action, np.float64) - self.shift) / self.scale)


def same_bounds(
    given: tuple[NDArray[Any], NDArray[Any]], wanted: tuple[Array, Array], half: Array
) -> bool:
    """Tell whether bounds, low and high (m,), are the same but for the rounding of their type.

    Where half-widths are infinite, the size of the bound is the unit.
    """
    found = np.array(given, np.float64)
    bounds = np.array(wanted)
    if found.shape != bounds.shape:
        return False
    size = np.where(np.isfinite(half), half, finite_sizes(*bounds))
    kind = np.asarray(given[0]).dtype
    digits = np.finfo(kind).eps if np.issubdtype(kind, np.floating) else 0.0
    room = 2e-6 * size + digits * np.abs(found)
    # Not np.isclose: that of numpy 1 takes no room for each entry where some are infinite.
    either = np.isfinite(found) & np.isfinite(bounds)
    apart = np.abs(np.where(either, found, 0) - np.where(either, bounds, 0))
    return bool(np.all(np.where(either, apart <= room, found == bounds)))
