"""Linear models from equations and from simulators: the operating point, then differences."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann._validation import Array, check_array, check_positive, check_positive_vector, to_float
from sb3_yann.control.linear_system import LinearSystem, names, zero_order_hold
from sb3_yann.control.linearization.differences import (
    Jacobian,
    curvature,
    differences,
    idle_inputs,
    partly_known,
)
from sb3_yann.control.linearization.simulator import (
    MOST,
    Simulator,
    borrow,
    connect,
    noise_of,
    sample_time,
    to_vector,
)
from sb3_yann.control.lqr import unreached

if TYPE_CHECKING:
    from sb3_yann.control.linearization.simulator import Maker


MOVED = 1e-3  # largest residual of a given steady state in one step, relative to the scale
AWAY = 1e-2  # largest distance to the linear model's steady state, relative to the scale
SOLVED = 1e-6  # largest residual of a steady state that was solved for
NOTHING = 1e-9  # a solved entry that is smaller, relative to its scale, is zero
SETTLES = 2_000  # steps in which a plant may come to rest by itself


def steady_state(
    simulator: Simulator, start: Array, free: NDArray[np.bool_], scale: Array
) -> Array:
    """Return the steady state and its action, shape (n+m,), with the free entries solved for.

    ``start`` (n+m,) holds the known entries, and a guess for the free ones. ``scale`` (n+m,) is the
    range in which each moves in use.
    """
    if not np.any(free):
        return start
    point = _solve(simulator, start, free, scale)
    moved = residual(simulator, point, scale)
    n = moved.size
    if not np.max(np.abs(moved)) <= SOLVED and np.all(free[:n]) and not np.any(free[n:]):
        # A search may run away from where the plant comes to rest by itself.
        another = _solve(simulator, _settled(simulator, start, scale), free, scale)
        if np.max(np.abs(residual(simulator, another, scale))) <= SOLVED:
            return _without_rounding(another, free, scale)
    if not np.max(np.abs(moved)) <= SOLVED and not _is_noise(simulator, point, moved, scale):
        reason = simulator.refusal if np.any(np.isnan(moved)) else f"{(moved * scale[:n]).tolist()}"
        stuck = _at_bounds(simulator, point[n:], scale[n:])
        raise ValueError(
            f"No steady state was found. The best is x_ss = {point[:n].tolist()}, u_ss = "
            f"{point[n:].tolist()}, which moves in one step by {reason}.{stuck} Leave more entries "
            "free (NaN), or start closer to it."
        )
    return _without_rounding(point, free, scale)


def _without_rounding(point: Array, free: NDArray[np.bool_], scale: Array) -> Array:
    """Return the point with zeros for solved entries that are next to nothing."""
    return np.where(free & (np.abs(point) <= NOTHING * scale), 0.0, point)


def _settled(simulator: Simulator, start: Array, scale: Array) -> Array:
    """Return the point that the plant comes to with its action held, the last one with values."""
    point = start
    n = scale.size - simulator.env.action_space.shape[0]
    for _ in range(SETTLES):
        reached = simulator.next_state(point[:n], point[n:])
        if not np.all(np.isfinite(reached)):
            break
        moved = np.max(np.abs(reached - point[:n]) / scale[:n])
        point = np.concatenate([reached, point[n:]])
        if moved <= SOLVED:
            break
    return point


def _is_noise(simulator: Simulator, point: Array, moved: Array, scale: Array) -> bool:
    """Tell whether what is left of the motion is no more than the simulator's own error."""
    n = moved.size

    def step(z: Array) -> Array:
        return simulator.next_state(z[:n], z[n:])

    noise = noise_of(step, point, np.where(np.arange(scale.size) < n, scale, 0.0)) / scale[:n]
    return bool(np.all(np.abs(moved) <= SOLVED + 5 * noise) and np.all(noise <= MOST))


def _at_bounds(simulator: Simulator, u: Array, scale: Array) -> str:
    """Name the inputs that are at their bounds."""
    space: Any = simulator.env.action_space
    stuck = [
        f"u[{i}] is at its {side} bound, {bound[i]:g}"
        for side, bound in (("lower", space.low), ("upper", space.high))
        for i in np.flatnonzero(np.abs(u - bound) <= 1e-6 * scale)
    ]
    return f" {', '.join(stuck)}: the inputs do not hold it." if stuck else ""


