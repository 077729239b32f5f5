"""Linear models of equations and of simulators: the operating point, then differences about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import (
    Array,
    Mask,
    check_array,
    check_positive,
    check_positive_vector,
    to_float,
    warn,
)
from sb3_yann.control.linear_system import LinearSystem, names, zero_order_hold
from sb3_yann.control.lqr import unreached
from sb3_yann.control.simulator import (
    MAX_NOISE,
    Simulator,
    borrow,
    connect,
    noise_of,
    sample_time,
    to_vector,
)

if TYPE_CHECKING:
    from sb3_yann.control.simulator import Maker

Rate = Callable[[Array], Array]  # dx/dt (n,), or how far the state moves, at [x, u, d]


@dataclass(frozen=True, eq=False)
class Jacobian:
    """A Jacobian (r, c), and what its differences showed.

    It is exactly zero where not above its own error; ``dropped`` is the largest entry set to zero.
    ``change`` (c,) are errors of the longest ``steps`` (c,), relative to the column, NaN without a
    value. ``doubt`` is the largest error left: how far two step sizes agree.
    """

    value: Array
    dropped: float
    steps: Array
    change: Array
    doubt: float


def jacobian(
    f: Callable[[Array], Array],
    point: Array,
    steps: Array,
    noise: Array,
    labels: list[str],
    actual: Callable[[Array], Array] = lambda z: z,
) -> Jacobian:
    """Return the derivatives of f, from points (c,) to values (r,), by Richardson extrapolation.

    Each entry takes the extrapolation that agrees best with its neighbor over shorter steps:
    Ridders (1982), *Advances in Engineering Software* 4, 75-76. ``steps`` (c,) are the longest;
    those at whose ends f has no value, NaN, are left out. ``noise`` (r,) is the error of each
    value, and ``actual`` the point at which f is evaluated for a given one, e.g. its float32
    rounding. ValueError where f has a kink or a jump at the point, or no value next to it.
    """
    begin = actual(point)
    center = f(begin)
    columns = []
    for i, label in enumerate(labels):
        found = _column(f, center, begin, i, steps[i], noise, actual)
        if isinstance(found, str):
            raise ValueError(
                f"The plant cannot be linearized at {point.tolist()}: along {label}, {found}, with "
                f"steps up to {steps[i]:.3g}. Clipping, dry friction, angles that wrap and too "
                "long steps do this: pass scale=..., move the operating point, or use "
                "LinearModel.from_data."
            )
        columns.append(found)
    value, error, change = (np.array(part) for part in zip(*columns, strict=True))
    lost = np.abs(value) <= error
    dropped = float(np.max(np.abs(value[lost]), initial=0.0))
    largest = np.max(np.abs(value), axis=1)
    doubt = np.max(np.max(error, axis=1) / np.where(largest > 0, largest, np.inf), initial=0.0)
    return Jacobian(np.where(lost, 0.0, value).T, dropped, steps, change, float(doubt))


def _column(
    f: Callable[[Array], Array],
    center: Array,
    point: Array,
    i: int,
    longest: float,
    noise: Array,
    actual: Callable[[Array], Array],
) -> tuple[Array, Array, float] | str:
    """Return derivatives by coordinate i, their errors and the change; or why there are none."""
    ratio = 4.0  # how much shorter each step is than the one before
    levels = 6  # steps that approach a point
    sides: list[Array] = []
    widths = []
    for level in range(2 * levels):
        offset = np.zeros(point.size)
        offset[i] = longest / ratio**level
        above = actual(point + offset)
        below = actual(point - offset)
        up = above[i] - point[i]
        down = point[i] - below[i]
        if up <= 0 or down <= 0 or len(sides) == levels:
            break  # the step is lost in the rounding of the point
        slopes = np.array([(f(above) - center) / up, (center - f(below)) / down])
        if np.all(np.isfinite(slopes)):
            sides.append(slopes)
            widths.append(up + down)
    if len(sides) < 3:
        return "it has no finite value on one of its sides"
    one, other = np.swapaxes(sides, 0, 1)
    span = np.array(widths)[:, None]
    slope = (one + other) / 2
    # Unequal sides (a point that is rounded) would leave a first-order error in the mean.
    value, error = _extrapolated(slope, ratio**2, 2 * noise / span)
    kink, doubt = _extrapolated(one - other, ratio, 4 * noise / span)
    scale = np.max(np.abs(value))
    steepest = np.max(np.abs(value) + np.abs(kink) / 2)
    if np.any((np.abs(kink) > 5 * doubt) & (np.abs(kink) > 0.01 * steepest)):
        return "its slopes to the two sides differ (a kink)"
    # 100.0: effects below so many times the noise are none. Hundreds of operations of an integrator
    # round ten times as much as one does, and a plant that forgets a state within a sample shows
    # only that.
    if np.max(error) > max(0.2 * scale, 100.0 * np.max(2 * noise / span[0])):
        return "its slope has no limit for short steps (a jump or noise)"
    change = np.max(np.abs(slope[0] - value)) / scale if scale > 0 else 0.0
    return value, error, float(change) if widths[0] > longest else np.nan


def _extrapolated(levels: Array, power: float, rounding: Array) -> tuple[Array, Array]:
    """Return the limits of the levels (k, r), whose errors fall by `power`, and their errors."""
    limits = (power * levels[1:] - levels[:-1]) / (power - 1)
    errors = np.abs(np.diff(limits, axis=0)) + 2 * rounding[1:-1]
    best = np.argmin(errors, axis=0)
    rows = np.arange(levels.shape[1])
    return limits[best, rows], errors[best, rows]


def notes_of(found: Jacobian, labels: list[str], of: str = "the next state") -> list[str]:
    """Return notes on what has no effect on values, dropped entries and strong nonlinearity.

    An input without effect is warned of as well.
    """
    notes = []
    idle = ~np.any(found.value, axis=0)
    if inputs := ", ".join(labels[i] for i in np.flatnonzero(idle) if labels[i][0] == "u"):
        notes.append(
            f"{inputs} has no effect on {of}. With a delay or an actuator, make the "
            "inputs on their way part of the state; leave out an idle input."
        )
        warn(notes[0])
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
        elif idle[i] and labels[i][0] != "u":
            notes.append(f"{labels[i]} has no effect on {of}.")
    return notes


def _partly_known(name: str, value: ArrayLike) -> Array:
    """Return a vector in which NaN stands for what is to be solved for."""
    array = to_float(name, value)
    if array.ndim != 1 or not array.size or np.any(np.isinf(array)):
        raise ValueError(
            f"{name} has shape {array.shape} and the entries {array.tolist()}; expected a vector "
            "of finite numbers, or NaN where the steady state is to be solved for; one at least."
        )
    return array


def _slopes(f: Callable[[Array], Array], point: Array, steps: Array) -> Array:
    """Return plain central differences (r, c) of f, over steps (c,)."""
    return np.array([(f(point + h) - f(point - h)) / (2 * h.max()) for h in np.diag(steps)]).T


XTOL = 1e-12  # in scales, of what is solved for; what is smaller is zero


def _least_moved(
    motion: Rate,
    start: Array,
    free: Mask,
    scale: Array,
    step: float,
    bounds: tuple[ArrayLike, ArrayLike] = (-np.inf, np.inf),
) -> tuple[Array, float]:
    """Return the point that moves least, its free entries changed, and its motion in scales.

    The search takes slopes over a ``step``, in scales, and turns back where there is no value.
    """
    from scipy.optimize import least_squares

    def at(z: Array) -> Array:
        point = start.copy()
        point[free] = z * scale[free]
        return point

    def finite(z: Array) -> Array:
        return np.asarray(np.nan_to_num(motion(at(z)), nan=1e3, posinf=1e3, neginf=-1e3))

    found = least_squares(
        finite,
        start[free] / scale[free],
        jac=lambda z: _slopes(finite, z, np.full(z.size, step)),
        bounds=[np.broadcast_to(side, start.shape)[free] / scale[free] for side in bounds],
        xtol=XTOL,
        ftol=1e-15,
        gtol=1e-15,
    )
    z = np.where(np.abs(found.x) <= XTOL, 0.0, found.x)
    return at(z), float(np.max(np.abs(found.fun)))


def _steady_state(
    simulator: Simulator, motion: Rate, start: Array, free: Mask, scale: Array
) -> Array:
    """Return the steady state and its action, shape (n+m,), with the free entries solved for.

    ``motion`` is that of the state in one step, in scales. ``start`` (n+m,) holds the known
    entries, and a guess for the free ones.
    """
    steady_residual = 1e-6  # largest residual of a steady state that was solved for
    n = scale.size - simulator.space.shape[0]
    low = np.append(np.full(n, -np.inf), simulator.space.low)
    high = np.append(np.full(n, np.inf), simulator.space.high)

    def search(start: Array) -> tuple[Array, float]:
        # Steps of 1e-3 scales: SciPy's own would vanish in the rounding of a float32 state.
        return _least_moved(motion, start, free, scale, 1e-3, (low, high))

    point, most = search(start)
    if most > steady_residual and np.all(free[:n]) and not np.any(free[n:]):
        # A search may run away from where the plant comes to rest by itself.
        settled = start.copy()
        for _ in range(2_000):  # steps in which a plant may come to rest by itself
            left = motion(settled)
            if not steady_residual < np.max(np.abs(left)) < np.inf:
                break
            settled[:n] += left * scale[:n]
        other = search(settled)
        if other[1] <= steady_residual:
            point, most = other
    if most > steady_residual:
        left = motion(point)  # which may be no more than the simulator's own error
        noise = noise_of(simulator.step, point, np.where(np.arange(scale.size) < n, scale, 0.0))
        noise /= scale[:n]
        if not (np.all(np.abs(left) <= steady_residual + 5 * noise) and np.all(noise <= MAX_NOISE)):
            at_bound = [
                f"u[{i - n}] is at its {side} bound, {bound[i]:g}"
                for side, bound in (("lower", low), ("upper", high))
                for i in np.flatnonzero(np.abs(point - bound) <= 1e-6 * scale)
            ]
            stuck = f" {', '.join(at_bound)}: the inputs do not hold it." if at_bound else ""
            moves = simulator.refusal if np.any(np.isnan(left)) else (left * scale[:n]).tolist()
            raise ValueError(
                f"No steady state was found. The best is x_ss = {point[:n].tolist()}, u_ss = "
                f"{point[n:].tolist()}, which moves in one step by {moves}.{stuck} Leave more "
                "entries free (NaN), or start closer to it."
            )
    # 1e-9: a solved entry that is smaller, relative to its scale, is zero
    return np.where(free & (np.abs(point) <= 1e-9 * scale), 0.0, point)


def _require_steady_state(moved: Array, point: Array, slopes: Array, scale: Array) -> None:
    """Raise ValueError if a given operating point is far from the linear model's steady states.

    How far it moves in one step (n,), in scales, says little: in a short sample a plant hardly
    moves from anywhere. The ``slopes`` (n, n+m) are those of the next state at the point (n+m,).
    """
    n = moved.size
    slopes = (slopes - np.eye(n, point.size)) * scale / scale[:n, None]
    way = np.linalg.lstsq(slopes, -moved, rcond=1e-9)[0]
    left = moved + slopes @ way
    # 1e-3: largest residual of a given steady state in one step, relative to the scale
    # 1e-2: largest distance to the linear model's steady state, relative to the scale
    if np.max(np.abs(way)) > 1e-2 or np.max(np.abs(left)) > 1e-3:
        raise ValueError(
            f"x_ss = {point[:n].tolist()}, u_ss = {point[n:].tolist()} is no steady state: one "
            f"step moves it by {(moved * scale[:n]).tolist()}. Set entries to NaN to be solved for."
        )


def _time_limit_fault(env: Any, action: Array) -> str:
    """Return that every episode terminates after the same number of steps, empty if it does not.

    The env is reset and stepped with an action (m,) and another one; pass a copy.
    """
    space = env.action_space
    other = action + 0.25 * np.minimum(space.high - space.low, 4.0)
    try:
        steps = _termination(env, 0, action)
        if steps < 2 or steps != _termination(env, 1, np.clip(other, space.low, space.high)):
            return ""
    except Exception:  # whatever a simulator raises away from its operating point
        return ""
    return (
        f"Episodes terminate after {steps} steps whatever happens: that is a time limit, but "
        "terminated=True means to the learner that nothing costs anything afterwards. Return "
        "truncated=True there, or wrap the environment in "
        f"sb3_yann.wrappers.TruncateAtTimeLimit(env, {steps})."
    )


def _termination(env: Any, seed: int, action: Array) -> int:
    """Return after how many steps an episode terminates, 0 if it does not or is cut before."""
    env.reset(seed=seed)
    begun = perf_counter()
    for step in range(1, 401):  # a longer episode counts as one without an end of its own
        _, _, terminated, truncated, _ = env.step(action.astype(env.action_space.dtype))
        if terminated or truncated or perf_counter() - begun > 1.0:  # a slow one
            return step if terminated else 0
    return 0


LONGEST_STEP = 0.01  # longest step of a difference, relative to the scale of its coordinate


def linearize_env(
    env: Maker,
    x_ss: ArrayLike | None,
    u_ss: ArrayLike | None,
    dt: float | None,
    set_state: Callable[[Any, Array], object] | None,
    get_state: Callable[[Any], ArrayLike] | None,
    scale: ArrayLike | None,
) -> LinearSystem:
    """Return the linearized step of `LinearModel.from_env`, which says what None stands for."""
    with borrow(env) as borrowed:
        step_time = sample_time(borrowed.env, dt)
        simulator = Simulator(borrowed, set_state, get_state)
        x = None if x_ss is None else _partly_known("x_ss", x_ss)
        u = None if u_ss is None else _partly_known("u_ss", u_ss)
        found = _linearize(simulator, x, u, step_time, scale)
        moves = np.linalg.svd(found.A - np.eye(len(found.A)), compute_uv=False)
        if x is None and moves[-1] <= 1e-6 * moves[0]:
            warn(
                f"The plant rests at other states too: x_ss = {found.x_ss.tolist()} is where a "
                "reset led. Pass the state to hold, x_ss=[...]."
            )
        fault = _time_limit_fault(borrowed.env, found.u_ss) if borrowed.private else ""
        if not fault:
            return found
        warn(fault)
        return replace(found, notes=(*found.notes, fault))


def _linearize(
    simulator: Simulator, x: Array | None, u: Array | None, dt: float, scale: ArrayLike | None
) -> LinearSystem:
    """Connect to the simulator, find its steady state, and take the differences there."""
    space = simulator.space
    bounded = (space.low > -1e6) & (space.high < 1e6)
    low = np.where(bounded, space.low, -1.0)
    high = np.where(bounded, space.high, 1.0)
    middle = (low + high) / 2
    if u is None:
        # With a state to hold, the action is what holds it; with none, that at mid range.
        u = middle if x is None else np.full(middle.size, np.nan)
    elif u.shape != middle.shape:
        raise ValueError(f"u_ss has shape {u.shape}, expected {middle.shape}.")
    u_start = np.where(np.isnan(u), middle, u)
    x_start, size = connect(simulator, x, u_start, scale)
    n = size.size
    scales = np.concatenate([size, (high - low) / 2])
    free = np.isnan(np.concatenate([np.full(n, np.nan) if x is None else x, u]))
    point = np.concatenate([x_start, u_start])

    def motion(point: Array) -> Array:
        return np.asarray((simulator.step(point) - point[:n]) / size)

    if np.any(free):
        point = _steady_state(simulator, motion, point, free, scales)
    found, noise = _differentiate(simulator, point, scales)
    if not np.any(free):
        _require_steady_state(motion(point), point, found.value, scales)
    A, B = np.split(found.value, [n], axis=1)
    notes = [
        *notes_of(found, names((n, u.size))),
        "Linearized by central differences over one step. The state was set by "
        f"{simulator.setter} and read from {simulator.reader}.",
        f"Of the {free.size} entries of the operating point, {np.count_nonzero(free)} were solved "
        "for and the others given or taken from the middle of the action space.",
    ]
    if noise:
        notes.append(
            f"The simulator's results carry an error of {noise:.1e} of a state's scale, as "
            f"adaptive integrators do: steps went up to {np.max(found.steps):.3g}, and the "
            f"derivatives of two step sizes agree within {found.doubt:.1%}. Tighten its tolerances "
            "for better ones."
        )
    state = simulator.step(point)
    if simulator.ended:
        notes.append("The environment terminates the episode at the operating point.")
    seen = to_vector(simulator.observation)
    if seen is None or seen.shape != state.shape or not np.allclose(seen, state, 1e-5, 1e-5):
        notes.append(
            "The observation is not this state. A policy needs a wrapper that makes it so."
        )
    notes.append(f"The simulator was {simulator.origin}.")
    none = np.zeros((n, 0))
    return LinearSystem(A, B, dt, point[:n], point[n:], none, np.zeros(0), tuple(notes))


def _differentiate(simulator: Simulator, point: Array, scale: Array) -> tuple[Jacobian, float]:
    """Return the Jacobian (n, n+m) of the next state, and the simulator's noise in scales."""
    space = simulator.space
    n = scale.size - space.shape[0]
    room = np.minimum(point[n:] - space.low, space.high - point[n:]).astype(np.float64)
    if np.any(room <= 1e-6 * scale[n:]):
        i = int(np.argmin(room / scale[n:]))
        raise ValueError(
            f"u_ss = {point[n:].tolist()}: entry {i} lies on its bound in {space}, where the "
            "plant cannot be linearized. Choose an operating point with room to both sides."
        )

    def actual(point: Array) -> Array:
        return np.concatenate([point[:n], simulator.actual(point[n:])])

    # What is read may be float32: then every number read is one, and steps have to be longer.
    of_states = np.where(np.arange(scale.size) < n, scale, 0.0)
    readings = np.array([simulator.step(point + k * LONGEST_STEP / 3 * of_states) for k in (0, 1)])
    single = np.array_equal(readings, readings.astype(np.float32), equal_nan=True)
    # Longer steps where states are read in float32.
    longest = (0.05 if single else LONGEST_STEP) * scale
    spacing = np.finfo(np.float32 if single else np.float64).eps
    rounding = spacing * np.maximum(np.abs(readings[0]), longest[:n])
    noise = noise_of(lambda z: simulator.step(actual(z)), point, of_states)
    # Noise counts from ten times the rounding on, and from 1e-10 of the scales.
    noise[noise <= np.maximum(10.0 * rounding, 1e-10 * scale[:n])] = 0.0
    if np.any(noise > MAX_NOISE * scale[:n]):
        noise[:] = 0.0  # no noise that differences could cope with
    rough = float(np.max(noise / scale[:n]))
    # Longer ones where an adaptive integrator leaves noise.
    longest = np.maximum(longest, np.minimum(1e6 * rough, 0.2) * scale)
    longest[n:] = np.minimum(longest[n:], room)
    labels = names((n, room.size))
    error = np.maximum(rounding, noise)
    return jacobian(simulator.step, point, longest, error, labels, actual), rough


