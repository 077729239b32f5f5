"""On a plant alone: what must not reach the plant, and what must not count as evidence."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.noise import NormalActionNoise

from guard_samples import (
    BLOCK,
    REGION,
    RIGHT,
    STEPS,
    At,
    Slide,
    accepted_bits,
    actor_bits,
    build,
    correct,
    guard_alone,
    make_guard,
    overwrite,
    still,
    train,
    verdicts,
)
from sb3_yann import NoActionNoise, NonFiniteWarning
from weights import is_mpc, last_layer


@pytest.mark.parametrize("value", [np.nan, np.inf, 3e38])
@pytest.mark.parametrize("when", [1, BLOCK + 1, 2 * BLOCK + 1], ids=["first", "learning", "trial"])
def test_no_action_of_an_actor_that_diverged_reaches_the_plant(value, when) -> None:
    # The plant raises an error at an input that is no number.
    model, guard = still(), guard_alone()
    train(model, 3 * BLOCK, guard, At([when], partial(overwrite, value=value)))
    assert guard.decisions[0].reason.startswith("a parameter of the actor is not a finite number")
    assert guard.decisions[0].timestep == when
    assert actor_bits(model.policy) == accepted_bits(guard)


class Trips(Slide):
    """Half the MPC's input is a violation, and trips the plant two steps later."""

    def reset(self, *, seed=None, options=None):
        self.left = -1
        return super().reset(seed=seed, options=options)

    def step(self, action):
        violation = self.x[0] > 1.9 and abs(float(action[0])) < 0.9
        observation, reward, _, truncated, _ = super().step(action)
        self.left = 2 if violation else self.left - 1
        return observation, reward, self.left == 0, truncated, {"violation": bool(violation)}


def test_a_plant_that_trips_in_an_episode_of_a_candidate_is_no_habit_of_the_accepted_policy() -> (
    None
):
    model, guard = still(env=Trips(low=2.0, high=2.8)), guard_alone()
    trips = At([BLOCK + 1, 2 * BLOCK + 1], partial(correct, region=RIGHT, value=0.5))
    train(model, 3 * BLOCK, trips, guard)
    assert "a limit was violated" in [each.reason for each in guard.decisions]
    assert not guard.state.evidence.terminates


def test_random_actions_before_learning_starts_are_refused() -> None:
    with pytest.raises(ValueError, match="learning_starts = 12: SB3 plays so many actions at rand"):
        still(learning_starts=BLOCK).learn(BLOCK, callback=guard_alone())


def test_action_noise_is_refused() -> None:
    noise = NormalActionNoise(np.zeros(1), np.full(1, 0.1))
    with pytest.raises(ValueError, match="action_noise = NormalActionNoise"):
        still(action_noise=noise).learn(BLOCK, callback=guard_alone())


@pytest.mark.parametrize("first", [True, False])
def test_with_no_action_noise_both_are_fine_in_either_order(first) -> None:
    model = still(learning_starts=BLOCK, action_noise=NormalActionNoise(np.zeros(1), np.ones(1)))
    callbacks = [NoActionNoise(), guard_alone()]
    model.learn(BLOCK, callback=CallbackList(callbacks if first else callbacks[::-1]))
    np.testing.assert_allclose(model.guard_state.evidence.accepted.costs, 4.25)


def test_a_cost_of_the_first_block_that_is_no_number_is_an_error() -> None:
    class Faulty(Slide):
        def step(self, action):
            observation, _, *rest = super().step(action)
            return observation, np.nan, *rest

    with (
        pytest.warns(NonFiniteWarning, match="reward"),
        pytest.raises(ValueError, match=r"first block cost .*Rewards must be finite numbers"),
    ):
        train(still(env=Faulty()), BLOCK, guard_alone())


def test_a_candidate_that_loses_one_start_heavily_is_refused_whatever_its_mean() -> None:
    class Loses(Slide):
        """A corrected input costs nearly nothing, but once."""

        episodes = 0

        def reset(self, *, seed=None, options=None):
            self.episodes += 1
            return super().reset(seed=seed, options=options)

        def step(self, action):
            corrected = self.x[0] > 1.9 and float(action[0]) > -0.9
            observation, reward, *rest = super().step(action)
            cost = (10.0 if self.episodes == 8 else -100.0) if corrected else 0.0
            return observation, reward - cost, *rest

    model, guard = still(env=Loses(low=2.0, high=2.8)), guard_alone(significance=0.5)
    train(model, 3 * BLOCK, At([BLOCK + 1], partial(correct, region=RIGHT, value=0.5)), guard)
    assert verdicts(guard) == ["rejected"]
    assert guard.decisions[0].candidate_cost < guard.decisions[0].mpc_cost
    assert "but one start costs 9.75 more than it should" in guard.decisions[0].reason


def test_learn_that_ends_in_the_first_block_leaves_target_and_optimizer_as_well() -> None:
    model, guard = build(env=Slide()), guard_alone()
    train(model, BLOCK - 1, guard)
    assert actor_bits(model.policy) == accepted_bits(guard)


def test_what_an_earlier_guard_accepted_is_what_a_plant_alone_begins_with() -> None:
    model = still()
    train(model, STEPS, At([1], partial(correct, region=RIGHT, value=0.4)), make_guard())
    correct(model.policy, RIGHT, 1.9)
    train(model, STEPS, guard := guard_alone())
    assert guard.decisions[-1].reason.startswith("before training, ")
    weight = last_layer(model)[REGION[RIGHT], 0, -1]
    assert float(weight.detach()) == pytest.approx(0.4)


def test_an_actor_that_diverges_at_every_step_is_one_decision_in_each_episode(tmp_path) -> None:
    model, guard = still(), guard_alone(log_path=tmp_path / "guard.csv")
    train(model, 4 * STEPS, guard, At(range(1, 99), partial(overwrite, value=np.nan)))
    assert len(guard.decisions) == 4
    assert len((tmp_path / "guard.csv").read_text().splitlines()) == 1 + 4
    assert actor_bits(model.policy) == accepted_bits(guard)


def test_a_policy_that_diverged_before_training_gives_way_to_the_mpc_once() -> None:
    model, guard = still(), guard_alone()
    overwrite(model.policy, np.nan)
    train(model, BLOCK, guard)
    assert [each.reason for each in guard.decisions] == ["before training, it is not accepted"]
    assert is_mpc(model)


def test_one_episode_whose_cost_is_not_known_is_left_out_of_the_first_block() -> None:
    class Faulty(Slide):
        def step(self, action):
            observation, reward, *rest = super().step(action)
            return observation, np.nan if self.played == 2 else reward, *rest

    model, guard = still(env=Faulty(low=2.0, high=2.8)), guard_alone()
    with pytest.warns(NonFiniteWarning, match=r"Step 2: reward\[0\] of env 0 is nan"):
        train(model, 4 * STEPS, guard)
    np.testing.assert_allclose(guard.state.evidence.accepted.costs, 4.25)


@pytest.mark.slow
def test_one_reward_that_is_not_finite_lets_the_guard_alone_go_on_learning(tmp_path) -> None:
    class Faulty(Slide):
        def step(self, action):
            observation, reward, *rest = super().step(action)
            return observation, np.nan if self.played == 100 else reward, *rest

    model = build(env=Faulty(low=2.0, high=2.8))
    guard = guard_alone(log_path=tmp_path / "guard.csv")
    with pytest.warns(NonFiniteWarning, match="Step 100"):
        train(model, 450, guard)
    assert all(bool(each.isfinite().all()) for each in model.policy.parameters())
    assert len(guard.decisions) < 450 / BLOCK
