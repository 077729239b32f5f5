"""Both environment checkers accept both environments, but for one recommendation each."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check

import sb3_yann_envs  # noqa: F401  # registers the environments

ENV_IDS = ["CSTR-v0", "ClippedPendulum-v0"]

# Actions are in physical units on purpose: the controllers that these environments are for have
# theirs in kJ/(h m2 K) and N m. Stable-Baselines3's actors rescale to the bounds by themselves.
NORMALIZE = "symmetric and normalized"


def messages(check: Callable[[], None]) -> list[str]:
    """Return the warnings that a check gives (Gymnasium's logger warns through `warnings`)."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check()
    return [str(warning.message) for warning in caught]


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_gymnasium_only_recommends_normalized_actions(env_id: str) -> None:
    env: gymnasium.Env[Any, Any] = gymnasium.make(env_id, render_mode="rgb_array").unwrapped
    (message,) = messages(lambda: gymnasium_check(env))
    assert "For Box action spaces, we recommend" in message
    assert NORMALIZE in message


@pytest.mark.parametrize("env_id", ENV_IDS)
@pytest.mark.parametrize("wrapped", [True, False])
def test_stable_baselines3_only_recommends_normalized_actions(env_id: str, wrapped: bool) -> None:
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")  # needs torch
    env: gymnasium.Env[Any, Any] = gymnasium.make(env_id, render_mode="rgb_array")
    checked = env if wrapped else env.unwrapped
    (message,) = messages(lambda: sb3.check_env(checked, warn=True, skip_render_check=False))
    assert "We recommend you to use a" in message
    assert NORMALIZE in message


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_gymnasiums_wrappers_find_nothing_in_an_episode(env_id: str) -> None:
    def play() -> None:
        env = gymnasium.make(env_id)
        env.action_space.seed(0)
        env.reset(seed=0)
        over = False
        while not over:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            over = terminated or truncated

    assert messages(play) == []
