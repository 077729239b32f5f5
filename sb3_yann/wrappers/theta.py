"""Wrappers that complete an observation to theta = [x, r, d, u_prev], in that order outwards."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from numpy.typing import ArrayLike, NDArray

from sb3_yann._validation import Array, NonFiniteWarning, check_int, check_type, check_vector, warn
from sb3_yann.control import DisturbanceObserver, StateEstimator
from sb3_yann.units import FLOAT32_ROUNDING, Units

Vector = NDArray[np.floating[Any]]
Env = gym.Env[Vector, Vector]


def require_vector(env: gym.Env[Any, Any], name: str) -> spaces.Box:
    """Return a space of the env, a Box with one dimension."""
    check_type("env", env, gym.Env, "a gymnasium.Env: gymnasium.make(id), or one of your own")
    space = getattr(env, name)
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise TypeError(
            f"{name} is {space}, the wrappers need a Box with one dimension. Wrap the env in "
            "gymnasium.wrappers.FlattenObservation, or observe the plant's state."
        )
    return space


class Appending(gym.Wrapper[Vector, Vector, Vector, Vector]):
    """Appends a vector between ``low`` and ``high`` (p,), for each of so many ``rows``.

    The first ``n_replaced`` entries of the env's observation give way to ``n_new`` unbounded ones.
    It is float64 where the env's is. What lies on a bound is shown inside it, where float32 would
    round it beyond: some laws are zero outside their box. ``appends`` are parts of `ThetaLayout`.
    """

    appends: tuple[str, ...] = ()

    def __init__(
        self,
        env: Env,
        low: ArrayLike,
        high: ArrayLike,
        n_replaced: int = 0,
        n_new: int = 0,
        rows: int = 1,
    ) -> None:
        inner = require_vector(env, "observation_space")
        super().__init__(env)
        self.inputs = require_vector(self, "action_space")
        sides = (np.array(side, np.float64, ndmin=1) for side in (low, high))
        self.low, self.high = (np.tile(side, rows) for side in sides)
        if self.low.ndim != 1 or self.low.shape != self.high.shape:
            raise ValueError(
                f"low has shape {self.low.shape} and high {self.high.shape}; give the bounds of "
                "each appended entry as two vectors of the same length."
            )
        if not np.all(self.low <= self.high):  # nor is NaN
            raise ValueError(
                f"low = {self.low.tolist()} and high = {self.high.tolist()} must be numbers, and "
                "no entry of low may exceed that of high."
            )
        free = np.full(n_new, np.inf)
        kind: Any = np.result_type(inner.dtype, np.float32)
        self._rounded = self.low.astype(kind), self.high.astype(kind)
        low, high = self._rounded
        self.observation_space: Any = spaces.Box(
            np.concatenate([-free, inner.low[n_replaced:], low]).astype(kind),
            np.concatenate([free, inner.high[n_replaced:], high]).astype(kind),
            dtype=kind,
        )
        self._inside = (
            np.where(low < self.low, np.nextafter(low, np.inf), low),
            np.where(high > self.high, np.nextafter(high, -np.inf), high),
        )

    def reset(self, **kwargs: Any) -> tuple[Vector, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(**kwargs)  # seeds the generator that draws
        return self._shown(observation, None, info), info

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Step; the observation is the completed one."""
        u = np.clip(np.array(action, np.float64), self.inputs.low, self.inputs.high)
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._shown(observation, u, info), float(reward), terminated, truncated, info

    def _shown(self, observation: Vector, u: Array | None, info: dict[str, Any]) -> Vector:
        """Return what is observed, with what was appended on its bounds or inside them."""
        parts = self._observe(observation, u, info)
        shown = np.concatenate(parts).astype(self.observation_space.dtype)
        appended = shown[len(shown) - len(self.low) :]
        for rounded, inside in zip(self._rounded, self._inside, strict=True):
            np.copyto(appended, inside, where=appended == rounded)
        return shown

    def _observe(self, observation: Vector, u: Array | None, info: dict[str, Any]) -> list[Vector]:
        """Return the parts of what follows an input u (m,), None at the start of an episode."""
        raise NotImplementedError


AWrapper = TypeVar("AWrapper", bound="gym.Wrapper[Any, Any, Any, Any]")
Schedule = Callable[[int], ArrayLike]
"""The reference after so many steps of an episode."""