def require_steady_state(simulator: Simulator, point: Array, jacobian: Array, scale: Array) -> None:
    """Raise ValueError if a given operating point is far from the linear model's steady states.

    Its motion alone says little: in a short sample a plant hardly moves from anywhere. The
    ``jacobian`` (n, n+m) is that of the next state at the point (n+m,).
    """
    moved = residual(simulator, point, scale)
    n = moved.size
    slopes = (jacobian - np.eye(n, point.size)) * scale / scale[:n, None]
    way = np.linalg.lstsq(slopes, -moved, rcond=1e-9)[0]
    left = moved + slopes @ way
    if np.max(np.abs(way)) > AWAY or np.max(np.abs(left)) > MOVED:
        raise ValueError(
            f"x_ss = {point[:n].tolist()}, u_ss = {point[n:].tolist()} is no steady state: one "
            f"step moves it by {(moved * scale[:n]).tolist()}. Set entries to NaN to be solved for."
        )


def residual(simulator: Simulator, point: Array, scale: Array) -> Array:
    """Return the motion of the state (n,) in one step, relative to the scale."""
    n = scale.size - simulator.env.action_space.shape[0]
    return (simulator.next_state(point[:n], point[n:]) - point[:n]) / scale[:n]


def _solve(simulator: Simulator, start: Array, free: NDArray[np.bool_], scale: Array) -> Array:
    """Return the point that moves least, with only the free entries changed."""
    space: Any = simulator.env.action_space
    n = scale.size - space.shape[0]
    low = np.concatenate([np.full(n, -np.inf), space.low.astype(np.float64)])
    high = np.concatenate([np.full(n, np.inf), space.high.astype(np.float64)])

    def moved(point: Array) -> Array:
        return residual(simulator, point, scale)

    # Steps as long as a float32 state needs; SciPy's own would vanish in its rounding.
    options: dict[str, Any] = {"step": 1e-3, "bounds": (low, high), "xtol": 1e-12}
    return _least_moved(moved, start, free, scale, **options)[0]


def _least_moved(
    moved: Callable[[Array], Array],
    start: Array,
    free: NDArray[np.bool_],
    scale: Array,
    xtol: float,
    step: float = 0.0,
    bounds: tuple[Array, Array] | None = None,
) -> tuple[Array, float]:
    """Return the point that moves least, its free entries changed, and its motion in scales."""
    from scipy.optimize import least_squares

    def at(z: Array) -> Array:
        point = start.copy()
        point[free] = z * scale[free]
        return point

    def finite(z: Array) -> Array:
        # Where there is no value, the search turns back.
        return np.asarray(np.nan_to_num(moved(at(z)), nan=1e3, posinf=1e3, neginf=-1e3))

    def slopes(z: Array) -> Array:
        steps = step * np.eye(z.size)
        return np.array([(finite(z + h) - finite(z - h)) / (2 * step) for h in steps]).T

    low, high = bounds or (np.full(start.size, -np.inf), np.full(start.size, np.inf))
    box = low[free] / scale[free], high[free] / scale[free]
    options: dict[str, Any] = {"xtol": xtol, "ftol": 1e-15, "gtol": 1e-15, "bounds": box}
    options["jac"] = slopes if step else "2-point"
    found = least_squares(finite, start[free] / scale[free], **options)
    return at(found.x), float(np.max(np.abs(found.fun)))


LONGEST_EPISODE = 400  # steps after which an episode counts as one without an end of its own
SECONDS = 1.0  # after which a slow one does


def time_limit_fault(env: Any, action: Array) -> str:
    """Return that every episode terminates after the same number of steps, empty if it does not.

    The env is reset and stepped with an action (m,) and another one; pass a copy. What it raises
    meanwhile ends the search.
    """
    low = env.action_space.low
    high = env.action_space.high
    other = np.clip(action + 0.25 * np.minimum(high - low, 4.0), low, high)
    ends = []
    for seed, u in enumerate((action, other)):
        try:
            ends.append(_termination(env, seed, u.astype(env.action_space.dtype)))
        except Exception:  # whatever a simulator raises away from its operating point
            return ""
        if ends[0] is None or ends[0] < 2:
            return ""
    if ends[0] != ends[1]:
        return ""
    return (
        f"Episodes terminate after {ends[0]} steps whatever happens: that is a time limit, but "
        "terminated=True means to the learner that nothing costs anything afterwards. Return "
        "truncated=True there, or wrap the environment in "
        f"sb3_yann.wrappers.TruncateAtTimeLimit(env, {ends[0]})."
    )


