"""What counts as no worse: less safe episodes, the worst starts, the mean cost."""

from typing import Any

import numpy as np
import pytest
from scipy import stats

from sb3_yann.compare import (
    AcceptanceRule,
    Difference,
    Scores,
    Starts,
    Tolerance,
    less_safe,
    level_of_look,
    looks,
    no_worse,
    tail_average,
    unsafe_columns,
)
from sb3_yann.control.mpc.bound_excess import BoundExcess

NAN = np.nan
INF = np.inf
STRICT = Tolerance(1.0)


def scores(costs: Any, unsafe: Any = (), visits: Any = None) -> Scores:
    """Return scores of episodes with the first columns of what is unsafe."""
    rows = np.zeros((len(costs), 9))
    unsafe = np.array(unsafe, float)
    if unsafe.size:
        rows[:, : unsafe.shape[1]] = unsafe
    visits = np.ones((len(costs), 2)) if visits is None else visits
    return Scores(np.array(costs, float), rows, np.array(visits, bool))


def starts(costs: Any, tolerance: Tolerance = STRICT, unsafe: Any = ()) -> Starts:
    return Starts((*range(100, 100 + len(costs)),), scores(costs, unsafe), tolerance)


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


def refusal(costs: Any, unsafe: Any = (), accepted: Any = (10, 20, 30), margin: float = 1) -> str:
    mpc = scores([10, 20, 30])
    return no_worse(scores(costs, unsafe), scores(accepted), mpc, Tolerance(margin)).reason


@pytest.mark.parametrize(
    ("costs", "why"),
    [
        ([10, 20, 30], ""),
        ([11, 19, 30], ""),  # one start worse by exactly the margin
        ([11.01, 5, 5], "start 0 costs 5.05 % of the mean cost more than with the MPC"),
        ([5, 5, 31.5], "start 2 costs 7.5 % of the mean cost more"),
        ([10, 20.5, 30], "mean cost 20.1667 from 3 starts, accepted 20"),
        ([10, 20, 30.00003], ""),  # a relative difference of 5e-7 is rounding
        ([10, 20, 30.0003], "mean cost 20.0001 from 3 starts, accepted 20"),
        ([NAN, 1, 1], "start 0 costs nan % of"),
        ([1, 1, INF], "start 2 costs inf % of"),
        ([-INF, NAN, 1], "start 1 costs nan % of"),
    ],
)
def test_a_worse_mean_or_one_start_beyond_the_margin_is_refused(costs, why) -> None:
    assert why in refusal(costs)
    assert bool(refusal(costs)) == bool(why)


def test_without_a_margin_no_start_may_cost_more_than_rounding() -> None:
    assert refusal([10, 20, 20], margin=0.0) == refusal([10 + 1e-9, 20, 20], margin=0.0) == ""
    assert "start 0" in refusal([10 + 1e-4, 20, 20], margin=0.0)
    mpc = np.full(4, 10.0)
    costs = np.array([10.0, 9.0, 11.0, NAN])
    assert Tolerance(2.0).excess(mpc, costs).tolist() == [0.0, -0.5, 0.5, INF]
    assert Tolerance(0.0).excess(mpc, costs).tolist() == pytest.approx([0.0, -1e5, 1e5, INF])


def test_rounding_adds_up_to_no_loss_however_many_policies_are_accepted_in_turn() -> None:
    mpc = accepted = scores([40.0, 60.0])
    for _ in range(50):
        candidate = scores(accepted.costs * (1 + 4e-7))
        verdict = no_worse(candidate, accepted, mpc, STRICT)
        accepted = candidate if verdict.accepted else accepted
    assert 0 < accepted.costs.mean() / mpc.costs.mean() - 1 <= 1e-6
    assert verdict.reason.startswith("mean cost 50.0001 from 2 starts, MPC 50")
    assert verdict.above_mpc


@pytest.mark.parametrize(
    ("now", "before", "why"),
    [
        ([[0, 0], [0, 0], [1, 0]], [[0, 0]] * 3, "1 of 3 starts with violations, the"),
        ([[0, 0], [2, 0], [0, 0]], [[0, 0], [2, 0], [0, 0]], ""),
        ([[1, 0], [0, 0], [0, 0]], [[0, 0], [2, 0], [0, 0]], "violations"),
        ([[0, 0], [3, 0], [0, 0]], [[0, 0], [2, 0], [0, 0]], "violations"),
        ([[1, 1], [0, 1], [0, 0]], [[2, 0], [0, 1], [0, 0]], "the env ends"),
        ([[0, 0, 0, 0], [0, 0, 0, 2], [0, 0, 0, 2]], [[0, 0]] * 3,
         "2 of 3 starts with an input that moves too far in one step, the first is start 1"),
    ],
)  # fmt: skip
def test_whoever_is_less_safe_is_refused_whatever_it_costs(now, before, why) -> None:
    accepted = scores([1, 1, 1], before)
    verdict = no_worse(scores([0, 0, 0], now), accepted, accepted, STRICT)
    assert why in verdict.reason and bool(verdict.reason) == bool(why)
    # A large step of an input wears, and breaks nothing: patience holds.
    assert verdict.breaks_limit == (bool(why) and "moves too far" not in why)


