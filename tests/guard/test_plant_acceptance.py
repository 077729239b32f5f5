"""Without a simulator: blocks of training episodes, in which the actor learns or rests."""

from __future__ import annotations

import re
from functools import partial
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from scipy import stats
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from guard_samples import (
    BLOCK,
    MPC,
    REGION,
    RIGHT,
    STEPS,
    At,
    Slide,
    accepted_bits,
    actor_bits,
    better,
    bits,
    build,
    correct,
    critic_bits,
    guard_alone,
    overwrite,
    plant,
    random_states,
    randomize,
    still,
    train,
    verdicts,
)
from sb3_yann import AcceptanceRule
from sb3_yann.guard.covariate import predicted_cost
from sb3_yann.guard.plant_acceptance import PlantAcceptance
from sb3_yann.guard.statistics import PlantEpisodes
from weights import last_layer


class Phases(At):
    """Notes the phase after each step, and the actor."""

    def __init__(self, guard) -> None:
        super().__init__(range(10_000), self.note)
        self.guard, self.phases, self.actors = guard, [], []

    def note(self, policy) -> None:
        self.phases.append(self.guard.state.evidence.phase)
        self.actors.append(bits(policy.actor.state_dict()))


def test_a_better_candidate_passes_after_a_first_a_learning_and_a_trial_block() -> None:
    model, guard = still(), guard_alone()
    train(model, 3 * BLOCK, At([BLOCK + 2], better), guard, phases := Phases(guard))
    first, learning, trial = ["first"] * (BLOCK - 1), ["learning"] * BLOCK, ["trial"] * BLOCK
    assert phases.phases == [*first, *learning, *trial, "learning"]
    (decision,) = guard.decisions
    assert decision.verdict == "accepted"
    assert (decision.timestep, decision.episode) == (3 * BLOCK, 9)
    assert re.fullmatch(r"-\S+ from the same starts by the linear model, p = \S+", decision.reason)
    assert decision.candidate_cost == decision.accepted_cost == pytest.approx(4)
    assert decision.mpc_cost == pytest.approx(4.25)
    assert np.isnan(decision.worst_start) and decision.share == 1
    assert actor_bits(model.policy) == accepted_bits(guard)
    assert float(last_layer(model)[REGION[RIGHT], 0, -1].detach()) == 0.5


@pytest.mark.parametrize("value", [-0.5, 1.0, 1.2], ids=["no effect", "no better", "worse"])
def test_a_candidate_that_is_no_better_is_taken_back(value) -> None:
    model, guard = still(), guard_alone()
    before = actor_bits(model.policy)
    seen: list[bool] = []
    look = At([3 * BLOCK], lambda policy: seen.append(actor_bits(policy) == before))
    move = At([BLOCK + 1], partial(correct, region=RIGHT, value=value))
    train(model, 3 * BLOCK, move, guard, look)
    assert verdicts(guard) == ["rejected"]
    assert (guard.decisions[0].step, guard.decisions[0].share) == (0.5, 0)
    assert guard.decisions[0].accepted_cost == pytest.approx(4.25)
    assert seen == [True]


@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_the_actor_rests_in_the_first_and_in_trial_blocks_and_learns_in_between(algorithm) -> None:
    model, guard = build(algorithm, env=Slide()), guard_alone(significance=0.0)
    train(model, 5 * BLOCK, guard, phases := Phases(guard))
    # What is noted after a step is the actor that has played it, or that was brought back then.
    a = phases.actors
    assert all(each == a[0] for each in a[:BLOCK])
    assert sum(x != y for x, y in pairwise(a[BLOCK : 2 * BLOCK])) > 3
    trial = a[2 * BLOCK : 3 * BLOCK - 1]
    assert all(each == trial[0] for each in trial)
    assert trial[0] != a[0]
    assert a[3 * BLOCK - 1] == a[0]  # rejected: no size of zero is passed
    assert a[4 * BLOCK - 1] != a[0]
    assert verdicts(guard) == ["rejected", "rejected"]
    assert bits(model.policy.actor.state_dict()) == a[0]


def test_the_critic_learns_in_all_blocks() -> None:
    model, guard = build(env=Slide()), guard_alone()
    critics: list[Any] = []
    look = At(range(2, 99), lambda policy: critics.append(critic_bits(policy)["critic"]))
    train(model, 3 * BLOCK, guard, look)
    assert len(critics) == 3 * BLOCK - 1
    assert all(a != b for a, b in pairwise(critics))


