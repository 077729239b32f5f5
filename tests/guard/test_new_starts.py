"""What is to be accepted is tried on new starts first, and those by which it loses are kept."""

from __future__ import annotations

from functools import partial

import gymnasium as gym
import numpy as np
import pytest

from guard_samples import (
    FIRST,
    LEFT,
    REGION,
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
    tried,
)
from weights import is_mpc, last_layer

WHOLE = {"by_region": False}


class OftenRight(Slide):
    """Starts on the right, but for some seeds beyond the guard's own.

    And for the first of its own, from which no input makes a difference.
    """

    def __init__(self, left_of: int = 3, after: int = FIRST + 10, **kwargs) -> None:
        super().__init__(**kwargs)
        self.left_of, self.after = left_of, after

    def reset(self, *, seed=None, options=None):
        self.indifferent = seed == FIRST
        left = seed is not None and seed >= self.after and seed % self.left_of == 0
        left |= self.indifferent
        self.low, self.high = (-4.0, -2.0) if left else (2.0, 4.0)
        return super().reset(seed=seed, options=options)

    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, -1.0 if self.indifferent else reward, *rest


def spoil_left(policy) -> None:
    """Make the right better than the MPC, and the left, where no known start shows it, worse."""
    correct(policy, RIGHT, 0.5)
    correct(policy, LEFT, -2.0)


def test_a_policy_that_loses_on_new_starts_is_accepted_without_the_regions_that_lose() -> None:
    model, guard = tried(spoil_left, env=OftenRight, n_new_starts=20)
    decision = guard.decisions[0]
    assert decision.verdict == "accepted in part"
    assert "7 of 20 new starts lose against the MPC, seed 1000" in decision.reason
    assert decision.reason.endswith("; what it has learnt in other regions is kept")
    assert decision.regions == (REGION[RIGHT],)
    weights = last_layer(model)[:, :, -1]
    assert not weights[REGION[LEFT]].any() and weights[REGION[RIGHT]].any()
    known = guard.state.evidence.starts.seeds
    assert known[:10] == tuple(range(FIRST, FIRST + 10))
    assert len(known) == 17 and all(seed % 3 == 0 for seed in known[10:])


@pytest.mark.parametrize(("final", "seeds"), [(None, 0), (30, 30)])
def test_what_passes_for_want_of_new_starts_is_found_on_those_at_the_end(final, seeds) -> None:
    model = build(gradient_steps=0)
    guard = make_guard(OftenRight, n_new_starts=0, n_final_starts=final, rule=WHOLE)
    train(model, STEPS, At([STEPS], spoil_left), guard)
    assert guard.state.evidence.next_seed == FIRST + 10 + seeds
    assert is_mpc(model) == (final is not None)
    if final is not None:
        assert guard.decisions[-1].reason.startswith("at the end, 10 of 30 new starts lose")


def test_without_by_region_the_whole_of_it_is_refused() -> None:
    model, guard = build(gradient_steps=0), make_guard(OftenRight, n_new_starts=20, rule=WHOLE)
    before = actor_bits(model.policy)
    train(model, STEPS, At([STEPS], spoil_left), guard)
    (decision,) = guard.decisions
    assert (decision.verdict, decision.restored) == ("rejected", True)
    assert actor_bits(model.policy) == accepted_bits(guard) == before


def test_starts_that_were_lost_once_are_tried_with_every_later_candidate() -> None:
    simulator = partial(OftenRight, after=FIRST + 10)
    model, guard = build(gradient_steps=0), make_guard(simulator, n_new_starts=20, rule=WHOLE)
    again = At([2 * STEPS], spoil_left)
    train(model, 2 * STEPS, At([STEPS], spoil_left), again, guard)
    first, second = guard.decisions[:2]
    assert "new starts" in first.reason
    assert "new starts" not in second.reason and "costs" in second.reason
    assert guard.state.evidence.next_seed == FIRST + 30


def test_what_was_accepted_before_gives_way_to_the_mpc_where_it_loses_as_well() -> None:
    # The first twenty new starts show the right only: all of it is accepted.
    simulator = partial(OftenRight, after=FIRST + 30)
    model, guard = build(gradient_steps=0), make_guard(simulator, n_new_starts=20, rule=WHOLE)

    def a_little_better(policy) -> None:
        correct(policy, RIGHT, 0.4)

    def still_better(policy) -> None:
        correct(policy, RIGHT, 0.5)

    def spoiled(policy) -> None:
        a_little_better(policy)
        correct(policy, LEFT, -2.0)

    steps = [At([STEPS], spoiled), At([2 * STEPS], still_better)]
    train(model, 2 * STEPS, *steps, guard)
    assert [each.verdict for each in guard.decisions] == ["accepted", "rejected"]
    assert actor_bits(model.policy) == accepted_bits(guard)
    assert is_mpc(model)
    assert guard.decisions[-1].accepted_cost == pytest.approx(guard.decisions[-1].mpc_cost)


def test_violations_on_new_starts_are_refused_though_they_cost_less() -> None:
    # On the left the better input, -1 + 0.5, is beyond the limit; the MPC's own, -1, is not.
    class Brittle(OftenRight):
        def step(self, action):
            observation, reward, terminated, truncated, _ = super().step(action)
            u = float(np.asarray(action)[0])
            violation = 0.3 < u < 0.8 and not self.indifferent
            return observation, reward, terminated, truncated, {"violation": violation}

    model = build(gradient_steps=0)
    guard = make_guard(Brittle, n_new_starts=20, rule=WHOLE, patience=5)
    train(model, STEPS, At([STEPS], lambda policy: correct(policy, LEFT, -0.5)), guard)
    (decision,) = guard.decisions
    assert "violates a limit" in decision.reason and decision.restored


def test_at_the_end_ten_times_as_many_new_starts_are_tried() -> None:
    # Only the very last of them shows the left.
    simulator = partial(OftenRight, left_of=1, after=FIRST + 10 + 20 + 199)
    model, guard = tried(spoil_left, env=simulator, n_new_starts=20)
    whole, end = guard.decisions
    assert whole.verdict == "accepted"
    assert end.verdict == "accepted in part" and end.reason.startswith("at the end, 1 of 200 new")
    assert not last_layer(model)[REGION[LEFT], :, -1].any()
    assert actor_bits(model.policy) == accepted_bits(guard)
    assert guard.state.evidence.starts.seeds[10:] == (FIRST + 10 + 20 + 199,)


def test_new_starts_are_others_each_time_and_after_a_load(tmp_path) -> None:
    seen: list[int] = []

    class Counting(Slide):
        def reset(self, *, seed=None, options=None):
            seen.append(seed)
            return super().reset(seed=seed, options=options)

    model, guard = tried(better, env=Counting, n_new_starts=5)
    new = {seed for seed in seen if seed is not None and seed >= FIRST + 10}
    assert new == set(range(FIRST + 10, FIRST + 10 + 5 + 50))
    assert guard.state.evidence.next_seed == FIRST + 65
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=Slide())
    assert loaded.guard_state.evidence.next_seed == FIRST + 65


def test_the_mpc_itself_is_not_tried() -> None:
    env = gym.make("Slide-v0")
    model, guard = build(gradient_steps=0), make_guard(env.unwrapped, n_new_starts=20)
    train(model, 2 * STEPS, guard)
    assert guard.state.evidence.next_seed == FIRST + 10