STEADY = 1e-3  # largest motion of a steady state in one sample, relative to its scale
STARTS = (0.0, 1.0, -1.0, 0.1, 10.0, 100.0)
"""Scales of the free entries from which the steady state is sought, in turn."""


def linearize_dynamics(
    f: Callable[..., ArrayLike],
    x_ss: ArrayLike,
    u_ss: ArrayLike,
    dt: float,
    d_ss: ArrayLike | None,
    scale: ArrayLike | None = None,
) -> LinearSystem:
    """Return the sampled linearization of `LinearModel.from_dynamics`, which documents the rest."""
    x = _partly_known("x_ss", x_ss)
    u = _partly_known("u_ss", u_ss)
    d = check_array("d_ss", [] if d_ss is None else d_ss, ("d",))
    dt = check_positive("dt", dt)
    labels = ["x", "u"] if d_ss is None else ["x", "u", "d"]
    if not callable(f):
        raise TypeError(f"f = {f!r} must be a function ({', '.join(labels)}) -> dx/dt.")
    sizes = (x.size, u.size, d.size)
    ends = np.cumsum(sizes)[: len(labels) - 1]

    def rate(point: Array) -> Array:
        parts = np.split(point, ends)
        return _vector(slope_of(f, *parts), *parts)

    given = np.concatenate([x, u, d])
    size = _size(given, x.size, scale)
    free = np.isnan(given)
    point, notes = _rest_of(rate, given, size, dt, sizes) if np.any(free) else (given, [])
    size = _size(point, x.size, scale)
    check_array(f"f({', '.join(f'{name}_ss' for name in labels)})", rate(point), (x.size,))
    require_order(f, dt, *np.split(point, ends))
    _require_steady(rate, np.split(point, ends), size[: x.size], dt, scale is not None)
    rounding = np.finfo(float).eps * np.maximum(np.abs(point), size)[: x.size] / dt
    found = jacobian(rate, point, LONGEST_STEP * size, rounding, names(sizes))
    A, B, E = np.split(found.value, np.cumsum(sizes[:2]), axis=1)
    A, B, E = zero_order_hold(A, B, E, dt)
    x, u, d = np.split(point, np.cumsum(sizes[:2]))
    notes += notes_of(found, names(sizes), "any slope")
    return LinearSystem(A, B, dt, x, u, E, d, tuple(notes))


