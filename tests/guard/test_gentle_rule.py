"""By default the worst starts count on average, and what is refused as a whole is tried in part."""

from __future__ import annotations

import numpy as np
import pytest
from test_new_starts import OftenRight
from test_shared_networks import push

from guard_samples import FIRST, LEFT, RIGHT, STEPS, At, build, correct, make_guard, train
from sb3_yann import AcceptanceRule
from sb3_yann.guard.episodes import Outcome, Starts
from sb3_yann.guard.statistics import Tolerance
from weights import is_mpc, last_layer

GENTLE = {"tail": 0.05, "retreat": True}
SHARED = {"networks": "shared"}


def test_of_a_step_too_far_half_is_accepted() -> None:
    model = build(gradient_steps=0, actor=SHARED)
    guard = make_guard(n_new_starts=0, rule=GENTLE)
    train(model, STEPS, At([STEPS], lambda policy: push(policy, 2.4)), guard)
    (decision, *_) = guard.decisions
    assert (decision.verdict, decision.share) == ("accepted in part", 0.5)
    assert decision.candidate_cost > decision.mpc_cost > decision.accepted_cost
    assert not is_mpc(model)


def test_without_retreat_it_is_refused() -> None:
    model = build(gradient_steps=0, actor=SHARED)
    guard = make_guard(n_new_starts=0, rule={**GENTLE, "retreat": False})
    train(model, STEPS, At([STEPS], lambda policy: push(policy, 2.4)), guard)
    assert (guard.decisions[0].verdict, guard.decisions[0].share) == ("rejected", 0.0)
    assert is_mpc(model)


class Dear(OftenRight):
    """The left is rare: one known start of sixty."""

    def __init__(self) -> None:
        super().__init__(left_of=60, after=FIRST)


@pytest.mark.parametrize(("tail", "accepted"), [(0.1, True), (0.0, False)])
def test_one_start_that_loses_a_little_stops_the_strict_rule_alone(tail, accepted) -> None:
    def spoil_a_little(policy) -> None:
        correct(policy, RIGHT, 0.5)
        correct(policy, LEFT, -1.02)  # a start there costs 1 % more; half of it would be best

    model = build(gradient_steps=0)
    rule = {"tail": tail, "retreat": False, "by_region": False, "margin": 0.001}
    guard = make_guard(Dear, n_starts=61, n_new_starts=0, rule=rule)
    train(model, STEPS, At([STEPS], spoil_a_little), guard)
    assert (guard.decisions[0].verdict == "accepted") is accepted
    assert is_mpc(model) is not accepted


def test_at_the_end_half_of_a_correction_is_kept_that_loses() -> None:
    """On the left, which only the last starts show, the whole costs more, and half costs less."""
    model = build(gradient_steps=0)
    rule = {**GENTLE, "by_region": False}
    guard = make_guard(OftenRight, n_new_starts=0, n_final_starts=60, rule=rule)
    train(model, STEPS, At([STEPS], lambda policy: push_left(policy)), guard)
    last = guard.decisions[-1]
    assert last.reason.startswith("at the end") and "50 % of its correction is kept" in last.reason
    assert last_layer(model)[:, :, -1].abs().max().item() == pytest.approx(0.6)


def push_left(policy) -> None:
    correct(policy, RIGHT, 0.5)
    correct(policy, LEFT, -1.2)  # the best is -.5


def test_a_fall_back_to_the_mpc_is_called_that() -> None:
    model = build(gradient_steps=0)
    rule = {**GENTLE, "by_region": False, "retreat": False}
    guard = make_guard(OftenRight, n_new_starts=0, n_final_starts=60, rule=rule)
    train(model, STEPS, At([STEPS], push_left), guard)
    assert guard.decisions[-1].reason.endswith("; the guard falls back to the MPC")
    assert is_mpc(model)
    said = guard.summary()
    assert "accepted last is the MPC" in said and "raise n_starts" in said