def test_a_policy_nearer_to_a_bound_than_the_mpc_does_not_tighten_it() -> None:
    riding, inside, farther = (
        Scores(np.array([cost]), columns(excess))
        for cost, excess in ((3.0, [0.04] * 5), (2.0, []), (1.0, [0.06] * 5))
    )
    mpc = riding._replace(costs=np.full(1, 4.0))
    assert no_worse(riding, inside._replace(costs=mpc.costs), mpc, STRICT).accepted
    verdict = no_worse(farther, inside, mpc, STRICT)
    assert verdict.reason and verdict.above_mpc and not verdict.breaks_limit


def test_with_a_cvar_the_worst_starts_count_on_average() -> None:
    mpc = np.full(100, 20.0)
    rule = Tolerance(margin=0.2, cvar_alpha=0.05, typical=20.0)

    def reason(worst: list[float], tolerance: Tolerance = rule) -> str:
        costs = mpc - 0.5
        costs[: len(worst)] = mpc[: len(worst)] + worst
        return no_worse(scores(costs), scores(mpc), scores(mpc), tolerance).reason

    assert reason([0.9, 0.1]) == reason([1.9]) == ""  # (.9 + .1 - 3 * .5) / 5 is below .2
    assert "start 0 costs 4.5 % of" in reason([0.9, 0.1], Tolerance(0.2))
    tail = "cost 4.6 % of the median cost more on average, 1 % is allowed: start 4 costs 5 % of"
    assert f"the worst 5 % of the starts {tail}" in reason([0.9, 0.9, 0.9, 0.9, 1.0])
    assert reason([2.1]).startswith("start 0 costs 10.5 %")  # ten times what the average may
    assert "start 0" in reason([NAN])


def test_what_a_start_may_cost_more_grows_with_its_cost() -> None:
    mpc = np.array([10.0, -60.0, 20.0])
    rule = Tolerance(2.0, 0.1, 20.0)
    assert rule.allowed(mpc).tolist() == [2.0, 6.0, 2.0]
    assert Tolerance(2.0, 0.0, 20.0).allowed(mpc).tolist() == [2.0, 2.0, 2.0]
    lost = starts(mpc, rule).lost(scores(mpc + np.array([2.1, 5.9, 1.9])))
    assert lost.tolist() == [True, False, False]


def test_a_policy_that_saves_a_few_dear_starts_may_lose_in_proportion_on_the_others() -> None:
    mpc = np.append(np.ones(19), 1000.0)
    rule = AcceptanceRule().tolerance(mpc)
    policy = mpc.copy()
    policy[0] = 1.4  # 40 % of the median, .8 % of what the policy saves on average
    assert "start 0" in no_worse(scores(policy), scores(mpc), scores(mpc), rule).reason
    policy[-1] = 1.0
    assert no_worse(scores(policy), scores(mpc), scores(mpc), rule).accepted
    policy[0] = 2.0
    assert "start 0" in no_worse(scores(policy), scores(mpc), scores(mpc), rule).reason


def test_the_average_of_a_tail_and_its_error_are_those_of_what_lies_beyond_a_quantile() -> None:
    draws = np.random.default_rng(0).standard_normal((400, 1000))
    found, errors = np.transpose([tail_average(each, 0.05) for each in draws])
    assert found.mean() == pytest.approx(stats.norm.pdf(stats.norm.isf(0.05)) / 0.05, abs=0.02)
    assert errors.mean() == pytest.approx(found.std(), rel=0.15)
    excess = np.random.default_rng(0).exponential(size=200)
    average, error = tail_average(excess, 0.1)
    ranked = np.sort(excess)[::-1]
    assert average == pytest.approx(ranked[:20].mean())
    assert error == pytest.approx(np.maximum(excess - ranked[19], 0).std() / np.sqrt(200) / 0.1)
    # A share that is no whole number counts the last one in part.
    part = (ranked[:20].sum() + 0.5 * ranked[20]) / 20.5
    assert tail_average(excess, 0.1025)[0] == pytest.approx(part)
    assert tail_average(excess, 1e-6) == (pytest.approx(ranked[0]), 0.0)


def test_standard_errors_of_the_tail_count_where_it_must_be_sure() -> None:
    excess = np.concatenate([[2.0, 0.5, 0.3], np.full(57, -1.0)])
    average, error = tail_average(excess, 0.05)
    enough = (1 - average) / error
    rule = Tolerance(1.0, 0.05, typical=50.0)
    assert rule.objection(excess) == rule.objection(excess, 0.99 * enough) == ""
    assert "cost up to 2 %" in (said := rule.objection(excess, 1.01 * enough))
    assert said.endswith("2 % is allowed: start 0")


