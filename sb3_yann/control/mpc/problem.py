"""The data of a linear MPC problem, and the maps that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_yann._validation import Array, ReadOnlyArrays, half_widths
from sb3_yann.control.model.labels import labels_of, with_units
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc.error_coordinates import ErrorSystem, error_system
from sb3_yann.control.mpc.groups import (
    DisturbanceBounds,
    OutputBounds,
    RateLimits,
    SoftBounds,
    Terminal,
    Tracking,
)
from sb3_yann.control.mpc.steady_state import SteadyStates, steady_states
from sb3_yann.control.mpc.theta_layout import ThetaLayout
from sb3_yann.units import Units, fields_in_deviations

if TYPE_CHECKING:
    from typing_extensions import Self


OF_OLD_PICKLES = "absolute", "theta_ss", "_online"
"""What a problem of 0.1 held besides, or had computed from its operating point."""


@dataclass(frozen=True, eq=False, repr=False)
class MPCProblem(ReadOnlyArrays):
    """The arguments of a :class:`LinearMPC`, whose constructor has checked them.

    Attributes
    ----------
    model, Q, R : LinearModel, and ndarray, shapes (n, n) and (m, m)
    horizon, gamma, infeasible : int, float and str
    x_min, x_max, u_min, u_max, theta_min, theta_max : ndarray, shapes (n,), (m,) and (n_theta,)
        Infinite where there is no bound.
    tracking, disturbances, rate, outputs, soft, terminal : Tracking, DisturbanceBounds, ...
        Never None, and in the sizes of the model.

    All of it is in plant units where the model has an operating point, and in the model's own
    coordinates where it has none.
    """

    model: LinearModel
    Q: Array
    R: Array
    horizon: int
    x_min: Array
    x_max: Array
    u_min: Array
    u_max: Array
    theta_min: Array
    theta_max: Array
    gamma: float
    infeasible: str
    tracking: Tracking
    disturbances: DisturbanceBounds
    rate: RateLimits
    outputs: OutputBounds
    soft: SoftBounds
    terminal: Terminal

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy or a pickle; one of 0.1 is in deviations, whatever its model says."""
        if "absolute" in state:
            model = state["model"].about_zero()
            state = {name: value for name, value in state.items() if name not in OF_OLD_PICKLES}
            rest = np.zeros(layout_of(model, state["tracking"], state["rate"]).size)
            laws = {name: law.on_plant(model, rest) for name, law in state.get("_laws", {}).items()}
            state |= {"model": model, "_laws": laws}
        super().__setstate__(state)

    @cached_property
    def units(self) -> Units:
        """The operating point, and the way from plant units to deviations and back."""
        return Units(self.theta_ss, self.model.u_ss)

    @property
    def deviations(self) -> Self:
        """The same problem in deviations from its operating point, as laws and networks take it."""
        return self._in_deviations if self.units.shifted else self

    @cached_property
    def _in_deviations(self) -> Self:
        found = object.__new__(type(self))
        MPCProblem.__init__(found, **fields_in_deviations(self))
        return found

    @property
    def has_rate_bounds(self) -> bool:
        """Whether the change of an input is bounded."""
        return self.rate.bounded

    @cached_property
    def layout(self) -> ThetaLayout:
        """What theta holds."""
        return layout_of(self.model, self.tracking, self.rate)

    @property
    def n_theta(self) -> int:
        """Number of parameters of the law."""
        return self.layout.size

    @cached_property
    def theta_ss(self) -> Array:
        """Theta at the operating point in plant units (n_theta,): x_ss, C x_ss, d_ss, u_ss."""
        model = self.model
        parts = model.x_ss, self.tracking.C @ model.x_ss, model.d_ss
        return np.concatenate([*parts, model.u_ss[: self.layout.n_previous]])

    @property
    def set_points(self) -> dict[int, int]:
        """The entry of theta that is the reference of a state, by the state's index."""
        rows = enumerate(self.tracking.C, start=self.model.n_states)
        single = (each for each in rows if np.count_nonzero(each[1]) == 1 == np.max(each[1]))
        return {int(np.argmax(row)): at for at, row in single}

    def labels(self, units: bool = False) -> tuple[str, ...]:
        """Return what each entry of theta is called: by the model's names, else as in the layout.

        A set-point is called after the state that it is for. Units stand in parentheses.
        """
        model, found = self.model, list(self.layout.names)
        states, inputs = with_units(model) if units else labels_of(model)
        if model.state_names or (units and model.units):
            found[self.layout.state] = states
            for state, at in self.set_points.items():
                found[at] = f"set-point of {states[state]}"
        if model.input_names or (units and model.units):
            previous = inputs[: self.layout.n_previous]
            found[self.layout.previous] = [f"previous {each}" for each in previous]
        return tuple(found)

    @cached_property
    def theta_half(self) -> Array:
        """The half-widths of the box of theta (n_theta,), 1 where it is unbounded."""
        return half_widths(self.deviations.theta_min, self.deviations.theta_max)

    @cached_property
    def u_half(self) -> Array:
        """The half-widths of the input range (m,), 1 where it is unbounded."""
        return half_widths(self.deviations.u_min, self.deviations.u_max)

    @cached_property
    def prediction(self) -> tuple[Array, Array]:
        """A_bar (n_theta, n_theta), B_bar (n_theta, m): ``theta+ = A_bar theta + B_bar u``.

        In deviations.
        """
        parts, model = self.layout, self.model
        A, B = np.eye(parts.size), np.zeros((parts.size, model.n_inputs))
        A[parts.state, parts.state], A[parts.state, parts.disturbance] = model.A, model.E
        A[parts.previous, parts.previous] = 0.0
        B[parts.state] = model.B
        B[parts.previous] = np.eye(model.n_inputs)[: parts.n_previous]
        return A, B

    @cached_property
    def steady_states(self) -> SteadyStates:
        """The map from r and d to the steady state, within bounds or not, in deviations."""
        own = self.deviations
        x_unit = np.maximum(np.abs(own.theta_min), np.abs(own.theta_max))[self.layout.state]
        x_unit = np.where(np.isfinite(x_unit), x_unit, 1.0)
        return steady_states(self.model, self.tracking.C, self.Q, self.R, x_unit, self.u_half)

    @cached_property
    def error_system(self) -> ErrorSystem:
        """The coordinates about the steady state in which the cost is quadratic."""
        weights = self.Q, self.R, self.rate.R_du
        return error_system(self.model, self.layout, self.steady_states, *weights)

    @property
    def stage_matrix(self) -> Array:
        """W (n_theta + m, n_theta + m): ``[theta; u]' W [theta; u]`` is the cost of deviations."""
        return self.error_system.stage_matrix

    def __hash__(self) -> int:
        """Return a hash that equal problems share."""
        return hash((self.model, self.horizon, self.Q.tobytes(), self.R.tobytes()))

    def __repr__(self) -> str:
        """Name the sizes, the bounds and what else there is."""
        sizes = f"states={self.model.n_states}, inputs={self.model.n_inputs}"
        options = f"horizon={self.horizon}, gamma={self.gamma:g}, infeasible={self.infeasible!r}"
        tracking, d, rate, outputs = self.tracking, self.disturbances, self.rate, self.outputs
        bounds = {
            "x": (self.x_min, self.x_max),
            "u": (self.u_min, self.u_max),
            "r": (tracking.r_min, tracking.r_max),
            "d": (d.d_min, d.d_max),
            "du": (rate.du_min, rate.du_max),
            "y": (outputs.y_min, outputs.y_max),
        }
        told = [_bounds_in_words(name, *sides) for name, sides in bounds.items()]
        return f"{type(self).__name__}({', '.join([sizes, options, *filter(None, told)])})"


def _bounds_in_words(name: str, lower: Array, upper: Array) -> str:
    """Return ``name_min=[...], name_max=[...]``, empty where nothing is bounded."""
    sides = ((f"{name}_min", lower), (f"{name}_max", upper))
    return ", ".join(
        f"{side}=[{', '.join(f'{value:.4g}' for value in values)}]"
        for side, values in sides
        if np.any(np.isfinite(values))
    )


def layout_of(model: LinearModel, tracking: Tracking, rate: RateLimits) -> ThetaLayout:
    """Return what theta holds in a problem with these parts."""
    previous = model.n_inputs if np.any(rate.R_du) or rate.bounded else 0
    return ThetaLayout(model.n_states, len(tracking.C), model.n_disturbances, previous)