@pytest.mark.parametrize("where", ["learning", "trial"])
def test_a_violation_brings_the_accepted_policy_back_at_once(where) -> None:
    model, guard = still(env=plant(limits=(-1.1, 0.2))), guard_alone()
    before = actor_bits(model.policy)
    # Its input is 1 in the right region, at the first step of the next episode.
    move = At([BLOCK + 2], partial(correct, region=RIGHT, value=2.0))
    step = BLOCK + STEPS + 1
    if where == "trial":
        move, step = At([2 * BLOCK - 2], move.act), 2 * BLOCK + 1
    seen: list[bool] = []
    look = At([step], lambda policy: seen.append(actor_bits(policy) == before))
    train(model, 2 * BLOCK + 2, move, guard, look)
    assert seen == [True]
    (decision,) = guard.decisions
    assert decision.timestep == step
    assert decision.reason == "a limit was violated"
    assert decision.restored
    assert np.isnan(decision.candidate_cost)
    assert guard.state.evidence.phase == "learning"


class LongViolations(gym.Wrapper):
    """Limits are violated in the fifth episode, from its second step to its end."""

    episodes, t = 0, 0

    def reset(self, **kwargs):
        self.episodes, self.t = self.episodes + 1, 0
        return self.env.reset(**kwargs)

    def step(self, action):
        *rest, info = self.env.step(action)
        self.t += 1
        return *rest, {**info, "violation": self.episodes == 5 and self.t > 1}


def test_one_long_violation_is_one_rejection_and_the_actor_rests_until_it_is_over() -> None:
    model, guard = build(env=LongViolations(Slide())), guard_alone()
    phases = Phases(guard)
    train(model, BLOCK + 3 * STEPS, guard, phases)
    assert [each.reason for each in guard.decisions] == ["a limit was violated"]
    assert guard.decisions[0].step == 0.5
    at = BLOCK + STEPS + 1  # the second step of the fifth episode, from 0
    accepted = bits(guard.state.accepted.actor)
    assert phases.actors[at - 1] != accepted
    assert all(each == accepted for each in phases.actors[at : at + STEPS - 1])
    assert phases.actors[-1] != accepted  # and then it learns again


def test_a_violation_of_the_accepted_policy_itself_is_no_rejection() -> None:
    model, guard = still(env=plant(limits=(-0.5, 1.1))), guard_alone()
    train(model, 2 * BLOCK, guard, phases := Phases(guard))
    assert guard.decisions == []
    assert phases.phases[BLOCK - 1 :: BLOCK] == ["learning", "trial"]


@pytest.mark.parametrize("sabotage", [randomize, partial(overwrite, value=np.nan)])
@pytest.mark.parametrize("place", ["before the guard", "after the guard"])
@pytest.mark.parametrize("step", [STEPS + 1, 2 * BLOCK + STEPS + 1], ids=["first", "trial"])
def test_sabotage_while_the_actor_rests_is_taken_back_at_once(sabotage, place, step) -> None:
    model, guard = still(env=Steady(plant())), guard_alone()
    before = actor_bits(model.policy)
    good, bad = At([BLOCK + 1], partial(correct, region=RIGHT, value=0.3)), At([step], sabotage)
    seen: list[bool] = []
    late = place == "after the guard"
    look = At([step + late], lambda policy: seen.append(actor_bits(policy) == before))
    callbacks = [good, guard, bad] if late else [good, bad, guard]
    train(model, 2 * BLOCK + 2 * STEPS, *callbacks, look)
    assert seen == [True]
    if late and sabotage is not randomize:  # before it acts
        assert guard.decisions[0].reason.startswith("a parameter of the actor is not a finite")
        assert guard.decisions[0].timestep == step
    else:
        assert guard.decisions[0].reason == "the actor was changed while it rested"
        assert guard.decisions[0].timestep == step + late
    assert actor_bits(model.policy) == before
    if guard.state.evidence.accepted is not None:  # without an episode of the saboteur's
        np.testing.assert_allclose(guard.state.evidence.accepted.costs, 4.25)


