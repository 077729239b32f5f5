"""A simulator that is put into a state and stepped: how that is done, and its noise."""

from __future__ import annotations

import copy
import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise, product
from math import factorial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, check_positive, check_positive_vector, to_float

if TYPE_CHECKING:
    import gymnasium

    Maker = gymnasium.Env[Any, Any] | str | Callable[[], gymnasium.Env[Any, Any]]

RESET = 'reset(options={"state": x})'
ATTRIBUTE = "env.unwrapped.state"
MUJOCO = "env.unwrapped.set_state(qpos, qvel)"
SHOWN = "the observation"


class Borrowed(NamedTuple):
    """An environment for experiments, where it comes from, and whether nobody else steps it."""

    env: Any
    note: str
    private: bool = True


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


@contextmanager
def borrow(env: Maker) -> Iterator[Borrowed]:
    """Lend an environment made from an id or a function, or a deep copy of the given one.

    What is made here is closed afterwards. A copy is not: it may share its window.
    """
    import gymnasium

    require_makes(env)
    if isinstance(env, str):
        found = Borrowed(gymnasium.make(env), f"a {env} made for it")
    elif isinstance(env, gymnasium.Env):
        try:
            found = Borrowed(copy.deepcopy(env), "a copy of env")
        except Exception:  # whatever a simulator raises that cannot be copied
            note = "env itself, which cannot be copied: reset it before its next step"
            found = Borrowed(env, note, private=False)
    elif callable(env):
        found = Borrowed(env(), "an environment made for it")
    else:
        raise TypeError(
            f"env = {env!r} must be a single gymnasium.Env, its id, or a function that makes one "
            "(of a vectorized environment, pass one of its parts)."
        )
    if not isinstance(found.env, gymnasium.Env):
        raise TypeError(f"env() returned {found.env!r}, expected a single gymnasium.Env.")
    try:
        space = found.env.action_space
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise TypeError(
                f"The action space is {space}: a linear model needs a Box of shape (m,). Wrap the "
                "environment so that its action is the physical input."
            )
        yield found
    finally:
        if not isinstance(env, gymnasium.Env):
            found.env.close()


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
    """The next state of an environment whose state can be set.

    `LinearModel.from_env` documents ``set_state`` and ``get_state``. A private environment is reset
    with a fixed seed. :func:`connect` chooses ``setter`` and ``reader`` among those there are.
    """

    def __init__(
        self,
        borrowed: Borrowed,
        set_state: Callable[[Any, Array], object] | None,
        get_state: Callable[[Any], ArrayLike] | None,
    ) -> None:
        self.env = borrowed.env
        self.origin = borrowed.note
        self.space = borrowed.env.action_space
        self.set_state = set_state
        self.get_state = get_state
        self.setter = RESET
        self.reader = ""
        self.n_states = 0
        self.refusal = ""
        self.ended = False
        self.over = False
        self.observation, self.info = self.env.reset(seed=0 if borrowed.private else None)
        plant = self.env.unwrapped
        self.setters = [RESET] if set_state is None else ["set_state"]
        if set_state is None and to_vector(getattr(plant, "state", None)) is not None:
            self.setters.append(f"{ATTRIBUTE} = x")
        if set_state is None and _positions_and_velocities(plant) is not None:
            self.setters.append(MUJOCO)

    def readings(self) -> dict[str, Array | None]:
        """Return the state wherever it may be, the most precise first: observations are float32."""
        if self.get_state is not None:
            return {"get_state": to_vector(self.get_state(self.env))}
        plant = self.env.unwrapped
        return {
            'info["state"]': to_vector(self.info.get("state")),
            ATTRIBUTE: to_vector(getattr(plant, "state", None)),
            "env.unwrapped.data.qpos and qvel": _positions_and_velocities(plant),
            SHOWN: to_vector(self.observation),
        }

    def put(self, x: Array) -> None:
        """Put the environment into the state x."""
        x = np.array(x)
        self.n_states = x.size
        plant = self.env.unwrapped
        if self.over and self.setter != RESET:
            self.observation, self.info = self.env.reset()
            self.over = False
        if self.set_state is not None:
            self.set_state(self.env, x)
        elif self.setter == RESET:
            self.observation, self.info = self.env.reset(options={"state": x})
        elif self.setter == MUJOCO:
            plant.set_state(*np.split(x, [np.size(plant.data.qpos)]))
        else:
            plant.state = x

    def put_and_read(self, x: Array) -> Array | None:
        """Put the environment into the state x; return what is read, None before a step shows."""
        self.put(x)
        stale = self.setter != RESET and self.reader in ('info["state"]', SHOWN)
        return None if stale else self.readings()[self.reader]

    def actual(self, u: Array) -> Array:
        """Return the action that the environment gets for u: in the precision of its space."""
        action = np.clip(u, self.space.low, self.space.high)
        return np.asarray(action.astype(self.space.dtype).astype(np.float64))

    def next_state(self, x: Array, u: Array) -> Array:
        """Return the state one step later, NaN where the environment cannot go from x."""
        try:
            self.put(x)
        except (ValueError, AssertionError) as error:
            self.refusal = str(error)
            return np.full(x.size, np.nan)
        try:
            return self.go_on(u)
        except ArithmeticError as error:  # the equations have no value there
            self.refusal = str(error)
            return np.full(x.size, np.nan)

    def go_on(self, u: Array) -> Array:
        """Return the state one step later, from wherever the environment is."""
        action = self.actual(u).astype(self.space.dtype)
        self.observation, _, terminated, truncated, self.info = self.env.step(action)
        self.over = bool(terminated or truncated)
        self.ended = bool(terminated)
        reached = self.readings()[self.reader]
        if reached is None or reached.size != self.n_states:
            raise ValueError(f"{self.reader} holds no state ({self.n_states},) after a step.")
        return reached

    def step(self, point: Array) -> Array:
        """Return the next state (n,) from the state and action in one vector (n+m,)."""
        return self.next_state(*np.split(point, [-self.space.shape[0]]))

    def way(self, u: Array) -> Array:
        """Return the way from u to the farther bound of the actions, signed, and at most 1000."""
        up = self.space.high - u
        down = u - self.space.low
        return np.asarray(np.where(up >= down, np.minimum(up, 1e3), -np.minimum(down, 1e3)))


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
MAX_NOISE = 1e-3  # largest noise, relative to the scale, that differences can cope with


