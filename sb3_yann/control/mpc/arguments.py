"""Checks of what the arguments of a problem mean, alone and together, and warnings about them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, check_array, check_bounds, check_int, to_float
from sb3_yann.control.linear_system import labels_of
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc.coordinates import ThetaLayout

DRIFT = 1e-3
BEYOND = 0.5
"""In widths: the drift in a sample that warns; how far theta's box reaches beyond soft bounds."""

Bounds = tuple[Array, Array]
Given = ArrayLike | None


def as_horizon(value: int) -> int:
    """Return the number of predicted steps, a whole number of at least 1."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"horizon = {value!r} must be a whole number of steps.")
    return check_int("horizon", value)


def as_control_horizon(
    value: int | Sequence[int] | None, horizon: int
) -> int | tuple[int, ...] | None:
    """Return the number of samples in which inputs move, or the lengths of their blocks."""
    if value is None:
        return None
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
        moves = check_int("control_horizon", value)
        if moves > horizon:
            raise ValueError(
                f"control_horizon = {moves} must be at most the horizon, {horizon}: inputs move in "
                "so many of its samples."
            )
        return moves
    if isinstance(value, (str, bool)) or not isinstance(value, (Sequence, np.ndarray)):
        raise TypeError(
            f"control_horizon = {value!r} must be a number of samples, or a list of the lengths of "
            "blocks."
        )
    blocks = tuple(check_int("control_horizon", each) for each in value)
    if sum(blocks) != horizon:
        raise ValueError(
            f"The blocks control_horizon = {[*blocks]} make {sum(blocks)} samples, and the horizon "
            f"is {horizon}: they must sum up to it."
        )
    return blocks


def require_preview_within(model: LinearModel, horizon: int, reference: int, load: int) -> None:
    """Raise where a preview is longer than the horizon, or nothing measures what it foresees."""
    for name, ahead in (("Tracking", reference), ("DisturbanceBounds", load)):
        if ahead > horizon:
            raise ValueError(
                f"{name}.preview = {ahead} must be at most the horizon, {horizon}: the law looks "
                "no further."
            )
    measured = model.n_disturbances - len(model.estimated)
    if load and sorted(model.estimated) != [*range(measured, model.n_disturbances)]:
        raise ValueError(
            f"estimated = {[*model.estimated]}: with a preview, theta holds the measured "
            "disturbances before the estimated ones. Sort the columns of E so."
        )
    if load and not measured:
        raise ValueError(
            "DisturbanceBounds.preview is of measured disturbances, and all are estimated."
        )


def constant_box(layout: ThetaLayout, r: Bounds, d: Bounds) -> list[Bounds]:
    """Return the boxes of r and d with their previews."""
    loads = layout.n_disturbances - layout.n_estimated
    ahead_r, ahead_d = layout.previews
    found = [(np.tile(r[0], ahead_r + 1), np.tile(r[1], ahead_r + 1))]
    low, high = (np.concatenate([np.tile(s[:loads], ahead_d + 1), s[loads:]]) for s in d)
    return [*found, (low, high)]


def as_softness(name: str, given: Array, bounds: Bounds) -> Array:
    """Return the unit of violation (size,) of soft bounds; one number is for all that are there."""
    size = len(bounds[0])
    bounded = np.isfinite(bounds).any(axis=0)
    units = given
    if given.ndim == 0:
        units = np.where(bounded, given, 0.0) if np.any(bounded) else np.full(size, float(given))
    units = check_array(name, units, (size,))
    if np.any(given > 0) and not np.any(units[bounded] > 0):
        wanted = f"pass {name[-1]}_min or {name[-1]}_max"
        raise ValueError(f"{name} = {given.tolist()}, but there is no bound to soften: {wanted}.")
    if np.any(units[~bounded] > 0):
        i = int(np.argmax((units > 0) & ~bounded))
        raise ValueError(
            f"{name} = {given.tolist()} softens entry {i}, which has no bound: make it 0."
        )
    return units


def theta_box(
    layout: ThetaLayout, given: tuple[Given, Given], states: Bounds, others: Sequence[Bounds]
) -> Bounds:
    """Return the box of theta.

    ``given`` are theta_min and theta_max: a number, (n,) for the states, or (n_theta,) as stored.
    ``states`` (n,) stand in for them. ``others`` are the boxes of r, d, bounds and the previous
    input, from which those given must not differ.
    """
    n = layout.n_states
    parts = []
    for value, fallback in zip(given, states, strict=True):
        part = fallback if value is None else to_float("theta", value)
        parts.append(part[:n] if part.shape == (layout.size,) else part)
    pieces = [check_bounds("theta", parts[0], parts[1], n), *others]
    low, high = (np.concatenate(side) for side in zip(*pieces, strict=True))
    low, high = check_bounds("theta", low, high, layout.size)
    for name, value, stored in zip(("theta_min", "theta_max"), given, (low, high), strict=True):
        _require_same_rest(name, value, stored, layout)
    return low, high


def _require_same_rest(name: str, given: Given, stored: Array, layout: ThetaLayout) -> None:
    """Raise where a box given for all of theta differs from that of r, d and u_prev."""
    box = None if given is None else to_float(name, given)
    # `dataclasses.replace` passes the stored box, which is read-only, and means the states.
    taken_over = isinstance(given, np.ndarray) and not given.flags.writeable
    if box is None or box.shape != stored.shape or taken_over:
        return
    for i in np.flatnonzero(box != stored):
        if i >= layout.n_states:
            part = layout.names[i].partition("[")[0].replace("u_prev", "u")
            side = name.partition("_")[2]
            raise ValueError(
                f"{name} has {box[i]:g} for {layout.names[i]}, but {part}_{side} is {stored[i]:g}. "
                f"Pass {name} of the {layout.n_states} states only; the rest has its own bounds."
            )


def softened_box(bounds: Bounds, softness: Array) -> Bounds:
    """Return bounds moved out by `BEYOND` of their width where they are soft."""
    width = bounds[1] - bounds[0]
    beyond = np.where((softness > 0) & np.isfinite(width), BEYOND * width, 0.0)
    return bounds[0] - beyond, bounds[1] + beyond


def warn_of_drift(model: LinearModel, lower: Array, upper: Array) -> None:
    """Warn of an operating point that moves noticeably: the law would rest beside it."""
    width = (upper - lower) / 2
    size = np.where(np.isfinite(width), width, np.maximum(np.abs(model.x_ss), 1.0))
    if np.any(np.abs(model.drift) > DRIFT * size):
        warnings.warn(
            f"x_ss = {model.x_ss.tolist()} with u_ss = {model.u_ss.tolist()} is no steady state: "
            f"there the plant moves by {model.drift.tolist()} in one sample, and the law will rest "
            "beside its references. Identify it with an x_ss and u_ss at which it rests.",
            stacklevel=3,
        )


def warn_of_unused_softness(softness: Array, bounds: Bounds, box: Bounds) -> None:
    """Warn of soft bounds of states that no theta of the box breaks."""
    (lower, upper) = bounds
    (low, high) = box
    unused = (softness > 0) & (low >= lower) & (high <= upper)
    if np.any(unused):
        i = int(np.argmax(unused))
        warnings.warn(
            f"SoftBounds.x softens the bounds {lower[i]:g} to {upper[i]:g} of x[{i}], but theta_min"
            f" = {low[i]:g} and theta_max = {high[i]:g} do not exceed them: the law ends there. "
            "Give theta_min and theta_max the states from which it is to come back.",
            stacklevel=3,
        )


def warn_of_misread_bounds(
    model: LinearModel, ranges: Mapping[str, tuple[Array, Array, Array]], has_constants: bool
) -> None:
    """Warn of bounds that seem to be deviations, or in which the law cannot rest.

    Ranges are lower and upper bounds, and the operating point between them, by name: "x", "theta"
    of the states, "u", and others. References and disturbances are other places to rest at.
    """
    left_out = {name: (low > point) | (high < point) for name, (low, high, point) in ranges.items()}
    for name, (lower, upper, points) in ranges.items():
        for i in np.flatnonzero(left_out[name] & (lower < 0) & (upper > 0))[:1]:
            low = lower[i]
            high = upper[i]
            point = points[i]
            warnings.warn(
                f"{name}_min = {low:g} and {name}_max = {high:g} of entry {i} leave out the "
                f"operating point, {point:g}, and hold 0. Bounds are what the plant shows. If "
                f"these are deviations, pass {name}_min = {low + point:g} and {name}_max = "
                f"{high + point:g}, or leave x_ss and u_ss out of the model.",
                stacklevel=3,
            )
            return
    if has_constants:
        return
    has_point = bool(np.any(model.x_ss) or np.any(model.u_ss))
    cure = "If these are what the plant takes, give the model its x_ss and u_ss."
    if has_point:
        cure = "Linearize where the inputs keep their bounds, or correct u_ss of the model."
    for i in np.flatnonzero(left_out["u"]):
        low, high, point = (each[i] for each in ranges["u"])
        warnings.warn(
            f"u_min = {low:g} and u_max = {high:g} leave out u[{i}] = {point:g}, "
            f"the operating point: the law cannot rest there. {cure}",
            stacklevel=3,
        )
    for i in np.flatnonzero(has_point & (left_out["x"] | left_out["theta"])):
        low, high, point = (each[i] for each in ranges["x" if left_out["x"][i] else "theta"])
        warnings.warn(
            f"{labels_of(model)[0][i]} = {point:g}, the operating point, lies outside its "
            f"bounds, {low:g} to {high:g}: the law cannot rest there. Look at the "
            "order of the states.",
            stacklevel=3,
        )
