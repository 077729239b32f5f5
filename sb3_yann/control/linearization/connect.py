"""Whether a simulator remembers more than the state that it is set to, as a delay does."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from sb3_yann._validation import Array

if TYPE_CHECKING:
    from sb3_yann.control.linearization.simulator import Simulator

LONGEST_DELAY = 20
"""Samples after which an input is no longer waited for."""
ADVICE = (
    "Make what it remembers part of the state (of a delay, the inputs on their way), have "
    "set_state set it too, or identify the plant: LinearModel.from_data"
)


def memory(simulator: Simulator, x: Array, u: Array, other: Array, scale: Array) -> str | None:
    """Return how a step depends on more than x and u, None if no trial shows that it does.

    Differences from a set state would be wrong without a sign of it. What setting the state leaves
    alone shows when a step is repeated after other inputs; what it starts anew shows when the
    plant goes on by itself.

    Parameters
    ----------
    x, u : ndarray, shapes (n,) and (m,)
        A state and an action to try.
    other : ndarray, shape (m,)
        Another action.
    scale : ndarray, shape (n,)
        How far each state moves in use.
    """
    first = simulator.next_state(x, u)
    for _ in range(LONGEST_DELAY):
        moved = simulator.next_state(x, other)
    again = simulator.next_state(x, u)
    if np.any(np.abs(again - first) > 1e-6 * (scale + np.abs(first))):
        return (
            f"the step from {x.tolist()} with the action {u.tolist()} ends in {first.tolist()}, "
            f"and after other actions in {again.tolist()}: the plant has states besides these, "
            f"which setting this one leaves alone (a delay of the input, an actuator). {ADVICE}"
        )
    for before, after in _trajectory(simulator, x, other, 10 * scale):
        reached = simulator.next_state(before, other)
        # States may be read in float32, which the step may enlarge.
        doubt = np.maximum(1e-5 * (scale + np.abs(after)), 0.01 * np.abs(moved - first))
        if np.any(np.abs(reached - after) > doubt):
            return (
                f"going on from {before.tolist()}, the action {other.tolist()} leads to "
                f"{after.tolist()}, and set there to {reached.tolist()}: the plant has states "
                "besides these, which setting this one starts anew (a delay of the input, an "
                f"actuator, a clock). {ADVICE}"
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
