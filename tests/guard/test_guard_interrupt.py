"""Ctrl-C leaves the accepted policy in the model, wherever it finds the training."""

from __future__ import annotations

import signal
from contextlib import suppress
from functools import partial

import pytest
from stable_baselines3.common.callbacks import BaseCallback

from guard_samples import (
    FIRST,
    STEPS,
    At,
    CutOff,
    accepted_bits,
    actor_bits,
    better,
    bits,
    build,
    make_guard,
    train,
)
from sb3_yann.guard import callback
from weights import is_mpc


@pytest.fixture(autouse=True)
def heeded():
    """Python's own handler: a shell starts what runs in its background with the signal ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def ctrl_c(*_) -> None:
    signal.raise_signal(signal.SIGINT)


def left(model) -> None:
    """Check that the model is what its guard accepted last, with target and optimizer."""
    assert actor_bits(model.policy) == accepted_bits(model)
    assert model.policy.actor_step == 1.0


def interrupted(model, steps: int, *callbacks: BaseCallback) -> None:
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train(model, steps, *callbacks)
    assert signal.getsignal(signal.SIGINT) is before
    left(model)


def test_between_two_steps_the_candidate_gives_way_to_what_was_accepted() -> None:
    model = build(learning_rate=0.0)
    guard = make_guard(eval_freq=100)
    interrupted(model, 40, At([5], better), guard, At([17], ctrl_c))
    assert is_mpc(model)  # no trial has been


@pytest.mark.parametrize("part", ["actor", "critic"])
def test_in_the_midst_of_a_gradient_step_as_well(monkeypatch, part) -> None:
    model = build()
    guard = make_guard(eval_freq=100)
    optimizer = getattr(model, part).optimizer
    step = optimizer.step
    taken = []

    def cut_off(*args, **kwargs):
        step(*args, **kwargs)
        taken.append(1)
        if len(taken) == 12:
            ctrl_c()

    monkeypatch.setattr(optimizer, "step", cut_off)
    interrupted(model, 40, guard)


@pytest.mark.parametrize("at", [FIRST + 12, FIRST + 10 + 5 + 7], ids=["a trial", "the end"])
def test_in_a_trial_what_stood_before_it_is_left(at) -> None:
    simulator = partial(CutOff, at, ctrl_c)
    model = build(gradient_steps=0)
    guard = make_guard(simulator, n_new_starts=5)
    interrupted(model, 2 * STEPS, At([1], better), guard)
    assert is_mpc(model) == (at == FIRST + 12)


def test_a_simulator_that_makes_another_error_of_it_is_not_taken_for_a_bad_policy() -> None:
    def act():
        if len(plays) == 3:  # the MPC has played them twice, and one input was pushed
            try:
                ctrl_c()
            except KeyboardInterrupt:
                raise SystemError("returned a result with an exception set") from None
        plays.append(1)

    plays: list[int] = []
    model = build(gradient_steps=0)
    guard = make_guard(partial(CutOff, FIRST, act))
    interrupted(model, 4 * STEPS, At([1], better), guard)


def test_a_simulator_that_swallows_it_ends_the_training_all_the_same() -> None:
    def act():
        plays.append(1)
        if len(plays) == 4:  # the candidate's turn
            with suppress(KeyboardInterrupt):
                ctrl_c()

    plays: list[int] = []
    model = build(gradient_steps=0)
    guard = make_guard(partial(CutOff, FIRST, act))
    interrupted(model, 4 * STEPS, At([1], better), guard)
    assert is_mpc(model) and len(plays) == 4


def test_where_the_end_of_training_fails_the_accepted_policy_is_left(monkeypatch) -> None:
    def fail() -> None:
        raise OSError("the simulator is gone")

    before = signal.getsignal(signal.SIGINT)
    model = build(gradient_steps=0)
    guard = make_guard(eval_freq=100)
    monkeypatch.setattr(guard, "_end", fail)
    with pytest.raises(OSError, match="gone"):
        train(model, 8, At([5], better), guard)
    left(model)
    assert signal.getsignal(signal.SIGINT) is before


def test_after_another_error_the_handler_only_passes_on() -> None:
    def fail(_) -> None:
        raise OSError("the plant is gone")

    before = signal.getsignal(signal.SIGINT)
    model = build(learning_rate=0.0)
    guard = make_guard(eval_freq=100)
    with pytest.raises(OSError, match="gone"):
        train(model, 20, guard, At([5], better), At([6], fail))
    candidate = bits(model.policy.actor.state_dict())
    with pytest.raises(KeyboardInterrupt):
        train(model, 8, At([3], ctrl_c))  # without the guard
    assert bits(model.policy.actor.state_dict()) == candidate
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("where", ["require_like_training", "first_evidence"])
def test_before_anything_is_accepted_the_end_of_training_is_none(monkeypatch, where) -> None:
    model = build()
    guard = make_guard()
    monkeypatch.setattr(callback, where, ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        train(model, 8, guard)
    guard.on_training_end()  # as RL Zoo does after Ctrl-C, before it saves the model
    assert is_mpc(model)