class Steady(gym.ActionWrapper):
    """Puts up with inputs that are no numbers."""

    def action(self, action):
        return np.nan_to_num(action)


def test_at_the_end_an_unfinished_trial_leaves_the_accepted_policy() -> None:
    model, guard = still(), guard_alone()
    before = actor_bits(model.policy)
    train(model, 3 * BLOCK - 1, At([BLOCK + 1], better), guard)
    assert guard.decisions == []
    assert actor_bits(model.policy) == before == accepted_bits(guard)
    evidence = guard.state.evidence
    assert (evidence.phase, evidence.costs, evidence.predicted) == ("learning", [], [])
    assert model.policy.actor_step == 1


def test_a_second_learn_counts_whole_episodes_only() -> None:
    model, guard = still(), guard_alone()
    train(model, STEPS + 2, guard)
    assert guard.state.evidence.costs == [pytest.approx(4.25)]
    train(model, 2 * STEPS + 2, guard, reset_num_timesteps=False)  # from the middle of an episode
    np.testing.assert_allclose(guard.state.evidence.accepted.costs, [4.25] * 3)


class Longer(gym.Wrapper):
    """Goes on for one step, without any cost, after the episode's end."""

    def step(self, action):
        *rest, reward, terminated, _, info = self.env.step(action)
        over = self.env.unwrapped.t > STEPS
        return *rest, 0.0 if over else reward, terminated, over, info


def test_of_two_plants_side_by_side_only_episodes_that_began_in_the_block_count() -> None:
    model = still(env=DummyVecEnv([plant, lambda: Longer(plant())]))
    guard = guard_alone(trial_episodes=4)
    # In the midst of an episode of each: both have left the right region already.
    move = At([2 * STEPS + 3], better)
    train(model, 100, move, guard, phases := Phases(guard))
    assert {*phases.phases} == {"first", "learning", "trial"}
    assert verdicts(guard) == ["accepted"]
    np.testing.assert_allclose(guard.state.evidence.mpc.costs, 4.25)
    np.testing.assert_allclose(guard.state.evidence.accepted.costs, 4.0)


def test_a_run_that_was_stopped_in_a_trial_goes_on_in_it(tmp_path) -> None:
    model, guard = still(), guard_alone()
    stop = 2 * BLOCK + STEPS + 1
    save = CheckpointCallback(stop, str(tmp_path), "model")
    train(model, stop + 1, At([BLOCK + 1], better), guard, save)
    loaded = DDPG.load(tmp_path / f"model_{stop}_steps", env=plant(), device="cpu")
    again = guard_alone()
    train(loaded, STEPS, again, phases := Phases(again), reset_num_timesteps=False)
    assert again.decisions == []  # the episode that was cut off is not taken for a whole one
    assert phases.phases == ["trial"] * STEPS
    loaded = DDPG.load(tmp_path / f"model_{stop}_steps", env=plant(), device="cpu")
    train(loaded, 2 * STEPS, again := guard_alone(), reset_num_timesteps=False)
    assert verdicts(again) == ["accepted"]
    np.testing.assert_allclose(again.state.evidence.mpc.costs, 4.25)
    np.testing.assert_allclose(again.state.evidence.accepted.costs, 4.0)


def test_a_policy_that_was_trained_already_is_the_first_accepted_one_not_the_mpc() -> None:
    model, guard = still(), guard_alone()
    better(model.policy)
    before = actor_bits(model.policy)
    train(model, BLOCK + 1, guard)
    assert guard.state.evidence.mpc is None
    np.testing.assert_allclose(guard.state.evidence.accepted.costs, 4.0)
    assert actor_bits(model.policy) == before


def test_the_covariate_is_the_cost_of_the_mpc_on_its_own_model() -> None:
    model, guard = still(env=Slide()), guard_alone()
    train(model, BLOCK, guard)
    predicted = guard.state.evidence.accepted.predicted
    starts = model.replay_buffer.observations[:BLOCK:STEPS, 0]
    for value, start in zip(predicted, starts, strict=True):
        x, expected = start.astype(float), 0.0
        for _ in range(STEPS):
            u = MPC.explicit()(x)
            expected += float(x[0] ** 2 + u[0] ** 2)
            x = 1.1 * x + u
        assert value == pytest.approx(expected)
        assert predicted_cost(MPC, start.astype(float), STEPS) == pytest.approx(expected)


