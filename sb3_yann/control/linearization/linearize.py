"""Linear models from simulators, by differences of their own step."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, to_float
from sb3_yann.control.linear_system import LinearSystem, names
from sb3_yann.control.linearization.connect import connect
from sb3_yann.control.linearization.differences import curvature, differences, idle_inputs
from sb3_yann.control.linearization.episodes import episode_faults
from sb3_yann.control.linearization.finite_differences import Jacobian
from sb3_yann.control.linearization.noise import MOST, noise_of
from sb3_yann.control.linearization.simulator import Simulator, borrow, sample_time, to_vector
from sb3_yann.control.linearization.steady_state import require_steady_state, steady_state

if TYPE_CHECKING:
    from sb3_yann.control.linearization.simulator import Maker

LONGEST = 0.01  # longest step of a difference, relative to the scale of its coordinate
LONGEST_SINGLE = 0.05  # the same where states are read in float32
LONGEST_NOISY = 0.2  # the same where an adaptive integrator leaves noise
NOISY, LEAST = 10.0, 1e-10  # from where on noise counts: beside rounding, and in scales


def linearize_env(
    env: Maker,
    x_ss: ArrayLike | None,
    u_ss: ArrayLike | None,
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
    x_ss, u_ss, scale : array_like, shapes (n,), (m,) and (n,), or None
        The operating point, NaN where it is to be solved for, and the range of each state.
    """
    with contextlib.closing(borrow(env)) as borrowed:
        step_time = sample_time(borrowed.env, dt)
        simulator = Simulator(borrowed, set_state, get_state)
        x, u = _partly_known("x_ss", x_ss), _partly_known("u_ss", u_ss)
        found = _linearize(simulator, x, u, step_time, scale)
        faults = episode_faults(borrowed.env, found.u_ss) if borrowed.private else []
        for fault in faults:
            warnings.warn(fault, stacklevel=3)
        return replace(found, notes=(*found.notes, *faults))


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
    A, B = found.value[:, :n], found.value[:, n:]
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
