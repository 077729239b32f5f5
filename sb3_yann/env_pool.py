"""Where envs come from: ids, makers, copies, parts of a VecEnv; a pool plays them again."""

from __future__ import annotations

import copy
import importlib
import itertools
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv

from sb3_yann._validation import check_type, half_widths, warn
from sb3_yann.control.observer import StateEstimator
from sb3_yann.control.simulator import require_makes
from sb3_yann.units import same_bounds

Source = gym.Env[Any, Any] | str | Callable[[], gym.Env[Any, Any]]


def as_source(env: Any) -> Any:
    """Return the id of an env, an env, or what makes one; else raise TypeError or ValueError.

    Of ``"module:name"`` the function is imported, unless the module registers an env of that name.
    """
    if isinstance(env, str) and ":" in env:
        module, name = env.split(":", 1)
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise ValueError(f"env = {env!r}: {module!r} cannot be imported ({error}).") from error
        if name in gym.registry:
            return name
        found = getattr(sys.modules[module], name, None)
        if not (callable(found) or isinstance(found, gym.Env)):
            raise ValueError(
                f"env = {env!r}: {module!r} has no function {name!r} that makes an env, and "
                "registers no env of that id."
            )
        return found
    wanted = "the id of an environment, a gymnasium.Env, or a function that makes one"
    check_type("env", env, str | gym.Env | Callable, wanted)
    require_makes(env)
    return env


def make_env(source: Source) -> gym.Env[Any, Any]:
    """Return the env that is given, or one that is made."""
    source = as_source(source)
    if isinstance(source, gym.Env):
        return source
    made = gym.make(source, disable_env_checker=True) if isinstance(source, str) else source()
    if not isinstance(made, gym.Env):
        raise TypeError(f"The function that makes envs returned {made!r}, not a gymnasium.Env.")
    return made


def maker(env: Any, name: str = "env_or_twin") -> Callable[[], gym.Env[Any, Any]]:
    """Return a function that makes envs like the one that is given, by this name, or made."""
    if is_vec_env(env):
        return itertools.cycle([OneOf(env, i) for i in range(env.num_envs)]).__next__
    source = as_source(env)
    if not isinstance(source, gym.Env):
        return partial(make_env, source)
    try:
        copy.deepcopy(source)
    except Exception as error:  # whatever a simulator raises that cannot be copied
        raise TypeError(
            f"{name} = {env!r} cannot be copied ({error}). Pass a function that makes such an env: "
            "the starts are played side by side."
        ) from error
    return partial(copy.deepcopy, source)


class ProcessEndedError(RuntimeError):
    """An env of a VecEnv has raised an error, and plays no more."""


class OneOf(gym.Env[Any, Any]):
    """One env of a Stable-Baselines3 VecEnv: it waits for no other, and resets alone.

    The VecEnv is not closed.
    """

    def __init__(self, envs: Any, number: int) -> None:
        self.all = envs
        self.number = number
        self.plant_name = name_of(envs)
        self.observation_space = envs.observation_space
        self.action_space = envs.action_space

    def reset(self, **kwargs: Any) -> Any:
        """Start an episode."""
        return self._asked("reset", **kwargs)

    def step(self, action: Any) -> Any:
        """Step this env alone."""
        return self._asked("step", action)

    def _asked(self, name: str, *given: Any, **named: Any) -> Any:
        try:
            return self.all.env_method(name, *given, indices=[self.number], **named)[0]
        except (EOFError, ConnectionError) as error:
            if not hasattr(self.all.unwrapped, "remotes"):  # it is the env's own
                raise
            raise ProcessEndedError(
                f"The process of env {self.number} has ended: its own error is above, on stderr. "
                "Let its step return terminated=True in a state that it cannot be in."
            ) from error


def is_vec_env(env: Any) -> bool:
    """Return whether an env is a VecEnv of Stable-Baselines3, which is not imported for that."""
    return hasattr(env, "env_method") and hasattr(env, "num_envs")


def observer_of(env: Any) -> StateEstimator | None:
    """Return the observer among the wrappers of an env or of a VecEnv, None where there is none.

    An id, a class or a function that makes an env has none.
    """
    found = None
    if is_vec_env(env) and env.has_attr("observer"):
        found = env.get_attr("observer", 0)[0]
    elif isinstance(env, gym.Env) and env.has_wrapper_attr("observer"):
        found = env.get_wrapper_attr("observer")
    return found if isinstance(found, StateEstimator) else None


def name_of(env: Any) -> str:
    """Return a name of a simulator that is the same in another process, "plant" for a lambda."""
    if isinstance(env, str):
        return env
    if is_vec_env(env):
        return f"{type(env.unwrapped).__name__} of {env.num_envs}"
    if isinstance(env, gym.Env):
        spec = env.spec
        plain = env.unwrapped  # of a `PlantEnv` it has the name of its function
        own = str(getattr(plain, "plant_name", type(plain).__name__))
        return own if spec is None else f"{spec.id}{spec.kwargs or ''}"
    if isinstance(env, partial):  # its repr holds an address, which the next process does not have
        return f"{name_of(env.func)}{env.args}{env.keywords}"
    name: str = getattr(env, "__qualname__", type(env).__name__)
    return "plant" if "<lambda>" in name else name


