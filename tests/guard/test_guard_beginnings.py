"""What a guard finds when training starts: faults, other settings, another simulator."""

from __future__ import annotations

import warnings
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import CallbackList, EvalCallback, EveryNTimesteps

from guard_samples import (
    FIRST,
    REGION,
    RIGHT,
    STEPS,
    At,
    Slide,
    actor_bits,
    better,
    build,
    correct,
    make_guard,
    random_states,
    train,
    tried,
    verdicts,
)
from sb3_yann import CostAudit, CostMismatchWarning, ImprovementGuard, NoActionNoise
from weights import last_layer


def test_a_fault_while_the_first_episodes_are_played_leaves_the_next_learn_a_clean_start() -> None:
    class Busy(Slide):
        calls = 0

        def reset(self, *, seed=None, options=None):
            if seed is not None and seed >= FIRST:
                Busy.calls += 1
                if Busy.calls == 13:  # while the MPC is in the policy's place
                    raise OSError("licence server busy")
            return super().reset(seed=seed, options=options)

    model = build(gradient_steps=0)
    better(model.policy)
    before = actor_bits(model.policy)
    with pytest.raises(OSError, match="busy"):
        train(model, STEPS, make_guard(Busy))
    assert actor_bits(model.policy) == before
    train(model, STEPS, guard := make_guard(Busy))
    assert len(guard.state.evidence.starts.seeds) == 10
    assert actor_bits(model.policy) == before


def test_new_starts_where_the_mpc_s_cost_is_no_number_are_left_out() -> None:
    class Faulty(Slide):
        def reset(self, *, seed=None, options=None):
            self.faulty = seed is not None and seed > FIRST + 10 and seed % 3 == 0
            return super().reset(seed=seed, options=options)

        def step(self, action):
            observation, reward, *rest = super().step(action)
            return observation, np.nan if self.faulty else reward, *rest

    _, guard = tried(better, env=Faulty, n_new_starts=5)
    assert verdicts(guard) == ["accepted"]


def test_a_simulator_that_ignores_its_seed_is_named() -> None:
    with pytest.warns(UserWarning, match="All 10 starts .* reset ignores its seed"):
        train(build(), STEPS, make_guard(partial(Slide, low=3.0, high=3.0)))


def test_another_simulator_of_the_same_name_begins_afresh_and_says_so() -> None:
    def simulator(cost: float):
        class Plant(Slide):
            def step(self, action):
                observation, reward, *rest = super().step(action)
                return observation, reward * cost, *rest

        return lambda: Plant()

    model = build(gradient_steps=0)
    train(model, STEPS, At([1], better), first := make_guard(simulator(1.0)))
    costs = first.state.evidence.scores.costs
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train(model, STEPS, make_guard(simulator(1.0)))
    with pytest.warns(UserWarning, match="it is another simulator of that name"):
        train(model, STEPS, second := make_guard(simulator(1.1)))
    np.testing.assert_allclose(second.state.evidence.scores.costs, 1.1 * costs)
    assert second.state.settings == first.settings.of_evidence


class Legacy(Slide):
    """Seeds the global generator, and draws from it."""

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            np.random.seed(seed)  # noqa: NPY002
        _, info = super().reset(seed=seed)
        self.x = np.random.uniform(-4, 4, 1)  # noqa: NPY002
        return self.x.astype(np.float32), info


def test_a_simulator_that_seeds_the_global_generator_does_not_seed_it_for_others() -> None:
    states = []
    for callbacks in ([], [make_guard(Legacy, n_new_starts=5)]):
        model = build(gradient_steps=0)
        moves = [At([1], better), At([STEPS + 1], partial(correct, region=RIGHT, value=0.4))]
        train(model, 3 * STEPS, *moves, *callbacks)
        states.append(random_states())
    assert len(callbacks[0].decisions) >= 2
    assert states[0] == states[1]


