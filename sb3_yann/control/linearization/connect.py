"""How the state of a simulator is set and read, chosen by trial."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, check_positive_vector
from sb3_yann.control.linearization.simulator import Simulator

LONGEST_DELAY = 20  # longest input delay, in samples, that is detected
HIDDEN = "the plant has states besides these, which setting this one"
ADVICE = (
    "Make them part of the state (of a delay, the inputs on their way), have set_state set them "
    "too, or identify the plant: LinearModel.from_data"
)

PASS = "Pass set_state=lambda env, x: ... and get_state=lambda env: ... for its state."


def connect(
    simulator: Simulator, x: Array | None, u: Array, scale: ArrayLike | None
) -> tuple[Array, Array]:
    """Choose how the state is set and read, by trial; return the state tried and its scale.

    Parameters
    ----------
    simulator : Simulator
        Its ``setter`` and ``reader`` are set to the first pair that passes.
    x : ndarray, shape (n,), optional
        A state to try, NaN where it is not known. The default is that of the reset.
    u : ndarray, shape (m,)
        An action to try.
    scale : array_like, shape (n,), optional
        Range in which each state moves in use.
    """
    begun = {name: simulator.read(name) for name in simulator.readers}
    tried = []
    for setter, (reader, start) in product(simulator.setters, begun.items()):
        if start is None or (x is not None and start.size != x.size):
            continue
        simulator.setter, simulator.reader = setter, reader
        trial = start if x is None else np.where(np.isnan(x), start, x)
        size = _scale(simulator, trial, scale)
        failure = _failure(simulator, trial, u, size)
        if failure is None:
            return trial, size
        tried.append(f"set by {setter}, read from {reader}: {failure}")
    if not tried:
        sizes = {name: None if v is None else v.shape for name, v in begun.items()}
        wanted = "" if x is None else f" of shape {x.shape}, like the one given,"
        tried = [f"a state{wanted} is nowhere to be read: {sizes}"]
    ways = "".join(f"\n  - {each}" for each in tried)
    given = "set_state" in simulator.setters and "get_state" in simulator.readers
    advice = "" if given else f"\n{PASS}"
    raise ValueError(
        f"The environment could not be put into a state and read. Tried:{ways}{advice}"
    )


def _scale(simulator: Simulator, x: Array, scale: ArrayLike | None) -> Array:
    """Return the scale of each state, shape (n,)."""
    if scale is not None:
        return check_positive_vector("scale", scale, x.size)
    size = np.maximum(np.abs(x), 1.0)
    space = simulator.env.observation_space
    if getattr(space, "shape", None) == x.shape and hasattr(space, "low"):
        width = (space.high.astype(np.float64) - space.low) / 2
        size = np.where(width < 1e6, width, size)  # "no bound" may be the largest float32
    return np.asarray(size)


def _failure(simulator: Simulator, x: Array, u: Array, scale: Array) -> str | None:
    """Try the present way to set and read the state; return its fault, None without one."""
    for other in (x + 0.01 * scale, x - 0.01 * scale):
        try:
            seen = [simulator.read() if simulator.put(state) else None for state in (x, other)]
        except (ValueError, AssertionError, TypeError, KeyError, AttributeError) as error:
            failure = f"refused ({error})"
            continue
        break
    else:
        return failure
    for wanted, got in zip((x, other), seen, strict=True):
        if got is not None and np.any(np.abs(got - wanted) > 1e-5 * (scale + np.abs(wanted))):
            reading = f"set to {wanted.tolist()} it reads {got.tolist()}"
            return f"{reading} (a state that is ignored, or an angle that wraps there)"
    first, moved, again = (simulator.next_state(state, u) for state in (x, other, x))
    if not np.all(np.abs(again - first) <= 1e-6 * (scale + np.abs(first))):
        return (
            f"two steps from the same state {x.tolist()} end in {first.tolist()} and "
            f"{again.tolist()}: setting it fails, or the plant is random or has states besides "
            "these (then identify it: LinearModel.from_data)"
        )
    pushed = simulator.next_state(other, u + 0.1 * _room(simulator, u))
    if np.array_equal(moved, other) and np.array_equal(pushed, other):
        return f"no step changes it from {other.tolist()}, whatever the action"
    # A plant that forgets within a sample has A = 0: then what it did before does not matter.
    alike = not simulator.resets and np.array_equal(first, moved)
    if alike and not np.array_equal(simulator.next_state(x, u), first):
        return f"the next state is {first.tolist()} from {x.tolist()} and {other.tolist()} alike"
    return _hidden_state(simulator, x, u, u + 0.5 * _room(simulator, u), scale)


def _room(simulator: Simulator, u: Array) -> Array:
    """Return the way from u to the farther bound of the actions, signed, and at most 1000."""
    space = simulator.env.action_space
    up, down = space.high - u, u - space.low
    return np.asarray(np.where(up >= down, np.minimum(up, 1e3), -np.minimum(down, 1e3)))


def _hidden_state(
    simulator: Simulator, x: Array, u: Array, other: Array, scale: Array
) -> str | None:
    """Describe the hidden states that show in steps from x with u and other, None without any.

    One that setting x leaves alone shows when a step is repeated after other inputs, one that
    setting x resets when the plant goes on by itself.
    """
    first = simulator.next_state(x, u)
    for _ in range(LONGEST_DELAY):
        moved = simulator.next_state(x, other)
    again = simulator.next_state(x, u)
    if np.any(np.abs(again - first) > 1e-6 * (scale + np.abs(first))):
        return (
            f"the step from {x.tolist()} with the action {u.tolist()} ends in {first.tolist()}, "
            f"and after other actions in {again.tolist()}: {HIDDEN} leaves alone (a delay of the "
            f"input, an actuator). {ADVICE}"
        )
    for before, after in _trajectory(simulator, x, other, 10 * scale):
        reached = simulator.next_state(before, other)
        # States may be read in float32, which the step may enlarge.
        doubt = np.maximum(1e-5 * (scale + np.abs(after)), 0.01 * np.abs(moved - first))
        if np.any(np.abs(reached - after) > doubt):
            return (
                f"going on from {before.tolist()}, the action {other.tolist()} leads to "
                f"{after.tolist()}, and set there to {reached.tolist()}: {HIDDEN} starts anew "
                f"(a delay of the input, an actuator, a clock). {ADVICE}"
            )
    return None


def _trajectory(
    simulator: Simulator, x: Array, u: Array, farthest: Array
) -> list[tuple[Array, Array]]:
    """Return the pairs of states before and after each step with u, set once, to x."""
    states = [x]
    for k in range(LONGEST_DELAY):
        states.append(simulator.go_on(u) if k else simulator.next_state(x, u))
        if simulator.over or not np.all(np.abs(states[-1] - x) <= farthest):
            break
    return list(pairwise(states[1:]))
