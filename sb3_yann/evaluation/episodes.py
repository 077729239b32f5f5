"""Seeded episodes of the deterministic policy, so that two policies meet the same starts."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import ArrayLike, NDArray

from sb3_yann._validation import Array, check_int, check_type
from sb3_yann.control import LinearModel, LinearMPC, OnlineLaw, PiecewiseAffine
from sb3_yann.control.linearization.wrapper_stack import require_state_shown
from sb3_yann.control.mpc.plant_units import InputUnits

Source = gym.Env[Any, Any] | str | Callable[[], gym.Env[Any, Any]]
LONG, LONGEST = 100_000, 1_000_000
"""Steps of an episode after which a warning tells of it, and after which it is an error."""


class Predictor(Protocol):
    """What Stable-Baselines3's models and policies offer."""

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, Any]:
        """Return the actions for a batch of observations, and a recurrent state."""


@dataclass(frozen=True)
class Episodes:
    """What came of a number of episodes, in the order of their seeds.

    Attributes
    ----------
    costs : ndarray, shape (episodes,)
        Minus the sum of the rewards.
    violations : ndarray of int, shape (episodes,)
        Steps whose ``info["violation"]`` is true.
    observations : tuple of ndarray, shapes (steps + 1, n)
    actions : tuple of ndarray, shapes (steps, m)
    terminated : ndarray of bool, shape (episodes,)
        Whether the env ended the episode itself, other than by a time limit, or with
        ``info["is_success"]``.

    Examples
    --------
    >>> episodes = evaluate(lambda observation: [0.0], "CSTR-v0", seeds=[0, 1])
    >>> [len(actions) for actions in episodes.actions]
    [400, 400]
    """

    costs: Array
    violations: NDArray[np.int64]
    observations: tuple[Array, ...]
    actions: tuple[Array, ...]
    terminated: NDArray[np.bool_]


def as_played(name: str, value: Episodes) -> Episodes:
    """Return ``value`` if it is Episodes, else raise TypeError."""
    return check_type(name, value, Episodes, "the Episodes that evaluate returns")


class EnvPool:
    """Envs that play again and again: making one often takes longer than its episode.

    Parameters
    ----------
    source : gymnasium.Env, str or callable
        As for :func:`evaluate`, which takes a pool in its place.
    """

    MOST = 200
    """Envs that are kept."""

    def __init__(self, source: Source) -> None:
        self.source = as_source(source)
        self.envs: list[gym.Env[Any, Any]] = []

    @contextmanager
    def lend(self, n: int) -> Iterator[list[gym.Env[Any, Any]]]:
        """Yield n envs. After an error none is kept: their episodes are not over."""
        try:
            while len(self.envs) < n:
                self.envs.append(make_env(self.source))
            yield self.envs[:n]
        except BaseException:
            self.close()
            raise
        self._close_beyond(self.MOST)

    def close(self) -> None:
        """Close all envs."""
        self._close_beyond(0)

    def _close_beyond(self, kept: int) -> None:
        while len(self.envs) > kept:
            self.envs.pop().close()