def test_a_mean_that_is_not_surely_below_the_mpc_s_does_not_pass_the_final_trial() -> None:
    mpc, tolerance = np.full(200, 20.0), Tolerance(2.0, 0.05, 20.0)
    nothing = np.zeros((200, 7)), np.zeros((200, 1), bool)
    sure = AcceptanceRule().standard_errors
    assert sure == pytest.approx(1.645, abs=1e-3) and AcceptanceRule(tail=0).standard_errors == 0
    change = np.random.default_rng(0).standard_normal(200)
    change += -0.5 * change.std() / np.sqrt(200) - change.mean()
    outcome = Outcome(mpc + change, *nothing)
    for errors, reason in ((0.0, ""), (sure, "not surely below")):
        starts = Starts((*range(200),), Outcome(mpc, *nothing), tolerance, 200, errors)
        assert reason in starts.objection(outcome)
        assert bool(starts.objection(outcome)) == bool(reason)


@pytest.mark.parametrize(("gain", "passes"), [(0.0009, False), (0.0011, True)])
def test_a_gain_that_is_sure_and_little_does_not_pass_the_final_trial(gain, passes) -> None:
    mpc, tolerance = np.full(50, -20.0), Tolerance(2.0, 0.05, 20.0)
    nothing = np.zeros((50, 7)), np.zeros((50, 1), bool)
    least, outcome = AcceptanceRule().least_gain, Outcome(mpc - 20 * gain, *nothing)
    starts = Starts((*range(50),), Outcome(mpc, *nothing), tolerance, 50, 1.6, least)
    assert starts.objection(outcome).endswith("" if passes else ": too little a gain")
    assert bool(starts.objection(outcome)) is not passes
    assert starts.at(range(9)).gains_too_little(outcome.at(range(9))) is not passes


@pytest.mark.parametrize("rule", [{}, {"least_gain": 0.0}, {"tail": 0}])
def test_what_gains_little_is_the_mpc_at_the_end_but_where_any_gain_will_do(rule) -> None:
    model = build(gradient_steps=0)
    guard = make_guard(n_final_starts=60, rule={**GENTLE, **rule})
    train(model, STEPS, At([STEPS], lambda policy: correct(policy, RIGHT, 1e-4)), guard)
    assert guard.decisions[0].verdict == "accepted"
    assert guard.decisions[0].accepted_cost < guard.decisions[0].mpc_cost
    assert is_mpc(model) is not bool(rule)
    last = guard.decisions[-1].reason
    assert ("too little a gain; the guard falls back to the MPC" in last) is not bool(rule)


def test_a_run_that_ends_within_the_warm_up_says_so() -> None:
    model, guard = build(actor={"critic_warmup": 500}), make_guard(rule=GENTLE)
    train(model, STEPS, guard)
    assert not guard.decisions and is_mpc(model)
    assert "lower critic_warmup" in guard.summary() and "= 500" in guard.summary()


def test_starts_are_lost_beyond_what_they_may_cost_and_the_hardest_come_first() -> None:
    mpc, tolerance = np.full(6, 20.0), Tolerance(2.0, 0.5, 20.0)
    nothing = np.zeros((6, 7)), np.zeros((6, 1), bool)
    starts = Starts((*range(6),), Outcome(mpc, *nothing), tolerance, 6)
    outcome = Outcome(np.array([21.9, 22.1, 23.9, 15.0, 20.0, 50.0]), *nothing)
    assert starts.lost(outcome).tolist() == [False, True, True, False, False, True]
    assert starts.hardest(outcome).tolist() == [5, 2, 1]
    unsafe = nothing[0].copy()
    unsafe[4, 0] = 1
    assert starts.hardest(outcome._replace(unsafe=unsafe)).tolist() == [4, 5, 2, 1]
    near = Outcome(np.array([21.0, 19.0, 21.5, 20.0, 18.0, 20.5]), *nothing)
    assert not starts.lost(near).any()
    assert starts.hardest(near).tolist() == [2, 0, 5]  # those that cost more than with the MPC
    assert starts.hardest(None).tolist() == [0]
