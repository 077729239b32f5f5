"""Input checks and constants that the environments share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray


def constant(values: ArrayLike) -> NDArray[np.float64]:
    """Return `values` as a float64 array that cannot be written to."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def clipped_input(action: ArrayLike, limit: float) -> float:
    """Return the only entry of an action of shape (1,), clipped to ``[-limit, limit]``.

    Raises
    ------
    ValueError
        If the shape is not (1,), or the entry is NaN.
    """
    values = np.asarray(action, dtype=np.float64)
    if values.shape != (1,):
        raise ValueError(f"action must have shape (1,), got shape {values.shape}: {action!r}.")
    value = float(values[0])
    if math.isnan(value):
        raise ValueError(
            f"action must be a number, got {action!r}. A policy that returns NaN has usually "
            "diverged in an earlier update."
        )
    return min(max(value, -limit), limit)


def start_option(
    options: Mapping[str, Any] | None,
    low: NDArray[np.floating[Any]],
    high: NDArray[np.floating[Any]],
    names: Sequence[str],
) -> tuple[float, ...] | None:
    """Return the start that ``reset(options={"state": ...})`` asks for, None if it asks for none.

    Parameters
    ----------
    options : mapping, optional
        The argument of `gymnasium.Env.reset`.
    low, high : ndarray, shape (n,)
        Bounds of a valid start.
    names : sequence of str
        Names of the n entries, for the messages.

    Raises
    ------
    ValueError
        If there is an option other than "state", or if the state has another shape than (n,), is
        not finite, or lies outside the bounds.
    """
    if not options:
        return None
    unknown = sorted(map(str, set(options) - {"state"}))
    if unknown:
        raise ValueError(f"options has unknown keys {unknown}; the only key is 'state'.")
    state = np.asarray(options["state"], dtype=np.float64)
    if state.shape != low.shape:
        raise ValueError(
            f"options['state'] must have shape {low.shape} ({', '.join(names)}), "
            f"got shape {state.shape}."
        )
    for name, value, lower, upper in zip(names, state, low, high, strict=True):
        if not lower <= value <= upper:  # also true for NaN
            raise ValueError(
                f"options['state']: {name} must be in [{lower:.9g}, {upper:.9g}], got {value!s}."
            )
    return tuple(state.tolist())


def check_render_mode(render_mode: str | None, env: gymnasium.Env[Any, Any]) -> str | None:
    """Return `render_mode` if `env` offers it or it is None, else raise a ValueError."""
    modes = env.metadata["render_modes"]
    if render_mode is not None and render_mode not in modes:
        raise ValueError(f"render_mode must be None or one of {modes}, got {render_mode!r}.")
    return render_mode


def warn_no_render_mode(env: gymnasium.Env[Any, Any]) -> None:
    """Give the warning that Gymnasium's own environments give without a render mode."""
    env_id = type(env).__name__ if env.spec is None else env.spec.id
    gymnasium.logger.warn(
        "You are calling render method without specifying any render mode. "
        "You can specify the render_mode at initialization, "
        f'e.g. gym.make("{env_id}", render_mode="rgb_array")'
    )


def not_reset(what: str, reason: str) -> gymnasium.error.ResetNeeded:
    """Return the error for a `what` ("step", "render") that needs a `reset` first."""
    return gymnasium.error.ResetNeeded(f"Call env.reset() before env.{what}(): {reason}.")