def noise_of(f: Callable[[Array], Array], point: Array, scale: Array) -> Array:
    """Return the deviation of each value's noise (r,), zeros where there is a kink instead.

    High differences of a smooth function vanish. What they show is noise where it does not shrink
    with the spacing: Hamming's table, as in Moré & Wild (2011), *SIAM J. Sci. Comput.* 33. f takes
    points (c,) and returns values (r,); ``scale`` (c,) is the range of each coordinate.
    """
    order = 6  # of the differences, which leave nothing of a smooth function
    direction = scale * np.random.default_rng(0).choice([-1.0, 1.0], point.size)
    offsets = np.arange(POINTS) - (POINTS - 1) / 2
    values = np.array([[f(point + h * k * direction) for k in offsets] for h in SPACINGS])
    shrink = factorial(order) ** 2 / factorial(2 * order)
    found = np.sqrt(shrink * np.mean(np.diff(values, order, axis=1) ** 2, axis=1))
    if not np.all(np.isfinite(found)):
        return np.zeros(found.shape[1])
    largest = np.max(found, axis=0)
    # A kink fades with the spacing. At the shortest, noise may be smooth, as of step sizes chosen.
    # 4.0: ratio of what two spacings show from which it is a kink rather than noise
    steady = largest <= 4.0 * np.maximum(np.median(found, axis=0), np.finfo(float).tiny)
    return np.where(steady, largest, 0.0)


UNSEEN = "the plant has states besides these, which setting this one"
SET_STATE_ADVICE = (
    "Make them part of the state (of a delay, the inputs on their way), have set_state set them "
    "too, or identify the plant: LinearModel.from_data"
)


def connect(
    simulator: Simulator, x: Array | None, u: Array, scale: ArrayLike | None
) -> tuple[Array, Array]:
    """Choose how the state is set and read, by trial; return the state tried and its scale.

    The simulator's ``setter`` and ``reader`` are the first pair that passes. A state x (n,) may
    hold NaN where it is not known, and is by default that of the reset; u (m,) is tried.
    """
    begun = simulator.readings()
    tried = []
    for setter, (reader, start) in product(simulator.setters, begun.items()):
        if start is None or (x is not None and start.size != x.size):
            continue
        simulator.setter = setter
        simulator.reader = reader
        trial = start if x is None else np.where(np.isnan(x), start, x)
        size = _scale(simulator, trial, scale)
        failure = _failure(simulator, trial, u, size)
        if not failure:
            return trial, size
        tried.append(f"set by {setter}, read from {reader}: {failure}")
    if not tried:
        sizes = {name: None if v is None else v.shape for name, v in begun.items()}
        tried = [f"a state is nowhere to be read: {sizes}"]
        if x is not None:
            tried[0] = f"x_ss has shape {x.shape}, and no state that is read has: {sizes}; where "
            tried[0] += "an entry is not known, give NaN"
    ways = "".join(f"\n  - {each}" for each in tried)
    if simulator.set_state is None or simulator.get_state is None:
        ways += "\nPass set_state=lambda env, x: ... and get_state=lambda env: ... for its state."
    raise ValueError(f"The environment could not be put into a state and read. Tried:{ways}")


