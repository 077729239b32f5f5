"""The data of a linear MPC problem, the maps that follow from them, and what is so at rest."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from sb3_yann._validation import Array, Given, ReadOnlyArrays, check_array, half_widths, to_float
from sb3_yann.control import lqr
from sb3_yann.control.linear_system import labels_of, labels_of_outputs, with_units
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc.coordinates import (
    ErrorSystem,
    SteadyStates,
    ThetaLayout,
    error_system,
    steady_states,
)
from sb3_yann.control.mpc.groups import (
    DisturbanceBounds,
    LinearCost,
    MixedBounds,
    OutputBounds,
    RateLimits,
    SoftBounds,
    Terminal,
    Tracking,
    bound_entry,
)
from sb3_yann.units import Units, fields_in_deviations

if TYPE_CHECKING:
    from typing_extensions import Self

    from sb3_yann.control.online import Law


class Bounded(NamedTuple):
    """What bounds of one kind are of: rows (k, n_theta + m) of ``[theta; u]``, and their names.

    ``softness`` (k,) is the violation that counts as one unit, 0 where a bound is hard.
    """

    rows: Array
    softness: Array
    names: list[str]


@dataclass(frozen=True, eq=False, repr=False)
class MPCProblem(ReadOnlyArrays):
    """The arguments of a :class:`LinearMPC`, whose constructor has checked them.

    Bounds are infinite where there is none, theta's box is (n_theta,), and groups such as
    `Tracking` are never None and have the sizes of the model. All of it is in plant units where the
    model has an operating point, and in the model's own coordinates where it has none.
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
    mixed: MixedBounds = field(default_factory=MixedBounds)
    price: LinearCost = field(default_factory=LinearCost)
    parametric_bounds: tuple[str, ...] = ()
    control_horizon: int | tuple[int, ...] | None = None

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

    @cached_property
    def has_rate_bounds(self) -> bool:
        """Whether the change of an input is bounded."""
        return bool(np.any(np.isfinite([self.rate.du_min, self.rate.du_max])))

    @cached_property
    def layout(self) -> ThetaLayout:
        """What theta holds."""
        model = self.model
        ahead = self.disturbances.preview
        return ThetaLayout(
            model.n_states,
            len(self.tracking.C),
            model.n_disturbances,
            n_previous=model.n_inputs if np.any(self.rate.R_du) or self.has_rate_bounds else 0,
            n_estimated=len(model.estimated) if ahead else 0,
            previews=(self.tracking.preview, ahead),
            bounds=self.parametric_bounds,
        )

    @cached_property
    def blocks(self) -> tuple[int, ...]:
        """For how many samples each of the inputs that the program chooses is held."""
        chosen = self.control_horizon
        if chosen is None:
            return (1,) * self.horizon
        if isinstance(chosen, tuple):
            return chosen
        return (1,) * (chosen - 1) + (self.horizon - chosen + 1,)

    @cached_property
    def settled(self) -> MPCProblem:
        """The problem without previews: what it is after the last r and d that are known."""
        layout = self.layout
        if layout.settled == layout:
            return self
        values = {each.name: getattr(self, each.name) for each in fields(MPCProblem)}
        terminal = self.terminal
        if isinstance(terminal.set, tuple) and terminal.set[0].shape[1] == layout.size:
            terminal = replace(terminal, set=(terminal.set[0] @ layout.lift, terminal.set[1]))
        values |= {
            "tracking": replace(self.tracking, preview=0),
            "disturbances": replace(self.disturbances, preview=0),
            "terminal": terminal,
            "theta_min": self.theta_min[layout.settles],
            "theta_max": self.theta_max[layout.settles],
        }
        return MPCProblem(**values)

    @cached_property
    def limits(self) -> dict[str, tuple[Array, Array]]:
        """The bounds of x, u, y, du, and of mixed rows; the widest of those that change."""
        return {
            "x": (self.x_min, self.x_max),
            "u": (self.u_min, self.u_max),
            "y": (self.outputs.y_min, self.outputs.y_max),
            "du": (self.rate.du_min, self.rate.du_max),
            "mixed": (self.mixed.low, self.mixed.high),
        }

    @cached_property
    def bounded(self) -> dict[str, Bounded]:
        """What is bounded, by kind as in :attr:`limits`; rates where theta holds the last input."""
        theta, u = np.split(np.eye(self.n_theta + self.model.n_inputs), [self.n_theta])
        x = theta[self.layout.state]
        C = self.outputs.C
        mixed = self.mixed
        states, inputs = labels_of(self.model)
        hard = np.zeros(len(u))
        combined = [f"mixed[{i}]" for i in range(len(mixed.F))]
        found = {
            "u": Bounded(u, hard, inputs),
            "x": Bounded(x, self.soft.x, states),
            "y": Bounded(C @ x, self.soft.y, labels_of_outputs(C, self.model.state_names)),
            "mixed": Bounded(mixed.F @ x + mixed.G @ u, mixed.soft, combined),
        }
        if self.layout.n_previous:
            rates = [f"the rate of {each}" for each in inputs]
            found["du"] = Bounded(u - theta[self.layout.previous], hard, rates)
        return found

    def limit_rows(self, kind: str) -> tuple[Array, Array, Array, Array]:
        """Return low, high (k,) and L, H (k, n_theta) of ``low + L theta`` and ``high + H theta``.

        A bound that changes at run time is its entry of theta.
        """
        low, high = (np.array(side) for side in self.limits[kind])
        L, H = (np.zeros((len(side), self.n_theta)) for side in (low, high))
        for at, name in enumerate(self.parametric_bounds, start=self.layout.limits.start):
            of, i, upper = bound_entry(name)
            if of == kind:
                (high if upper else low)[i] = 0.0
                (H if upper else L)[i, at] = 1.0
        return low, high, L, H

    def limits_at(self, kind: str, thetas: Array) -> tuple[Array, Array]:
        """Return lower and upper bounds of a kind, such as "u", at thetas (..., n_theta)."""
        if not any(bound_entry(name)[0] == kind for name in self.parametric_bounds):
            return self.limits[kind]
        low, high, L, H = self.limit_rows(kind)
        return low + thetas @ L.T, high + thetas @ H.T

    def input_range(self, thetas: Array) -> tuple[Array, Array]:
        """Return the least and the largest inputs (..., m) at thetas (..., n_theta).

        A bound that changes at run time is reached as fast as the rate allows, and the rate ends at
        the fixed bounds.
        """
        fixed = self.u_min, self.u_max
        if not self.has_rate_bounds and not self.parametric_bounds:
            return fixed
        low, high = (np.clip(side, *fixed) for side in self.limits_at("u", thetas))
        high = np.maximum(low, high)
        if not self.has_rate_bounds:
            return low, high
        before = thetas[..., self.layout.previous]
        slowest = [np.clip(before + side, *fixed) for side in self.limits_at("du", thetas)]
        return np.clip(low, *slowest), np.clip(high, *slowest)

    @property
    def n_theta(self) -> int:
        """Number of parameters of the law."""
        return self.layout.size

    @cached_property
    def theta_ss(self) -> Array:
        """Theta at the operating point in plant units (n_theta,): x_ss, C x_ss, d_ss, u_ss.

        Bounds that change at run time count from what they bound: those of u from u_ss.
        """
        x = self.model.x_ss
        u = self.model.u_ss
        y = self.outputs.C @ x
        mixed = self.mixed.F @ x + self.mixed.G @ u
        bounded = {"x": x, "u": u, "y": y, "du": np.zeros_like(u), "mixed": mixed}
        entries = map(bound_entry, self.parametric_bounds)
        bounds = np.array([bounded[kind][i] for kind, i, _ in entries])
        parts = x, self.tracking.C @ x, self.model.d_ss, bounds, u[: self.layout.n_previous]
        return np.asarray(self.layout.lift @ np.concatenate(parts))

    @cached_property
    def clamped(self) -> Array | None:
        """The range (2, n_theta) of what theta asks for, in deviations; None where that is nothing.

        It is finite for references and for bounds that change at run time, and holds the operating
        point, at which the law has a value. Laws and policies take what lies beyond as at its end.
        States and disturbances are what they are: they go on.
        """
        held = np.r_[self.layout.reference, self.layout.limits]
        found = np.full((2, self.n_theta), np.inf) * [[-1.0], [1.0]]
        rest = self.theta_rest[held]
        found[0, held] = np.minimum(self.deviations.theta_min[held], rest)
        found[1, held] = np.maximum(self.deviations.theta_max[held], rest)
        return found if np.any(np.isfinite(found)) else None

    @cached_property
    def theta_rest(self) -> Array:
        """Theta at rest in deviations (n_theta,): zero, and the widest of bounds that change."""
        rest = np.zeros(self.n_theta)
        limits = self.deviations.limits
        entries = map(bound_entry, self.parametric_bounds)
        rest[self.layout.limits] = [limits[kind][upper][i] for kind, i, upper in entries]
        return rest

    @cached_property
    def extra(self) -> NDArray[np.intp]:
        """The entries of theta that the law ignores: measured disturbances that move nothing."""
        moves = np.any(self.model.E, axis=0)
        moves[[*self.model.estimated]] = True
        found = np.flatnonzero(~moves) if not self.disturbances.preview else np.empty(0, np.intp)
        return np.asarray(self.layout.disturbance.start + found, np.intp)

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
        model = self.model
        states, inputs, loads = with_units(model, units)
        has_units = bool(units and model.units)
        called = {("x", i): each for i, each in enumerate(states)}
        called |= {("d", i): loads[i] for i in range(len(model.disturbance_names))}
        if model.state_names or has_units:
            rows = ((i, at - model.n_states) for i, at in self.set_points.items())
            called |= {("r", row): f"set-point of {states[i]}" for i, row in rows}
        if model.input_names or has_units:
            called |= {("u_prev", i): f"previous {each}" for i, each in enumerate(inputs)}
        found = []
        for name, (kind, i, ahead) in zip(self.layout.names, self.layout.entries, strict=True):
            later = f", {ahead} sample{'s' * (ahead > 1)} ahead" if ahead else ""
            found.append(called[kind, i] + later if (kind, i) in called else name)
        return tuple(found)

    def shown_as_deviation(self, shown: ArrayLike) -> str:
        """Return which entry of theta (steps, n_theta) is shown as a deviation; empty for none.

        Nearly all rows lie outside the box of the law, and inside with the operating point put on.
        All states must say so together, and lie nearer to zero than to the operating point.
        """
        rows = np.asarray(shown, np.float64)
        point = self.theta_ss
        if not len(rows) or not np.any(point):
            return ""
        reach = self.theta_half
        low = self.theta_min - 1e-6 * reach
        high = self.theta_max + 1e-6 * reach
        within = [(low <= each) & (each <= high) for each in (rows, rows + point)]
        n = self.model.n_states
        end = self.layout.previous.start
        for first, last in ((0, n), *((i, i + 1) for i in range(n, end) if point[i])):
            is_in, would_be = (np.mean(each[:, first:last].all(axis=1)) for each in within)
            # By how much nearer to zero than to the operating point, in half-widths.
            nearer = np.mean((np.abs(rows - point) / 2 - np.abs(rows)) / reach, axis=0)[first:last]
            i = first + int(np.argmax(nearer))
            if is_in <= 0.1 and would_be >= 0.9 and (first >= n or nearer.max() > 0):
                return (
                    f"{self.labels()[i]} = {rows[0, i]:.6g} is shown, and the operating point is "
                    f"{point[i]:.6g}: this is a deviation, and the problem is in plant units. Show "
                    "what the plant shows, or leave x_ss and u_ss out of the model."
                )
        return ""

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
        parts = self.layout
        model = self.model
        A = np.eye(parts.size)[parts.next]
        B = np.zeros((parts.size, model.n_inputs))
        A[parts.state, parts.state] = model.A
        A[parts.state, parts.now[parts.n_references :]] = model.E
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

    def is_reachable(self, r: Given = None, d: Given = None) -> NDArray[np.bool_]:
        """Tell whether the steady state for r (p,) and d (d,) lies within the bounds of x, u and y.

        Both may be batches; None is the operating point. Soft bounds count too.
        """
        return np.asarray(np.all(margins(self, r, d) >= 0, axis=-1))

    def steady_state(self, r: Given = None, d: Given = None) -> tuple[Array, Array]:
        """Return x_s (n,) and u_s (m,) for the reference r (p,) and disturbance d (d,).

        Where several steady states have ``C x_s = r``, the one with the smallest
        ``x_s'Q x_s + u_s'R u_s``.

        Raises
        ------
        ValueError
            If it lies beyond a bound of x, u or y: the law then rests elsewhere, within the bounds,
            and the stage cost counts from this point all the same.
        """
        constant = _constants(self, r, d)
        if constant.ndim != 1:
            raise ValueError(
                f"r and d make {len(constant)} points, and steady_state takes one: r (p,) and d "
                "(d,)."
            )
        room = margins(self, r, d)
        x = self.units.to_plant(self.steady_states.x @ constant)
        u = self.units.input_to_plant(self.steady_states.u @ constant)
        if np.any(room < 0):
            kinds = [(kind, len(self.limits[kind][0])) for kind in BOUNDED_KINDS]
            entries = [(kind, i) for kind, size in kinds for i in range(size)]
            sides = [f"{kind}[{i}] > {kind}_max[{i}]" for kind, i in entries]
            sides += [f"{kind}[{i}] < {kind}_min[{i}]" for kind, i in entries]
            broken = ", ".join(side for side, left in zip(sides, room, strict=True) if left < 0)
            p = len(self.tracking.C)
            shown = constant + self.theta_ss[self.layout.now]
            is_balanced = self.model.n_inputs > p and "u[" in broken
            raise ValueError(
                f"The reference r = {shown[:p].tolist()} with d = {shown[p:].tolist()} is not "
                f"reachable: its steady state is x_s = {x.tolist()}, u_s = {u.tolist()}, and "
                f"{broken}. Ask is_reachable(r, d) first, or choose a reference nearer to the "
                "operating point."
                + " Another balance of the inputs may reach it: R sets it, and R = 0 with "
                "RateLimits(R_du=) leaves it to the law." * is_balanced
            )
        return x, u

    @cached_property
    def error_system(self) -> ErrorSystem:
        """The coordinates about the steady state in which the cost is quadratic."""
        weights = self.Q, self.R, self.rate.R_du
        return error_system(self.model, self.layout, self.steady_states, self.prediction, weights)

    @property
    def stage_matrix(self) -> Array:
        """W (n_theta + m, n_theta + m): ``[theta; u]' W [theta; u]`` is the cost of deviations.

        What a price costs comes on top: :attr:`stage_slope`.
        """
        return self.error_system.stage_matrix

    @cached_property
    def stage_slope(self) -> Array:
        """The price (n_theta + m,) of theta and u: ``[theta; u]' slope`` and price.constant."""
        found = np.zeros(self.n_theta + self.model.n_inputs)
        found[self.layout.state] = self.price.x
        found[self.n_theta :] = self.price.u
        return found

    def __hash__(self) -> int:
        return hash((self.model, self.horizon, self.Q.tobytes(), self.R.tobytes()))

    def __repr__(self) -> str:
        sizes = f"states={self.model.n_states}, inputs={self.model.n_inputs}"
        options = f"horizon={self.horizon}, gamma={self.gamma:g}, infeasible={self.infeasible!r}"
        if self.control_horizon is not None:
            options += f", control_horizon={self.control_horizon}"
        limits = self.limits
        r = self.tracking.r_min, self.tracking.r_max
        d = self.disturbances.d_min, self.disturbances.d_max
        bounds = {"x": limits["x"], "u": limits["u"], "r": r, "d": d, **limits}
        shown = [
            f"{name}_{end}=[{', '.join(f'{value:.4g}' for value in values)}]"
            for name, sides in bounds.items()
            for end, values in zip(("min", "max"), sides, strict=True)
            if np.any(np.isfinite(values))
        ]
        if self.layout.bounds:
            shown.append(f"parametric_bounds={[*self.layout.bounds]}")
        return f"{type(self).__name__}({', '.join([sizes, options, *shown])})"