def slope_of(f: Callable[..., ArrayLike], *parts: Array) -> ArrayLike:
    """Return f(x, u[, d]); a TypeError says how f is called where it seems to take others."""
    try:
        return f(*parts)
    except (IndexError, TypeError, ValueError) as error:
        of_shapes = any(word in str(error) for word in ("unpack", "dimension", "shapes"))
        if isinstance(error, ValueError) and not of_shapes:
            raise
        fault = f"f ended in {type(error).__name__} ({error})."
        raise TypeError(f"{fault} {called_as(*parts)}") from error


def called_as(*parts: Array) -> str:
    """Return how f is called, for an error."""
    shapes = [f"{name} {part.shape}" for name, part in zip("xud", parts, strict=False)]
    order = f"f({', '.join('xud'[: len(parts)])}), in this order"
    return f"It is called as {order}, with {', '.join(shapes)}, and returns dx/dt {parts[0].shape}."


def require_order(f: Callable[..., ArrayLike], dt: float, *parts: Array) -> None:
    """Raise TypeError where f(u, x) rests at the operating point, and f(x, u) does not."""
    if len(parts) != 2 or parts[0].shape != parts[1].shape:
        return
    try:
        with np.errstate(all="ignore"):
            moved, other = (dt * np.abs(_vector(f(*at), *at)) for at in (parts, parts[::-1]))
    except Exception:  # whatever f raises where it was not meant to be called
        return
    if np.max(moved) > STEADY * np.max(np.abs(parts)) and np.all(other < STEADY * np.max(moved)):
        raise TypeError(f"f(u, x) rests at the operating point. {called_as(*parts)}")


