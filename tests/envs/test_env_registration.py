"""Importing sb3_yann_envs registers two environments, and does nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest

import sb3_yann_envs

ENV_IDS = ["CSTR-v0", "ClippedPendulum-v0"]
HEAVY = {"torch", "stable_baselines3", "sb3_yann", "matplotlib"}


def fresh_python(code: str) -> subprocess.CompletedProcess[str]:
    """Run code in a new interpreter that finds this package, with warnings as errors."""
    folder = str(Path(sb3_yann_envs.__file__).parents[1])
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        env={**os.environ, "PYTHONPATH": folder},
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )


def test_the_import_is_light_and_silent() -> None:
    done = fresh_python(f"import sys, sb3_yann_envs; sys.exit(bool({HEAVY} & set(sys.modules)))")
    assert (done.stdout, done.stderr) == ("", "")


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_making_and_stepping_an_environment_stays_light(env_id: str) -> None:
    code = (
        "import sys, gymnasium\n"
        f"env = gymnasium.make('sb3_yann_envs:{env_id}')\n"
        "env.reset(seed=0); env.step(env.action_space.sample())\n"
        f"print({HEAVY} & set(sys.modules))"
    )
    done = fresh_python(code)
    assert (done.stdout, done.stderr) == ("set()\n", "")


@pytest.mark.parametrize(("env_id", "steps"), [("CSTR-v0", 400), ("ClippedPendulum-v0", 200)])
def test_an_episode_is_truncated_at_its_length(env_id: str, steps: int) -> None:
    assert gymnasium.spec(env_id).max_episode_steps == steps


def test_registering_again_is_harmless(recwarn: pytest.WarningsRecorder) -> None:
    before = {env_id: gymnasium.spec(env_id) for env_id in ENV_IDS}
    sb3_yann_envs.register_envs()
    assert not recwarn.list
    for env_id, spec in before.items():
        assert gymnasium.spec(env_id) is spec


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_a_vector_of_environments_can_be_made(env_id: str) -> None:
    envs = gymnasium.make_vec(env_id, num_envs=2, vectorization_mode="sync")
    observations, _ = envs.reset(seed=0)
    assert observations in envs.observation_space
    envs.close()
