"""What counts as no worse: paired episodes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from sb3_yann.guard.statistics import PairedEpisodes, Tolerance, tail_average

NONE = np.zeros((3, 7))
NAN, INF = np.nan, np.inf


def objection(costs, violations=NONE, accepted=(10.0, 20.0, 30.0), margin=1.0) -> str:
    mpc = np.array([10.0, 20.0, 30.0])
    return PairedEpisodes(mpc, np.array(accepted), NONE, Tolerance(margin)).objection(
        np.array(costs, float), violations
    )


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
    assert why in objection(costs)
    assert bool(objection(costs)) == bool(why)


def test_an_equal_cost_is_no_excess_whatever_the_margin() -> None:
    mpc, costs = np.full(4, 10.0), np.array([10.0, 9.0, 11.0, NAN])
    assert Tolerance(2.0).excess(mpc, costs).tolist() == [0.0, -0.5, 0.5, INF]
    assert Tolerance(0.0).excess(mpc, costs).tolist() == pytest.approx([0.0, -1e5, 1e5, INF])


def test_the_mean_is_compared_with_the_accepted_policy_and_each_start_with_the_mpc() -> None:
    assert "mean" in objection([10, 20, 30], accepted=(9, 20, 30))
    assert objection([10.9, 18, 29], accepted=(1, 28, 29)) == ""


def test_without_a_margin_no_start_may_cost_more() -> None:
    assert objection([10, 20, 20], margin=0.0) == ""
    assert objection([10 + 1e-9, 20, 20], margin=0.0) == ""  # which is rounding
    assert "start 0" in objection([10 + 1e-4, 20, 20], margin=0.0)


def test_any_violation_more_than_the_accepted_policy_s_is_refused_whatever_it_costs() -> None:
    def violations(*steps: int):
        return np.column_stack([steps, np.zeros((3, 6))])

    message = "1 starts with violations, the first is number 2"
    assert message in objection([1, 1, 1], violations(0, 0, 1))
    paired = PairedEpisodes(np.ones(3), np.ones(3), violations(0, 2, 0), Tolerance(1.0))
    assert paired.objection(np.ones(3), violations(0, 2, 0)) == ""
    assert paired.objection(np.ones(3), violations(0, 1, 0)) == ""
    assert "violations" in paired.objection(np.zeros(3), violations(0, 3, 0))
    assert "violations" in paired.objection(np.zeros(3), violations(1, 0, 0))


def test_an_episode_that_is_terminated_is_refused_though_it_has_fewer_violations() -> None:
    accepted = np.pad([[2, 0], [0, 1]], ((0, 0), (0, 5)))
    paired = PairedEpisodes(np.ones(2), np.ones(2), accepted, Tolerance(1.0))
    assert "the env ends" in paired.objection(
        np.zeros(2), np.pad([[1, 1], [0, 1]], ((0, 0), (0, 5)))
    )
    assert paired.objection(np.zeros(2), accepted) == ""
    assert "violations" in paired.objection(np.zeros(2), np.pad([[2, 0], [1, 0]], ((0, 0), (0, 5))))


def test_with_a_tail_the_worst_starts_count_on_average() -> None:
    mpc, allowed = np.full(100, 20.0), Tolerance(margin=0.2, tail=0.05, typical=20.0)
    costs = mpc - 0.5

    def reason(worst: list[float], rule: Tolerance = allowed) -> str:
        policy = costs.copy()
        policy[: len(worst)] = mpc[: len(worst)] + worst
        nothing = np.zeros((100, 7))
        return PairedEpisodes(mpc, mpc, nothing, rule).objection(policy, nothing)

    assert reason([0.9, 0.1]) == ""  # (.9 + .1 - 3 * .5) / 5 is below .2
    assert "start 0 costs 0.9 more" in reason([0.9, 0.1], Tolerance(0.2))
    assert "the worst 5 % of the starts cost too much, start 4" in reason([0.9, 0.9, 0.9, 0.9, 1.0])
    assert reason([2.1]).startswith("start 0 costs 2.1")  # ten times what the average may
    assert reason([1.9]) == ""
    assert "start 0" in reason([NAN])


def test_with_a_tail_a_dear_start_may_cost_more_in_proportion() -> None:
    mpc, rule = np.array([10.0, 20.0, 200.0]), Tolerance(margin=0.2, tail=0.05, typical=20.0)
    assert rule.excess(mpc, mpc + 1.9) == pytest.approx([9.5, 9.5, 0.95])
    assert Tolerance(0.2).excess(mpc, mpc + 1.9) == pytest.approx([9.5, 9.5, 9.5])


def test_a_start_that_is_too_dear_is_offset_by_the_others_of_the_tail() -> None:
    rule, excess = Tolerance(1.0, tail=0.05, typical=1.0), np.zeros(40)
    for second, refused in ((0.4, False), (0.6, True)):  # the mean of the worst two
        excess[[7, 3]] = 1.5, second
        assert bool(rule.objection(excess)) == refused
    assert "the worst 5 % of the starts cost too much, start 7" in rule.objection(excess)


def test_the_worst_of_many_starts_stand_for_all_of_them() -> None:
    excess = np.array([3.0, 2.0, 1.0, 0.0])
    assert tail_average(excess, 0.05, 40)[0] == pytest.approx(2.5)  # two of forty
    assert tail_average(excess, 0.05, 4)[0] == 3.0  # one at least
    draws = np.random.default_rng(0).standard_normal((400, 1000))
    found, errors = np.transpose([tail_average(each, 0.05, 1000) for each in draws])
    assert found.mean() == pytest.approx(stats.norm.pdf(stats.norm.isf(0.05)) / 0.05, abs=0.02)
    assert errors.mean() == pytest.approx(found.std(), rel=0.15)
    assert tail_average(10 * draws[0], 0.05, 1000)[1] == pytest.approx(10 * errors[0])
    two, n = np.array([3.0, 1.0] + 18 * [0.0]), 20  # beyond the level, 1, is 2 with p = 1/20
    assert tail_average(two, 0.1, n)[1] == pytest.approx(2 * np.sqrt(0.05 * 0.95 * n) / 2)


def test_the_error_of_a_tail_s_average_is_that_of_what_lies_beyond_its_quantile() -> None:
    rng = np.random.default_rng(0)
    excess = rng.exponential(size=200)
    average, error = tail_average(excess, 0.1, 200)
    ranked = np.sort(excess)[::-1]
    assert average == pytest.approx(ranked[:20].mean())
    beyond = np.maximum(excess - ranked[19], 0)
    assert error == pytest.approx(beyond.std() / np.sqrt(200) / 0.1)
    # The worst of many stand for all: those left out are nowhere beyond.
    assert tail_average(ranked[:40], 0.1, 200) == pytest.approx((average, error))
    # A share that is no whole number counts the last one in part.
    part = (ranked[:20].sum() + 0.5 * ranked[20]) / 20.5
    assert tail_average(excess, 0.1025, 200)[0] == pytest.approx(part)
    assert tail_average(excess, 1e-6, 200) == (pytest.approx(ranked[0]), 0.0)
    assert tail_average(excess[:3], 0.5, 200)[0] == pytest.approx(excess[:3].mean())


def test_standard_errors_of_the_tail_count_where_it_must_be_sure() -> None:
    excess = np.concatenate([[3.0, 0.5, 0.3], np.full(57, -1.0)])
    average, error = tail_average(excess, 0.05, 60)
    assert average == pytest.approx(3.8 / 3) and average > 1
    excess[0] = 2.0
    average, error = tail_average(excess, 0.05, 60)
    assert average < 1
    enough = (1 - average) / error
    allowed = Tolerance(1.0, 0.05)
    assert allowed.objection(excess, 60, 0.99 * enough) == ""
    assert allowed.objection(excess, 60, 1.01 * enough).endswith("cost too much, start 0")
    assert allowed.objection(excess) == ""


def test_a_start_ten_times_beyond_what_is_allowed_is_too_much_alone() -> None:
    allowed = Tolerance(1.0, 0.5)
    rest = np.full(99, -50.0)
    assert allowed.objection(np.append(rest, 10.0)) == ""
    assert allowed.objection(np.append(rest, 10.1)) == "start 99"
    assert allowed.objection(np.append(rest, 1.0)) == ""


def test_what_a_dear_start_may_cost_more_grows_with_its_cost() -> None:
    mpc = np.array([10.0, -60.0, 20.0])
    assert Tolerance(2.0, 0.1, 20.0).allowed(mpc).tolist() == [2.0, 6.0, 2.0]
    assert Tolerance(2.0, 0.0, 20.0).allowed(mpc).tolist() == [2.0, 2.0, 2.0]
    paired = PairedEpisodes(mpc, mpc, NONE, Tolerance(2.0, 0.1, 20.0))
    assert paired.lost(mpc + np.array([2.1, 5.9, 1.9])).tolist() == [True, False, False]
    for more, loses in ((-1.0, False), (0.0, False), (1e-9, False), (1e-3, True)):
        assert paired.loses_to_the_mpc(mpc + np.array([more, 0, 0])) == loses
    assert paired.loses_to_the_mpc(np.array([NAN, 0.0, 0.0]))


def test_the_first_start_of_several_is_named() -> None:
    now = np.zeros((3, 7))
    now[1:, 3] = 2
    said = PairedEpisodes(np.ones(3), np.ones(3), NONE, Tolerance(1.0)).objection(np.ones(3), now)
    assert said == "2 starts with an input that moves too far in one step, the first is number 1"


def test_rounding_adds_up_to_no_loss_however_many_policies_are_accepted_in_turn() -> None:
    mpc = np.array([40.0, 60.0])
    nothing = np.zeros((2, 7))
    accepted = mpc
    for _ in range(50):
        paired = PairedEpisodes(mpc, accepted, nothing, Tolerance(1.0))
        candidate = accepted * (1 + 4e-7)
        if not paired.objection(candidate, nothing):
            accepted = candidate
    assert 0 < accepted.mean() / mpc.mean() - 1 <= 1e-6
    said = paired.objection(candidate, nothing)
    assert said.startswith("mean cost 50.0001, MPC 50")
