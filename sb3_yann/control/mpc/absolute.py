"""Bounds, references and boxes as the plant shows them, turned into deviations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sb3_yann._validation import Array, check_bool, check_bounds, check_outputs
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc._arguments import Given
from sb3_yann.control.mpc.groups import DisturbanceBounds, OutputBounds, Tracking

if TYPE_CHECKING:
    from sb3_yann.control.mpc.problem import MPCProblem

Sides = tuple[Given, Given]


class Boxes(NamedTuple):
    """The arguments of a problem that count from the operating point, or from the plant's zero."""

    x: Sides
    u: Sides
    theta: Sides
    tracking: Tracking | None
    disturbances: DisturbanceBounds | None
    outputs: OutputBounds | None

    def seen_from(
        self, model: LinearModel, absolute: bool, stored: MPCProblem | None = None
    ) -> Boxes:
        """Return them in deviations; absolute ones less the operating point. None stays None.

        Parameters
        ----------
        model, absolute
            As in :class:`LinearMPC`.
        stored : MPCProblem, optional
            An absolute problem, of which something is replaced: its arrays are deviations already,
            from the operating point of its model.
        """
        if not check_bool("absolute", absolute):
            return self
        tracking, d, outputs = self.tracking, self.disturbances, self.outputs
        old = None if stored is None else stored.model
        if tracking is not None:
            rows = check_outputs("Tracking.C", tracking.C, model.n_states)
            before = None if stored is None or old is None else stored.tracking.C @ old.x_ss
            r = _Shift("r", rows @ model.x_ss, stored and stored.tracking, before)
            tracking = Tracking(rows, *r.of(tracking.r_min, tracking.r_max))
        if outputs is not None:
            rows = check_outputs("OutputBounds.C", outputs.C, model.n_states)
            before = None if stored is None or old is None else stored.outputs.C @ old.x_ss
            y = _Shift("y", rows @ model.x_ss, stored and stored.outputs, before)
            outputs = OutputBounds(rows, *y.of(outputs.y_min, outputs.y_max))
        if d is not None:
            shift = _Shift(
                "d", model.d_ss, stored and stored.disturbances, None if old is None else old.d_ss
            )
            d = DisturbanceBounds(*shift.of(d.d_min, d.d_max))
        x = _Shift("x", model.x_ss, stored, None if old is None else old.x_ss).of(*self.x)
        theta = _Shift("theta", model.x_ss, stored, None if old is None else old.x_ss).of(
            *self.theta
        )
        u = _Shift("u", model.u_ss, stored, None if old is None else old.u_ss).of(*self.u)
        return Boxes(x, u, theta, tracking, d, outputs)


class _Shift:
    """From absolute values to deviations, for the two bounds of one quantity.

    ``owner`` holds bounds that are deviations from the point ``before``.
    """

    def __init__(self, name: str, point: Array, owner: Any, before: Array | None) -> None:
        self.name = name
        self.point = point
        self.before = before
        self.kept = (
            () if owner is None else (getattr(owner, f"{name}_min"), getattr(owner, f"{name}_max"))
        )

    def of(self, low: Given, high: Given) -> Sides:
        """Return bounds minus the point, None where there is none."""
        return self._side(f"{self.name}_min", low), self._side(f"{self.name}_max", high)

    def _side(self, name: str, value: Given) -> Given:
        if value is None or not self.point.size:  # what is not given has its own default
            return value
        moved = self.point
        if self.before is not None and any(value is each for each in self.kept):
            moved = self.point - self.before
            if not np.any(moved):
                return value
            if np.size(value) > moved.size:  # all of theta: the rest has its own bounds
                value = np.asarray(value)[: moved.size]
        side = name.partition("_")[2]
        size = self.point.size
        if side == "min":
            found = check_bounds(self.name, value, None, size)[0] - moved
        else:
            found = check_bounds(self.name, None, value, size)[1] - moved
        return np.where(found == 0, 0.0, found)
