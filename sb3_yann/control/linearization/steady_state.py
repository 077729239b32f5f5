"""Where a simulator rests: found, or checked where it is given."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control.linearization.simulator import Simulator

MOVED = 1e-3
"""How far a given steady state may move in one step, in parts of the scale."""
AWAY = 1e-2
"""How far from it the plant may really rest, in parts of the scale."""
SOLVED = 1e-6
"""How far one that was solved for may move."""


def steady_state(
    simulator: Simulator, start: Array, free: NDArray[np.bool_], scale: Array
) -> Array:
    """Return the state and action that one step leaves where they are, shape (n+m,).

    Parameters
    ----------
    simulator : Simulator
        Put in a state, and stepped, many times.
    start : ndarray, shape (n+m,)
        What is known of it, and a guess for the rest.
    free : ndarray of bool, shape (n+m,)
        Which entries to solve for. The others stay.
    scale : ndarray, shape (n+m,)
        How far each moves in use.

    Raises
    ------
    ValueError
        If there is none with these entries, or the environment refuses the given one.
    """
    if not np.any(free):
        return start
    point = _solve(simulator, start, free, scale)
    rest = drift(simulator, point, scale)
    n = rest.size
    if not np.max(np.abs(rest)) <= SOLVED:
        reason = simulator.refusal if np.any(np.isnan(rest)) else f"{(rest * scale[:n]).tolist()}"
        raise ValueError(
            f"No steady state was found. The best is state = {point[:n].tolist()}, action = "
            f"{point[n:].tolist()}, which moves in one step by {reason}."
            f"{_at_bounds(simulator, point[n:], scale[n:])} Leave more entries free (NaN), or "
            "start closer to it."
        )
    return point


def _at_bounds(simulator: Simulator, u: Array, scale: Array) -> str:
    """Return which inputs would have to go beyond their bounds, in words."""
    space: Any = simulator.env.action_space
    stuck = [
        f"u[{i}] is at its {side} bound, {bound[i]:g}"
        for side, bound in (("lower", space.low), ("upper", space.high))
        for i in np.flatnonzero(np.abs(u - bound) <= 1e-6 * scale)
    ]
    return f" {', '.join(stuck)}: the inputs do not hold it." if stuck else ""


def check_rest(simulator: Simulator, point: Array, jacobian: Array, scale: Array) -> None:
    """Refuse a given operating point that moves, or that is far from where the plant rests.

    In a short sample a plant moves little from anywhere. So the way to the nearest steady state
    counts: that of the linear model, by least squares in state and action.

    Raises
    ------
    ValueError
        If the point is no steady state.
    """
    rest = drift(simulator, point, scale)
    n = rest.size
    slopes = (jacobian - np.eye(n, point.size)) * scale / scale[:n, None]
    way = np.linalg.lstsq(slopes, -rest, rcond=1e-9)[0]
    left = rest + slopes @ way
    if np.max(np.abs(way)) > AWAY or np.max(np.abs(left)) > MOVED:
        raise ValueError(
            f"state = {point[:n].tolist()}, action = {point[n:].tolist()} is no steady state: one "
            f"step moves it by {(rest * scale[:n]).tolist()}. Leave one of the two out, or set "
            "entries to NaN, to have them solved for."
        )


def drift(simulator: Simulator, point: Array, scale: Array) -> Array:
    """Return how far one step moves the state, in parts of the scale, shape (n,)."""
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

    def residual(z: Array) -> Array:
        # Where the environment refuses a state, the search turns back.
        moved = drift(simulator, at(z), scale)
        return np.asarray(np.nan_to_num(moved, nan=1e3, posinf=1e3, neginf=-1e3))

    def slopes(z: Array) -> Array:
        # Steps as long as a float32 state needs; SciPy's own would vanish in its rounding.
        steps = 1e-3 * np.eye(z.size)
        return np.array([(residual(z + h) - residual(z - h)) / 2e-3 for h in steps]).T

    begin, bounds = start[place] / scale[place], (low / scale[place], high / scale[place])
    found = least_squares(residual, begin, slopes, bounds, xtol=1e-12, ftol=1e-15, gtol=1e-15)
    return at(found.x)