def test_starts_lose_by_cost_or_by_what_is_unsafe_and_the_hardest_come_first() -> None:
    given = starts([10, 10])
    assert given.lost(scores([11, 11.1])).tolist() == [False, True]
    assert given.lost(scores([0, 0], [[0, 0, 0, 1], [0, 0, 0, 0]])).tolist() == [True, False]
    assert given.lost(scores([NAN])).tolist() == [True]  # of the first
    many = starts([10.0] * 15)
    assert many.hardest(scores(12.0 + np.arange(15))).tolist() == [*range(14, 4, -1)]
    assert len(many.hardest(scores([10.0] * 15))) == 0
    given = starts(np.full(6, 20.0), Tolerance(2.0, 0.5, 20.0))
    costs = [21.9, 22.1, 23.9, 15, 20, 50]
    assert given.hardest(scores(costs)).tolist() == [5, 2, 1]
    assert given.hardest(scores(costs, [[0]] * 4 + [[1], [0]])).tolist() == [4, 5, 2, 1]
    near = scores([21, 19, 21.5, 20, 18, 20.5])
    assert not given.lost(near).any()
    assert given.hardest(near).tolist() == [2, 0, 5]  # those that cost more than with the MPC


def test_hard_starts_come_first_and_count_in_no_mean() -> None:
    both = starts([1, 2, 3]).with_hard(starts([5, 6]), np.array([1]))
    assert both.seeds == (101, 100, 101, 102) and both.n_hard == 1
    assert both.mpc.costs.tolist() == [6, 1, 2, 3]
    dear = scores([6.5, 0.5, 1.5, 2.5])
    assert no_worse(dear, both.mpc, both.mpc, STRICT, n_hard=1).accepted
    verdict = no_worse(scores([7.5, 0, 0, 0]), both.mpc, both.mpc, STRICT, names=both.seeds)
    assert verdict.reason == "start 101 costs 50 % of the mean cost more than with the MPC"


def test_a_gain_is_sure_or_hopeless_by_the_pairs() -> None:
    mpc = scores(np.full(20, 10.0))
    noise = np.tile([-1.0, 1.0], 10)

    def found(change: float, **options: float) -> Any:
        return no_worse(scores(10 * (1 + change) + noise), mpc, mpc, Tolerance(9.0), **options)

    edge = stats.t.ppf(0.95, 19) * noise.std(ddof=1) / np.sqrt(20) / 10
    assert found(-1.01 * edge).is_sure and not found(-0.99 * edge).is_sure
    assert not found(-1.01 * edge, level=0.01).is_sure
    one = noise.std(ddof=1) / np.sqrt(20) / 10
    assert found(1.01 * one).is_hopeless and not found(0.99 * one).is_hopeless
    least = {"least_gain": 0.05}
    assert found(1.01 * one - 0.025, **least).is_hopeless
    assert not found(0.99 * one - 0.025, **least).is_hopeless
    # What is lost for good is hopeless; a tail may fall below its bound with more starts.
    unsafe = scores(np.full(20, 1.0), [[1]] + [[0]] * 19)
    assert no_worse(unsafe, mpc, mpc, Tolerance(9.0)).is_hopeless
    tail = scores([11.5] + [1.0] * 19)
    assert not no_worse(tail, mpc, mpc, Tolerance(1.0, 0.05, 10.0)).is_hopeless
    assert no_worse(tail, mpc, mpc, Tolerance(1.0)).is_hopeless


def test_pairs_that_follow_each_other_alike_are_fewer_than_they_seem() -> None:
    apart = Difference.of(np.tile([-1.0, 1.0], 20) + 3, in_turns=True)
    drifting = Difference.of(np.repeat([-1.0, 1.0], 20) + 3, in_turns=True)
    assert apart.mean == drifting.mean == pytest.approx(3.0)
    assert apart.error == pytest.approx(1.0 / np.sqrt(39)) and drifting.error > 4 * apart.error
    assert apart.room(0.05) == pytest.approx(stats.t.ppf(0.95, 39) * apart.error)
    assert Difference.of(np.array([1.0])).room(0.05) == np.inf
    assert Difference.of(np.repeat([-1.0, 1.0], 20) + 3).error == apart.error  # of a simulator


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.5])
def test_a_drift_that_the_drawn_orders_line_up_is_no_gain_in_one_of_twenty_cases(noise) -> None:
    rng = np.random.default_rng(0)
    for pairs in range(2, 10):
        drift = 1 + noise * rng.standard_normal(pairs)  # the second of a pair costs more
        orders = 1 - 2 * (np.arange(2**pairs)[:, None] >> np.arange(pairs) & 1)
        kept = [Difference.of(each * drift, in_turns=True).is_below_zero(0.05) for each in orders]
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


def test_looks_double_and_share_the_level() -> None:
    assert looks(5, 100) == [5, 10, 20, 40, 80, 100] and looks(5, 3) == [3]
    assert sum(level_of_look(0.05, j) for j in range(1, 1000)) == pytest.approx(0.05, rel=0.01)


def test_the_interval_of_a_relative_change_holds_it_where_the_mpc_s_costs_vary() -> None:
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(1000):
        mpc = rng.gamma(8.0, 0.6, 40)
        more = -1.96 + 0.07 * rng.standard_normal(40)  # saves as much from each start
        found = Difference.relative(more, mpc)
        held += abs(found.mean + 1.96 / 4.8) <= found.room(0.05)
    assert 860 <= held <= 930