def evaluate(
    policy: Predictor | Callable[[Any], Any],
    env: Source | EnvPool,
    seeds: Iterable[int],
    starts: Sequence[ArrayLike] | None = None,
) -> Episodes:
    """Return one whole episode for each seed, under the policy without any noise.

    Parameters
    ----------
    policy : model or callable
        Something with ``predict(observation, deterministic=True)``, or a function from an
        observation to an action, such as the explicit law.
    env : gymnasium.Env, str or callable
        Must end its episodes within a million steps. A given env runs them one after the other.
        A named one, or a function that makes one, is made for each seed: the episodes run side by
        side, and the policy sees them as one batch. An :class:`EnvPool` keeps them for next time.
    seeds : iterable of int
        ``env.reset(seed=seed)`` starts each episode; the rest of it must follow from that.
    starts : sequence of array_like, optional
        The state of each start, ``env.reset(options={"state": ...})``, for envs that have one.

    Raises
    ------
    RuntimeError
        If an episode does not end.

    Examples
    --------
    >>> import gymnasium
    >>> law = gymnasium.make("CSTR-v0").observation_space.problem.explicit()
    >>> bool(evaluate(law, "CSTR-v0", seeds=[0]).costs[0] > 0)
    True
    """
    seeds = as_seeds(seeds)
    options = [None] * len(seeds) if starts is None else [{"state": start} for start in starts]
    resets = [*zip(seeds, options, strict=True)]
    act = _as_batch_function(policy)
    pool = env if isinstance(env, EnvPool) else None
    source: Source = env.source if isinstance(env, EnvPool) else as_source(env)
    if isinstance(source, gym.Env):
        _require_same_inputs(policy, source.action_space)
        _require_state_shown(policy, source)
        episodes = [_side_by_side(act, [source], [reset])[0] for reset in resets]
    elif isinstance(source, str) and (vector_env := _vector_env(source, len(seeds))) is not None:
        with closing(vector_env):
            _require_same_inputs(policy, vector_env.single_action_space)
            return _as_one(act, vector_env, seeds, starts)
    else:
        own = EnvPool(source)
        with closing(own), (pool or own).lend(len(seeds)) as envs:
            for each in envs[:1]:
                _require_same_inputs(policy, each.action_space)
                _require_state_shown(policy, each)
            if len({id(each.unwrapped) for each in envs}) < len(envs):
                raise ValueError(
                    "The function that makes envs returned the same one twice. Make a new one each "
                    "time, since episodes run side by side, or pass the env itself."
                )
            episodes = _side_by_side(act, envs, resets)
    return Episodes(
        np.array([episode.cost for episode in episodes]),
        np.array([episode.violations for episode in episodes], dtype=np.int64),
        tuple(np.array(episode.observations, float) for episode in episodes),
        tuple(np.array(episode.actions, float) for episode in episodes),
        np.array([episode.terminated for episode in episodes], dtype=bool),
    )


@contextmanager
def one_env(env: Source) -> Iterator[gym.Env[Any, Any]]:
    """Yield the env that is given, or make the one that is named, and close it afterwards."""
    if isinstance(env, gym.Env):
        yield env
        return
    with closing(make_env(env)) as made:
        yield made


def as_seeds(seeds: Iterable[int]) -> list[int]:
    """Return the seeds of episodes, whole numbers of at least 0."""
    if not isinstance(seeds, Iterable):
        raise TypeError(f"seeds = {seeds!r} must hold a seed for each episode, e.g. range(20).")
    return [check_int("seeds", each, 0) for each in seeds]


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
    if not (isinstance(env, str | gym.Env) or callable(env)):
        raise TypeError(
            f"env = {env!r} must be the id of an environment, a gymnasium.Env, or a function that "
            "makes one."
        )
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


@dataclass
class _Episode:
    observations: list[Any]
    actions: list[Any] = field(default_factory=list)
    cost: float = 0.0
    violations: int = 0
    terminated: bool = False


def _as_batch_function(policy: Predictor | Callable[[Any], Any]) -> Callable[[Any], Any]:
    if isinstance(policy, LinearMPC):
        raise TypeError(
            "policy is a LinearMPC, which is a problem: pass its law, mpc.explicit() or mpc.law(); "
            "for an env in absolute values mpc.explicit().plant_input."
        )
    if hasattr(policy, "predict"):
        return lambda observations: policy.predict(observations, deterministic=True)[0]
    if isinstance(policy, PiecewiseAffine):
        return policy
    if callable(policy):
        return lambda observations: [policy(observation) for observation in observations]
    raise TypeError(f"policy = {policy!r} must have a predict method or be callable.")


def _require_state_shown(policy: Any, env: gym.Env[Any, Any]) -> None:
    """Raise if an env does not show a law the state; other policies may take anything."""
    acts = getattr(policy, "policy", policy)  # a model's
    owner = getattr(acts, "__self__", acts)  # of a method, such as law.plant_input
    if isinstance(owner, PiecewiseAffine | OnlineLaw) or hasattr(owner, "told"):
        require_state_shown(env, getattr(owner, "told", False))


