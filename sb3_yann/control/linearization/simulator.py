"""A Gymnasium environment as the map from a state and an action to the next state."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, as_array, as_positive, to_float
from sb3_yann.control.linearization.connect import memory

if TYPE_CHECKING:
    import gymnasium

    Maker = gymnasium.Env[Any, Any] | str | Callable[[], gymnasium.Env[Any, Any]]

Reader = Callable[[Any, Any, dict[str, Any]], Any]
"""Returns the state from the environment, the observation and the info, None if it is not there."""

RESET = 'reset(options={"state": x})'
ATTRIBUTE = "env.unwrapped.state"
READERS: dict[str, Reader] = {
    'info["state"]': lambda env, observation, info: info.get("state"),
    ATTRIBUTE: lambda env, observation, info: getattr(env.unwrapped, "state", None),
    "the observation": lambda env, observation, info: observation,
}
"""Where a state may be read, the most precise first: observations are float32."""


@dataclass
class Borrowed:
    """An environment to experiment with, and what becomes of the user's."""

    env: Any
    note: str
    private: bool
    owned: bool

    def close(self) -> None:
        """Close the environment if it was made here; a copy may share its window."""
        if self.owned:
            self.env.close()


def borrow(env: Maker) -> Borrowed:
    """Return an environment of one's own: made from an id or a function, or a deep copy.

    Raises
    ------
    TypeError
        If it is none, or its actions are not a one-dimensional Box.
    """
    import gymnasium

    if isinstance(env, str):
        found = Borrowed(gymnasium.make(env), f"a {env} made for it", private=True, owned=True)
    elif isinstance(env, gymnasium.Env):
        try:
            found = Borrowed(copy.deepcopy(env), "a copy of env", private=True, owned=False)
        except Exception:  # whatever a simulator raises that cannot be copied
            note = "env itself, which cannot be copied: reset it before its next step"
            found = Borrowed(env, note, private=False, owned=False)
    elif callable(env):
        found = Borrowed(env(), "an environment made for it", private=True, owned=True)
    else:
        raise TypeError(
            f"env = {env!r} must be a single gymnasium.Env, its id, or a function that makes one "
            "(of a vectorized environment, pass one of its parts)."
        )
    if not isinstance(found.env, gymnasium.Env):
        raise TypeError(f"env() returned {found.env!r}, expected a single gymnasium.Env.")
    space = found.env.action_space
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
        found.close()
        raise TypeError(
            f"The action space is {space}: a linear model needs a Box of shape (m,). Wrap the "
            "environment so that its action is the physical input."
        )
    return found


def sample_time(env: Any, dt: float | None) -> float:
    """Return the time of one step: ``dt``, or what the environment is seen to use.

    Raises
    ------
    ValueError
        If none is given and none is found.
    """
    if dt is not None:
        return as_positive("dt", dt)
    plant = env.unwrapped
    module = sys.modules[type(plant).__module__]
    for owner, name in ((plant, "dt"), (plant, "tau"), (plant, "DT"), (module, "DT")):
        value = getattr(owner, name, None)
        if isinstance(value, (int, float, np.number)) and 0 < value < np.inf:
            return float(value)
    raise ValueError(
        f"dt is not given, and {type(plant).__name__} has no dt, tau or DT to take it from. Pass "
        "dt=..., the time of one step (1.0 if the plant has no time unit)."
    )


