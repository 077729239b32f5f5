"""The steady state of a simulator: solved for, or checked where it is given."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control.linearization.noise import MOST, noise_of
from sb3_yann.control.linearization.simulator import Simulator

MOVED = 1e-3  # largest residual of a given steady state in one step, relative to the scale
AWAY = 1e-2  # largest distance to the linear model's steady state, relative to the scale
SOLVED = 1e-6  # largest residual of a steady state that was solved for
NOTHING = 1e-9  # a solved entry that is smaller, relative to its scale, is zero
SETTLES = 2_000  # steps in which a plant may come to rest by itself


def steady_state(
    simulator: Simulator, start: Array, free: NDArray[np.bool_], scale: Array
) -> Array:
    """Return the steady state and its action, shape (n+m,).

    Parameters
    ----------
    simulator : Simulator
        Put in a state, and stepped, many times.
    start : ndarray, shape (n+m,)
        The known entries, and a guess for the free ones.
    free : ndarray of bool, shape (n+m,)
        The entries to solve for.
    scale : ndarray, shape (n+m,)
        Range in which each entry moves in use.
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
    point, n = start, scale.size - simulator.env.action_space.shape[0]
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

    Its motion alone tells little: in a short sample a plant hardly moves from anywhere.

    Parameters
    ----------
    simulator, jacobian : Simulator, and ndarray, shape (n, n+m)
        What is stepped, and the derivatives of its next state at the point.
    point, scale : ndarray, shape (n+m,)
        State and action, and the range in which each moves in use.
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
    from scipy.optimize import least_squares

    place = np.flatnonzero(free)
    space: Any = simulator.env.action_space
    n = scale.size - space.shape[0]
    low = np.concatenate([np.full(n, -np.inf), space.low.astype(np.float64)])[place]
    high = np.concatenate([np.full(n, np.inf), space.high.astype(np.float64)])[place]

    def at(z: Array) -> Array:
        point = start.copy()
        point[place] = z * scale[place]
        return point

    def moved(z: Array) -> Array:
        # Where the environment refuses a state, the search turns back.
        step = residual(simulator, at(z), scale)
        return np.asarray(np.nan_to_num(step, nan=1e3, posinf=1e3, neginf=-1e3))

    def slopes(z: Array) -> Array:
        # Steps as long as a float32 state needs; SciPy's own would vanish in its rounding.
        steps = 1e-3 * np.eye(z.size)
        return np.array([(moved(z + h) - moved(z - h)) / 2e-3 for h in steps]).T

    begin, bounds = start[place] / scale[place], (low / scale[place], high / scale[place])
    found = least_squares(moved, begin, slopes, bounds, xtol=1e-12, ftol=1e-15, gtol=1e-15)
    return at(found.x)
