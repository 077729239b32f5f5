"""Bounds, references and boxes as the plant shows them, turned into deviations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_yann._validation import Array, as_bounds, as_flag
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc._arguments import Given
from sb3_yann.control.mpc.groups import DisturbanceBounds, OutputBounds, Tracking

Sides = tuple[Given, Given]


class Boxes(NamedTuple):
    """The arguments of a problem that count from the operating point, or from the plant's zero."""

    x: Sides
    u: Sides
    theta: Sides
    tracking: Tracking | None
    disturbances: DisturbanceBounds | None
    outputs: OutputBounds | None

    def seen_from(self, model: LinearModel, absolute: bool) -> Boxes:
        """Return them in deviations; absolute ones less the operating point. None stays None."""
        if not as_flag("absolute", absolute):
            return self
        tracking, d, outputs = self.tracking, self.disturbances, self.outputs
        if tracking is not None:
            rows = tracking.sized(model.n_states).C
            r = _less("r", (tracking.r_min, tracking.r_max), rows @ model.x_ss)
            tracking = Tracking(rows, *r)
        if outputs is not None:
            rows = outputs.sized(model.n_states).C
            y = _less("y", (outputs.y_min, outputs.y_max), rows @ model.x_ss)
            outputs = OutputBounds(rows, *y)
        if d is not None:
            d = DisturbanceBounds(*_less("d", (d.d_min, d.d_max), model.d_ss))
        x, theta = (_less(k, getattr(self, k), model.x_ss) for k in ("x", "theta"))
        return Boxes(x, _less("u", self.u, model.u_ss), theta, tracking, d, outputs)


def _less(name: str, sides: Sides, point: Array) -> Sides:
    """Return bounds minus a point, None where there is none."""
    if not point.size:
        return sides
    low, high = as_bounds(name, *sides, point.size)
    low, high = low - point, high - point
    # What is not given has its own default.
    return (
        None if sides[0] is None else np.where(low == 0, 0.0, low),
        None if sides[1] is None else np.where(high == 0, 0.0, high),
    )
