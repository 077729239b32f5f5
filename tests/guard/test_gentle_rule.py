"""By default the worst starts count on average, and what is refused as a whole is tried in part."""

from __future__ import annotations

import pytest
from test_new_starts import OftenRight
from test_shared_networks import push

from guard_samples import LEFT, RIGHT, STEPS, At, build, correct, make_guard, train
from weights import is_mpc, last_layer

GENTLE = {"cvar_alpha": 0.05, "backtrack": True}
SHARED = {"networks": "shared"}


def test_of_a_step_too_far_half_is_accepted() -> None:
    model = build(gradient_steps=0, actor=SHARED)
    guard = make_guard(n_new_starts=0, rule=GENTLE)
    train(model, STEPS, At([STEPS], lambda policy: push(policy, 2.4)), guard)
    (decision, *_) = guard.decisions
    assert (decision.verdict, decision.share) == ("accepted in part", 0.5)
    assert decision.candidate_cost > decision.mpc_cost > decision.accepted_cost
    assert not is_mpc(model)


def test_without_backtracking_it_is_refused() -> None:
    model = build(gradient_steps=0, actor=SHARED)
    guard = make_guard(n_new_starts=0, rule={**GENTLE, "backtrack": False})
    train(model, STEPS, At([STEPS], lambda policy: push(policy, 2.4)), guard)
    assert (guard.decisions[0].verdict, guard.decisions[0].share) == ("rejected", 0.0)
    assert is_mpc(model)


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
    rule = {**GENTLE, "by_region": False, "backtrack": False}
    guard = make_guard(OftenRight, n_new_starts=0, n_final_starts=60, rule=rule)
    train(model, STEPS, At([STEPS], push_left), guard)
    assert guard.decisions[-1].reason.endswith("; the guard falls back to the MPC")
    assert is_mpc(model)
    said = guard.summary()
    assert "accepted last is the MPC" in said and "raise n_eval_episodes" in said


@pytest.mark.parametrize("rule", [{}, {"least_gain": 0.0}, {"cvar_alpha": 0}])
def test_what_gains_little_is_the_mpc_at_the_end_but_where_any_gain_will_do(rule) -> None:
    model = build(gradient_steps=0)
    guard = make_guard(n_final_starts=60, rule={**GENTLE, **rule})
    train(model, STEPS, At([STEPS], lambda policy: correct(policy, RIGHT, 1e-4)), guard)
    assert guard.decisions[0].verdict == "accepted"
    assert guard.decisions[0].accepted_cost < guard.decisions[0].mpc_cost
    assert is_mpc(model) is not bool(rule)
    last = guard.decisions[-1].reason
    assert ("too little a gain; the guard falls back to the MPC" in last) is not bool(rule)