def _scale(simulator: Simulator, x: Array, scale: ArrayLike | None) -> Array:
    """Return the scale of each state, shape (n,)."""
    if scale is not None:
        return check_positive_vector("scale", scale, x.size)
    size = np.maximum(np.abs(x), 1.0)
    space = simulator.env.observation_space
    if getattr(space, "shape", None) == x.shape and hasattr(space, "low"):
        width = (space.high.astype(np.float64) - space.low) / 2
        size = np.where(width < largest_bound(x), width, size)
    return np.asarray(size)


def largest_bound(x: Array) -> Array:
    """Return what an observation space's bounds at a state x (n,) are none beyond.

    "No bound" may be written as the largest float32, or as 1e10.
    """
    return 1e6 + 1e3 * np.abs(x)


def _failure(simulator: Simulator, x: Array, u: Array, scale: Array) -> str:
    """Try the present way to set and read the state; return its fault, empty without one."""
    for other in (x + 0.01 * scale, x - 0.01 * scale):
        try:
            seen = [(state, simulator.put_and_read(state)) for state in (x, other)]
            break
        except (ValueError, AssertionError, TypeError, KeyError, AttributeError) as error:
            failure = f"refused ({error})"
    else:
        return failure
    for wanted, got in seen:
        if got is not None and got.shape != wanted.shape:
            return f"a state of {wanted.size} entries is read as {got.size}: {got.tolist()}"
        if got is not None and np.any(np.abs(got - wanted) > 1e-5 * (scale + np.abs(wanted))):
            reading = f"set to {wanted.tolist()} it reads {got.tolist()}"
            return f"{reading} (a state that is ignored, or an angle that wraps there)"
    first, moved, again = (simulator.next_state(state, u) for state in (x, other, x))
    if not np.all(np.abs(again - first) <= 1e-6 * (scale + np.abs(first))):
        return (
            f"two steps from the same state {x.tolist()} end in {first.tolist()} and "
            f"{again.tolist()}: setting it fails, or the plant is random or has states besides "
            "these (linearize it without its noise, its equations by LinearModel.from_dynamics, "
            "with d_ss= of a load, or identify it: LinearModel.from_data)"
        )
    pushed = simulator.next_state(other, u + 0.1 * simulator.way(u))
    if np.array_equal(moved, other) and np.array_equal(pushed, other):
        return f"no step changes it from {other.tolist()}, whatever the action"
    # A plant that forgets within a sample has A = 0: then what it did before does not matter.
    alike = simulator.setter != RESET and np.array_equal(first, moved)
    if alike and not np.array_equal(simulator.next_state(x, u), first):
        return f"the next state is {first.tolist()} from {x.tolist()} and {other.tolist()} alike"
    return _hidden_state(simulator, x, u, first, scale)


def _hidden_state(simulator: Simulator, x: Array, u: Array, first: Array, scale: Array) -> str:
    """Describe states besides x, whose next one is the first with u; empty without any.

    One that setting x leaves alone shows when a step is repeated after other inputs, one that
    setting x resets when the plant goes on by itself.
    """
    longest_delay = 20  # longest input delay, in samples, that is detected
    push = u + 0.5 * simulator.way(u)
    for _ in range(longest_delay):
        moved = simulator.next_state(x, push)
    again = simulator.next_state(x, u)
    if np.any(np.abs(again - first) > 1e-6 * (scale + np.abs(first))):
        return (
            f"the step from {x.tolist()} with the action {u.tolist()} ends in {first.tolist()}, "
            f"and after other actions in {again.tolist()}: {UNSEEN} leaves alone (a delay of the "
            f"input, an actuator). {SET_STATE_ADVICE}"
        )
    states = [simulator.next_state(x, push)]
    while len(states) < longest_delay and not simulator.over:
        if not np.all(np.abs(states[-1] - x) <= 10 * scale):
            break
        states.append(simulator.go_on(push))
    for before, after in pairwise(states):
        reached = simulator.next_state(before, push)
        # States may be read in float32, which the step may enlarge.
        doubt = np.maximum(1e-5 * (scale + np.abs(after)), 0.01 * np.abs(moved - first))
        if np.any(np.abs(reached - after) > doubt):
            return (
                f"going on from {before.tolist()}, the action {push.tolist()} leads to "
                f"{after.tolist()}, and set there to {reached.tolist()}: {UNSEEN} starts anew "
                f"(a delay of the input, an actuator, a clock). {SET_STATE_ADVICE}"
            )
    return ""
