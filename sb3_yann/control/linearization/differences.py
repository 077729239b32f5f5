"""Jacobians with the coordinate named where there is none, and remarks on what they showed."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control.linearization.finite_differences import Jacobian, NotSmoothError, jacobian

SHORTER = 64.0  # factor by which steps shrink where a function has no value next to the point


def differences(
    f: Callable[[Array], Array],
    point: Array,
    steps: Array,
    rounding: Array,
    labels: list[str],
    actual: Callable[[Array], Array] = lambda z: z,
) -> Jacobian:
    """Return the Jacobian; name the coordinate where there is none.

    Parameters
    ----------
    f, point, steps, rounding, actual : callable, ndarray (c,) twice, ndarray (r,), callable
        As of `jacobian`, which calls the rounding noise.
    labels : list of str
        The names of the coordinates.
    """
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


def idle_inputs(B: Array, stacklevel: int) -> list[str]:
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


def curvature(found: Jacobian, labels: list[str]) -> list[str]:
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
