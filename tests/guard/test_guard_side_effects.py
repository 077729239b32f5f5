"""The guard changes the actor and nothing else, and goes on after a stop bit for bit."""

import signal
from contextlib import suppress
from functools import partial
from typing import Any

import pytest
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from guard_samples import (
    FIRST,
    STEPS,
    At,
    CutOff,
    Slide,
    accepted_bits,
    actor_bits,
    better,
    bits,
    buffer_bits,
    build,
    critic_bits,
    env_random_states,
    make_guard,
    random_states,
    train,
    verdicts,
)
from resumed import Checkpoint, all_bits, envs, go_on, guard_in_simulator, loaded, model_bits
from sb3_yann import ImprovementGuard, compare
from sb3_yann.compare import Verdict
from sb3_yann.guard import callback
from weights import is_mpc

ALGORITHMS = pytest.mark.parametrize("algorithm", [DDPG, TD3])


def after_training(algorithm, *guards: ImprovementGuard, **kwargs):
    model = build(algorithm, **kwargs)
    train(model, 8 * STEPS + 2, *guards)
    state = {
        "critic": critic_bits(model.policy),
        "buffer": buffer_bits(model),
        "random": random_states(),
        "envs": env_random_states(model),
        "returns": [info["r"] for info in model.ep_info_buffer],
        "steps": [env.unwrapped.played for env in model.get_env().envs],
    }
    return model, state


@pytest.mark.parametrize(
    ("env", "algorithm"), [(Slide, TD3), ("an instance", DDPG), ("Slide-v0", DDPG)]
)
def test_a_run_whose_candidates_are_all_accepted_is_the_run_without_a_guard(
    algorithm, env, monkeypatch
) -> None:
    monkeypatch.setattr(compare, "no_worse", lambda *_, **__: Verdict(is_sure=True))
    guard = make_guard(Slide() if env == "an instance" else env)
    free, expected = after_training(algorithm)
    model, state = after_training(algorithm, guard)
    assert set(verdicts(guard)) == {"accepted"}
    assert state == expected
    assert actor_bits(model.policy) == actor_bits(free.policy)


@ALGORITHMS
def test_while_patience_lasts_rejections_change_nothing_but_the_final_actor(
    algorithm, monkeypatch
) -> None:
    monkeypatch.setattr(compare, "no_worse", lambda *_, **__: Verdict("no"))
    free, expected = after_training(algorithm)
    model, state = after_training(algorithm, guard := make_guard(patience=1000, keep_if_worse=True))
    assert set(verdicts(guard)) == {"rejected"}
    assert state == expected
    assert is_mpc(model)
    assert not is_mpc(free)


def test_two_training_envs_side_by_side_count_their_episodes_together() -> None:
    model = build(env=DummyVecEnv([Slide, Slide]), gradient_steps=0)
    guard = make_guard()
    train(model, 4 * STEPS, At([1], better), guard)
    assert [each.episode for each in guard.decisions] == [2]
    assert guard.decisions[0].timestep == 2 * STEPS
    assert guard.state.episodes == 4


RARE = {"eval_freq": 3}
"""A candidate after every third episode."""


def whole_and_resumed(
    folder, guard: Any, n: int, algorithm: Any = DDPG, episodes: int = 16
) -> list[Any]:
    """Return what is left of a training that went through, and of one that stopped halfway."""
    whole = build(algorithm, env=envs(n))
    steps = episodes * STEPS
    at = episodes // 2 * STEPS
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
    model = build(gradient_steps=0)
    guard = guard_in_simulator()
    train(model, STEPS, At([1], better), guard)
    assert not model.policy.actor.mu.network.is_zero()
    model.save(tmp_path / "model")
    again = DDPG.load(tmp_path / "model", env=envs(1), device="cpu")
    other = guard_in_simulator()
    train(again, 1, other, reset_num_timesteps=False)
    assert all_bits(other.player.mpc) == all_bits(guard.player.mpc)


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
    interrupted(model, 40, At([5], better), make_guard(eval_freq=100), At([17], ctrl_c))
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
    interrupted(model, 4 * STEPS, At([1], better), make_guard(partial(CutOff, FIRST, act)))


def test_a_simulator_that_swallows_it_ends_the_training_all_the_same() -> None:
    def act():
        plays.append(1)
        if len(plays) == 5:  # the candidate's turn, after two pushes of the input
            with suppress(KeyboardInterrupt):
                ctrl_c()

    plays: list[int] = []
    model = build(gradient_steps=0)
    interrupted(model, 4 * STEPS, At([1], better), make_guard(partial(CutOff, FIRST, act)))
    assert is_mpc(model) and len(plays) == 5


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
