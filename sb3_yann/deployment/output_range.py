"""The scale of outputs with which no rounding leads beyond their bounds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array

STEPS = 8
"""By how many roundings a scale becomes smaller at most."""


def scale_within(
    scale: Array, shift: Array, low: Array, high: Array, real: Any = np.float64
) -> NDArray[Any]:
    """Return the scale (m,), some roundings smaller where ``shift +- scale`` is beyond the bounds.

    Where the bounds have no room for that, in float32 beside a huge operating point, it stays.

    Parameters
    ----------
    scale, shift : ndarray, shape (m,)
        Outputs are ``scale * y + shift`` for y in [-1, 1].
    low, high : ndarray, shape (m,)
        Bounds of the outputs.
    real : type, default numpy.float64
        In which the outputs are computed.
    """
    found, middle = scale.astype(real), shift.astype(real)
    step = np.spacing(np.maximum(found, np.abs(middle)))
    tried = found - np.arange(STEPS)[:, None].astype(real) * step
    inside = (middle - tried >= low) & (middle + tried <= high) & (tried > 0)
    best = np.take_along_axis(tried, inside.argmax(0)[None], 0)[0]
    return np.where(inside.any(0), best, found)


def scale_in(data: Mapping[str, Any], precision: str) -> NDArray[Any]:
    """Return the scale of a controller's outputs for code of that precision."""
    scale, shift = data["action_scale"], data["action_shift"]
    if precision == "double":
        found: NDArray[Any] = scale
        return found
    return scale_within(scale, shift, shift - scale, shift + scale, np.float32)
