"""On a plant alone: one error budget for a whole run, and more blocks for what is promising."""

from __future__ import annotations

from itertools import groupby
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import CheckpointCallback

from guard_samples import (
    BLOCK,
    REGION,
    RIGHT,
    STEPS,
    At,
    Slide,
    accepted_bits,
    actor_bits,
    better,
    guard_alone,
    still,
    train,
    verdicts,
    worse,
)
from sb3_yann.guard.statistics import ErrorBudget
from weights import last_layer


class Scattered(Slide):
    """Starts are equal; episodes cost a little less, the same and a little more in turn.

    Two blocks of three (4.25 and 4.0) differ by p = .039. With as many again it is .002.
    """

    def __init__(self, size: float = 0.13) -> None:
        super().__init__(low=2.4, high=2.4)
        self.size, self.episodes = size, -1

    def reset(self, *, seed=None, options=None):
        self.episodes += 1
        return super().reset(seed=seed, options=options)

    def step(self, action):
        observation, reward, *rest = super().step(action)
        extra = self.size * (self.episodes % 3 - 1) if self.t == 1 else 0.0
        return observation, reward - extra, *rest


class Phases(At):
    """Notes the phase and the actor's correction after each step."""

    def __init__(self, guard) -> None:
        super().__init__(range(10_000), self.note)
        self.guard, self.seen = guard, []

    def note(self, policy) -> None:
        self.seen.append((self.guard.state.evidence.phase, correction(policy)))

    @property
    def phases(self) -> list[str]:
        return [phase for phase, _ in groupby(each for each, _ in self.seen)]


def correction(owner) -> float:
    return float(last_layer(owner)[REGION[RIGHT], 0, -1].detach())


def test_a_promising_candidate_and_the_accepted_policy_play_in_turn_until_it_is_clear() -> None:
    model, guard = still(env=Scattered()), guard_alone()
    train(model, 5 * BLOCK, At([BLOCK + 1], better), guard, look := Phases(guard))
    assert look.phases == ["first", "learning", "trial", "again", "trial", "learning"]
    assert verdicts(guard) == ["accepted"]
    assert guard.decisions[0].timestep == 5 * BLOCK
    assert guard.state.budget.tests == 3
    assert correction(model) == 0.5
    assert actor_bits(model.policy) == accepted_bits(guard)
    assert len(guard.state.evidence.accepted.costs) == 6
    assert guard.state.evidence.accepted.costs.mean() == pytest.approx(4)
    np.testing.assert_allclose(np.sort(guard.state.evidence.mpc.costs), [4.12, 4.25, 4.38])
    assert {("trial", 0.5), ("again", 0.0)} <= set(look.seen)
    assert not {("trial", 0.0), ("again", 0.5)} & set(look.seen)


@pytest.mark.parametrize("size", [0.2, 1.0])
def test_a_candidate_that_is_not_promising_is_refused_at_once(size) -> None:
    model, guard = still(env=Scattered(size)), guard_alone()
    train(model, 3 * BLOCK, At([BLOCK + 1], better), guard, look := Phases(guard))
    assert look.phases == ["first", "learning", "trial", "learning"]
    assert verdicts(guard) == ["rejected"]
    assert guard.decisions[0].reason.endswith(", not below 0.025")
    assert correction(model) == 0


def test_a_later_candidate_meets_a_smaller_test_also_in_other_learns_and_with_other_guards() -> (
    None
):
    first = still(env=Scattered(0.1))
    train(first, 3 * BLOCK, At([BLOCK + 1], better), guard := guard_alone())
    assert verdicts(guard) == ["accepted"]  # p = .019, of .05 / 2
    model = still(env=Scattered(0.1))
    train(model, 3 * BLOCK, At([BLOCK + 1], worse), guard_alone())
    more = 2 * BLOCK + STEPS
    train(model, more, At([STEPS + 1], worse), guard_alone(), reset_num_timesteps=False)
    assert model.guard_state.budget == ErrorBudget(2)
    guard = guard_alone()
    better_now = At([STEPS + 1], better)
    train(model, more, better_now, guard, look := Phases(guard), reset_num_timesteps=False)
    assert look.phases == ["learning", "trial", "again"]  # of .05 / 12
    assert verdicts(guard) == ["rejected"] * 2


def test_a_guard_with_other_blocks_goes_on_with_the_same_budget() -> None:
    model = still(env=Scattered(1.0))
    train(model, 3 * BLOCK, At([BLOCK + 1], better), guard_alone())
    assert model.guard_state.budget == ErrorBudget(1)
    train(model, STEPS, guard_alone(trial_episodes=4), reset_num_timesteps=False)
    assert model.guard_state.budget == ErrorBudget(1)


def test_learn_that_ends_between_two_blocks_of_a_candidate_leaves_the_accepted_policy() -> None:
    model, guard = still(env=Scattered()), guard_alone()
    before = actor_bits(model.policy)
    train(model, 3 * BLOCK + STEPS, At([BLOCK + 1], better), guard)
    assert guard.decisions == []
    assert actor_bits(model.policy) == before == accepted_bits(guard)
    assert guard.state.evidence.phase == "learning"
    assert guard.state.evidence.candidate is guard.state.evidence.on_trial is None


def test_a_run_that_was_stopped_while_the_accepted_policy_plays_again_goes_on(tmp_path) -> None:
    model, stop = still(env=Scattered()), 4 * BLOCK - STEPS
    save = CheckpointCallback(stop, str(tmp_path), "model")
    train(model, stop + 1, At([BLOCK + 1], better), guard_alone(), save)
    plant = Scattered()
    loaded = DDPG.load(tmp_path / f"model_{stop}_steps", env=plant, device="cpu")
    plant.episodes = 10  # it goes on where it was
    guard = guard_alone()
    train(loaded, STEPS + BLOCK, guard, look := Phases(guard), reset_num_timesteps=False)
    assert look.phases == ["again", "trial", "learning"]
    assert verdicts(guard) == ["accepted"]
    assert correction(loaded) == 0.5


def test_the_state_of_an_earlier_version_goes_on() -> None:
    model, guard = still(env=Scattered(0.01)), guard_alone()
    train(model, BLOCK, guard)
    state: Any = model.guard_state
    del state.__dict__["budget"]
    for name in ("log", "candidate", "on_trial"):
        del state.evidence.__dict__[name]
    for each in (state.evidence.accepted, state.evidence.mpc):
        each.__dict__.pop("log", None)
    steps = STEPS + 2 * BLOCK  # the first episode does not count
    train(model, steps, At([1], better), again := guard_alone(), reset_num_timesteps=False)
    assert verdicts(again) == ["accepted"]
    assert again.state.budget.tests == 1
