"""The guard's summary says what its decisions say."""

from __future__ import annotations

from sb3_yann.guard.state import Decision
from sb3_yann.guard.summary import ADVICE, summary_of


def decision(verdict: str, accepted: float, reason: str = "", mpc: float = 40.0) -> Decision:
    return Decision(9, 7, verdict, reason, False, 1.0, accepted, mpc, 0.0, (), 1.0)


def test_nothing_was_tried() -> None:
    assert "has tried no candidate yet" in summary_of([], 10)


def test_it_counts_verdicts_and_says_what_the_last_policy_costs() -> None:
    kind = next(iter(ADVICE))
    refused = [decision("rejected", 39.0, f"seed {i}: {kind}, by {i}") for i in (3, 4)]
    others = [decision("rejected", 39.0, "mean cost 5"), decision("accepted", 39.0)]
    said = summary_of([*refused, *others, decision("accepted in part", 30.0, "half")], 12)
    assert said.splitlines() == [
        "The policy accepted last costs 30, 25 % less than the MPC's 40, on 12 starts.",
        "Candidates: 1 accepted, 1 in part, 3 refused, in 7 episodes.",
        f"Refused most often (2 times): seed 3: {kind}, by 3.",
        f"What may help: {ADVICE[kind]}.",
    ]


def test_more_than_the_mpc_nothing_and_an_mpc_that_costs_nothing() -> None:
    assert "costs 41, 2.5 % more than the MPC's 40" in summary_of([decision("accepted", 41.0)], 5)
    assert "gains nothing: it costs 40 on 5" in summary_of([decision("rejected", 40.0, "x")], 5)
    free = decision("accepted", -2.0, mpc=0.0)
    assert "costs -2, 2e+02 % less than the MPC's 0" in summary_of([free], 5)


def test_a_reward_that_makes_costs_negative_is_compared_by_its_size() -> None:
    gained = decision("accepted", -50.0, mpc=-40.0)
    assert "costs -50, 25 % less than the MPC's -40" in summary_of([gained], 5)