class EnvPool:
    """Envs that play again and again: making one often takes longer than its episode.

    :func:`evaluate` takes it in the place of an env. There are at most so many envs: more episodes
    are played one lot after the other. They are stepped by ``each(step, rows, actions)``. An env
    that was given plays alone, and is never closed.
    """

    def __init__(
        self, source: Source, most: int | None = None, each: Callable[..., Iterable[Any]] = map
    ) -> None:
        self.source = as_source(source)
        self.is_given = isinstance(self.source, gym.Env)
        self.most = 1 if self.is_given else most
        self.each = each
        self.envs: list[gym.Env[Any, Any]] = []

    @contextmanager
    def acquire(self, n: int) -> Iterator[list[gym.Env[Any, Any]]]:
        """Yield n envs. After an error none is kept: their episodes are not over."""
        try:
            while len(self.envs) < n:
                self.envs.append(make_env(self.source))
            yield self.envs[:n]
        except BaseException:
            self.close()
            raise
        self.close(200)  # envs that a pool keeps

    def close(self, kept: int = 0) -> None:
        """Close all envs but so many."""
        while len(self.envs) > kept:
            env = self.envs.pop()
            if not self.is_given:
                env.close()


def pool_of(env: Any, make: Callable[[], gym.Env[Any, Any]]) -> EnvPool:
    """Return a pool of what ``make`` makes; of a VecEnv as many as it has, stepped at once."""
    if not is_vec_env(env):
        return EnvPool(make)
    own = hasattr(env.unwrapped, "remotes")  # a process each, which are asked by threads
    return EnvPool(make, env.num_envs, ThreadPoolExecutor(env.num_envs).map if own else map)


@contextmanager
def one_env(source: Source | EnvPool) -> Iterator[gym.Env[Any, Any]]:
    """Yield the env that is given, one of a pool, or one that is made and closed afterwards."""
    pool = source if isinstance(source, EnvPool) else EnvPool(source)
    with pool.acquire(1) as (env,):
        yield env
    if pool is not source:
        pool.close()


def require_like_training(source: Source | EnvPool, training_env: Any, name: str) -> None:
    """Raise ValueError if a simulator is the training env, or an env of another plant."""
    training = [env.unwrapped for env in getattr(training_env, "envs", [])]
    with one_env(source) as env:
        if any(env.unwrapped is each for each in training):
            raise ValueError(
                f"{name} is the training env, whose episodes its own would interrupt. Give it "
                "another one, e.g. its id."
            )
        require_like(env, training_env, name, "the training env")
        spec = env.spec
        for own in (each.spec for each in training[:1]):
            if spec is None or own is None or spec.id != own.id:
                continue
            names = sorted({*spec.kwargs, *own.kwargs} - {"render_mode"})
            both = [[given.kwargs.get(each) for each in names] for given in (spec, own)]
            if other := [each for each, a, b in zip(names, *both, strict=True) if _differ(a, b)]:
                its, theirs = ({n: given.kwargs.get(n) for n in other} for given in (spec, own))
                warn(f"{name} makes {spec.id} with {its}, and the training env has {theirs}.")


def _differ(one: Any, other: Any) -> bool:
    """Tell whether two arguments of an env are others; gymnasium copies what it is given."""
    with suppress(Exception):  # of whatever compares itself
        if np.all(one == other):
            return False
    words = (re.sub(" at 0x[0-9a-fA-F]+", "", repr(each)) for each in (one, other))
    return next(words) != next(words)


def require_like(env: Any, other: Any, name: str, whose: str) -> None:
    """Raise ValueError unless an env shows and takes what another one does, or a model.

    The bounds of the actions may be rounded. Copies that step as one array are one env.
    """
    names = ("observation_space", "action_space")
    x, u = (getattr(env, f"single_{each}", getattr(env, each)) for each in names)
    other_x, other_u = (getattr(other, each) for each in names)
    same = x.shape == other_x.shape and u.shape == other_u.shape and isinstance(u, gym.spaces.Box)
    if same:
        coarse, fine = (u, other_u) if u.dtype.itemsize <= other_u.dtype.itemsize else (other_u, u)
        bounds = (fine.low, fine.high)
        same = same_bounds((coarse.low, coarse.high), bounds, half_widths(*bounds))
    if not same:
        raise ValueError(
            f"{name} has observations of shape {x.shape} and {u}, {whose} {other_x.shape} and "
            f"{other_u}. Give it a simulator of this plant, or the plant, in the same wrappers."
        )


def vector_env_of(env_id: str, n: int) -> VectorEnv[Any, Any, Any] | None:
    """Return n copies of an env that step as one array, None where there is no such env of it."""
    spec = gym.spec(env_id)
    if spec.vector_entry_point is None or spec.additional_wrappers or n == 0:
        return None
    made = gym.make_vec(env_id, num_envs=n, vectorization_mode="vector_entry_point")
    if made.metadata.get("seeds_each", False):  # most take one seed for all of them together
        return made
    made.close()
    return None
