"""The accepted policy has a place of its own, beside any best model that nobody has accepted."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import EvalCallback, EveryNTimesteps
from stable_baselines3.common.monitor import Monitor

from guard_samples import (
    RIGHT,
    STEPS,
    At,
    Slide,
    accepted_bits,
    actor_bits,
    better,
    build,
    correct,
    make_guard,
    train,
)
from resumed import model_bits
from weights import is_mpc


def saved(folder: Path) -> Any:
    return DDPG.load(folder / "accepted_model.zip", device="cpu")


def evaluates(folder: Path) -> EvalCallback:
    return EvalCallback(
        Monitor(Slide()),
        best_model_save_path=str(folder),
        eval_freq=2,
        n_eval_episodes=1,
        verbose=0,
    )


def test_the_file_holds_what_is_accepted_from_the_first_step_on(tmp_path) -> None:
    folder = tmp_path / "new" / "folder"
    model, guard = build(gradient_steps=0), make_guard(save_path=folder)
    seen: list[Any] = []
    look = At([1, STEPS + 1, 2 * STEPS], lambda _: seen.append(saved(folder)))
    worse = At([STEPS + 2], partial(correct, region=RIGHT, value=2.0))
    train(model, 2 * STEPS, At([2], better), worse, guard, look)
    first, accepted, later = seen
    assert is_mpc(first) and not is_mpc(accepted)
    assert actor_bits(accepted.policy) == actor_bits(later.policy) == accepted_bits(guard)
    assert actor_bits(saved(folder).policy) == actor_bits(model.policy)
    assert [each.name for each in folder.iterdir()] == ["accepted_model.zip"]


def test_saving_changes_no_bit_of_the_training(tmp_path) -> None:
    found = []
    for options in ({}, {"save_path": tmp_path}):
        model = build()
        train(model, 4 * STEPS, guard := make_guard(**options))
        found.append(model_bits(model))
        assert len(guard.decisions) > 2
    assert found[0] == found[1]


@pytest.mark.parametrize("nested", [False, True])
def test_a_best_model_that_nobody_accepted_is_told_and_the_accepted_one_lies_beside(
    tmp_path, nested
) -> None:
    best = evaluates(tmp_path)
    other = EveryNTimesteps(1, best) if nested else best
    model, guard = build(gradient_steps=0), make_guard(n_new_starts=5)
    with pytest.warns(
        UserWarning, match="best_model.zip that EvalCallback.*accepted_model.zip"
    ) as told:
        train(model, STEPS, At([2], partial(correct, region=RIGHT, value=2.0)), guard, other)
    assert len(told) == 1
    assert (tmp_path / "best_model.zip").is_file()
    assert is_mpc(saved(tmp_path))


def test_a_folder_of_ones_own_is_used_and_a_callback_that_keeps_no_model_is_not_told(
    tmp_path,
) -> None:
    model, guard = build(gradient_steps=0), make_guard(save_path=tmp_path / "mine")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train(model, 2, guard, EvalCallback(Monitor(Slide()), eval_freq=99, verbose=0))
    with pytest.warns(UserWarning, match="mine"):
        train(model, 2, guard, evaluates(tmp_path / "best"))
    assert (tmp_path / "mine" / "accepted_model.zip").is_file()
    assert not (tmp_path / "best" / "accepted_model.zip").exists()


def test_a_disk_that_is_full_stops_no_training(tmp_path, monkeypatch) -> None:
    model, guard = build(gradient_steps=0), make_guard(save_path=tmp_path)

    def full(*_: Any) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.warns(UserWarning, match=r"accepted_model.zip could not be written \(No space"):
        train(model, STEPS, At([2], better), guard)
    assert not is_mpc(model) and [*tmp_path.iterdir()] == []


def test_a_file_is_no_folder(tmp_path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"save_path = .* is a file; name a folder"):
        make_guard(save_path=tmp_path / "file")