class Simulator:
    """``next_state(x, u)`` of an environment that can be put into a state.

    Parameters
    ----------
    borrowed : Borrowed
        The environment; it is reset once here, with a fixed seed unless it is the user's.
    set_state, get_state : callable, optional
        See `LinearModel.from_env`.
    """

    def __init__(
        self,
        borrowed: Borrowed,
        set_state: Callable[[Any, Array], object] | None,
        get_state: Callable[[Any], ArrayLike] | None,
    ) -> None:
        self.env = borrowed.env
        self.refusal = ""
        self.ended = False
        self.observation, self.info = self.env.reset(seed=0 if borrowed.private else None)
        self.over = False
        self.readers = dict(READERS)
        if get_state is not None:
            self.readers = {"get_state": lambda env, observation, info: get_state(env)}
        self.setters: dict[str, Callable[[Array], object]] = {}
        if set_state is not None:
            self.setters["set_state"] = lambda x: set_state(self.env, x)
        else:
            self.setters[RESET] = self._reset_to
            if to_vector(getattr(self.env.unwrapped, "state", None)) is not None:
                self.setters[f"{ATTRIBUTE} = x"] = self._assign
        self.setter, self.reader = next(iter(self.setters)), next(iter(self.readers))

    def read(self, reader: str | None = None) -> Array | None:
        """Return the state of shape (n,) where `reader` has it, None if it is not there."""
        read = self.readers[reader or self.reader]
        return to_vector(read(self.env, self.observation, self.info))

    @property
    def resets(self) -> bool:
        """Whether the state is set by a reset, which returns the observation of it."""
        return self.setter == RESET

    def put(self, x: Array) -> bool:
        """Put the environment into the state x; tell whether `read` then returns it already.

        Raises
        ------
        ValueError, AssertionError, TypeError
            Whatever the environment raises for a state that it does not take.
        """
        if self.over and not self.resets:
            self.observation, self.info = self.env.reset()
            self.over = False
        self.setters[self.setter](x)
        return self.resets or self.reader in ("get_state", ATTRIBUTE)

    def actual(self, u: Array) -> Array:
        """Return the action that the environment gets for u: in the precision of its space."""
        space = self.env.action_space
        return np.clip(u, space.low, space.high).astype(space.dtype).astype(np.float64)

    def next_state(self, x: Array, u: Array) -> Array:
        """Return the state one step later, NaN where the environment refuses to start from x."""
        try:
            self.put(x)
        except (ValueError, AssertionError) as error:
            self.refusal = str(error)
            return np.full(x.size, np.nan)
        reached = self.go_on(u)
        if reached.shape != x.shape:
            raise ValueError(f"{self.reader} holds no state of shape {x.shape} after a step.")
        return reached

    def go_on(self, u: Array) -> Array:
        """Return the state one step later, from wherever the environment is."""
        action = self.actual(u).astype(self.env.action_space.dtype)
        self.observation, _, terminated, truncated, self.info = self.env.step(action)
        self.over = bool(terminated or truncated)
        self.ended = bool(terminated)
        reached = self.read()
        if reached is None:
            raise ValueError(f"{self.reader} holds no state after a step.")
        return reached

    def _reset_to(self, x: Array) -> None:
        self.observation, self.info = self.env.reset(options={"state": np.array(x)})

    def _assign(self, x: Array) -> None:
        self.env.unwrapped.state = np.array(x)


def to_vector(value: Any) -> Array | None:
    """Return ``value`` as an array of shape (n,), None if it is no vector of numbers."""
    if value is None or isinstance(value, (str, dict)):
        return None
    try:
        array = to_float("state", value)
    except TypeError:
        return None
    return array if array.ndim == 1 and array.size and np.all(np.isfinite(array)) else None


def connect(
    simulator: Simulator, x: Array | None, u: Array, scale: ArrayLike | None
) -> tuple[Array, Array]:
    """Choose how the state is set and read, by trying it; return the state tried and its scale.

    Parameters
    ----------
    x : ndarray, shape (n,), optional
        A state to try, NaN where it is not known; None takes that of the reset.
    u : ndarray, shape (m,)
        An action to try.

    Raises
    ------
    ValueError
        If no way passes the trial; the message says what each failed at.
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
    raise ValueError(
        "The environment could not be put into a state and read. Tried:\n  - "
        + "\n  - ".join(tried)
        + "\nPass set_state=lambda env, x: ... and get_state=lambda env: ... for its state."
    )


def _scale(simulator: Simulator, x: Array, scale: ArrayLike | None) -> Array:
    """Return how far each state moves in use, shape (n,)."""
    if scale is not None:
        given = as_array("scale", scale, (x.size,))
        if np.any(given <= 0):
            raise ValueError(f"scale = {given.tolist()} must be above 0 in each entry.")
        return given
    size = np.maximum(np.abs(x), 1.0)
    space = simulator.env.observation_space
    if getattr(space, "shape", None) == x.shape and hasattr(space, "low"):
        width = (space.high.astype(np.float64) - space.low) / 2
        # Gymnasium's way of saying "no bound" is also the largest float32.
        size = np.where(width < 1e6, width, size)
    return np.asarray(size)


def _failure(simulator: Simulator, x: Array, u: Array, scale: Array) -> str | None:
    """Try a way to set and read the state; return what is wrong with it, None if nothing is."""
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
            return (
                f"set to {wanted.tolist()} it reads {got.tolist()} (a state that is ignored, or "
                "an angle that wraps there)"
            )
    first, moved, again = (simulator.next_state(state, u) for state in (x, other, x))
    if not np.all(np.abs(again - first) <= 1e-6 * (scale + np.abs(first))):
        return (
            f"two steps from the same state {x.tolist()} end in {first.tolist()} and "
            f"{again.tolist()}: setting it does not work, or the plant is random or has states "
            "besides these (then identify it: LinearModel.from_data)"
        )
    pushed = simulator.next_state(other, u + 0.1 * _room(simulator, u))
    if np.array_equal(moved, other) and np.array_equal(pushed, other):
        return f"no step changes it from {other.tolist()}, whatever the action"
    if not simulator.resets and np.array_equal(first, moved):
        return f"the next state is {first.tolist()} from {x.tolist()} and {other.tolist()} alike"
    return memory(simulator, x, u, u + 0.5 * _room(simulator, u), scale)


def _room(simulator: Simulator, u: Array) -> Array:
    """Return the way from u to the farther bound of the actions, signed, and at most 1000."""
    space = simulator.env.action_space
    up, down = space.high - u, u - space.low
    return np.asarray(np.where(up >= down, np.minimum(up, 1e3), -np.minimum(down, 1e3)))
