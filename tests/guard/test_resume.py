"""A guarded training that is saved and loaded goes on as if it had never stopped, bit for bit."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
from stable_baselines3 import DDPG, TD3

from guard_samples import (
    STEPS,
    At,
    better,
    build,
    train,
)
from resumed import (
    Checkpoint,
    all_bits,
    envs,
    go_on,
    guard_in_simulator,
    loaded,
    model_bits,
)

RARE = {"eval_freq": 3}
"""A candidate after every third episode."""


def whole_and_resumed(
    folder, guard: Any, n: int, algorithm: Any = DDPG, episodes: int = 16
) -> list[Any]:
    """Return what is left of a training that went through, and of one that stopped halfway."""
    whole = build(algorithm, env=envs(n))
    steps, at = episodes * STEPS, episodes // 2 * STEPS
    train(whole, steps, guard(log_path=folder / "whole.csv"), Checkpoint(at, folder))
    model = loaded(folder, envs(n), algorithm)
    go_on(model, steps - at, guard(log_path=folder / "cut.csv"))
    assert len(model.guard_state.decisions) >= 3
    records = [(folder / name).read_bytes() for name in ("whole.csv", "cut.csv")]
    return [*zip(map(model_bits, (whole, model)), records, strict=True)]


@pytest.mark.parametrize(
    ("n_envs", "algorithm", "options"),
    [(1, DDPG, {}), (4, DDPG, {}), (4, TD3, {}), (1, DDPG, RARE)],
    ids=["one env", "four envs", "TD3", "rare trials"],
)
def test_with_a_simulator_nothing_is_lost(n_envs, algorithm, options, tmp_path) -> None:
    guard = partial(guard_in_simulator, **options)
    whole, resumed = whole_and_resumed(tmp_path, guard, n_envs, algorithm)
    assert whole == resumed


def test_the_mpc_that_is_restored_has_the_same_weights_after_loading(tmp_path) -> None:
    model, guard = build(gradient_steps=0), guard_in_simulator()
    train(model, STEPS, At([1], better), guard)
    assert not model.policy.actor.mu.network.is_zero()
    model.save(tmp_path / "model")
    again, other = DDPG.load(tmp_path / "model", env=envs(1), device="cpu"), guard_in_simulator()
    train(again, 1, other, reset_num_timesteps=False)
    assert all_bits(other.player.mpc) == all_bits(guard.player.mpc)
