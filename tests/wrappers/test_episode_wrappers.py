"""Faults of episodes are cured, and nothing else is changed."""

from __future__ import annotations

import random

import gymnasium as gym
import numpy as np
import pytest
from numpy.random.mtrand import get_bit_generator

from sb3_yann.wrappers import SeededGlobals, TruncateAtTimeLimit


class Walk(gym.Env):
    """Draws each step from the global generators, and terminates after some."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float64)

    def __init__(self, last: int = 5) -> None:
        self.last = last

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return self._draw(), {}

    def step(self, action):
        self.steps += 1
        return self._draw(), 0.0, self.steps == self.last, False, {}

    def _draw(self) -> np.ndarray:
        return np.array([np.random.normal() + random.random()])  # noqa: NPY002 (the fault)


def walk(env: gym.Env, seed: int | None) -> list[float]:
    seen = [env.reset(seed=seed)[0][0]]
    return seen + [env.step(np.zeros(1))[0][0] for _ in range(4)]


def test_a_seed_repeats_an_episode_and_another_does_not() -> None:
    env = SeededGlobals(Walk())
    first = walk(env, 1)
    later = walk(env, None)  # goes on in the stream
    assert walk(env, 1) == first
    assert walk(env, None) == later != first
    assert walk(env, 2) != first


def test_the_global_generators_are_left_alone() -> None:
    env = SeededGlobals(Walk())
    np.random.seed(3), random.seed(3)  # noqa: NPY002 (what is to be left alone)
    before = np.random.normal(), random.random()  # noqa: NPY002
    np.random.seed(3), random.seed(3)  # noqa: NPY002
    walk(env, 7)
    assert before == (np.random.normal(), random.random())  # noqa: NPY002


def test_a_step_that_fails_leaves_the_global_generators_alone() -> None:
    env = SeededGlobals(Walk())
    env.reset(seed=0)
    del env.unwrapped.steps
    before, generator = random.getstate(), get_bit_generator()
    with pytest.raises(AttributeError, match="steps"):
        env.step(np.zeros(1))
    assert random.getstate() == before and get_bit_generator() is generator


def ends(env: gym.Env) -> list[tuple[bool, bool]]:
    env.reset(seed=0)
    return [env.step(np.zeros(1))[2:4] for _ in range(5)]


def test_the_end_at_the_limit_is_truncation_and_an_earlier_one_is_not() -> None:
    late, early = (TruncateAtTimeLimit(Walk(last), 5) for last in (5, 3))
    assert ends(late) == ends(late) == [(False, False)] * 4 + [(False, True)]
    assert ends(early)[2] == (True, False)


def test_a_limit_must_be_a_number_of_steps() -> None:
    with pytest.raises(ValueError, match="steps = 0 must be a whole number of at least 1"):
        TruncateAtTimeLimit(Walk(), 0)