class PastInputs(Appending):
    """Appends the inputs on their way, which are states of a model with dead time.

    They belong to x: wrap the env in this first. ``LinearModel.from_data(..., delay=)`` makes such
    a model, and its report names the delays.

    Parameters
    ----------
    env : gymnasium.Env, with one-dimensional Box spaces
    delays : sequence of int, length m
        For each input, how many of its past values are appended, newest first.
    initial : array_like, shape (m,), optional
        What was on its way at the start of an episode, as the env takes it: zeros by default.
        An env with an operating point needs it: ``model.u_ss``. So does one whose bounds leave zero
        out, or begin or end there.

    Examples
    --------
    >>> import gymnasium as gym
    >>> env = PastInputs(gym.make("CSTR-v0"), delays=[2])
    >>> _ = env.reset(seed=0), env.step(np.float32([1]))
    >>> env.step(np.float32([-1]))[0][-2:].tolist()
    [-1.0, 1.0]
    """

    appends = "state", "previous"

    def __init__(self, env: Env, delays: Sequence[int], initial: ArrayLike | None = None) -> None:
        bounds = require_vector(env, "action_space")
        hint = "It counts past values of an input."
        check_type("delays", delays, Iterable, "a list, how late each input acts")
        self.delays = [check_int("delays", each, 0, hint) for each in delays]
        if len(self.delays) != bounds.shape[0]:
            raise ValueError(
                f"delays = {self.delays} must have one entry for each of the {bounds.shape[0]} "
                "inputs, 0 for one without dead time."
            )
        low = np.repeat(bounds.low, self.delays)
        high = np.repeat(bounds.high, self.delays)
        super().__init__(env, low, high)
        late = np.array(self.delays) > 0
        if initial is None and np.any(late & ((bounds.low >= 0) | (bounds.high <= 0))):
            raise ValueError(
                f"The env takes inputs from {bounds.low.tolist()} to {bounds.high.tolist()}: zero, "
                "the default, is hardly the one before an episode. Pass initial, such as u_ss of "
                "the model."
            )
        given = check_vector("initial", initial, len(bounds.low))
        self.initial = np.clip(given, bounds.low, bounds.high)
        off = np.abs(given - self.initial) > FLOAT32_ROUNDING * np.maximum(np.abs(given), 1)
        if np.any(late & off):
            raise ValueError(
                f"initial = {given.tolist()} is not between the env's {bounds.low.tolist()} and "
                f"{bounds.high.tolist()}. Give the inputs in their order and units; those of a "
                "PlantEnv are u_ss of its model."
            )
        self.past: list[Array] = []

    def _observe(self, observation: Vector, u: Array | None, info: dict[str, Any]) -> list[Vector]:
        longest = max(self.delays, default=0)
        self.past = [self.initial] * longest if u is None else [u, *self.past][:longest]
        shown = [self.past[k][j] for j, delay in enumerate(self.delays) for k in range(delay)]
        return [observation, np.array(shown, np.float64)]


class PreviousInput(PastInputs):
    """Appends the input of the step before, ``u_prev`` (m,), for bounds or weights on its rate.

    Parameters
    ----------
    env : gymnasium.Env, with one-dimensional Box spaces
    initial : array_like, shape (m,), optional
        What counts as the previous input at the start of an episode: see :class:`PastInputs`.

    Examples
    --------
    >>> import gymnasium as gym
    >>> env = PreviousInput(gym.make("CSTR-v0"))
    >>> env.reset(seed=0)[0].shape, float(env.step(np.float32([1]))[0][-1])
    ((5,), 1.0)
    """

    def __init__(self, env: Env, initial: ArrayLike | None = None) -> None:
        super().__init__(env, [1] * require_vector(env, "action_space").shape[0], initial)


