"""What the reactor and the pendulum have in common: starts, seeds, the problem they stand for."""

from __future__ import annotations

import copy
import random

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_yann_envs import ProblemBox
from sb3_yann_envs.clipped_pendulum import ClippedPendulumEnv
from sb3_yann_envs.cstr import CSTREnv

ENVS = {"cstr": CSTREnv, "clipped_pendulum": ClippedPendulumEnv}
GENTLE = {"cstr": 10.0, "clipped_pendulum": 1.0}
"""Inputs that end no episode early."""
BOTH = pytest.mark.parametrize("name", ENVS)


def act(u: float) -> NDArray[np.float32]:
    return np.array([u], dtype=np.float32)


@BOTH
def test_the_observation_space_refers_to_the_problem(name: str) -> None:
    space = ENVS[name]().observation_space
    assert isinstance(space, ProblemBox)
    assert f"sb3_yann_envs.problems:{name}" in repr(space)


@BOTH
def test_a_seed_reproduces_an_episode(name: str) -> None:
    def episode() -> list[NDArray[np.float32]]:
        env = ENVS[name]()
        observations = [env.reset(seed=5)[0]]
        observations += [env.step(act(GENTLE[name] * np.sin(k)))[0] for k in range(50)]
        return [*observations, env.reset()[0]]

    np.testing.assert_array_equal(episode(), episode())


@BOTH
def test_the_global_random_states_are_untouched(name: str) -> None:
    python, legacy = random.getstate(), copy.deepcopy(np.random.get_state())  # noqa: NPY002
    env = ENVS[name]()
    env.reset(seed=1)
    env.step(act(1.0))
    env.reset()
    assert random.getstate() == python
    for now, before in zip(np.random.get_state(), legacy, strict=True):  # noqa: NPY002
        np.testing.assert_array_equal(now, before)


@BOTH
def test_a_step_before_the_first_reset_is_refused(name: str) -> None:
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"env.reset\(\) before env.step\(\)"):
        ENVS[name]().step(act(0.0))