def _termination(env: Any, seed: int, action: Array) -> int | None:
    """Return after how many steps an episode terminates, None if it does not or is cut before."""
    env.reset(seed=seed)
    begun = perf_counter()
    for step in range(1, LONGEST_EPISODE + 1):
        _, _, terminated, truncated, _ = env.step(action)
        if terminated:
            return step
        if truncated or perf_counter() - begun > SECONDS:
            return None
    return None


LONGEST = 0.01  # longest step of a difference, relative to the scale of its coordinate
LONGEST_SINGLE = 0.05  # the same where states are read in float32
LONGEST_NOISY = 0.2  # the same where an adaptive integrator leaves noise
# from where on noise counts: beside rounding, and in scales
NOISY = 10.0
LEAST = 1e-10


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
    with contextlib.closing(borrow(env)) as borrowed:
        step_time = sample_time(borrowed.env, dt)
        simulator = Simulator(borrowed, set_state, get_state)
        x = None if x_ss is None else partly_known("x_ss", x_ss)
        u = None if u_ss is None else partly_known("u_ss", u_ss)
        found = _linearize(simulator, x, u, step_time, scale)
        moves = np.linalg.svd(found.A - np.eye(len(found.A)), compute_uv=False)
        if x is None and moves[-1] <= 1e-6 * moves[0]:
            warnings.warn(
                f"The plant rests at other states too: x_ss = {found.x_ss.tolist()} is where a "
                "reset led. Pass the state to hold, x_ss=[...].",
                stacklevel=3,
            )
        fault = time_limit_fault(borrowed.env, found.u_ss) if borrowed.private else ""
        if not fault:
            return found
        warnings.warn(fault, stacklevel=3)
        return replace(found, notes=(*found.notes, fault))


def _linearize(
    simulator: Simulator, x: Array | None, u: Array | None, dt: float, scale: ArrayLike | None
) -> LinearSystem:
    """Connect to the simulator, find its steady state, and take the differences there."""
    middle, width = _actions(simulator.env.action_space)
    if u is None:
        # With a state to hold, the action is what holds it; with none, that at mid range.
        u = middle if x is None else np.full(middle.size, np.nan)
    elif u.shape != middle.shape:
        raise ValueError(f"u_ss has shape {u.shape}, expected {middle.shape}.")
    u_start = np.where(np.isnan(u), middle, u)
    x_start, size = connect(simulator, x, u_start, scale)
    scales = np.concatenate([size, width])
    n = size.size
    free = np.isnan(np.concatenate([np.full(n, np.nan) if x is None else x, u]))
    point = steady_state(simulator, np.concatenate([x_start, u_start]), free, scales)
    found, noise = _differentiate(simulator, point, scales)
    if not np.any(free):
        require_steady_state(simulator, point, found.value, scales)
    A = found.value[:, :n]
    B = found.value[:, n:]
    notes = (
        *idle_inputs(B, 5),
        "Linearized by central differences over one step. The state was set by "
        f"{simulator.setter} and read from {simulator.reader}.",
        f"Of the {free.size} entries of the operating point, {np.count_nonzero(free)} were solved "
        "for and the others given or taken from the middle of the action space.",
        *_noise(found, noise),
        *_remarks(simulator, point),
        *curvature(found, names((n, u.size))),
        f"The simulator was {simulator.origin}.",
    )
    return LinearSystem(A, B, dt, point[:n], point[n:], np.zeros((n, 0)), np.zeros(0), notes)


def _actions(space: Any) -> tuple[Array, Array]:
    """Return the middle of a Box of actions and half its width; 0 and 1 where it is unbounded."""
    low = space.low.astype(np.float64)
    high = space.high.astype(np.float64)
    bounded = (low > -1e6) & (high < 1e6)
    low = np.where(bounded, low, -1.0)
    high = np.where(bounded, high, 1.0)
    return (low + high) / 2, (high - low) / 2