def _require_same_inputs(policy: Any, space: Any) -> None:
    """Raise if a law puts out deviations, and an env takes absolute inputs."""
    model = getattr(policy, "model", None)
    if not isinstance(policy, PiecewiseAffine | OnlineLaw) or not isinstance(model, LinearModel):
        return
    if not isinstance(space, gym.spaces.Box):
        return
    units = InputUnits.between(policy.u_min, policy.u_max, model.u_ss, space.low, space.high)
    if units is not None and units.kind == "absolute":
        raise ValueError(
            f"The env takes absolute inputs, from {space.low.tolist()} to {space.high.tolist()}, "
            f"and the law puts out deviations, from {policy.u_min.tolist()} to "
            f"{policy.u_max.tolist()}. Pass law.plant_input where the env shows absolute values "
            "too, else wrap the plant in sb3_yann.wrappers.Deviations(env, mpc.model)."
        )


def _vector_env(env_id: str, n: int) -> VectorEnv[Any, Any, Any] | None:
    """Return n copies of an env that step as one array, None where there is no such env of it."""
    spec = gym.spec(env_id)
    if spec.vector_entry_point is None or spec.additional_wrappers or n == 0:
        return None
    made = gym.make_vec(env_id, num_envs=n, vectorization_mode="vector_entry_point")
    if made.metadata.get("seeds_each", False):  # most take one seed for all of them together
        return made
    made.close()
    return None


def _as_one(
    act: Callable[[Any], Any],
    env: VectorEnv[Any, Any, Any],
    seeds: Sequence[int],
    starts: Sequence[ArrayLike] | None,
) -> Episodes:
    """Run an episode in each copy; those that are over begin another, which is ignored."""
    options = None if starts is None else {"state": starts}
    observations = [env.reset(seed=seeds, options=options)[0]]  # type: ignore[arg-type]
    n = len(seeds)
    running, lengths = np.ones(n, dtype=bool), np.zeros(n, dtype=int)
    costs, violations = np.zeros(n), np.zeros(n, dtype=np.int64)
    ended, actions = np.zeros(n, dtype=bool), []
    while running.any():
        actions.append(np.asarray(act(observations[-1])))
        observation, rewards, terminated, truncated, info = env.step(actions[-1])
        observations.append(np.array(observation))
        costs[running] -= np.asarray(rewards, dtype=np.float64)[running]
        violations[running] += np.asarray(info.get("violation", np.zeros(n)), dtype=bool)[running]
        lengths[running] += 1
        success = np.asarray(info.get("is_success", np.zeros(n)), dtype=bool)
        ended[running] |= (terminated & ~success)[running]
        running &= ~(terminated | truncated)
        watch_length(env, len(actions))
    states, inputs = np.array(observations, float), np.array(actions, float)
    return Episodes(
        costs,
        violations,
        tuple(states[: k + 1, i].copy() for i, k in enumerate(lengths)),
        tuple(inputs[:k, i].copy() for i, k in enumerate(lengths)),
        ended,
    )


def watch_length(env: Any, steps: int) -> None:
    """Warn of an episode that is long, and raise RuntimeError where it seems to have no end."""
    if steps not in (LONG, LONGEST):
        return
    told = (
        f"An episode of {env} has not ended after {steps} steps, all of which are kept in memory. "
        "Give it a limit: max_episode_steps when it is registered, or gymnasium.wrappers.TimeLimit."
    )
    if steps == LONGEST:
        raise RuntimeError(told)
    warnings.warn(told, stacklevel=3)


def _side_by_side(
    act: Callable[[Any], Any],
    envs: Sequence[gym.Env[Any, Any]],
    resets: Sequence[tuple[int, dict[str, Any] | None]],
) -> list[_Episode]:
    """Run one episode in each env; those that are over wait for the others."""
    episodes = [
        # A copy: an env may write its next observation into the same array.
        _Episode([np.array(env.reset(seed=seed, options=options)[0])])
        for env, (seed, options) in zip(envs, resets, strict=True)
    ]
    running = [*zip(envs, episodes, strict=True)]
    while running:
        actions = act(np.stack([episode.observations[-1] for _, episode in running]))
        going_on = []
        for (env, episode), action in zip(running, actions, strict=True):
            observation, reward, terminated, truncated, info = env.step(action)
            episode.observations.append(np.array(observation))
            episode.actions.append(action)
            episode.cost -= float(reward)
            episode.violations += bool(info.get("violation", False))
            episode.terminated = bool(terminated) and not info.get("is_success", False)
            if not (terminated or truncated):
                going_on.append((env, episode))
            if episode is running[0][1]:  # the others are as long
                watch_length(env, len(episode.actions))
        running = going_on
    return episodes