class _WrongShapeError(ValueError):
    """What f returned is not dx/dt of each state."""


def _vector(value: Any, *parts: Array) -> Array:
    """Return what f returned as a vector (n,): of shape (n,), (n, 1) or (1, n), or a list."""
    size = parts[0].size
    if isinstance(value, (list, tuple)):  # of numbers, and of arrays with one entry
        value = np.concatenate([np.ravel(to_float("f(x, u)", each)) for each in value])
    array = to_float("f(x, u)", value)
    if array.shape not in ((size,), (size, 1), (1, size)):
        raise _WrongShapeError(f"f returned the shape {array.shape}. {called_as(*parts)}")
    return array.reshape(size)


def _rest_of(
    rate: Rate, given: Array, scale: Array, dt: float, sizes: tuple[int, int, int]
) -> tuple[Array, list[str]]:
    """Return the steady state with the free entries solved for, and notes on how sure it is."""
    free = np.isnan(given)
    n = sizes[0]

    def motion(point: Array) -> Array:
        try:
            with np.errstate(all="ignore"):
                return np.asarray(dt * rate(point) / scale[:n])
        except _WrongShapeError:
            raise
        except (ArithmeticError, ValueError):  # math functions raise where numpy's return NaN
            return np.full(n, np.nan)

    found: list[Array] = []
    begun = [np.where(free, start * scale, given) for start in STARTS]
    # Slopes are taken over 1e-6 scales.
    tried = [_least_moved(motion, each, free, scale, 1e-6) for each in begun]
    for point, left in tried:
        # 1e-3: distance, in scales, from which two steady states are different ones
        apart = (np.max(np.abs(point - other) / scale) > 1e-3 for other in found)
        # 1e-8: largest motion in one sample of a steady state that was solved for
        if left <= 1e-8 and all(apart):
            found.append(point)
    if not found:
        best, least = min(tried, key=lambda each: each[1])
        raise ValueError(
            f"No steady state was found. The best is x_ss = {best[:n].tolist()}, the rest "
            f"{best[n:].tolist()}, which moves in one sample by {least:.2g} scales. Leave more "
            "entries free (NaN), give one that you know, or pass scale=..., how far each moves."
        )

    def is_lost(point: Array) -> bool:
        """Tell whether a mode that does not decay is out of reach of the inputs."""
        try:
            slopes = _slopes(rate, point, 1e-4 * _size(point, n, scale[:n]))
            A, B, E = np.split(slopes, np.cumsum(sizes[:2]), axis=1)
            A, B, _ = zero_order_hold(A, B, E, dt)
            return unreached(A, B) is not None
        except (ArithmeticError, ValueError):  # no value next to it
            return True

    # A bioreactor that is washed out is at rest too, and no input brings it back.
    found.sort(key=is_lost)
    solved = np.count_nonzero(free)
    notes = [f"Solved for the steady state: {solved} {'entry' if solved == 1 else 'entries'}."]
    if solved > n:
        notes[0] += f" The equations determine {n}: it is one of many. Give more entries."
        warn(f"{notes[0]} It is x_ss = {found[0][:n].tolist()}, and {found[0][n:].tolist()}.")
    elif len(found) > 1:
        others = "; ".join(str([float(f"{v:.4g}") for v in other]) for other in found[1:])
        notes[0] += f" There are others, {others}: give an entry that separates them."
    return found[0], notes


