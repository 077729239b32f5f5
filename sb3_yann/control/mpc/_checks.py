"""Checks of what the arguments of a problem mean together, and warnings about them."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, to_float
from sb3_yann.control.model.linear_model import LinearModel

DRIFT = 1e-3
"""How far a model's operating point may move in a sample without a warning, in parts of the box."""


BEYOND = 0.5
"""How far the box of theta reaches beyond soft bounds by default, in parts of their width."""


def require_room_to_rest(low: Array, high: Array, du_min: Array, du_max: Array, free: bool) -> None:
    """Raise where an input must change for ever; warn where it cannot rest at the operating point.

    With references or disturbances (`free`) there are other places to rest.

    Raises
    ------
    ValueError
        If du_min is above 0 or du_max below.
    """
    for i in np.flatnonzero((du_min > 0) | (du_max < 0)):
        raise ValueError(
            f"du_min = {du_min[i]:g} and du_max = {du_max[i]:g} make u[{i}] change in every "
            "sample: du_min must be at most 0, and du_max at least 0."
        )
    for i in () if free else np.flatnonzero((low > 0) | (high < 0)):
        warnings.warn(
            f"u_min = {low[i]:g} and u_max = {high[i]:g} leave out u[{i}] = 0, the input at the "
            "operating point: the law cannot rest there. All is in deviations: take u_ss of the "
            "model off bounds that are absolute.",
            stacklevel=3,
        )


def require_same_rest(
    name: str, given: ArrayLike | None, stored: Array, names: tuple[str, ...], k: int
) -> None:
    """Raise where a box given for all of theta differs from that of r, d and u_prev.

    A box that a problem has stored is read-only: of it `dataclasses.replace` means the states.

    Raises
    ------
    ValueError
        If an entry after the first k does.
    """
    box = None if given is None else to_float(name, given)
    taken_over = isinstance(given, np.ndarray) and not given.flags.writeable
    if box is None or box.shape != stored.shape or taken_over:
        return
    for i in np.flatnonzero(box != stored):
        if i >= k:
            part = names[i].partition("[")[0].replace("u_prev", "u")
            side = name.partition("_")[2]
            raise ValueError(
                f"{name} has {box[i]:g} for {names[i]}, but {part}_{side} is {stored[i]:g}. Pass "
                f"{name} of the {k} states only, and give the rest by its own bounds."
            )


def warn_of_drift(model: LinearModel, lower: Array, upper: Array) -> None:
    """Warn of an operating point that moves noticeably: the law would rest beside what it is to."""
    width = (upper - lower) / 2
    size = np.where(np.isfinite(width), width, np.maximum(np.abs(model.x_ss), 1.0))
    if np.any(np.abs(model.drift) > DRIFT * size):
        warnings.warn(
            f"The operating point of the model, x_ss = {model.x_ss.tolist()} with u_ss = "
            f"{model.u_ss.tolist()}, is no steady state: there the plant moves by "
            f"{model.drift.tolist()} in one sample, which the model leaves out, and the law will "
            "rest beside its references. Identify it with an x_ss and u_ss at which it rests.",
            stacklevel=3,
        )


def softened_box(lower: Array, upper: Array, softness: Array) -> tuple[Array, Array]:
    """Return bounds moved out by `BEYOND` of their width where they are soft."""
    width = upper - lower
    beyond = np.where((softness > 0) & np.isfinite(width), BEYOND * width, 0.0)
    return lower - beyond, upper + beyond


def warn_of_unused_softness(
    softness: Array, bounds: tuple[Array, Array], box: tuple[Array, Array]
) -> None:
    """Warn of soft bounds of states that no theta of the box breaks."""
    (lower, upper), (low, high) = bounds, box
    unused = (softness > 0) & (low >= lower) & (high <= upper)
    if np.any(unused):
        i = int(np.argmax(unused))
        warnings.warn(
            f"x_soft softens the bounds {lower[i]:g} to {upper[i]:g} of x[{i}], but theta_min = "
            f"{low[i]:g} and theta_max = {high[i]:g} do not exceed them: the law ends there. Give "
            "theta_min and theta_max the states from which it is to come back.",
            stacklevel=3,
        )