class SetPoint(Appending):
    """Appends the reference r (p,) for the next action: drawn uniformly, or of a schedule.

    Parameters
    ----------
    env : gymnasium.Env, with one-dimensional Box spaces
    low, high : array_like, shape (p,)
        The box of references, ``r_min`` and ``r_max`` of the problem.
    hold : int, optional
        Steps after which another one is drawn. The default is one reference for each episode.
    schedule : callable, optional
        ``schedule(step) -> r`` replaces the random reference after so many steps of an episode; or
        a sequence of references, the last of which stays.
    preview : int, default 0
        Appends the references of so many samples ahead as well, as `Tracking(preview=)` has them.

    Examples
    --------
    >>> import gymnasium as gym
    >>> plant = gym.make("CSTR-v0")
    >>> env = SetPoint(plant, 0, 9, schedule=lambda step: step)
    >>> float(env.reset(seed=0)[0][-1]), float(env.step(np.float32([0]))[0][-1])
    (0.0, 1.0)
    """

    appends = "reference", "limits"

    def __init__(
        self,
        env: Env,
        low: ArrayLike,
        high: ArrayLike,
        *,
        hold: int | None = None,
        schedule: Schedule | Sequence[ArrayLike] | None = None,
        preview: int = 0,
    ) -> None:
        self.preview = check_int("preview", preview, 0, "It counts samples ahead.")
        super().__init__(env, low, high, rows=preview + 1)
        if not np.all(np.isfinite([self.low, self.high])):
            raise ValueError(
                f"low = {self.low.tolist()} and high = {self.high.tolist()} must be finite: "
                "references are drawn between them."
            )
        if hold is not None:
            check_int("hold", hold, hint="It counts steps; None is one reference in each episode.")
        self.hold = hold
        self.schedule = _as_schedule(schedule)
        self.steps = 0
        self.reference: Array = np.zeros(len(self.low))
        self._last: Array = self.reference
        self._ahead: list[Array] = [self._last]
        self._own: np.random.Generator | None = None
        for step in range(0 if schedule is None or callable(schedule) else len(schedule)):
            self._next(step)  # an error for one beyond low and high

    def reset(self, **kwargs: Any) -> tuple[Vector, dict[str, Any]]:
        """Start an episode, with another reference: a seed draws the same one again."""
        if keys := {"set_point", "reference", "schedule"} & {*(kwargs.get("options") or ())}:
            raise ValueError(
                f"options = {kwargs['options']!r} of reset: {keys} would be ignored. A reference "
                "r is held by SetPoint(env, low, high, schedule=[r])."
            )
        observation, info = self.env.reset(**kwargs)
        if (seed := kwargs.get("seed")) is not None:
            # An env that does not seed its own generator lends none.
            seeded = self.unwrapped.np_random_seed == seed
            self._own = None if seeded else seeding.np_random(seed)[0]
        return self._shown(observation, None, info), info

    def _observe(self, observation: Vector, u: Array | None, info: dict[str, Any]) -> list[Vector]:
        self.steps = 0 if u is None else self.steps + 1
        self._ahead = [] if u is None else self._ahead[1:]
        for step in range(self.steps + len(self._ahead), self.steps + self.preview + 1):
            due = self.schedule is not None or (self.hold and step % self.hold == 0)
            self._last = self._next(step) if due or step == 0 else self._last
            self._ahead.append(self._last)
        self.reference = np.concatenate(self._ahead)
        return [observation, self.reference]

    def _next(self, step: int) -> Array:
        p = len(self.low) // (self.preview + 1)
        low = self.low[:p]
        high = self.high[:p]
        if self.schedule is None:
            return np.asarray((self._own or self.np_random).uniform(low, high))
        try:
            r = np.atleast_1d(np.array(self.schedule(step), np.float64))
        except IndexError as error:
            raise ValueError(
                f"schedule({step}) ends in {error!r}. With preview={self.preview} it is asked "
                f"{self.preview} steps beyond the last one that is played: hold the last reference "
                "there, or pass the sequence itself, whose last one stays."
            ) from error
        if r.shape != low.shape or not np.all((low <= r) & (r <= high)):
            raise ValueError(
                f"schedule({step}) = {r.tolist()} must have shape {low.shape} and lie "
                f"between low = {low.tolist()} and high = {high.tolist()}."
            )
        return r


def _as_schedule(given: Schedule | Sequence[ArrayLike] | None) -> Schedule | None:
    """Return a schedule; of a sequence the last reference stays."""
    if given is None or callable(given):
        return given
    if not isinstance(given, Sequence | np.ndarray) or len(given) == 0:
        raise TypeError(
            f"schedule = {given!r} must be a function of the step, or references one after another."
        )
    return lambda step: given[min(step, len(given) - 1)]


