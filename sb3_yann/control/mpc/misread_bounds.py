"""Bounds that leave out the operating point, or look as if they were given in the other units."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control.model.labels import labels_of
from sb3_yann.control.model.linear_model import LinearModel

Mask = NDArray[np.bool_]
ELSEWHERE = ("r", "d")
"""These may well lie on one side of the operating point, all of them."""


class Range(NamedTuple):
    """Bounds of a problem, in deviations, and the operating point that they count from.

    Attributes
    ----------
    name : {"x", "theta", "u", "r", "y", "d"}
    low, high, point : ndarray, shape (k,)
    """

    name: str
    low: Array
    high: Array
    point: Array

    @property
    def leave_out_rest(self) -> Mask:
        """Which leave out the operating point."""
        return np.asarray((self.low > 0) | (self.high < 0))

    def hold_zero(self, shift: Array) -> Mask:
        """Tell which have 0 inside when they are moved."""
        return np.asarray((self.low + shift < 0) & (self.high + shift > 0))


def warn_of_misread_bounds(
    model: LinearModel, ranges: Sequence[Range], has_constants: bool, absolute: bool
) -> None:
    """Warn of bounds in which the law cannot rest, or that would make sense in the other units.

    Parameters
    ----------
    model : LinearModel
        Which names the states.
    ranges : sequence of Range
        Those of a problem: x, theta of the states, u, and others.
    has_constants : bool
        Whether references or disturbances are other places to rest at.
    absolute : bool
        Whether the bounds were given in absolute values.
    """
    x, theta, u = ranges[:3]
    told = False
    if not has_constants:
        told = _warn_of_no_rest(u, absolute)
        told |= absolute and _warn_of_no_room(model, x, theta)
    elif not absolute and np.all(u.hold_zero(-u.point)):
        told = _warn_of_no_rest(u, absolute)
    if not told:
        _warn_of_other_units(ranges, absolute)


def _warn_of_no_rest(u: Range, absolute: bool) -> bool:
    """Warn of inputs that cannot rest at the operating point, and tell whether there are any."""
    cure = "Give absolute bounds with absolute=True, or take u_ss of the model off them."
    if absolute:
        cure = "Linearize where the inputs keep their bounds, or correct u_ss of the model."
    rest = u.point if absolute else np.zeros_like(u.point)
    for i in np.flatnonzero(u.leave_out_rest):
        warnings.warn(
            f"u_min = {u.low[i] + rest[i]:g} and u_max = {u.high[i] + rest[i]:g} leave out u[{i}] "
            f"= {rest[i]:g}, the operating point: the law cannot rest there. {cure}",
            stacklevel=4,
        )
    return bool(u.leave_out_rest.any())


def _warn_of_no_room(model: LinearModel, x: Range, theta: Range) -> bool:
    """Warn of absolute bounds of states without the operating point, and tell whether it did."""
    found = x.leave_out_rest | theta.leave_out_rest
    for i in np.flatnonzero(found):
        low, high = np.array((x if x.leave_out_rest[i] else theta)[1:3])[:, i] + x.point[i]
        warnings.warn(
            f"{labels_of(model)[0][i]} = {x.point[i]:g}, the operating point, lies outside its "
            f"bounds, {low:g} to {high:g}: the law cannot rest there. Look at the order of the "
            "states, and whether these bounds are deviations: then leave out absolute=True.",
            stacklevel=4,
        )
    return bool(found.any())


def _warn_of_other_units(ranges: Sequence[Range], absolute: bool) -> None:
    """Warn of the first bounds that make no sense as they are taken, and would otherwise."""
    for each in ranges:
        found = _deviations(each) if absolute else _absolute(each, ranges)
        if not found.any():
            continue
        name, i = each.name, int(np.argmax(found))
        low, high, point = each.low[i], each.high[i], each.point[i]
        if absolute:
            warnings.warn(
                f"{name}_min = {low + point:g} and {name}_max = {high + point:g} of entry {i} "
                f"leave out the operating point, {point:g}, and hold 0: with absolute=True they "
                "are what the plant shows. If they are deviations, pass "
                f"{name}_min = {low + 2 * point:g} and {name}_max = {high + 2 * point:g}.",
                stacklevel=4,
            )
        else:
            warnings.warn(
                f"{name}_min = {low:g} and {name}_max = {high:g} of entry {i} are taken as "
                f"deviations from the operating point, {point:g}, and have that inside rather than "
                "0. If they are what the plant shows, pass absolute=True; else take the operating "
                "point of the model off them.",
                stacklevel=4,
            )
        return


def _deviations(given: Range) -> Mask:
    """Tell which absolute bounds leave out the operating point, and hold 0."""
    return np.asarray(given.leave_out_rest & given.hold_zero(given.point))


def _absolute(given: Range, ranges: Sequence[Range]) -> Mask:
    """Tell which deviations have the operating point inside rather than 0.

    Those that end at 0, or may leave it out, count only where all bounds hold that point.
    """
    holds, suspect = given.hold_zero(-given.point), given.leave_out_rest
    if all(np.all((each.point == 0) | each.hold_zero(-each.point)) for each in ranges):
        closed = np.isfinite(given.low) & np.isfinite(given.high)
        suspect = suspect | (closed & ((given.low == 0) | (given.high == 0)))
    elif given.name in ELSEWHERE:
        return np.zeros(len(holds), dtype=bool)
    return np.asarray(holds & suspect & (given.point != 0))