BOUNDED_KINDS = "x", "u", "y", "mixed"


def margins(problem: MPCProblem, r: Given, d: Given, thetas: Array | None = None) -> Array:
    """Return the room to the upper, then the lower bounds of x, u, y and mixed ones, at thetas."""
    tolerance = 1e-9  # relative to a bound: a steady state so little beyond counts as within
    constant = _constants(problem, r, d)
    x = constant @ problem.steady_states.x.T
    u = constant @ problem.steady_states.u.T
    own = problem.deviations
    below: list[Array] = []
    above: list[Array] = []
    for kind in BOUNDED_KINDS:
        rows = own.bounded[kind].rows
        value = x @ rows[:, own.layout.state].T + u @ rows[:, own.n_theta :].T
        low, high = own.limits[kind] if thetas is None else own.limits_at(kind, thetas)
        below.append(high - value + tolerance * np.where(np.isfinite(high), np.abs(high), 0.0))
        above.append(value - low + tolerance * np.where(np.isfinite(low), np.abs(low), 0.0))
    return np.concatenate([*below, *above], axis=-1)


def _constants(problem: MPCProblem, r: Given, d: Given) -> Array:
    """Return [r; d] in deviations, of shape (p + d,) or (batch, p + d)."""
    p = len(problem.tracking.C)
    n_d = problem.model.n_disturbances
    rests = np.split(problem.theta_ss[problem.layout.now], [p])
    parts = []
    for name, value, size, rest in zip("rd", (r, d), (p, n_d), rests, strict=True):
        array = to_float(name, rest if value is None else value)
        shape: tuple[int | str, ...] = ("batch", size) if array.ndim == 2 else (size,)
        parts.append(check_array(name, array, shape) - rest)
    rows = np.broadcast_shapes(parts[0].shape[:-1], parts[1].shape[:-1])
    return np.concatenate([np.broadcast_to(a, (*rows, a.shape[-1])) for a in parts], axis=-1)