class MeasuredDisturbance(Appending):
    """Appends a disturbance d (d,) that the env measures and reports in ``info``.

    An entry that is no finite number is named, and the last one that was holds: at first 0, or the
    nearest bound to it. :class:`ObserveDisturbance` comes after it.

    Parameters
    ----------
    env : gymnasium.Env, with one-dimensional Box spaces
    low, high : array_like, shape (d,)
        The box of disturbances, ``d_min`` and ``d_max`` of the problem.
    key : str, default "disturbance"
        The entry of ``info``, after reset and after each step, that holds d.
    preview : int, default 0
        That entry holds the disturbances of so many samples ahead as well, (preview + 1, d), as
        `DisturbanceBounds(preview=)` has them. Of fewer rows in the course of an episode, as a
        record ends, the last one stays.

    Examples
    --------
    >>> import gymnasium as gym
    >>> class Told(gym.Wrapper):
    ...     def reset(self, **kwargs):
    ...         return self.env.reset(**kwargs)[0], {"disturbance": 0.25}
    >>> env = MeasuredDisturbance(Told(gym.make("CSTR-v0")), low=-1, high=1)
    >>> float(env.reset(seed=0)[0][-1])
    0.25
    """

    appends = ("disturbance",)

    def __init__(
        self, env: Env, low: ArrayLike, high: ArrayLike, key: str = "disturbance", preview: int = 0
    ) -> None:
        check_int("preview", preview, 0, "It counts samples ahead.")
        super().__init__(env, low, high, rows=preview + 1)
        self.n_loads = len(self.low) // (preview + 1)
        if below(env, EstimateState) is not None:
            raise ValueError(
                "The env is in ObserveDisturbance already, whose observer would take the measured "
                "disturbance for an unknown one. Wrap it in MeasuredDisturbance first."
            )
        self.key = check_type("key", key, str, "a str, the entry of info that holds d")
        self.held: Array = np.clip(np.zeros(self.low.shape), self.low, self.high)
        self.failing = np.zeros(self.low.shape, dtype=bool)

    def _observe(self, observation: Vector, u: Array | None, info: dict[str, Any]) -> list[Vector]:
        if self.key not in info:
            raise ValueError(
                f"info has no {self.key!r}, only {sorted(info)}. Pass the name of the entry that "
                "holds the measured disturbance as key."
            )
        given = np.atleast_1d(np.asarray(info[self.key], np.float64))
        size = self.n_loads
        rows = len(self.low) // size
        d = given.reshape(-1, size) if given.ndim == 1 and len(given) % size == 0 else given
        least = rows if u is None else 1
        if d.ndim != 2 or d.shape[1] != size or not least <= len(d) <= rows:
            expected = (size,) if rows == 1 else (rows, size)
            ahead = f", a row for this sample and each of {rows - 1} ahead" if rows > 1 else ""
            raise ValueError(
                f"info[{self.key!r}] has shape {given.shape}, expected {expected}{ahead}."
            )
        d = d[np.minimum(np.arange(rows), len(d) - 1)].ravel()
        failing = ~np.isfinite(d)
        self.held = np.where(failing, self.held, d)
        if np.any(failing & ~self.failing):  # once, for a sensor that stays so
            warn(
                f"info[{self.key!r}] = {d.tolist()} is not finite: {self.held.tolist()} holds "
                "until it is again. Mend the sensor.",
                NonFiniteWarning,
            )
        self.failing = failing
        return [observation, self.held]


