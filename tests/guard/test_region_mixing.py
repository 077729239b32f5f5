"""Where the whole candidate is refused, the regions that improve the policy may still stay."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from stable_baselines3 import DDPG, TD3

from guard_samples import (
    CENTER,
    LEFT,
    REGION,
    RIGHT,
    STEPS,
    At,
    Slide,
    accepted_bits,
    actor_bits,
    bits,
    build,
    correct,
    make_guard,
    train,
    tried,
    verdicts,
)
from sb3_yann.guard import decide
from sb3_yann.policy.checkpoint import ActorCheckpoint
from sb3_yann.policy.policies import YannPolicy
from sb3_yann.rollout import evaluate
from weights import is_learnt, last_layer


def half_good(policy: YannPolicy) -> None:
    correct(policy, LEFT, -2.0)
    correct(policy, RIGHT, 0.5)


def rows(checkpoint: ActorCheckpoint, region: int) -> list[object]:
    """Return what belongs to a region: parameters of actor and target, and moments."""
    parts = [checkpoint.actor, checkpoint.target, *checkpoint.optimizer["state"].values()]
    tensors = [
        value
        for part in parts
        for key, value in part.items()
        if str(key).startswith("exp_avg") or is_learnt(str(key))
    ]
    return [bits(value[region]) for value in tensors]


@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_the_good_region_is_the_candidate_s_and_the_others_are_as_before(algorithm) -> None:
    model, guard = build(algorithm), make_guard(rule={"margin": 0.03})
    checkpoints: dict[str, ActorCheckpoint] = {}

    def change(policy) -> None:
        checkpoints["accepted"] = guard.state.accepted
        half_good(policy)
        checkpoints["candidate"] = ActorCheckpoint.of(policy)

    step = 3 * STEPS  # the first candidate, from the first episode, is accepted with its moments
    seen: list[bool] = []
    look = At([step], lambda policy: seen.append(actor_bits(policy) == accepted_bits(guard)))
    keep = At([step], lambda policy: checkpoints.update(mixed=ActorCheckpoint.of(policy)))
    fix = At([STEPS], lambda policy: correct(policy, LEFT, -0.2))
    train(model, step, fix, At([step], change), guard, look, keep)
    assert checkpoints["accepted"].optimizer["state"]
    (decision,) = [each for each in guard.decisions if each.timestep == step][:1]
    assert decision.verdict == "accepted in part"
    assert REGION[RIGHT] in decision.regions
    assert REGION[LEFT] not in decision.regions
    assert "costs" in decision.reason
    for region in REGION.values():
        source = "candidate" if region in decision.regions else "accepted"
        assert rows(checkpoints["mixed"], region) == rows(checkpoints[source], region)
    assert rows(checkpoints["candidate"], 0) != rows(checkpoints["accepted"], 0)
    assert seen == [True]


def test_the_evidence_is_that_of_the_policy_that_was_put_together() -> None:
    model, guard = tried(half_good)
    assert guard.decisions[0].regions == (REGION[RIGHT],)
    played = evaluate(model, Slide, guard.settings.seeds)
    np.testing.assert_allclose(guard.state.evidence.scores.costs, played.costs, atol=1e-5)
    assert guard.decisions[0].accepted_cost == pytest.approx(played.costs.mean())
    assert guard.decisions[0].accepted_cost < guard.decisions[0].mpc_cost
    assert guard.decisions[0].candidate_cost > guard.decisions[0].mpc_cost
    assert guard.decisions[0].step == 1  # neither shrinks nor grows


@pytest.mark.parametrize("most_lost", [0.0, 0.5], ids=["one by one", "all but those that lose"])
def test_only_the_starts_that_come_through_a_region_are_played_again(
    most_lost, monkeypatch
) -> None:
    monkeypatch.setattr(decide, "MAX_LOST_SHARE", most_lost)
    simulator = Slide()
    model, guard = build(gradient_steps=0), make_guard(simulator, n_new_starts=0)
    count: list[int] = []
    before, after = (At([STEPS], lambda _: count.append(simulator.played)) for _ in range(2))
    train(model, STEPS, At([STEPS], half_good), before, guard, after)
    assert guard.decisions[0].regions == (REGION[RIGHT],)
    left, right = guard.state.evidence.scores.visits[:, [REGION[LEFT], REGION[RIGHT]]].sum(0)
    assert 0 < left < right < 10
    # One by one, the candidate's own episodes stand for those that come through one region only.
    episodes = 10 if most_lost == 0 else 10 + left
    assert count[1] - count[0] == episodes * STEPS


def test_a_region_that_violates_a_limit_is_not_taken_over() -> None:
    # To the right half the input violates; nothing else does.
    simulator = partial(Slide, low=-4.0, limits=(-1.1, 0.9))
    _, guard = tried(lambda policy: correct(policy, RIGHT, 2.0), env=simulator)
    assert verdicts(guard) == ["rejected"]
    assert "violations" in guard.decisions[0].reason


def test_regions_may_be_taken_over_while_patience_lasts() -> None:
    model, guard = build(gradient_steps=0), make_guard(patience=2, keep_if_worse=True)
    seen: list[bytes] = []
    before, after = (
        At([STEPS], lambda policy: seen.append(bits(policy.actor.state_dict()))) for _ in range(2)
    )
    train(model, STEPS + 1, At([STEPS], half_good), before, guard, after)
    assert seen[0] == seen[1]  # the actor goes on as it was
    assert guard.decisions[0].verdict == "accepted in part"
    weight = last_layer(model)
    assert float(weight[REGION[RIGHT], 0, -1].detach()) == 0.5
    assert float(weight[REGION[LEFT], 0, -1].detach()) == 0


def test_moments_that_the_accepted_policy_has_not_got_are_zero_elsewhere() -> None:
    trained = build()
    train(trained, 3)
    mixed = ActorCheckpoint.of(build().policy).with_regions(
        ActorCheckpoint.of(trained.policy), [REGION[RIGHT]]
    )
    assert mixed.optimizer["state"]
    for state in mixed.optimizer["state"].values():
        assert float(state["step"]) == 3
        for region in (REGION[LEFT], REGION[CENTER]):
            assert not state["exp_avg"][region].any()
            assert not state["exp_avg_sq"][region].any()


def test_a_candidate_in_another_box_is_accepted_with_it_or_mixed_within_the_old() -> None:
    box = 2 * np.ones(build().policy.problem.n_theta)

    def confined(change, policy) -> None:
        change(policy)
        policy.confine_correction(-box, box)

    for change, verdict, kept in ((half_good, "accepted in part", False), (good, "accepted", True)):
        model, guard = build(gradient_steps=0), make_guard()
        before = ActorCheckpoint.of(model.policy)
        train(model, STEPS + 1, At([STEPS], partial(confined, change)), guard)
        assert guard.decisions[0].verdict == verdict
        assert bool(model.actor.mu.confines.any()) == kept
        assert float(last_layer(model)[REGION[RIGHT], 0, -1].detach()) == 0.5
        other = ActorCheckpoint.of(build(gradient_steps=0).policy)
        assert before.changed_regions(guard.state.accepted).all() == kept
        assert not before.changed_regions(other)[REGION[LEFT]]


def good(policy: YannPolicy) -> None:
    correct(policy, RIGHT, 0.5)