class Value(NamedTuple):
    """``theta' P theta + slope' theta + constant``, of theta in deviations."""

    P: Array
    slope: Array
    constant: float

    def at(self, theta: Array) -> Array:
        """Return it at theta (..., n_theta)."""
        return np.asarray(np.sum((theta @ self.P + self.slope) * theta, axis=-1) + self.constant)

    @property
    def form(self) -> Array:
        """The matrix of the same as a form of ``[theta; 1]``."""
        half = self.slope[:, None] / 2
        return np.block([[self.P, half], [half.T, np.full((1, 1), self.constant)]])


def value(problem: MPCProblem, law: Law, gamma: float) -> Value:
    """Return what :meth:`LinearMPC.value_terms` does; without a price it is solved for in z."""
    if problem.price.counts:
        return _priced_value(problem, law, gamma)
    errors = problem.error_system
    K = gain_at_rest(problem, law)
    P = lqr.policy_value(errors.model, errors.Q, errors.R, K, gamma, errors.cross)
    P = np.asarray(errors.to_error.T @ P @ errors.to_error)
    return Value(P, np.zeros(len(P)), 0.0)


def _priced_value(problem: MPCProblem, law: Law, gamma: float) -> Value:
    """Return the value of the affine law at the point where the model rests under it.

    That point is reached from the operating point, with r and d at zero.
    """
    rest_steps = 100_000  # a law that does not rest by then is given up
    if gamma >= 1:
        raise ValueError(
            "With a price the law pays at rest too: its cost for good is infinite without a "
            "discount. Pass a gamma below 1."
        )
    A, B = problem.prediction
    theta = problem.theta_rest
    for _ in range(rest_steps):
        u = law(theta)
        before = theta
        theta = A @ theta + B @ u
        if np.all(np.abs(theta - before) <= 1e-13 * problem.theta_half):
            break
    else:
        raise ValueError(
            f"The law comes to no rest in {rest_steps} steps from the operating point, so that "
            "no quadratic form is its value there. Lengthen the horizon, or give states and "
            "inputs weights."
        )
    K = law.gain(theta)
    held = law(theta) - K @ theta
    # On [theta; 1]: a price is a quadratic form of it.
    n = problem.n_theta
    one = np.ones((1, 1))
    stage = Value(problem.stage_matrix, problem.stage_slope, problem.price.constant).form
    play = np.block([[np.eye(n), np.zeros((n, 1))], [K, held[:, None]], [np.zeros((1, n)), one]])
    closed = linalg.block_diag(A + B @ K, one)
    closed[:n, n] = B @ held
    own = play.T @ stage @ play
    still = np.zeros((n + 1, 1))
    P = lqr.policy_value(LinearModel(closed, still, problem.model.dt), own, one, still.T, gamma)
    return Value(P[:n, :n], 2 * P[:n, n], float(P[n, n]))


def gain_at_rest(problem: MPCProblem, law: Law) -> Array:
    """Return K (m, n_z) with ``v = -K z`` near rest, where the law must rest."""
    errors = problem.error_system
    rest = problem.theta_rest
    unit = 2 * problem.u_half
    if not law.in_domain(rest) or np.any(np.abs(law(rest)) > 1e-9 * unit):
        beyond = (problem.theta_min > 0) | (problem.theta_max < 0)
        names = ", ".join(name for name, out in zip(problem.labels(), beyond, strict=True) if out)
        raise ValueError(
            "The law does not rest at the operating point: x_ss and u_ss must keep all bounds. "
            "Choose an operating point inside the bounds, and inside the box of theta"
            f"{f', whose range of {names} leaves it out' * bool(names)}."
        )
    gains = law.gain(rest)
    K = -gains @ errors.to_theta
    box = np.maximum(np.abs(problem.theta_min), np.abs(problem.theta_max))
    if np.any(np.abs(gains - (errors.to_input - K @ errors.to_error)) @ box > 1e-6 * unit):
        raise ValueError(
            "The law does not rest at the steady states near theta = 0: a constraint acts there. "
            "Choose an operating point inside the bounds."
        )
    return K
