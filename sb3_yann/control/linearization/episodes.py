"""Faults of an environment's episodes that spoil training: no seeds, an end that is none."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np

from sb3_yann._validation import Array

LONGEST_EPISODE = 400  # steps after which an episode counts as one without an end of its own
SECONDS = 1.0  # after which a slow one does


def episode_faults(env: Any, action: Array) -> list[str]:
    """Return what is wrong with the episodes of an env, each with the wrapper that cures it.

    The env is reset and stepped; pass a copy. What it raises meanwhile ends the search.

    Parameters
    ----------
    env : gymnasium.Env
        With a Box of actions.
    action : ndarray, shape (m,)
        An action to play.

    Examples
    --------
    >>> import gymnasium
    >>> episode_faults(gymnasium.make("CSTR-v0"), np.zeros(1))
    []
    """
    try:
        return [*_unseeded(env), *_ends_at_its_limit(env, action)]
    except Exception:  # whatever a simulator raises away from its operating point
        return []


def _unseeded(env: Any) -> list[str]:
    """Return that one seed leads to two starts."""
    first, second = (np.array(env.reset(seed=0)[0]) for _ in range(2))
    if first.shape == second.shape and np.array_equal(first, second, equal_nan=True):
        return []
    return [
        f"reset(seed=0) starts at {first.tolist()} and then at {second.tolist()}: the environment "
        "ignores its seed, and no two policies can be compared from the same starts. If it draws "
        "from numpy's global generator, wrap it in sb3_yann.wrappers.SeededGlobals."
    ]


def _ends_at_its_limit(env: Any, action: Array) -> list[str]:
    """Return that every episode terminates after the same number of steps, whatever happens."""
    low, high = env.action_space.low, env.action_space.high
    other = np.clip(action + 0.25 * np.minimum(high - low, 4.0), low, high)
    ends = []
    for seed, u in enumerate((action, other)):
        ends.append(_termination(env, seed, u.astype(env.action_space.dtype)))
        if ends[0] is None or ends[0] < 2:
            return []
    if ends[0] != ends[1]:
        return []
    return [
        f"Episodes terminate after {ends[0]} steps whatever happens: that is a time limit, but "
        "terminated=True tells the learner that nothing costs anything afterwards. Return "
        "truncated=True there, or wrap the environment in "
        f"sb3_yann.wrappers.TimeLimitIsNoTermination(env, {ends[0]})."
    ]


def _termination(env: Any, seed: int, action: Array) -> int | None:
    """Return after how many steps an episode terminates, None if it does not or is cut before."""
    env.reset(seed=seed)
    begun = perf_counter()
    for step in range(1, LONGEST_EPISODE + 1):
        _, _, terminated, truncated, _ = env.step(action)
        if terminated:
            return step
        if truncated or perf_counter() - begun > SECONDS:
            return None
    return None
