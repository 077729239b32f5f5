"""The guard's summary says what its decisions say."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from guard_samples import At, Slide, better, build, make_guard, train
from sb3_yann.guard.state import ADVICE, Decision, summary_of


def decision(verdict: str, accepted: float, reason: str = "", mpc: float = 40.0) -> Decision:
    return Decision(
        timestep=9, episode=7, verdict=verdict, reason=reason, candidate_cost=1.0,
        accepted_cost=accepted, mpc_cost=mpc,
    )  # fmt: skip


def said_of(
    decisions: list[Decision], n: int = 5, is_mpc: bool = False, updates: int = 9, acts: bool = True
) -> list[str]:
    """Return the lines about decisions on n starts, and one hard start that is left out."""
    last = decisions[-1] if decisions else decision("accepted", 40.0)
    costs = SimpleNamespace(costs=np.array([last.accepted_cost] * n + [999.0]))
    mpc = SimpleNamespace(costs=np.array([last.mpc_cost] * n + [999.0]))
    checkpoint = SimpleNamespace(has_networks_of=lambda _: is_mpc, is_actor_of=lambda _: acts)
    state: Any = SimpleNamespace(
        decisions=decisions,
        settings={"seeds": range(n)},
        evidence=SimpleNamespace(scores=costs, starts=SimpleNamespace(mpc=mpc), mpc=checkpoint),
        accepted=checkpoint,
    )
    policy: Any = SimpleNamespace(critic_updates=updates, critic_warmup=5)
    return summary_of(state, policy).splitlines()


def test_it_counts_verdicts_and_says_what_the_last_policy_costs() -> None:
    kind = next(iter(ADVICE))
    refused = [decision("rejected", 39.0, f"seed {i}: {kind}, by {i}") for i in (3, 4)]
    others = [decision("rejected", 39.0, "mean cost 5"), decision("accepted", 39.0)]
    decisions = [*refused, *others, decision("accepted in part", 30.0, "half")]
    assert said_of(decisions, 12) == [
        "The policy accepted last costs 30, 25 % less than the MPC's 40, on 12 starts.",
        "Candidates: 1 accepted, 1 in part, 3 refused, in 7 episodes.",
        f"Refused most often (2 times): seed 3: {kind}, by 3.",
        f"What may help: {ADVICE[kind]}.",
    ]


@pytest.mark.parametrize(
    ("last", "words"),
    [
        (decision("accepted", 41.0), "costs 41, 2.5 % more than the MPC's 40"),
        (decision("rejected", 40.0, "x"), "is not the MPC, and gains nothing: it costs 40 on 5"),
        (decision("accepted", -2.0, mpc=0.0), "costs -2, less than the MPC's 0"),
        (decision("accepted", -50.0, mpc=-40.0), "costs -50, 25 % less than the MPC's -40"),
    ],
    ids=["more", "as much", "an MPC that costs nothing", "negative costs"],
)
def test_the_change_is_against_the_size_of_the_mpc_s_cost(last, words) -> None:
    assert words in said_of([last])[0]


def test_nothing_was_tried_and_why() -> None:
    mpc = "The policy accepted last is the MPC: it costs 40 on 5 starts."
    assert said_of([], is_mpc=True) == [mpc, "The guard has tried no candidate yet."]
    assert "had 3 updates, and the actor moves after" in said_of([], is_mpc=True, updates=3)[2]


def test_a_changed_policy_is_never_called_the_mpc() -> None:
    """What a policy learnt before training is not the MPC, nor is what changed it since."""
    model, guard = build(gradient_steps=0, actor={"critic_warmup": 99}), make_guard(Slide)
    better(model.policy)
    train(model, 2, guard)
    said = guard.summary()
    assert "is the MPC" not in said and "% less than the MPC's" in said
    assert "tried no candidate yet" in said and "critic_warmup = 99" in said
    other, guard = build(gradient_steps=0), make_guard(Slide)
    train(other, 2, At([], better), guard)
    assert "accepted last is the MPC" in guard.summary()
    better(other.policy)
    assert "The model's policy is another one, which no guard has accepted" in guard.summary()