def _differentiate(simulator: Simulator, point: Array, scale: Array) -> tuple[Jacobian, float]:
    """Return the Jacobian (n, n+m) of the next state, and the simulator's noise in scales."""
    space = simulator.env.action_space
    n = scale.size - space.shape[0]
    room = np.minimum(point[n:] - space.low, space.high - point[n:]).astype(np.float64)
    if np.any(room <= 1e-6 * scale[n:]):
        i = int(np.argmin(room / scale[n:]))
        raise ValueError(
            f"u_ss = {point[n:].tolist()}: entry {i} lies on its bound in {space}, where the "
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
    noise = noise_of(
        lambda z: step(actual(z)), point, np.where(np.arange(scale.size) < n, scale, 0.0)
    )
    noise = np.where(noise > np.maximum(NOISY * rounding, LEAST * scale[:n]), noise, 0.0)
    if np.any(noise > MOST * scale[:n]):
        noise = np.zeros(n)  # no noise that differences could cope with
    rough = float(np.max(noise / scale[:n]))
    longest = np.maximum(longest, np.minimum(1e6 * rough, LONGEST_NOISY) * scale)
    longest[n:] = np.minimum(longest[n:], room)
    labels = names((n, room.size))
    found = differences(step, point, longest, np.maximum(rounding, noise), labels, actual)
    return found, rough


def _noise(found: Jacobian, noise: float) -> list[str]:
    """Return a note on a simulator whose own error is noise to differences."""
    if not noise:
        return []
    return [
        f"The simulator's results carry an error of {noise:.1e} of a state's scale, as adaptive "
        f"integrators do: steps went up to {np.max(found.steps):.3g}, and the derivatives of two "
        f"step sizes agree within {found.doubt:.1%}. Tighten its tolerances for better ones."
    ]


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


@dataclass(frozen=True)
class Rate:
    """``dx/dt`` (n,) at a point ``[x, u, d]``, of an f of vectors of these sizes; n is the first.

    f returns dx/dt of shape (n,), (n, 1) or (1, n), or a list.
    """

    f: Callable[..., ArrayLike]
    sizes: tuple[int, ...]

    def __call__(self, point: Array) -> Array:
        """Return dx/dt (n,) at ``[x, u, d]``."""
        parts = np.split(point, np.cumsum(self.sizes[:-1]))
        return _vector(self.f(*parts), self.sizes[0])


def _vector(value: Any, size: int) -> Array:
    """Return what f returned as a vector (n,)."""
    try:
        array = to_float("f(x, u)", value)
    except TypeError:
        if not isinstance(value, (list, tuple)):
            raise
        # A list of numbers and of arrays with one entry.
        array = np.concatenate([np.ravel(to_float("f(x, u)", each)) for each in value])
    if array.shape not in ((size,), (size, 1), (1, size)):
        raise ValueError(
            f"f returned the shape {array.shape}, expected ({size},) or ({size}, 1): dx/dt of each "
            "state."
        )
    return array.reshape(size)


STEADY = 1e-3  # largest motion of a steady state in one sample, relative to its scale
MOVES = 0.01  # the same relative to its own size: beyond it, a state smaller than 1 gets a warning
AT_REST = 1e-8  # largest motion in one sample of a steady state that was solved for
STARTS = (0.0, 1.0, -1.0, 0.1, 10.0)
"""Scales of the free entries from which the steady state is sought, in turn."""
ANOTHER = 1e-3  # distance, in scales, from which two steady states are different ones


def linearize_dynamics(
    f: Callable[..., ArrayLike],
    x_ss: ArrayLike,
    u_ss: ArrayLike,
    dt: float,
    d_ss: ArrayLike | None,
    scale: ArrayLike | None = None,
) -> LinearSystem:
    """Return the sampled linearization of `LinearModel.from_dynamics`, which documents the rest."""
    x = partly_known("x_ss", x_ss)
    u = partly_known("u_ss", u_ss)
    d = check_array("d_ss", [] if d_ss is None else d_ss, ("d",))
    dt = check_positive("dt", dt)
    labels = ["x", "u"] if d_ss is None else ["x", "u", "d"]
    if not callable(f):
        raise TypeError(f"f = {f!r} must be a function ({', '.join(labels)}) -> dx/dt.")
    sizes = (x.size, u.size, d.size)
    given = np.concatenate([x, u, d])
    rate = Rate(f, sizes[: len(labels)])
    size = _size(given, x.size, scale)
    free = np.isnan(given)
    point, notes = _rest_of(rate, given, size, dt) if np.any(free) else (given, [])
    size = _size(point, x.size, scale)
    check_array(f"f({', '.join(f'{name}_ss' for name in labels)})", rate(point), (x.size,))
    _require_steady(rate, point, size, dt, scale is not None)
    rounding = np.finfo(float).eps * np.maximum(np.abs(point), size)[: x.size] / dt
    found = differences(rate, point, LONGEST * size, rounding, names(sizes))
    A, B, E = _parts(found.value, sizes)
    A, B, E = zero_order_hold(A, B, E, dt)
    x, u, d = np.split(point, np.cumsum(sizes[:2]))
    notes += [*idle_inputs(B, 4), *curvature(found, names(sizes))]
    return LinearSystem(A, B, dt, x, u, E, d, tuple(notes))


def _rest_of(rate: Rate, given: Array, scale: Array, dt: float) -> tuple[Array, list[str]]:
    """Return the steady state with the free entries solved for, and notes on how sure it is."""
    free = np.isnan(given)
    n = rate.sizes[0]
    found: list[Array] = []
    best = given
    least = np.inf
    for start in STARTS:
        point, moved = _solved_from(rate, np.where(free, start * scale, given), free, scale, dt)
        if moved < least:
            best = point
            least = moved
        apart = [np.max(np.abs(point - other) / scale) > ANOTHER for other in found]
        if moved <= AT_REST and all(apart):
            found.append(point)
    if not found:
        raise ValueError(
            f"No steady state was found. The best is x_ss = {best[:n].tolist()}, the rest "
            f"{best[n:].tolist()}, which moves in one sample by {least:.2g} scales. Leave more "
            "entries free (NaN), give one that you know, or pass scale=..., how far each moves."
        )
    # A bioreactor that is washed out is at rest too, and no input brings it back.
    found.sort(key=lambda each: _is_lost(rate, each, _size(each, n, scale[:n]), dt))
    solved = np.count_nonzero(free)
    notes = [f"Solved for the steady state: {solved} {'entry' if solved == 1 else 'entries'}."]
    if solved > n:
        notes[0] += f" The equations determine {n}: it is one of many. Give more entries."
    elif len(found) > 1:
        others = "; ".join(str([float(f"{v:.4g}") for v in other]) for other in found[1:])
        notes[0] += f" There are others, {others}: give an entry that separates them."
    return found[0], notes


def _parts(slopes: Array, sizes: Sequence[int]) -> list[Array]:
    """Return the derivatives by x, u and d."""
    return np.split(slopes, np.cumsum(sizes[:2]), axis=1)


def _is_lost(rate: Rate, point: Array, size: Array, dt: float) -> bool:
    """Tell whether a mode that does not decay is out of reach of the inputs at a steady state."""
    steps = np.diag(1e-4 * size)
    try:
        slopes = np.array([(rate(point + h) - rate(point - h)) / (2 * h.max()) for h in steps]).T
        A, B, E = _parts(slopes, rate.sizes)
        A, B, _ = zero_order_hold(A, B, E, dt)
        return unreached(A, B) is not None
    except (ArithmeticError, ValueError):  # no value next to it
        return True


def _solved_from(
    rate: Rate, start: Array, free: NDArray[np.bool_], scale: Array, dt: float
) -> tuple[Array, float]:
    """Return the point near a start that moves least, and its motion in scales; inf for none."""

    def moved(point: Array) -> Array:
        with np.errstate(all="ignore"):
            return np.asarray(dt * rate(point) / scale[: rate.sizes[0]])

    try:
        return _least_moved(moved, start, free, scale, xtol=1e-14)
    except (ArithmeticError, ValueError):  # math functions raise where numpy's return NaN
        return start, np.inf


def _require_steady(rate: Rate, point: Array, size: Array, dt: float, scaled: bool) -> None:
    """Raise if the operating point moves too far in one sample; warn if that is not certain."""
    parts = np.split(point, np.cumsum(rate.sizes[:-1]))
    x = parts[0]
    moved = dt * np.abs(rate(point))
    if np.any(moved > STEADY * size[: x.size]):
        at = ", ".join(f"{k}_ss = {part.tolist()}" for k, part in zip("xud", parts, strict=False))
        raise ValueError(
            f"{at} is no steady state: in one sample of {dt:g} the state moves by "
            f"{moved.tolist()}, with a scale of {size[: x.size].tolist()}. Set entries to NaN to "
            "have them solved for."
        )
    if not scaled and np.any((moved > MOVES * np.abs(x)) & (x != 0) & (moved > 1e-8)):
        warnings.warn(
            f"In one sample of {dt:g} the steady state x_ss = {x.tolist()} moves by "
            f"{moved.tolist()}, much beside itself. Pass scale=..., how far each state moves.",
            stacklevel=4,
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
