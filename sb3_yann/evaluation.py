"""Seeded episodes of the deterministic policy, so that two policies meet the same starts."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Predictor(Protocol):
    """What Stable-Baselines3's models and policies offer."""

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, Any]:
        """Return the action for an observation, and a recurrent state."""


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
    """

    costs: Array
    violations: NDArray[np.int64]
    observations: tuple[Array, ...]
    actions: tuple[Array, ...]


def evaluate(
    policy: Predictor | Callable[[Any], Any], env: gym.Env[Any, Any] | str, seeds: Iterable[int]
) -> Episodes:
    """Return one whole episode for each seed, under the policy without any noise.

    Parameters
    ----------
    policy : model or callable
        Something with ``predict(observation, deterministic=True)``, or a function from an
        observation to an action, such as the explicit law.
    env : gymnasium.Env or str
        Must end its episodes. One that is named is made here, and closed.
    seeds : iterable of int
        ``env.reset(seed=seed)`` starts each episode.
    """
    made = gym.make(env) if isinstance(env, str) else env
    act = _as_function(policy)
    try:
        episodes = [_episode(act, made, seed) for seed in seeds]
    finally:
        if isinstance(env, str):
            made.close()
    costs, violations, observations, actions = zip(*episodes, strict=True)
    return Episodes(np.array(costs), np.array(violations), observations, actions)


def _as_function(policy: Predictor | Callable[[Any], Any]) -> Callable[[Any], Any]:
    if hasattr(policy, "predict"):
        return lambda observation: policy.predict(observation, deterministic=True)[0]
    if callable(policy):
        return policy
    raise TypeError(f"policy = {policy!r} must have a predict method or be callable.")


def _episode(
    act: Callable[[Any], Any], env: gym.Env[Any, Any], seed: int
) -> tuple[float, int, Array, Array]:
    observation, _ = env.reset(seed=seed)
    observations, actions, cost, violations, done = [observation], [], 0.0, 0, False
    while not done:
        action = act(observation)
        observation, reward, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        cost -= float(reward)
        violations += bool(info.get("violation", False))
        observations.append(observation)
        actions.append(action)
    return cost, violations, np.array(observations, float), np.array(actions, float)
