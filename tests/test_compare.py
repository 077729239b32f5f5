"""What counts as no worse: less safe episodes, the worst starts, the mean cost."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from sb3_yann.compare import (
    AcceptanceRule,
    PairedMean,
    Scores,
    Starts,
    Tolerance,
    less_safe,
    no_worse,
    tail_average,
    unsafe_columns,
)
from sb3_yann.control.mpc.bound_excess import BoundExcess

NAN, INF = np.nan, np.inf
STRICT = Tolerance(1.0)


def scores(costs: Any, unsafe: Any = (), visits: Any = None) -> Scores:
    """Return scores of episodes with the first columns of what is unsafe."""
    rows = np.zeros((len(costs), 9))
    unsafe = np.array(unsafe, float)
    if unsafe.size:
        rows[:, : unsafe.shape[1]] = unsafe
    visits = np.ones((len(costs), 2)) if visits is None else visits
    return Scores(np.array(costs, float), rows, np.array(visits, bool))


def starts(costs: Any, tolerance: Tolerance = STRICT, unsafe: Any = (), **bar: float) -> Starts:
    seeds = tuple(range(100, 100 + len(costs)))
    return Starts(seeds, scores(costs, unsafe), tolerance, len(costs), **bar)


def columns(*episodes: list[float], violations: object = 0) -> np.ndarray:
    """Return what is unsafe of episodes that exceed one bound by so much, step by step."""
    largest = np.array([max(each, default=0.0) for each in episodes])
    summed = np.array([sum(each) for each in episodes])
    return unsafe_columns(
        violations, 0, 0, BoundExcess(largest, summed, largest, np.zeros(len(episodes)))
    )


@pytest.mark.parametrize(
    ("mpc", "policy", "worse"),
    [
        ([0.04] * 5, [0.04] * 6, False),  # as large, one step more
        ([0.04] * 2, [0.04] * 3, False),
        ([0.04] * 5, [0.04] * 9, True),  # as large, and much longer
        ([0.04] * 5, [0.06], True),  # larger
        ([0.04] * 5, [0.044] * 5, False),
        ([], [0.0009], False),
        ([], [0.5], True),
        ([0.5], [np.inf], True),
        ([2.0, 1.0], [], False),
    ],
)
def test_an_excess_is_worse_by_its_size_and_not_by_a_step(
    mpc: list[float], policy: list[float], worse: bool
) -> None:
    assert bool(less_safe(columns(policy), columns(mpc)).any()) == worse


def test_one_step_more_in_some_episodes_passes_and_in_all_of_many_does_not() -> None:
    mpc = columns(*[[0.3] * 5] * 20)
    some = columns(*[[0.3] * 6] * 8, *[[0.3] * 4] * 8, *[[0.3] * 5] * 4)
    assert not less_safe(some, mpc).any()
    assert less_safe(columns(*[[0.3] * 7] * 20), mpc)[:, 5].all()


def test_a_reported_violation_more_counts_unless_its_size_is_known_and_no_larger() -> None:
    mpc = columns([0.04] * 10, violations=10)
    assert not less_safe(columns([0.04] * 11, violations=11), mpc).any()
    assert less_safe(columns([0.09] * 11, violations=11), mpc)[0, 0]
    assert less_safe(columns([], violations=11), columns([], violations=10))[0, 0]
    assert less_safe(columns([], violations=1), columns([]))[0, 0]


def test_a_wider_room_lets_more_pass() -> None:
    assert less_safe(columns([0.05]), columns([])).any()
    assert not less_safe(columns([0.05]), columns([]), room=0.06).any()


def refusal(costs: Any, unsafe: Any = (), accepted: Any = (10, 20, 30), margin: float = 1) -> str:
    mpc = scores([10, 20, 30])
    return no_worse(scores(costs, unsafe), scores(accepted), mpc, Tolerance(margin)).reason


@pytest.mark.parametrize(
    ("costs", "why"),
    [
        ([10, 20, 30], ""),
        ([11, 19, 30], ""),  # one start worse by exactly the margin
        ([11.01, 5, 5], "start 0 costs 1.01 more than with the MPC"),
        ([5, 5, 31.5], "start 2 costs 1.5 more"),
        ([10, 20.5, 30], "mean cost 20.1667, accepted 20"),
        ([10, 20, 30.00003], ""),  # a relative difference of 5e-7 is rounding
        ([10, 20, 30.0003], "mean cost 20.0001, accepted 20"),
        ([NAN, 1, 1], "start 0 costs nan more"),
        ([1, 1, INF], "start 2 costs inf more"),
        ([-INF, NAN, 1], "start 1 costs nan more"),
    ],
)
def test_a_worse_mean_or_one_start_beyond_the_margin_is_refused(costs, why) -> None:
    assert why in refusal(costs)
    assert bool(refusal(costs)) == bool(why)


def test_the_mean_is_compared_with_the_accepted_policy_and_each_start_with_the_mpc() -> None:
    assert "mean" in refusal([10, 20, 30], accepted=(9, 20, 30))
    assert refusal([10.9, 18, 29], accepted=(1, 28, 29)) == ""


def test_without_a_margin_no_start_may_cost_more_than_rounding() -> None:
    assert refusal([10, 20, 20], margin=0.0) == refusal([10 + 1e-9, 20, 20], margin=0.0) == ""
    assert "start 0" in refusal([10 + 1e-4, 20, 20], margin=0.0)
    mpc, costs = np.full(4, 10.0), np.array([10.0, 9.0, 11.0, NAN])
    assert Tolerance(2.0).excess(mpc, costs).tolist() == [0.0, -0.5, 0.5, INF]
    assert Tolerance(0.0).excess(mpc, costs).tolist() == pytest.approx([0.0, -1e5, 1e5, INF])


def test_rounding_adds_up_to_no_loss_however_many_policies_are_accepted_in_turn() -> None:
    mpc = accepted = scores([40.0, 60.0])
    for _ in range(50):
        candidate = scores(accepted.costs * (1 + 4e-7))
        verdict = no_worse(candidate, accepted, mpc, STRICT)
        accepted = candidate if verdict.accepted else accepted
    assert 0 < accepted.costs.mean() / mpc.costs.mean() - 1 <= 1e-6
    assert verdict.reason.startswith("mean cost 50.0001, MPC 50") and verdict.above_mpc


@pytest.mark.parametrize(
    ("now", "before", "why"),
    [
        ([[0, 0], [0, 0], [1, 0]], [[0, 0]] * 3, "1 starts with violations, the first is number 2"),
        ([[0, 0], [2, 0], [0, 0]], [[0, 0], [2, 0], [0, 0]], ""),
        ([[1, 0], [0, 0], [0, 0]], [[0, 0], [2, 0], [0, 0]], "violations"),
        ([[0, 0], [3, 0], [0, 0]], [[0, 0], [2, 0], [0, 0]], "violations"),
        ([[1, 1], [0, 1], [0, 0]], [[2, 0], [0, 1], [0, 0]], "the env ends"),
        ([[0, 0, 0, 0], [0, 0, 0, 2], [0, 0, 0, 2]], [[0, 0]] * 3,
         "2 starts with an input that moves too far in one step, the first is number 1"),
    ],
)  # fmt: skip
def test_whoever_is_less_safe_is_refused_whatever_it_costs(now, before, why) -> None:
    accepted = scores([1, 1, 1], before)
    verdict = no_worse(scores([0, 0, 0], now), accepted, accepted, STRICT)
    assert why in verdict.reason and bool(verdict.reason) == bool(why)
    # A large step of an input wears, and breaks nothing: patience holds.
    assert verdict.breaks_limit == (bool(why) and "moves too far" not in why)


def test_the_accepted_policy_may_not_be_less_safe_than_the_mpc() -> None:
    mpc, accepted = scores([1, 1]), scores([1, 1], [[3], [0]])
    assert not no_worse(scores([0, 0], [[3], [0]]), accepted, mpc, STRICT).accepted


def test_with_a_cvar_the_worst_starts_count_on_average() -> None:
    mpc, rule = np.full(100, 20.0), Tolerance(margin=0.2, cvar_alpha=0.05, typical=20.0)

    def reason(worst: list[float], tolerance: Tolerance = rule) -> str:
        costs = mpc - 0.5
        costs[: len(worst)] = mpc[: len(worst)] + worst
        return no_worse(scores(costs), scores(mpc), scores(mpc), tolerance).reason

    assert reason([0.9, 0.1]) == reason([1.9]) == ""  # (.9 + .1 - 3 * .5) / 5 is below .2
    assert "start 0 costs 0.9 more" in reason([0.9, 0.1], Tolerance(0.2))
    assert "the worst 5 % of the starts cost too much, start 4" in reason([0.9, 0.9, 0.9, 0.9, 1.0])
    assert reason([2.1]).startswith("start 0 costs 2.1")  # ten times what the average may
    assert "start 0" in reason([NAN])


def test_what_a_start_may_cost_more_grows_with_its_cost() -> None:
    mpc, rule = np.array([10.0, -60.0, 20.0]), Tolerance(2.0, 0.1, 20.0)
    assert rule.allowed(mpc).tolist() == [2.0, 6.0, 2.0]
    assert Tolerance(2.0, 0.0, 20.0).allowed(mpc).tolist() == [2.0, 2.0, 2.0]
    lost = starts(mpc, rule).lost(scores(mpc + np.array([2.1, 5.9, 1.9])))
    assert lost.tolist() == [True, False, False]


def test_a_single_start_ten_times_beyond_what_is_allowed_is_too_much_alone() -> None:
    rule, rest = Tolerance(1.0, 0.5), np.full(99, -50.0)
    assert rule.objection(np.append(rest, 10.0)) == rule.objection(np.append(rest, 1.0)) == ""
    assert rule.objection(np.append(rest, 10.1)) == "start 99"


def test_the_worst_of_many_starts_stand_for_all_of_them() -> None:
    excess = np.array([3.0, 2.0, 1.0, 0.0])
    assert tail_average(excess, 0.05, 40)[0] == pytest.approx(2.5)  # two of forty
    assert tail_average(excess, 0.05, 4)[0] == 3.0  # one at least
    draws = np.random.default_rng(0).standard_normal((400, 1000))
    found, errors = np.transpose([tail_average(each, 0.05, 1000) for each in draws])
    assert found.mean() == pytest.approx(stats.norm.pdf(stats.norm.isf(0.05)) / 0.05, abs=0.02)
    assert errors.mean() == pytest.approx(found.std(), rel=0.15)
    assert tail_average(10 * draws[0], 0.05, 1000)[1] == pytest.approx(10 * errors[0])


def test_the_error_of_a_tail_s_average_is_that_of_what_lies_beyond_its_quantile() -> None:
    excess = np.random.default_rng(0).exponential(size=200)
    average, error = tail_average(excess, 0.1, 200)
    ranked = np.sort(excess)[::-1]
    assert average == pytest.approx(ranked[:20].mean())
    assert error == pytest.approx(np.maximum(excess - ranked[19], 0).std() / np.sqrt(200) / 0.1)
    # The worst of many stand for all: those left out are nowhere beyond.
    assert tail_average(ranked[:40], 0.1, 200) == pytest.approx((average, error))
    # A share that is no whole number counts the last one in part.
    part = (ranked[:20].sum() + 0.5 * ranked[20]) / 20.5
    assert tail_average(excess, 0.1025, 200)[0] == pytest.approx(part)
    assert tail_average(excess, 1e-6, 200) == (pytest.approx(ranked[0]), 0.0)


def test_standard_errors_of_the_tail_count_where_it_must_be_sure() -> None:
    excess = np.concatenate([[2.0, 0.5, 0.3], np.full(57, -1.0)])
    average, error = tail_average(excess, 0.05, 60)
    enough = (1 - average) / error
    rule = Tolerance(1.0, 0.05)
    assert rule.objection(excess) == rule.objection(excess, 60, 0.99 * enough) == ""
    assert rule.objection(excess, 60, 1.01 * enough).endswith("cost too much, start 0")


def test_episodes_are_picked_joined_and_replaced() -> None:
    one = scores([1, 2, 3], visits=[[1, 0], [0, 1], [1, 1]])
    assert one.at([2, 0]).costs.tolist() == [3, 1]
    assert one.at([2, 0]).visits.tolist() == [[True, True], [True, False]]
    longer = one.extended_by(scores([7]))
    assert longer.costs.tolist() == [1, 2, 3, 7] and len(longer.unsafe) == len(longer.visits) == 4
    other = one.replaced([1], scores([9], [[1, 2, 3, 4]], [[0, 0]]))
    assert other.costs.tolist() == [1, 9, 3] and other.unsafe[1, :4].tolist() == [1, 2, 3, 4]
    assert other.visits[1].tolist() == [False, False]
    assert one.costs.tolist() == [1, 2, 3]  # as it was


def test_some_starts_stand_for_all_and_starts_join() -> None:
    some = starts([1, 2, 3], standard_errors=2.0).at([2, 0])
    assert some.seeds == (102, 100) and some.mpc.costs.tolist() == [3, 1]
    assert (some.n_starts, some.standard_errors) == (3, 2.0)
    both = some.joined_with(starts([5.0]))
    assert both.seeds == (102, 100, 100) and both.n_starts == 4 and both.standard_errors == 0.0
    assert both.mpc.costs.tolist() == [3, 1, 5]


def test_starts_lose_by_cost_or_by_what_is_unsafe() -> None:
    given = starts([10, 10])
    assert given.lost(scores([11, 11.1])).tolist() == [False, True]
    assert given.excess(scores([11, NAN])).tolist() == [1.0, INF]
    assert given.is_lost(scores([11.1, 0])) and not given.is_lost(scores([11, 10]))
    assert given.is_lost(scores([0, 0], [[0, 0, 0, 1], [0, 0, 0, 0]]))
    # With a CVaR, of more starts than these: the worst tenth of twenty is two.
    many = Starts((1, 2), scores([10, 10]), Tolerance(1.0, 0.1, 10.0), 20)
    assert not many.is_lost(scores([11.5, 10])) and many.is_lost(scores([11.5, 10.6]))


def test_the_mean_must_not_be_above_the_mpc_s_by_more_than_rounding() -> None:
    given = starts([10, -30])
    for more, above in ((0.9e-6, False), (1.1e-6, True)):
        assert given.mean_is_above(scores([10, -30 + 2 * 20 * more])) == above
    assert given.mean_is_above(scores([10, NAN]))
    change = np.array([-3.0, 1.0, -1.0, -1.0])
    edge = 1.0 / (change.std() / 2)  # standard errors that the mean is below
    for errors, above in ((0.99 * edge, False), (1.01 * edge, True)):
        surely = starts([10.0] * 4, Tolerance(9.0), standard_errors=errors)
        assert surely.mean_is_above(scores(10 + change)) == above


@pytest.mark.parametrize(
    ("costs", "unsafe", "reason"),
    [
        ([12, 9, 13.5], (), "2 of 3 new starts lose against the MPC, seed 102 costs 3.5 more"),
        ([9, 9, 12], [[0], [1], [0]],
         "2 of 3 new starts lose against the MPC, seed 101 costs -1 more and violates a limit"),
        ([9, 9, 9], [[0] * 4, [0, 0, 0, 1], [0] * 4],
         "1 of 3 new starts lose against the MPC, seed 101 costs -1 more and moves an input too "
         "far"),
        ([10.5, 10, 10], (), "mean cost 10.1667 on 3 new starts, MPC 10"),
        ([10, 10, 10.00006], (), "mean cost 10.00002 on 3 new starts, MPC 10"),
        ([10, 10, 10], (), ""),
    ],
)  # fmt: skip
def test_the_reason_names_the_hardest_start_and_how_many_are_lost(costs, unsafe, reason) -> None:
    verdict = starts([10, 10, 10]).verdict(scores(costs, unsafe))
    assert verdict.reason == reason
    assert verdict.breaks_limit == ("violates" in reason)


def test_at_the_end_a_gain_must_be_sure_and_large_enough() -> None:
    rule = AcceptanceRule()
    sure, least = rule.standard_errors, rule.least_gain
    assert sure == pytest.approx(1.645, abs=1e-3)
    assert AcceptanceRule(cvar_alpha=0).standard_errors == 0
    change = np.random.default_rng(0).standard_normal(200)
    change += -0.5 * change.std() / np.sqrt(200) - change.mean()
    for errors, reason in ((0.0, ""), (sure, "not surely below")):
        given = starts(np.full(200, 20.0), Tolerance(2.0, 0.05, 20.0), standard_errors=errors)
        said = given.verdict(scores(20 + change)).reason
        assert reason in said and bool(said) == bool(reason)
    given = starts(np.full(50, -20.0), Tolerance(2.0, 0.05, 20.0), least_gain=least)
    for gain, passes in ((0.0009, False), (0.0011, True)):
        said = given.verdict(scores(np.full(50, -20 - 20 * gain))).reason
        assert said.endswith("" if passes else ": too little a gain") and passes is not bool(said)


def test_the_ten_hardest_starts_come_first_and_those_less_safe_before() -> None:
    given = starts([10.0] * 15)
    assert given.hardest(scores(12.0 + np.arange(15))).tolist() == [*range(14, 4, -1)]
    assert len(given.hardest(scores([10.0] * 15))) == 0
    given = starts(np.full(6, 20.0), Tolerance(2.0, 0.5, 20.0))
    costs = [21.9, 22.1, 23.9, 15, 20, 50]
    assert given.hardest(scores(costs)).tolist() == [5, 2, 1]
    unsafe = np.zeros((6, 1))
    unsafe[4] = 1
    assert given.hardest(scores(costs, unsafe)).tolist() == [4, 5, 2, 1]
    near = scores([21, 19, 21.5, 20, 18, 20.5])
    assert not given.lost(near).any()
    assert given.hardest(near).tolist() == [2, 0, 5]  # those that cost more than with the MPC
    assert given.hardest(None).tolist() == [0]


def test_pairs_that_follow_each_other_alike_are_fewer_than_they_seem() -> None:
    apart = PairedMean.of(np.tile([-1.0, 1.0], 20) + 3)
    drifting = PairedMean.of(np.repeat([-1.0, 1.0], 20) + 3)
    assert apart.mean == drifting.mean == pytest.approx(3.0)
    assert apart.error == pytest.approx(1.0 / np.sqrt(39)) and drifting.error > 4 * apart.error
    assert apart.room() == pytest.approx(stats.t.ppf(0.95, 39) * apart.error)
    assert PairedMean.of(np.array([1.0])).room() == np.inf


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.5])
def test_a_drift_that_the_drawn_orders_line_up_is_no_gain_in_one_of_twenty_cases(noise) -> None:
    rng = np.random.default_rng(0)
    for pairs in range(2, 10):
        drift = 1 + noise * rng.standard_normal(pairs)  # the second of a pair costs more
        orders = 1 - 2 * (np.arange(2**pairs)[:, None] >> np.arange(pairs) & 1)
        kept = [PairedMean.of(order * drift).is_below_zero() for order in orders]
        assert np.mean(kept) <= 0.05
        assert any(kept) == (pairs > 4)  # of four pairs one order in sixteen does it


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("margin", (0.0, 5.0), (-1e-9, np.inf)), ("cvar_alpha", (0.0, 1.0), (-0.1, 1.1)),
        ("max_input_step", (1.0, 7.0, None), (0.99, np.inf, np.nan, "2")),
        ("significance", (0.0, 0.5), (-0.1, 0.51)), ("by_region", (True, False), (1, "no")),
        ("backtrack", (True, False), (0, None)),
    ],
)  # fmt: skip
def test_what_a_rule_may_be_ends_where_it_says(name: str, good: Any, bad: Any) -> None:
    for value in good:
        assert getattr(AcceptanceRule(**{name: value}), name) == value
    for value in bad:
        with pytest.raises((ValueError, TypeError), match=name):
            AcceptanceRule(**{name: value})