def below(env: Any, kind: type[AWrapper]) -> AWrapper | None:
    """Return the outermost wrapper of a kind in an env, None where there is none."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, kind):
            return env
        env = env.env
    return None


def _require_known(observer: StateEstimator, measured: MeasuredDisturbance | None) -> None:
    """Raise unless an observer knows which disturbances the env measures, and comes after them."""
    shown = 0 if measured is None else measured.n_loads
    n_known = observer.n_known
    if shown != n_known:
        raise ValueError(
            f"The env measures {shown} disturbances (MeasuredDisturbance), but the observer "
            f"takes {n_known}: what it does not take it estimates, and that would count twice. "
            "Wrap the plant in MeasuredDisturbance first, and give the observer the MPC's model "
            "with E of all disturbances, the measured ones first: LinearModel(A, B, dt, E=E, "
            "estimated=[...])."
        )
    estimated = [*observer.model.estimated]
    if n_known and estimated and estimated[0] < n_known:
        raise ValueError(
            f"estimated = {estimated}: theta holds the measured disturbances before the estimated "
            "ones. Sort the columns of E so."
        )


CLIPPED = 50  # steps for which an estimate is beyond its range, after which it is no transient


class EstimateState(Appending):
    """Puts the estimated state in place of the measured outputs, and appends the disturbance d.

    All of it is in plant units where the estimator's model has an operating point. A reading that
    is not finite is left out: the estimator goes on without it.

    The first entries of the env's observation are the measured outputs y (q,) of the estimator;
    what other wrappers have appended to them, such as a reference, stays where it is. Measured
    disturbances come from a :class:`MeasuredDisturbance` below, and the estimator takes them.

    Parameters
    ----------
    env : gymnasium.Env, with one-dimensional Box spaces
    observer : StateEstimator
        Copied, so that each env has an estimate of its own.
    low, high : array_like, shape (d,), optional
        ``d_min`` and ``d_max`` of the problem, to which the estimate is clipped. Those of its
        measured disturbances may be left out. There are no bounds by default.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from sb3_yann.control import LinearModel
    >>> model = LinearModel(np.eye(5) / 2, np.ones((5, 1)), dt=1, C=np.eye(4, 5) + 1)
    >>> env = EstimateState(gym.make("CSTR-v0"), StateEstimator(model))
    >>> env.reset(seed=0)[0].shape
    (5,)
    """

    appends = ("disturbance",)

    def __init__(
        self,
        env: Env,
        observer: StateEstimator,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
    ) -> None:
        wanted = "identify_outputs(...).estimator(), or the second of offset_free(mpc)"
        check_type("observer", observer, StateEstimator, f"a StateEstimator: {wanted}")
        free = np.full(observer.n_estimated, np.inf)
        low = -free if low is None else low
        high = free if high is None else high
        self.measured: Any = below(env, MeasuredDisturbance)
        _require_known(observer, self.measured)
        if np.size(low) == np.size(high) == observer.model.n_disturbances:
            low, high = (np.ravel(side)[observer.n_known :] for side in (low, high))
        super().__init__(env, low, high, observer.n_measured, observer.model.n_states)
        if len(self.low) != observer.n_estimated:
            raise ValueError(
                f"low has shape {self.low.shape}, but the observer estimates "
                f"{observer.n_estimated} disturbances."
            )
        self.observer = copy.deepcopy(observer)
        model = observer.model
        known, estimated = np.split(model.d_ss, [observer.n_known])
        # The observer computes with deviations: what counts from where.
        self.inner = Units(np.concatenate([observer.C @ model.x_ss, known]), model.u_ss)
        self.outer = Units(np.concatenate([model.x_ss, estimated]), model.u_ss)
        self.load: Array | None = None
        self.clipped: NDArray[np.intp] = np.zeros(observer.n_estimated, dtype=np.intp)
        self.failing: NDArray[np.bool_] = np.zeros(observer.n_measured, dtype=bool)
        self.readings: Vector = np.full(observer.n_measured, np.nan)  # the latest, in deviations

    def _observe(self, observation: Vector, u: Array | None, info: dict[str, Any]) -> list[Vector]:
        observer = self.observer
        measured, rest = np.split(observation.copy(), [observer.n_measured])
        measured = self.inner.to_deviations(measured) if self.inner.shifted else measured
        u = None if u is None else self.inner.input_to_deviations(u)
        failing = ~np.isfinite(measured)
        if np.any((failing & ~self.failing)[observer.every == 1]):  # once, for one that stays so
            shown = observation[: len(measured)].tolist()
            at = f"The measurement {shown} is not finite: the observer predicts it."
            warn(at, NonFiniteWarning)
        self.failing = failing
        measured[failing] = np.nan
        self.readings = measured
        both = observer.reset(measured) if u is None else observer.update(measured, u, self.load)
        if self.measured is not None:  # acts until the next sample
            first = observer.n_measured
            self.load = self.measured.held[: observer.n_known] - self.inner.theta_ss[first:]
        x_hat, d_hat = np.split(self.outer.to_plant(np.concatenate(both)), [len(both[0])])
        shown = np.clip(d_hat, self.low, self.high)
        # The state is estimated with the disturbance that the law knows, or both drive it off.
        observer.estimate[len(x_hat) :] -= d_hat - shown
        self.clipped = np.where((shown != d_hat) & (u is not None), self.clipped + 1, 0)
        for i in np.flatnonzero(self.clipped == CLIPPED):
            warn(
                f"For {CLIPPED} steps the estimated d[{i}] has been beyond its range, "
                f"{self.low[i]:g} to {self.high[i]:g}: more than that acts, and the plant settles "
                "beside its targets. Widen it: offset_free(mpc, d_max=...)."
            )
        return [x_hat, rest, shown]


class ObserveDisturbance(EstimateState):
    """:class:`EstimateState` with a disturbance, whose estimate is clipped to a box.

    Parameters
    ----------
    env : gymnasium.Env, with one-dimensional Box spaces
    observer : DisturbanceObserver
    low, high : array_like, shape (d,)

    Examples
    --------
    >>> import gymnasium as gym
    >>> from sb3_yann.control import LinearModel
    >>> model = LinearModel(np.eye(4) / 2, np.ones((4, 1)), dt=1, E=np.ones((4, 1)))
    >>> env = ObserveDisturbance(gym.make("CSTR-v0"), DisturbanceObserver(model), -1, 1)
    >>> env.reset(seed=0)[0].shape
    (5,)
    """

    def __init__(
        self, env: Env, observer: DisturbanceObserver, low: ArrayLike, high: ArrayLike
    ) -> None:
        check_type("observer", observer, DisturbanceObserver, "a DisturbanceObserver")
        super().__init__(env, observer, low, high)
