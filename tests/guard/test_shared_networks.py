"""With one network for all of theta a candidate is accepted, or refused, as a whole."""

from __future__ import annotations

import pytest
import torch as th

from guard_samples import STEPS, At, accepted_bits, actor_bits, build, make_guard, train, tried
from sb3_yann.policy.policies import YannPolicy
from weights import first_layer, is_mpc, last_layer

SHARED = pytest.mark.parametrize("actor", [{"networks": "shared"}, {"law": "online"}])


@th.no_grad()
def push(policy: YannPolicy, size: float) -> None:
    """Add ``size tanh(x / 5)`` to the law, against its own sign."""
    first_layer(policy).zero_()
    last_layer(policy).zero_()
    first_layer(policy)[0, 0, 0, 0], last_layer(policy)[0, 0, 0] = 1.0, size


@SHARED
def test_a_better_network_is_accepted_and_a_worse_one_is_not(actor) -> None:
    model, guard = build(gradient_steps=0, actor=actor), make_guard(n_new_starts=0)
    good = At([STEPS], lambda policy: push(policy, 0.4))
    bad = At([2 * STEPS], lambda policy: push(policy, -0.4))
    train(model, 2 * STEPS, good, bad, guard)
    first, second = guard.decisions[:2]
    assert first.verdict == "accepted"
    assert first.accepted_cost < first.mpc_cost
    assert second.verdict not in ("accepted", "accepted in part")
    assert not is_mpc(model)
    assert actor_bits(model.policy) == accepted_bits(guard)


@SHARED
def test_nothing_of_a_bad_network_is_accepted_in_part(actor) -> None:
    model, guard = tried(lambda policy: push(policy, -0.4), actor=actor, n_new_starts=0)
    assert guard.decisions[0].verdict not in ("accepted", "accepted in part")
    assert guard.decisions[0].regions == ()
    assert is_mpc(model)
