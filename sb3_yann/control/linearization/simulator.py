"""A Gymnasium environment as the map from a state and an action to the next state."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, check_positive, to_float

if TYPE_CHECKING:
    import gymnasium

    Maker = gymnasium.Env[Any, Any] | str | Callable[[], gymnasium.Env[Any, Any]]

Reader = Callable[[Any, Any, dict[str, Any]], Any]  # of an environment, observation and info

RESET = 'reset(options={"state": x})'
ATTRIBUTE = "env.unwrapped.state"
MUJOCO = "env.unwrapped.data.qpos and qvel"
SHOWN = "the observation"
READERS: dict[str, Reader] = {
    'info["state"]': lambda env, observation, info: info.get("state"),
    ATTRIBUTE: lambda env, observation, info: getattr(env.unwrapped, "state", None),
    MUJOCO: lambda env, observation, info: _positions_and_velocities(env.unwrapped),
    SHOWN: lambda env, observation, info: observation,
}
"""Where a state may be read, the most precise first: observations are float32."""


@dataclass
class Borrowed:
    """An environment for experiments: `private` to them, or `owned` and so closed afterwards.

    Attributes
    ----------
    env, note : gymnasium.Env and str
        The environment, and where it comes from.
    private, owned : bool
    """

    env: Any
    note: str
    private: bool
    owned: bool

    def close(self) -> None:
        """Close the environment if it was made here; a copy may share its window."""
        if self.owned:
            self.env.close()


def borrow(env: Maker) -> Borrowed:
    """Return an environment made from an id or a function, or a deep copy of the given one."""
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
    """Return the time of one step: ``dt``, or the one that the environment states."""
    if dt is not None:
        return check_positive("dt", dt)
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
    """``next_state(x, u)`` of an environment whose state can be set.

    `LinearModel.from_env` documents ``set_state`` and ``get_state``. A private environment is reset
    with a fixed seed.
    """

    def __init__(
        self,
        borrowed: Borrowed,
        set_state: Callable[[Any, Array], object] | None,
        get_state: Callable[[Any], ArrayLike] | None,
    ) -> None:
        self.env, self.origin = borrowed.env, borrowed.note
        self.refusal, self.ended, self.over = "", False, False
        self.observation, self.info = self.env.reset(seed=0 if borrowed.private else None)
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
            if _positions_and_velocities(self.env.unwrapped) is not None:
                self.setters["env.unwrapped.set_state(qpos, qvel)"] = self._set_mujoco
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
        """Put the environment into the state x; tell whether `read` then returns it already."""
        if self.over and not self.resets:
            self.observation, self.info = self.env.reset()
            self.over = False
        self.setters[self.setter](x)
        return self.resets or self.reader in ("get_state", ATTRIBUTE, MUJOCO)

    def actual(self, u: Array) -> Array:
        """Return the action that the environment gets for u: in the precision of its space."""
        space = self.env.action_space
        return np.clip(u, space.low, space.high).astype(space.dtype).astype(np.float64)

    def next_state(self, x: Array, u: Array) -> Array:
        """Return the state one step later, NaN where the environment cannot go from x."""
        try:
            self.put(x)
        except (ValueError, AssertionError) as error:
            self.refusal = str(error)
            return np.full(x.size, np.nan)
        try:
            reached = self.go_on(u)
        except ArithmeticError as error:  # the equations have no value there
            self.refusal = str(error)
            return np.full(x.size, np.nan)
        if reached.shape != x.shape:
            raise ValueError(f"{self.reader} holds no state of shape {x.shape} after a step.")
        return reached

    def go_on(self, u: Array) -> Array:
        """Return the state one step later, from wherever the environment is."""
        action = self.actual(u).astype(self.env.action_space.dtype)
        self.observation, _, terminated, truncated, self.info = self.env.step(action)
        self.over, self.ended = bool(terminated or truncated), bool(terminated)
        reached = self.read()
        if reached is None:
            raise ValueError(f"{self.reader} holds no state after a step.")
        return reached

    def _reset_to(self, x: Array) -> None:
        self.observation, self.info = self.env.reset(options={"state": np.array(x)})

    def _assign(self, x: Array) -> None:
        self.env.unwrapped.state = np.array(x)

    def _set_mujoco(self, x: Array) -> None:
        plant = self.env.unwrapped
        split = np.size(plant.data.qpos)
        plant.set_state(np.array(x[:split]), np.array(x[split:]))


def _positions_and_velocities(plant: Any) -> Array | None:
    """Return [qpos, qvel] of Gymnasium's MuJoCo environments, None where there is no such."""
    data: Any = getattr(plant, "data", None)
    if not callable(getattr(plant, "set_state", None)) or not hasattr(data, "qvel"):
        return None
    return np.concatenate([np.ravel(data.qpos), np.ravel(data.qvel)]).astype(np.float64)


def to_vector(value: Any) -> Array | None:
    """Return ``value`` as an array of shape (n,), None if it is no vector of numbers."""
    if value is None or isinstance(value, (str, dict)):
        return None
    try:
        array = to_float("state", value)
    except TypeError:
        return None
    return array if array.ndim == 1 and array.size and np.all(np.isfinite(array)) else None
