"""Linear models from equations and from simulators."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, as_array, as_positive, as_positive_vector, to_float
from sb3_yann.control.linear_system import LinearSystem, names, zero_order_hold
from sb3_yann.control.linearization.connect import connect
from sb3_yann.control.linearization.finite_differences import Jacobian, NotSmoothError, jacobian
from sb3_yann.control.linearization.simulator import Simulator, borrow, sample_time, to_vector
from sb3_yann.control.linearization.steady_state import require_steady_state, steady_state

if TYPE_CHECKING:
    from sb3_yann.control.linearization.simulator import Maker

LONGEST = 0.01  # longest step of a difference, relative to the scale of its coordinate
LONGEST_SINGLE = 0.05  # the same where states are read in float32
STEADY = 1e-3  # largest motion of a steady state in one sample, relative to its scale
MOVES = 0.01  # the same relative to its own size: beyond it, a state smaller than 1 gets a warning
SHORTER = 64.0  # factor by which steps shrink where a function has no value next to the point


def linearize_dynamics(
    f: Callable[..., ArrayLike],
    x_ss: ArrayLike,
    u_ss: ArrayLike,
    dt: float,
    d_ss: ArrayLike | None,
    scale: ArrayLike | None = None,
) -> LinearSystem:
    """Return the sampled linearization of `LinearModel.from_dynamics`.

    Parameters
    ----------
    f, dt : callable, and float
        Returns dx/dt (n,) for x and u, with ``d_ss`` also d; the sampling time.
    x_ss, u_ss, d_ss, scale : array_like, shapes (n,), (m,), (d,), and (n,) or (n + m + d,)
        A steady state of f, and the range of each entry. d_ss and scale may be None.
    """
    x, u = as_array("x_ss", x_ss, ("n",)), as_array("u_ss", u_ss, ("m",))
    d = as_array("d_ss", [] if d_ss is None else d_ss, ("d",))
    dt = as_positive("dt", dt)
    given = {"x": x, "u": u} if d_ss is None else {"x": x, "u": u, "d": d}
    sizes = (x.size, u.size, d.size)
    if not callable(f):
        raise TypeError(f"f = {f!r} must be a function ({', '.join(given)}) -> dx/dt.")

    def rate(point: Array) -> Array:
        parts = np.split(point, np.cumsum(sizes[:2]))
        return np.asarray(f(*parts[: len(given)]), dtype=np.float64)

    called = f"f({', '.join(f'{name}_ss' for name in given)})"
    point = np.concatenate([x, u, d])
    size = _dynamics_scale(point, x.size, scale)
    moved = dt * np.abs(as_array(called, f(*given.values()), (x.size,)))
    _require_steady_dynamics(given, moved, size, dt, scale is not None)
    rounding = np.finfo(float).eps * np.maximum(np.abs(x), size[: x.size]) / dt
    labels = names(sizes)
    found = _differences(rate, point, LONGEST * size, rounding, labels)
    A, B, E = np.split(found.value, np.cumsum(sizes[:2]), axis=1)
    A, B, E = zero_order_hold(A, B, E, dt)
    notes = (*_idle_inputs(B, 4), *_curvature(found, labels))
    return LinearSystem(A, B, dt, x, u, E, d, notes)


def _require_steady_dynamics(
    given: dict[str, Array], moved: Array, size: Array, dt: float, scaled: bool
) -> None:
    """Raise if the operating point moves too far in one sample; warn if that is not certain."""
    x = given["x"]
    if np.any(moved > STEADY * size[: x.size]):
        point = ", ".join(f"{name}_ss = {value.tolist()}" for name, value in given.items())
        raise ValueError(
            f"{point} is no steady state: in one sample of {dt:g} the state moves by "
            f"{moved.tolist()}, with a scale of {size[: x.size].tolist()}. Solve "
            f"f({', '.join(given)}) = 0 first, e.g. with scipy.optimize.root."
        )
    if not scaled and np.any((moved > MOVES * np.abs(x)) & (x != 0) & (moved > 1e-8)):
        warnings.warn(
            f"In one sample of {dt:g} the steady state x_ss = {x.tolist()} moves by "
            f"{moved.tolist()}, much beside itself. Pass scale=..., how far each state moves.",
            stacklevel=4,
        )


def _dynamics_scale(point: Array, n: int, scale: ArrayLike | None) -> Array:
    """Return the scale of each state, input and disturbance, completed by their sizes."""
    size: Array = np.maximum(np.abs(point), 1.0)
    if scale is None:
        return size
    k = point.size if np.shape(scale) == point.shape else n
    size[:k] = as_positive_vector("scale", scale, k)
    return size


def linearize_env(
    env: Maker,
    state: ArrayLike | None,
    action: ArrayLike | None,
    dt: float | None,
    set_state: Callable[[Any, Array], object] | None,
    get_state: Callable[[Any], ArrayLike] | None,
    scale: ArrayLike | None,
) -> LinearSystem:
    """Return the linearized step of `LinearModel.from_env`, which documents what None stands for.

    Parameters
    ----------
    env, dt, set_state, get_state : Maker, float or None, callable or None
        The simulator, the time of one step, and what sets and returns the state (n,).
    state, action, scale : array_like, shapes (n,), (m,) and (n,), or None
        The operating point, NaN where it is to be solved for, and the range of each state.
    """
    with contextlib.closing(borrow(env)) as borrowed:
        step_time = sample_time(borrowed.env, dt)
        simulator = Simulator(borrowed, set_state, get_state)
        x, u = _partly_known("state", state), _partly_known("action", action)
        return _linearize(simulator, x, u, step_time, scale)


def _linearize(
    simulator: Simulator, x: Array | None, u: Array | None, dt: float, scale: ArrayLike | None
) -> LinearSystem:
    """Connect to the simulator, find its steady state, and take the differences there."""
    middle, width = _actions(simulator.env.action_space)
    if u is None:
        # With a state to hold, the action is what holds it; with none, that at mid range.
        u = middle if x is None else np.full(middle.size, np.nan)
    elif u.shape != middle.shape:
        raise ValueError(f"action has shape {u.shape}, expected {middle.shape}.")
    u_start = np.where(np.isnan(u), middle, u)
    x_start, size = connect(simulator, x, u_start, scale)
    scales = np.concatenate([size, width])
    n = size.size
    free = np.isnan(np.concatenate([np.full(n, np.nan) if x is None else x, u]))
    point = steady_state(simulator, np.concatenate([x_start, u_start]), free, scales)
    found = _differentiate(simulator, point, scales)
    if not np.any(free):
        require_steady_state(simulator, point, found.value, scales)
    A, B = found.value[:, :n], found.value[:, n:]
    notes = (
        *_idle_inputs(B, 5),
        "Linearized by central differences over one step. The state was set by "
        f"{simulator.setter} and read from {simulator.reader}.",
        f"Of the {free.size} entries of the operating point, {np.count_nonzero(free)} were solved "
        "for and the others given or taken from the middle of the action space.",
        *_remarks(simulator, point),
        *_curvature(found, names((n, u.size))),
        f"The simulator was {simulator.origin}.",
    )
    return LinearSystem(A, B, dt, point[:n], point[n:], np.zeros((n, 0)), np.zeros(0), notes)


def _actions(space: Any) -> tuple[Array, Array]:
    """Return the middle of a Box of actions and half its width; 0 and 1 where it is unbounded."""
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    bounded = (low > -1e6) & (high < 1e6)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    return (low + high) / 2, (high - low) / 2


def _partly_known(name: str, value: ArrayLike | None) -> Array | None:
    """Return ``value`` as an array of shape (n,) in which NaN stands for unknown entries."""
    if value is None:
        return None
    array = to_float(name, value)
    if array.ndim != 1 or np.any(np.isinf(array)):
        raise ValueError(f"{name} = {value!r} must be a vector of finite numbers, or NaN to solve.")
    return array


def _differentiate(simulator: Simulator, point: Array, scale: Array) -> Jacobian:
    """Return the Jacobian (n, n+m) of the next state with respect to state and action."""
    space = simulator.env.action_space
    n = scale.size - space.shape[0]
    room = np.minimum(point[n:] - space.low, space.high - point[n:]).astype(np.float64)
    if np.any(room <= 1e-6 * scale[n:]):
        i = int(np.argmin(room / scale[n:]))
        raise ValueError(
            f"action = {point[n:].tolist()}: entry {i} lies on its bound in {space}, where the "
            "plant cannot be linearized. Choose an operating point with room to both sides."
        )

    def step(point: Array) -> Array:
        return simulator.next_state(point[:n], point[n:])

    def actual(point: Array) -> Array:
        return np.concatenate([point[:n], simulator.actual(point[n:])])

    # What is read may be float32: then every number read is one, and steps have to be longer.
    readings = [step(point), step(point + LONGEST / 3 * scale * (np.arange(scale.size) < n))]
    single = all(np.array_equal(r, r.astype(np.float32), equal_nan=True) for r in readings)
    longest = (LONGEST_SINGLE if single else LONGEST) * scale
    spacing = np.finfo(np.float32 if single else np.float64).eps
    rounding = spacing * np.maximum(np.abs(readings[0]), longest[:n])
    longest[n:] = np.minimum(longest[n:], room)
    return _differences(step, point, longest, rounding, names((n, room.size)), actual)


def _differences(
    f: Callable[[Array], Array],
    point: Array,
    steps: Array,
    rounding: Array,
    labels: list[str],
    actual: Callable[[Array], Array] = lambda z: z,
) -> Jacobian:
    """Return the Jacobian; name the coordinate where there is none."""
    shortest, steps = steps / SHORTER**2, steps.copy()
    while True:
        try:
            return jacobian(f, point, steps, rounding, actual)
        except NotSmoothError as error:
            i, reason = error.column, str(error)
            if not error.no_value or steps[i] <= shortest[i]:
                break
            steps[i] /= SHORTER
    raise ValueError(
        f"The plant cannot be linearized at {point.tolist()}: along {labels[i]}, {reason}, with "
        f"steps up to {steps[i]:.3g}. Clipping, dry friction, angles that wrap and too long steps "
        "do this: pass scale=..., move the operating point, or use LinearModel.from_data."
    )


def _idle_inputs(B: Array, stacklevel: int) -> list[str]:
    """Return a note on inputs without effect, and warn of them."""
    idle = np.flatnonzero(~np.any(B, axis=0))
    if not idle.size:
        return []
    note = (
        f"{', '.join(f'u[{i}]' for i in idle)} has no effect on the next state. With a delay or an "
        "actuator, make the inputs on their way part of the state; leave out an idle input."
    )
    warnings.warn(note, stacklevel=stacklevel)
    return [note]


def _remarks(simulator: Simulator, point: Array) -> list[str]:
    """Return notes on the end of the episode and on the observation."""
    n = point.size - simulator.env.action_space.shape[0]
    simulator.next_state(point[:n], point[n:])
    remarks = []
    if simulator.ended:
        remarks.append("The environment terminates the episode at the operating point.")
    seen: Any = to_vector(simulator.observation)
    state: Any = simulator.read()
    if np.shape(seen) != np.shape(state) or not np.allclose(seen, state, rtol=1e-5, atol=1e-5):
        hint = "A policy needs a wrapper that makes it so."
        remarks.append(f"The observation is not this state. {hint}")
    return remarks


def _curvature(found: Jacobian, labels: list[str]) -> list[str]:
    """Return notes on dropped entries, strong nonlinearity, and what has no effect."""
    notes = []
    if found.dropped > 0:
        notes.append(
            f"Derivatives that are not above their rounding error (at most {found.dropped:.1e}) "
            "were set to zero."
        )
    for i, change in enumerate(found.change):
        if not change <= 0.1:
            what = "it has no value there" if np.isnan(change) else f"slopes differ by {change:.0%}"
            notes.append(
                f"The plant is not smooth within {found.steps[i]:.3g} of the operating point "
                f"along {labels[i]}: {what}."
            )
        elif not np.any(found.value[:, i]) and not labels[i].startswith("u"):
            notes.append(f"{labels[i]} has no effect on the next state.")
    return notes
