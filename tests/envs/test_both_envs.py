"""What the reactor and the pendulum have in common: starts, seeds, the problem they stand for."""

import random
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from numpy.typing import NDArray

from errors import told
from sb3_yann_envs import clipped_pendulum, cstr
from sb3_yann_envs.clipped_pendulum import ClippedPendulumEnv
from sb3_yann_envs.cstr import CSTREnv

ENVS = {"cstr": CSTREnv, "clipped_pendulum": ClippedPendulumEnv}
GENTLE = {"cstr": 10.0, "clipped_pendulum": 1.0}
"""Inputs that end no episode early."""
BOTH = pytest.mark.parametrize("name", ENVS)


def act(u: float) -> NDArray[np.float32]:
    return np.array([u], dtype=np.float32)


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
    before = random.getstate(), str(np.random.get_state())  # noqa: NPY002
    env = ENVS[name]()
    env.reset(seed=1)
    env.step(act(1.0))
    env.reset()
    assert before == (random.getstate(), str(np.random.get_state()))  # noqa: NPY002


@BOTH
def test_a_step_before_the_first_reset_is_refused(name: str) -> None:
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"env.reset\(\) before env.step\(\)"):
        ENVS[name]().step(act(0.0))


@pytest.mark.parametrize(
    ("plant", "bound", "tried", "rel"),
    [
        (cstr, 55.0, (-20.0, 33.0, 500.0, -np.inf), 1e-12),
        (clipped_pendulum, 2.0, (0.5, -1.3, 10.0, -np.inf), 1e-6),
    ],
)
def test_the_cost_is_that_of_the_state_before_the_step_and_the_clipped_input(
    plant: Any, bound: float, tried: tuple[float, ...], rel: float
) -> None:
    env = ENVS[plant.__name__.split(".")[-1]]()
    _, info = env.reset(seed=3)
    for u in tried:
        before = info["state"]
        applied = np.clip([u], -bound, bound)
        _, reward, terminated, truncated, info = env.step(act(u))
        expected = before @ plant.Q @ before + applied @ plant.R @ applied
        assert info["cost"] == pytest.approx(expected, rel=rel)
        assert reward == -info["cost"] and isinstance(reward, float)
        assert (terminated, truncated, info["violation"]) == (False, False, False)


REACH = np.array([clipped_pendulum.START_ANGLE, clipped_pendulum.START_SPEED])


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("cstr", cstr.START_LOW, cstr.START_HIGH), ("clipped_pendulum", -REACH, REACH)],
)
def test_random_starts_fill_their_box(name: str, low: Any, high: Any) -> None:
    env = ENVS[name]()
    starts = np.array([env.reset(seed=seed)[1]["state"] for seed in range(500)])
    assert (starts >= low).all() and (starts <= high).all()
    assert (np.ptp(starts, axis=0) / (high - low) > 0.97).all()


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("cstr", {"state": [0.0, 0.0, 0.0]}, r"must have shape \(4,\)"),
        ("cstr", {"state": [0.0, np.nan, 0.0, 0.0]}, "C_B deviation must be in .* got nan"),
        ("cstr", {"state": [0.0, 0.0, 0.0, 5.1]}, r"T deviation must be in \[-70, 5\], got 5.1"),
        ("cstr", {"state": [-0.09, 0.0, 0.0, 0.0]}, "C_A deviation must be in"),
        ("cstr", {"start": [0.0, 0.0, 0.0, 0.0]}, r"unknown keys \['start'\]"),
        ("clipped_pendulum", {"state": 0.0}, r"must have shape \(2,\)"),
        ("clipped_pendulum", {"state": [np.nan, 0.0]}, "theta must be in .* got nan"),
        ("clipped_pendulum", {"state": [3.2, 0.0]}, "theta must be in"),
        ("clipped_pendulum", {"state": [0.0, -8.1]}, r"theta_dot must be in \[-8, 8\], got -8.1"),
    ],
)
def test_a_bad_start_is_refused_with_its_reason(name: str, options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ENVS[name]().reset(options=options)


@BOTH
@pytest.mark.parametrize(
    ("action", "message"),
    [
        (act(np.nan), "got array.*nan"),
        (np.zeros(2), r"shape \(1,\)"),
        (np.zeros((1, 1)), r"shape \(1,\)"),
        ([], r"shape \(1,\)"),
    ],
)
def test_a_bad_action_is_refused_and_leaves_the_state_alone(
    name: str, action: Any, message: str
) -> None:
    env = ENVS[name]()
    twin = ENVS[name]()
    for each in (env, twin):
        each.reset(seed=4)
    with pytest.raises(ValueError, match=message):
        env.step(action)
    np.testing.assert_array_equal(env.step(act(1.0))[0], twin.step(act(1.0))[0])


ENV_IDS = ["CSTR-v0", "ClippedPendulum-v0"]

# Actions are in physical units on purpose: the controllers that these environments are for have
# theirs in kJ/(h m2 K) and N m. Stable-Baselines3's actors rescale to the bounds by themselves.
NORMALIZE = "symmetric and normalized"


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_gymnasium_only_recommends_normalized_actions(env_id: str) -> None:
    env: gymnasium.Env[Any, Any] = gymnasium.make(env_id, render_mode="rgb_array").unwrapped
    (message,) = told(lambda: gymnasium_check(env))
    assert "For Box action spaces, we recommend" in message
    assert NORMALIZE in message


@pytest.mark.parametrize("env_id", ENV_IDS)
@pytest.mark.parametrize("wrapped", [True, False])
def test_stable_baselines3_only_recommends_normalized_actions(env_id: str, wrapped: bool) -> None:
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")  # needs torch
    env: gymnasium.Env[Any, Any] = gymnasium.make(env_id, render_mode="rgb_array")
    checked = env if wrapped else env.unwrapped
    (message,) = told(lambda: sb3.check_env(checked, warn=True, skip_render_check=False))
    assert "We recommend you to use a" in message
    assert NORMALIZE in message


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


@BOTH
def test_rendering_says_where_it_cannot_be(name: str) -> None:
    make = ENVS[name]
    with pytest.raises(ValueError, match="render_mode must be None or one of"):
        make(render_mode="ansi")
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"before env.render\(\)"):
        make(render_mode="rgb_array").render()
    env = make()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="without specifying any render mode"):
        assert env.render() is None
