"""Frames of both environments are pictures, and rendering says where it cannot be."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from sb3_yann_envs.clipped_pendulum import ClippedPendulumEnv
from sb3_yann_envs.cstr import CSTREnv

EVERY_ENV = pytest.mark.parametrize("make", [CSTREnv, ClippedPendulumEnv])


@pytest.mark.parametrize(
    ("make", "action", "width"), [(CSTREnv, -55.0, 600), (ClippedPendulumEnv, 2.0, 400)]
)
def test_a_frame_is_a_picture_that_changes_with_the_episode(make, action, width) -> None:
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    env.step(np.array([action], dtype=np.float32))
    second = env.render()
    assert first is not None and second is not None
    assert first.shape == (400, width, 3)
    assert first.dtype == np.uint8
    assert (first != second).any()


@EVERY_ENV
def test_an_unknown_render_mode_is_refused(make) -> None:
    with pytest.raises(ValueError, match="render_mode must be None or one of"):
        make(render_mode="ansi")


@EVERY_ENV
def test_rendering_before_the_first_reset_is_refused(make) -> None:
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"before env.render\(\)"):
        make(render_mode="rgb_array").render()


@EVERY_ENV
def test_rendering_without_a_mode_warns_and_returns_nothing(make) -> None:
    env = make()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="without specifying any render mode"):
        assert env.render() is None
