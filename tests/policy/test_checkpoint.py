"""Checkpoints of an actor: copies, mixtures, shares, and when one has diverged."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th

from guard_samples import LEFT, REGION, RIGHT, actor_bits, build, correct, randomize
from sb3_yann.compare import Scores, Starts, Tolerance
from sb3_yann.guard import state
from sb3_yann.guard.state import Evidence
from sb3_yann.policy.checkpoint import DIVERGED_SIZE, ActorCheckpoint
from weights import last_layer


def pair() -> tuple[Any, ActorCheckpoint, ActorCheckpoint]:
    """Return a policy, and a checkpoint before and after it was corrected to the right."""
    policy = build().policy
    before = ActorCheckpoint.of(policy)
    correct(policy, RIGHT, 0.5)
    return policy, before, ActorCheckpoint.of(policy)


def test_a_checkpoint_is_a_copy_that_is_restored_bit_for_bit() -> None:
    policy, before, after = pair()
    assert after.is_actor_of(policy) and not before.is_actor_of(policy)
    before.restore(policy)
    original = actor_bits(policy)
    randomize(policy)
    assert not before.is_actor_of(policy)
    before.restore(policy)
    assert actor_bits(policy) == original and before.is_actor_of(policy)


def test_the_regions_whose_networks_differ_are_reported() -> None:
    _, before, after = pair()
    changed = np.arange(3) == REGION[RIGHT]
    np.testing.assert_array_equal(before.changed_regions(after), changed)
    np.testing.assert_array_equal(after.changed_networks(before), changed)
    assert before.has_networks_of(before) and not before.has_networks_of(after)
    boxed = ActorCheckpoint(dict(after.actor), after.target, after.optimizer)
    (name,) = (key for key in boxed.actor if key.endswith("confines"))
    boxed.actor[name] = th.ones_like(boxed.actor[name])
    assert boxed.changed_regions(after).all() and not boxed.changed_networks(after).any()
    assert not boxed.is_confined_as(after) and not boxed.has_networks_of(after)


def test_part_of_the_way_is_a_share_of_the_difference_of_all_weights() -> None:
    policy, before, _ = pair()
    randomize(policy, 0.3)
    other = ActorCheckpoint.of(policy)
    found = before.part_way(other, 0.25)
    assert before.networks().keys() == found.networks().keys()
    for side in ("actor", "target"):
        ours, theirs, mixed = (getattr(each, side) for each in (before, other, found))
        for key in before.networks():
            expected = ours[key] + 0.25 * (theirs[key] - ours[key])
            th.testing.assert_close(mixed[key], expected)
        assert all(th.equal(mixed[key], ours[key]) for key in ours if key not in found.networks())
    assert before.part_way(other, 0.0).has_networks_of(before)


def test_a_shrunk_correction_is_a_share_of_what_the_networks_add() -> None:
    policy, before, _ = pair()
    randomize(policy, 0.3)
    whole = ActorCheckpoint.of(policy)
    theta = th.linspace(-4, 4, 9)[:, None]
    layer = policy.actor.mu

    def added(checkpoint: ActorCheckpoint) -> np.ndarray:
        checkpoint.restore(policy)
        region = th.as_tensor(layer.regions(theta))
        z = (theta / layer.theta_half).to(layer.theta_half)
        return layer.network(z, region).detach().numpy()

    all_of_it = added(whole)
    assert np.abs(all_of_it).max() > 0.1
    np.testing.assert_allclose(added(whole.shrunk(0.25)), 0.25 * all_of_it, rtol=1e-4, atol=1e-6)
    assert not added(whole.shrunk(0.0)).any()
    for side in ("actor", "target"):
        changed = [
            key
            for key, value in getattr(whole, side).items()
            if not th.equal(value, getattr(whole.shrunk(0.5), side)[key])
        ]
        assert len(changed) == 1
    assert whole.is_confined_as(before)


def test_regions_of_another_come_with_their_targets() -> None:
    policy, before, _ = pair()
    randomize(policy, 0.3)
    other = ActorCheckpoint.of(policy)
    index = REGION[LEFT]
    found = before.with_regions(other, [index])
    for side in ("actor", "target"):
        ours, theirs, mixed = (getattr(each, side) for each in (before, other, found))
        for key in before.networks():
            for region in range(3):
                source = theirs if region == index else ours
                assert th.equal(mixed[key][region], source[key][region])
    np.testing.assert_array_equal(before.changed_regions(found), np.arange(3) == index)
    assert before.with_regions(other, []).has_networks_of(before)


@pytest.mark.parametrize(
    ("value", "bad"),
    [(0.0, False), (DIVERGED_SIZE, False), (-DIVERGED_SIZE, False), (1.01 * DIVERGED_SIZE, True),
     (-2e9, True), (np.nan, True), (np.inf, True)],
)  # fmt: skip
def test_a_parameter_beyond_a_thousand_million_has_diverged(value: float, bad: bool) -> None:
    policy = build().policy
    with th.no_grad():
        last_layer(policy)[0, 0, 0] = value
    assert ActorCheckpoint.of(policy).has_diverged() == bad


def test_what_passed_is_kept_once_the_latest_last_and_as_far_as_memory_allows(monkeypatch) -> None:
    policy, mpc, _ = pair()
    some = []
    for value in (0.1, 0.2, 0.3, 0.4):
        correct(policy, RIGHT, value)
        some.append(ActorCheckpoint.of(policy))
    scores = Scores(np.zeros(1), np.zeros((1, 9)), np.zeros((1, 3), bool))
    evidence = Evidence(mpc, mpc, Starts((0,), scores, Tolerance(1.0)), scores, next_seed=1)
    for each in (*some[:3], some[0], mpc):  # the MPC is always there
        evidence = evidence.with_passed(each)
    assert [*evidence.passed] == [some[1], some[2], some[0]]
    evidence = evidence.without_passed(some[2])
    assert [*evidence.passed] == [some[1], some[0]]
    monkeypatch.setattr(state, "MAX_PASSED", 2)
    evidence = evidence.with_passed(some[3])
    assert [*evidence.passed] == [some[0], some[3]]
    for room, left in ((2.0, 2), (1.99, 1), (0.1, 1)):
        monkeypatch.setattr(state, "MAX_PASSED_BYTES", int(room * mpc.size))
        found = evidence.with_passed(some[1]).with_passed(some[2])
        assert [*found.passed] == [some[1], some[2]][-left:]


def test_a_checkpoint_knows_whether_it_has_learned_anything() -> None:
    policy, before, after = pair()
    assert not before.has_learned() and after.has_learned()
    assert not after.shrunk(0.0).has_learned()
    randomize(policy, 0.3)
    assert ActorCheckpoint.of(policy).has_learned()
