"""A simulator that is put into a state and stepped: how that is done, and its noise."""

from __future__ import annotations

import copy
import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product
from math import factorial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, check_positive, check_positive_vector, to_float

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
    """An environment for experiments, and where it comes from.

    It is `private` to them, or not; one that is `owned` is closed afterwards.
    """

    env: Any
    note: str
    private: bool
    owned: bool

    def close(self) -> None:
        """Close the environment if it was made here; a copy may share its window."""
        if self.owned:
            self.env.close()


def require_makes(env: Any) -> None:
    """Raise unless an id is registered, or a function can be called without arguments."""
    import gymnasium

    if isinstance(env, str):
        try:
            gymnasium.spec(env)
        except gymnasium.error.Error as error:
            raise ValueError(
                f"env = {env!r} cannot be made ({error}) Import the package that registers it, or "
                "pass a function that makes such an env."
            ) from error
    elif callable(env):
        try:
            inspect.signature(env).bind()
        except TypeError as error:
            raise TypeError(
                f"env = {env!r} cannot be called without arguments ({error}). Pass an env, or a "
                "function without arguments that makes one, such as lambda: PlantEnv(f, mpc)."
            ) from error
        except ValueError:  # its arguments are not known
            pass


def borrow(env: Maker) -> Borrowed:
    """Return an environment made from an id or a function, or a deep copy of the given one."""
    import gymnasium

    require_makes(env)
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
        self.env = borrowed.env
        self.origin = borrowed.note
        self.refusal = ""
        self.ended = False
        self.over = False
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
        self.setter = next(iter(self.setters))
        self.reader = next(iter(self.readers))

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


SPACINGS = (1e-3, 1e-4, 1e-5)
"""Distances of the points at which noise is measured, relative to the scale."""
POINTS = 10
ORDER = 6
"""Points on a line, and the order of the differences that leave nothing of a smooth function."""
UNLIKE = 4.0  # ratio of what two spacings show from which it is a kink rather than noise
MOST = 1e-3  # largest noise, relative to the scale, that differences can cope with


def noise_of(f: Callable[[Array], Array], point: Array, scale: Array) -> Array:
    """Return the deviation of each value's noise (r,), zeros where there is a kink instead.

    High differences of a smooth function vanish. What they show is noise where it does not shrink
    with the spacing: Hamming's table, as in Moré & Wild (2011), *SIAM J. Sci. Comput.* 33. f takes
    points (c,) and returns values (r,); ``scale`` (c,) is the range of each coordinate.
    """
    direction = scale * np.random.default_rng(0).choice([-1.0, 1.0], point.size)
    offsets = np.arange(POINTS) - (POINTS - 1) / 2
    shrink = factorial(ORDER) ** 2 / factorial(2 * ORDER)
    levels = []
    for spacing in SPACINGS:
        values = np.array([f(point + spacing * k * direction) for k in offsets])
        table = np.diff(values, ORDER, axis=0)
        levels.append(np.sqrt(shrink * np.mean(table**2, axis=0)))
    found = np.array(levels)
    if not np.all(np.isfinite(found)):
        return np.zeros(found.shape[1])
    largest = np.max(found, axis=0)
    # A kink fades with the spacing. At the shortest, noise may be smooth, as of step sizes chosen.
    steady = largest <= UNLIKE * np.maximum(np.median(found, axis=0), np.finfo(float).tiny)
    return np.where(steady, largest, 0.0)


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

    The simulator's ``setter`` and ``reader`` are the first pair that passes. A state x (n,) may
    hold NaN where it is not known, and is by default that of the reset; u (m,) is tried.
    """
    begun = {name: simulator.read(name) for name in simulator.readers}
    tried = []
    for setter, (reader, start) in product(simulator.setters, begun.items()):
        if start is None or (x is not None and start.size != x.size):
            continue
        simulator.setter = setter
        simulator.reader = reader
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
    up = space.high - u
    down = u - space.low
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