@pytest.mark.parametrize("together", [lambda a, b: [a, b], lambda a, b: [CallbackList([a]), b]])
def test_two_guards_at_once_are_refused(together) -> None:
    guards = together(make_guard(), make_guard())
    with pytest.raises(ValueError, match="2 guards were passed to learn, expected is one"):
        train(build(), STEPS, *guards)


@pytest.mark.parametrize(("kind", "deep"), [("every", False), ("every", True), ("eval", False)])
def test_a_guard_within_an_event_callback_is_refused(deep, kind) -> None:
    guard = make_guard()
    inner = CallbackList([CallbackList([guard])]) if deep else guard
    outer = (
        EveryNTimesteps(STEPS, inner)
        if kind == "every"
        else EvalCallback(Slide(), callback_on_new_best=inner)
    )
    with pytest.raises(
        ValueError, match=r"within a callback of the class E.* Pass the guard to learn"
    ):
        train(build(), STEPS, outer)


def test_with_other_settings_the_accepted_policy_the_hard_starts_and_the_count_are_kept() -> None:
    class LostLater(Slide):
        """From new starts on, a strong correction on the right loses."""

        def reset(self, *, seed=None, options=None):
            seen.append(seed)
            self.new = seed is not None and seed >= FIRST + 10
            return super().reset(seed=seed, options=options)

        def step(self, action):
            strong = self.new and self.x[0] > 1.9 and float(action[0]) > -0.65
            observation, reward, *rest = super().step(action)
            return observation, reward - (1.0 if strong else 0.0), *rest

    seen: list[int] = []
    model, values = build(gradient_steps=0), iter([0.3, 0.5])
    moves = At([1, STEPS + 1], lambda policy: correct(policy, RIGHT, next(values)))
    train(model, 2 * STEPS, moves, first := make_guard(LostLater, n_new_starts=10))
    hard = set(first.state.evidence.starts.seeds) - set(range(FIRST, FIRST + 10))
    assert hard
    used = first.state.evidence.next_seed
    correct(model.policy, RIGHT, 1.9)  # what the model has got when the next learn begins
    seen.clear()
    train(model, STEPS, second := make_guard(LostLater, n_new_starts=10, n_eval_episodes=4))
    assert set(second.state.evidence.starts.seeds) >= hard | set(range(FIRST, FIRST + 4))
    right = last_layer(model)[REGION[RIGHT], 0, -1]
    assert float(right.detach()) == pytest.approx(0.3)
    new = {seed for seed in seen if seed is not None} - set(second.state.evidence.starts.seeds)
    assert new
    assert min(new) >= used


def _halved(env: gym.Env) -> gym.Env:
    return gym.wrappers.TransformReward(env, lambda reward: reward / 2)


def test_a_guard_names_a_reward_that_is_not_the_cost_once_and_a_passed_audit_alone() -> None:
    model = DDPG("YannPolicy", _halved(gym.make("CSTR-v0")), seed=0, device="cpu", batch_size=2)
    guard = ImprovementGuard(
        lambda: _halved(gym.make("CSTR-v0")), n_eval_episodes=2, n_new_starts=0
    )
    for callbacks, count in (([guard], 1), ([guard], 0), ([guard, CostAudit()], 1)):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            model.learn(110, callback=[NoActionNoise(), *callbacks])
        found = [str(each.message) for each in told if each.category is CostMismatchWarning]
        assert len(found) == count
        assert all("0.5 times minus the cost" in each for each in found)


def test_a_guard_says_nothing_of_a_reward_that_is_the_cost() -> None:
    model = DDPG("YannPolicy", "CSTR-v0", seed=1, device="cpu", batch_size=2)
    guard = ImprovementGuard("CSTR-v0", n_eval_episodes=2, n_new_starts=0)
    model.learn(110, callback=[NoActionNoise(), guard])  # a warning would be an error
    assert guard._audit is not None and guard._audit.finding.matches