def test_a_plant_alone_draws_no_random_numbers() -> None:
    states = []
    for callbacks in ([], [guard_alone()]):
        model = build(env=Slide())
        train(model, 4 * BLOCK, *callbacks)
        states.append([random_states(), model.env.envs[0].unwrapped.np_random.bit_generator.state])
        states[-1].append(model.env.envs[0].unwrapped.played)
    assert states[0] == states[1]


def test_of_episodes_that_end_at_one_step_no_more_count_than_a_block_has() -> None:
    model = still(env=DummyVecEnv([plant] * 4))
    guard = guard_alone(trial_episodes=6)
    move = At([2 * STEPS + 1], better)  # vectorized steps: two rounds of four episodes a block
    train(model, 4 * 6 * STEPS, move, guard, phases := Phases(guard))
    assert phases.phases[2 * STEPS - 1 :: 2 * STEPS] == ["learning", "trial", "learning"]
    assert verdicts(guard) == ["accepted"]
    assert guard.decisions[0].episode == 24
    np.testing.assert_allclose(guard.state.evidence.mpc.costs, [4.25] * 6)
    np.testing.assert_allclose(guard.state.evidence.accepted.costs, [4.0] * 6)


class Slow(gym.Wrapper):
    """Episodes of ten times the length."""

    def step(self, action):
        *rest, _, info = self.env.step(action)
        return *rest, self.env.unwrapped.t >= 10 * STEPS, info


def test_the_first_episodes_to_start_count_not_the_first_to_end() -> None:
    model = still(env=DummyVecEnv([plant, lambda: Slow(plant())]))
    guard = guard_alone(trial_episodes=3)
    train(model, 2 * 10 * STEPS, guard)
    assert len(guard.state.evidence.accepted.costs) == 3
    lasting = np.sort(guard.state.evidence.accepted.costs)
    np.testing.assert_allclose(lasting, [4.25, 4.25, 40.25])


def test_an_episode_begun_by_a_policy_that_is_then_taken_back_does_not_count() -> None:
    model, guard = still(env=DummyVecEnv([plant] * 2)), guard_alone(trial_episodes=4)
    # After the guard has looked: the next episodes begin with an action of this actor.
    move = At([STEPS], partial(correct, region=RIGHT, value=2.0))
    train(model, 2 * 5 * STEPS, guard, move)
    assert [each.reason for each in guard.decisions] == ["the actor was changed while it rested"]
    np.testing.assert_allclose(guard.state.evidence.accepted.costs, [4.25] * 4)


def compared(new: Any, old: Any, size: float, margin: float = 0.0) -> tuple[bool, bool, str]:
    """Return whether a candidate passes a test, whether it has an outlier, and why."""
    pair = (PlantEpisodes(np.array(each, float), np.full(len(each), 5.0)) for each in (new, old))
    return PlantAcceptance(AcceptanceRule(margin=margin))._compare(*pair, size)


def test_a_comparison_says_by_how_much_and_with_which_probability() -> None:
    rng = np.random.default_rng(0)
    old = 40 + rng.normal(size=10)
    new = old[::-1] - 0.7
    chance = stats.ttest_ind(new, old, equal_var=False, alternative="less").pvalue
    said = f"-0.7 from the same starts by {{}}, p = {chance:.3g}"
    assert compared(new, old, 1.01 * chance) == (True, False, said)
    not_below = f"{said}, not below {0.99 * chance:.2g}"
    assert compared(new, old, 0.99 * chance) == (False, False, not_below)
    for lost in (np.nan, np.inf, -np.inf):
        result = compared([lost, *new[1:8], lost], old, 0.5)
        assert result == (False, True, "2 of 9 episodes cost no finite number")


def test_an_outlier_fails_whatever_the_mean_and_the_margin_is_of_the_accepted_median() -> None:
    old = np.array([40.0, 40.0, 40.0, 40.0, 40.0])
    new = np.array([1.0, 1.0, 1.0, 1.0, 41.0])
    passed, outlier, why = compared(new, old, 0.5)
    assert (passed, outlier) == (False, True)
    assert why.endswith("but one start costs 1 more than it should")
    assert compared(new, old, 0.5, margin=0.024)[1] and not compared(new, old, 0.5, margin=0.026)[1]