def _require_steady(rate: Rate, parts: list[Array], size: Array, dt: float, scaled: bool) -> None:
    """Raise if the operating point moves too far in one sample; warn if that is not certain."""
    x = parts[0]
    moved = dt * np.abs(rate(np.concatenate(parts)))
    if np.any(moved > STEADY * size):
        at = ", ".join(f"{k}_ss = {part.tolist()}" for k, part in zip("xud", parts, strict=False))
        raise ValueError(
            f"{at} is no steady state: in one sample of {dt:g} the state moves by "
            f"{moved.tolist()}, with a scale of {size.tolist()}. Set entries to NaN to have them "
            "solved for."
        )
    # A state smaller than 1 that moves by 1 % of its own size gets a warning.
    if not scaled and np.any((moved > 0.01 * np.abs(x)) & (x != 0) & (moved > 1e-8)):
        warn(
            f"In one sample of {dt:g} the steady state x_ss = {x.tolist()} moves by "
            f"{moved.tolist()}, much beside itself. Pass scale=..., how far each state moves."
        )


def _size(point: Array, n: int, scale: ArrayLike | None) -> Array:
    """Return the scale of each state, input and disturbance, completed by their sizes."""
    size: Array = np.maximum(np.nan_to_num(np.abs(point), nan=1.0), 1.0)
    if scale is None:
        return size
    given = to_float("scale", scale)
    k = point.size if given.shape == point.shape else n
    size[:k] = check_positive_vector("scale", given, k)
    return size
