"""Wrappers that cure faults of an env's episodes: a time limit that terminates, seeds ignored."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.random.mtrand import get_bit_generator, set_bit_generator

from sb3_yann._validation import check_int

Any_Env = gym.Env[Any, Any]


class TruncateAtTimeLimit(gym.Wrapper[Any, Any, Any, Any]):
    """Turns ``terminated`` after a fixed number of steps into ``truncated``: a time limit.

    After ``terminated`` the learner counts no further cost. At a time limit the plant goes on.
    Terminations before the limit stay what they are.

    Parameters
    ----------
    env : gymnasium.Env
    steps : int
        Steps after which the env ends every episode.

    Examples
    --------
    >>> class Ends(gym.Wrapper):
    ...     def step(self, action):
    ...         observation, reward, *_ = self.env.step(action)
    ...         return observation, reward, True, False, {}
    >>> env = TruncateAtTimeLimit(Ends(gym.make("CSTR-v0")), steps=1)
    >>> _ = env.reset(seed=0)
    >>> env.step(np.zeros(1, np.float32))[2:4]
    (False, True)
    """

    def __init__(self, env: Any_Env, steps: int) -> None:
        super().__init__(env)
        hint = "It counts the steps after which the env ends every episode."
        self.steps = check_int("steps", steps, hint=hint)
        self.taken = 0

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        self.taken = 0
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step; at the limit the episode is truncated instead of terminated."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.taken += 1
        if terminated and self.taken == self.steps:
            return observation, reward, False, True, info
        return observation, reward, bool(terminated), bool(truncated), info


class SeededGlobals(gym.Wrapper[Any, Any, Any, Any]):
    """Gives an env that draws from the global generators a stream of its own, which seeds set.

    Those are numpy's ``np.random`` and Python's ``random``. Around each reset and step their states
    are the env's; afterwards they are again what they were, so that nothing else is disturbed. That
    takes a tenth of a millisecond. An env that draws from ``self.np_random`` needs none of it.

    Parameters
    ----------
    env : gymnasium.Env

    Examples
    --------
    >>> class Draws(gym.Wrapper):
    ...     def reset(self, *, seed=None, options=None):
    ...         return self.env.reset(seed=0)[0] + np.random.normal(), {}
    >>> env = SeededGlobals(Draws(gym.make("CSTR-v0")))
    >>> bool(np.all(env.reset(seed=1)[0] == env.reset(seed=1)[0]))
    True
    """

    def __init__(self, env: Any_Env) -> None:
        super().__init__(env)
        self.numpy_stream: Any = np.random.MT19937()
        self.python_stream: Any = random.getstate()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; a seed begins the env's stream anew."""
        with self._own_stream():
            if seed is not None:
                np.random.seed(seed % 2**32)  # noqa: NPY002 (what the env draws from)
                random.seed(seed)
            return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step with the env's own stream."""
        with self._own_stream():
            observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, bool(terminated), bool(truncated), info

    @contextmanager
    def _own_stream(self) -> Iterator[None]:
        """Let global functions draw from the env's generators, and then from theirs again.

        Those of numpy are exchanged, for their states are slow to read and to set. An exchange
        forgets the second normal number of a pair that was drawn: the user's is put back.
        """
        python_outside = random.getstate()
        outside = get_bit_generator()
        state: Any = np.random.get_state(legacy=False)  # noqa: NPY002 (what the env draws from)
        random.setstate(self.python_stream)
        set_bit_generator(self.numpy_stream)
        try:
            yield
        finally:
            set_bit_generator(outside)
            if state["has_gauss"]:
                np.random.set_state(state)  # noqa: NPY002 (what the env draws from)
            self.python_stream = random.getstate()
            random.setstate(python_outside)
