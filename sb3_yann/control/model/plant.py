"""What a linear model does and says, however it was made."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array
from sb3_yann.control.linear_system import LinearSystem
from sb3_yann.control.model.labels import Units, completed, past_inputs, short_repr
from sb3_yann.control.model.report import describe
from sb3_yann.control.model.statespace import to_control

if TYPE_CHECKING:
    from typing_extensions import Self


class Plant(LinearSystem):
    """The methods of a :class:`LinearModel`."""

    def step(self, x: ArrayLike, u: ArrayLike, d: ArrayLike | None = None) -> Array:
        """Return ``A x + B u + E d``; each is a vector or a batch of them, (batch, size)."""
        moved = np.asarray(x) @ self.A.T + np.asarray(u) @ self.B.T
        return moved if d is None else moved + np.asarray(d) @ self.E.T

    def named(
        self,
        state_names: Sequence[str] = (),
        input_names: Sequence[str] = (),
        units: Units = (),
        time_unit: str | None = None,
    ) -> Self:
        """Return the model with names and units; notes and drift stay, as does a unit of time.

        Inputs on their way, the last states of a model with dead time, are named after the inputs
        where names and units are given of the others only.
        """
        if past := past_inputs(self):
            state_names, units = completed(self, past, state_names, input_names, units)
        given: dict[str, Any] = {
            "state_names": state_names,
            "input_names": input_names,
            "units": units,
        }
        if time_unit is not None:
            given["time_unit"] = time_unit
        return type(self)(**{**vars(self), **given})

    def about_zero(self) -> Self:
        """Return the model without an operating point: what it describes are deviations."""
        return type(self)(**{**vars(self), "x_ss": None, "u_ss": None, "d_ss": None})

    def to_statespace(self) -> Any:
        """Return a discrete `control.StateSpace` from [u, d] to x, all in deviations.

        Examples
        --------
        >>> from sb3_yann.control import LinearModel
        >>> LinearModel([[0.5]], [[2.0]], dt=0.1).to_statespace().dt
        0.1
        """
        return to_control(self)

    def report(self) -> str:
        """Return an account in words: poles, controllability, scaling, sampling and notes."""
        return describe(self)

    def __hash__(self) -> int:
        """Return a hash that equal models share."""
        return hash((self.A.tobytes(), self.B.tobytes(), self.dt, self.E.tobytes()))

    def __repr__(self) -> str:
        """Name the states, the inputs and the operating point."""
        return short_repr(self)
