"""What counts as no worse: paired episodes, and the test on a plant alone."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from sb3_yann.guard.statistics import (
    OUTLIER,
    ErrorBudget,
    PairedEpisodes,
    PlantEpisodes,
    Tolerance,
    analyze_covariance,
    excess_of_an_outlier,
    is_promising,
    tail_average,
)


def probability_of_chance(candidate: PlantEpisodes, accepted: PlantEpisodes) -> float:
    return analyze_covariance(candidate, accepted)[1]


NONE = np.zeros((3, 4), dtype=np.int64)
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
        ([10, 20, 30.0000003], "mean cost 20.0000001, accepted 20"),
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
    assert Tolerance(0.0).excess(mpc, costs).tolist() == [0.0, -INF, INF, INF]


def test_the_mean_is_compared_with_the_accepted_policy_and_each_start_with_the_mpc() -> None:
    assert "mean" in objection([10, 20, 30], accepted=(9, 20, 30))
    assert objection([10.9, 18, 29], accepted=(1, 28, 29)) == ""


def test_without_a_margin_no_start_may_cost_more() -> None:
    assert objection([10, 20, 20], margin=0.0) == ""
    assert "start 0" in objection([10 + 1e-9, 20, 20], margin=0.0)


def test_any_violation_more_than_the_accepted_policy_s_is_refused_whatever_it_costs() -> None:
    def violations(*steps: int):
        return np.column_stack([steps, np.zeros((3, 3), np.int64)])

    message = "1 starts with violations, the first is number 2"
    assert message in objection([1, 1, 1], violations(0, 0, 1))
    paired = PairedEpisodes(np.ones(3), np.ones(3), violations(0, 2, 0), Tolerance(1.0))
    assert paired.objection(np.ones(3), violations(0, 2, 0)) == ""
    assert paired.objection(np.ones(3), violations(0, 1, 0)) == ""
    assert "violations" in paired.objection(np.zeros(3), violations(0, 3, 0))
    assert "violations" in paired.objection(np.zeros(3), violations(1, 0, 0))


def test_an_episode_that_is_terminated_is_refused_though_it_has_fewer_violations() -> None:
    accepted = np.array([[2, 0, 0, 0], [0, 1, 0, 0]])
    paired = PairedEpisodes(np.ones(2), np.ones(2), accepted, Tolerance(1.0))
    assert "the env terminates" in paired.objection(
        np.zeros(2), np.array([[1, 1, 0, 0], [0, 1, 0, 0]])
    )
    assert paired.objection(np.zeros(2), accepted) == ""
    assert "violations" in paired.objection(np.zeros(2), np.array([[2, 0, 0, 0], [1, 0, 0, 0]]))


def episodes(costs, predicted=None) -> PlantEpisodes:
    costs = np.array(costs, float)
    return PlantEpisodes(costs, np.ones_like(costs) if predicted is None else np.array(predicted))


@pytest.mark.parametrize("sizes", [(10, 10), (4, 9), (3, 3), (2, 5), (2, 2)])
@pytest.mark.parametrize("predicted", ["equal", "missing"])
def test_without_a_covariate_it_is_welch_s_test(sizes, predicted) -> None:
    rng = np.random.default_rng(0)
    new, old = (rng.normal(size=size) for size in sizes)
    covariates = [np.full(size, 7.0 if predicted == "equal" else NAN) for size in sizes]
    chance = probability_of_chance(episodes(new, covariates[0]), episodes(old, covariates[1]))
    expected = stats.ttest_ind(new, old, equal_var=False, alternative="less").pvalue
    assert chance == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("sizes", [(1, 5), (5, 1)])
def test_a_single_episode_is_not_compared(sizes) -> None:
    with pytest.raises(ValueError, match="6 episodes are too few to compare two policies"):
        analyze_covariance(*(episodes(np.arange(size)) for size in sizes))


def test_with_a_covariate_it_is_least_squares_with_a_variance_for_each_policy() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        sizes = rng.integers(3, 12, 2)
        predicted = rng.exponential(size=sizes.sum()) * 1e3
        policy = np.arange(sizes.sum()) < sizes[0]
        costs = 2 * predicted + rng.normal(size=sizes.sum()) * np.where(policy, 300, 50)
        X = np.column_stack([policy, ~policy, (predicted - 1e3) / 1e3]).astype(float)
        solver = np.linalg.pinv(X)
        coefficients, row = solver @ costs, solver[0] - solver[1]
        rest = costs - X @ coefficients
        parts = np.array([np.sum(row[k] ** 2) * np.sum(rest[k] ** 2) for k in (policy, ~policy)])
        parts /= sizes - 1.5
        freedom = parts.sum() ** 2 / np.sum(parts**2 / (sizes - 1.5))
        expected = coefficients[0] - coefficients[1]
        difference, chance = analyze_covariance(
            episodes(costs[policy], predicted[policy]), episodes(costs[~policy], predicted[~policy])
        )
        assert difference == pytest.approx(expected, rel=1e-7)
        t = expected / np.sqrt(parts.sum())
        assert chance == pytest.approx(stats.t.cdf(t, freedom), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("slope", [0.0, 3.0])
def test_under_no_difference_it_accepts_as_often_as_its_size_says(slope) -> None:
    rng, trials, size = np.random.default_rng(2), 2000, 0.05
    accepted = 0
    for _ in range(trials):
        predicted = rng.exponential(size=16)
        costs = 5 + slope * predicted + rng.normal(size=16)
        chance = probability_of_chance(
            episodes(costs[:8], predicted[:8]), episodes(costs[8:], predicted[8:])
        )
        accepted += chance < size
    low, high = stats.binom.interval(0.9999, trials, size)
    assert low <= accepted <= high


def test_the_covariate_finds_a_difference_that_the_starts_hide() -> None:
    rng = np.random.default_rng(3)
    predicted = rng.exponential(size=20) * 100
    costs = predicted + rng.normal(size=20)
    costs[:10] -= 3
    with_it = probability_of_chance(
        episodes(costs[:10], predicted[:10]), episodes(costs[10:], predicted[10:])
    )
    without = probability_of_chance(episodes(costs[:10]), episodes(costs[10:]))
    assert with_it < 1e-3 < 0.05 < without


def test_units_do_not_matter() -> None:
    rng = np.random.default_rng(4)
    costs, predicted = rng.normal(size=12), rng.normal(size=12)
    chances = [
        probability_of_chance(
            episodes(scale * costs[:6], shift + scale * predicted[:6]),
            episodes(scale * costs[6:], shift + scale * predicted[6:]),
        )
        for scale, shift in [(1, 0), (1e-9, 0), (1e9, 0), (1, 1e6)]
    ]
    np.testing.assert_allclose(chances, chances[0], rtol=1e-6)


@pytest.mark.parametrize("value", [0.1, 5.3, 1e9 / 3, 1e-9 / 3, 0.0, -7.7])
@pytest.mark.parametrize("count", [3, 10, 11])
def test_equal_costs_are_no_improvement_whatever_rounding_says(value, count) -> None:
    predicted = np.random.default_rng(5).normal(size=2 * count)
    new = episodes([value] * count, predicted[:count])
    old = episodes([value] * count, predicted[count:])
    assert probability_of_chance(new, old) > 0.5
    assert probability_of_chance(episodes([value] * count), episodes([value] * count)) > 0.5


def test_without_scatter_the_sign_decides() -> None:
    assert probability_of_chance(episodes([4.0] * 3), episodes([4.25] * 3)) < 1e-6
    assert probability_of_chance(episodes([4.25] * 3), episodes([4.0] * 3)) > 1 - 1e-6


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
def test_a_cost_that_is_not_a_number_is_no_improvement(bad) -> None:
    assert probability_of_chance(episodes([bad, 1, 1]), episodes([5, 6, 7])) == 1
    assert probability_of_chance(episodes([0, 1, 1]), episodes([5, bad, 7])) == 1


def test_starts_that_tell_the_policies_apart_are_no_evidence() -> None:
    new, old = episodes([1, 2, 1, 2], [1.0] * 4), episodes([9, 8, 9, 8], [2.0] * 4)
    assert probability_of_chance(new, old) == 1


def test_too_few_episodes_are_an_error() -> None:
    with pytest.raises(ValueError, match="2 episodes are too few"):
        probability_of_chance(episodes([1]), episodes([2]))


@pytest.mark.slow
@pytest.mark.parametrize("slope", [0.0, 3.0])
def test_an_episode_of_a_policy_like_the_accepted_one_is_seldom_an_outlier(slope) -> None:
    rng, trials, found = np.random.default_rng(6), 2000, 0
    for _ in range(trials):
        predicted = rng.exponential(size=20)
        costs = slope * predicted + rng.normal(size=20)
        blocks = [episodes(costs[i : i + 10], predicted[i : i + 10]) for i in (0, 10)]
        found += excess_of_an_outlier(*blocks) > 0
    assert found <= stats.binom.ppf(0.9999, trials, OUTLIER)


def test_one_heavy_loss_is_an_outlier_though_the_test_of_the_mean_may_not_mind() -> None:
    rng, found, passed = np.random.default_rng(7), 0, 0
    for _ in range(200):
        predicted = rng.exponential(size=20) * 60
        costs = predicted + 5 * rng.normal(size=20)
        costs[:10] -= 12
        costs[rng.integers(10)] += 200
        new, old = episodes(costs[:10], predicted[:10]), episodes(costs[10:], predicted[10:])
        passed += probability_of_chance(new, old) < 0.3
        found += excess_of_an_outlier(new, old) > 100
    assert found >= 195
    assert passed < 195


@pytest.mark.parametrize("predicted", [None, [1.0, 2.0, 3.0]], ids=["missing", "known"])
def test_without_scatter_equal_or_lower_costs_are_no_outlier_and_higher_ones_are(predicted) -> None:
    old = episodes([4.25] * 3, predicted)
    assert excess_of_an_outlier(episodes([4.25, 4.0, 4.25], predicted), old) == 0
    assert excess_of_an_outlier(episodes([4.25, 4.0, 5.25], predicted), old) == pytest.approx(1)


def test_a_margin_lets_an_episode_cost_so_much_more_than_its_prediction_limit() -> None:
    old, new = episodes([4.25] * 3), episodes([4.25, 4.0, 4.3])
    assert excess_of_an_outlier(new, old) == pytest.approx(0.05)
    assert excess_of_an_outlier(new, old, margin=0.06) == 0


def test_the_tests_of_a_run_share_its_significance_whatever_passes() -> None:
    budget, spent = ErrorBudget(), []
    for _ in range(10_000):
        spent.append(budget.size(0.05))
        budget = budget.after(spent[-1], passed=False)
    assert spent[0] == pytest.approx(0.025)
    assert all(later < earlier for earlier, later in pairwise(spent))
    assert 0.0499 < sum(spent) < 0.05


def test_a_test_that_passes_hands_its_size_on_once() -> None:
    refused = ErrorBudget().after(0.025, passed=False)
    passed = ErrorBudget().after(0.025, passed=True)
    assert passed.size(0.05) == pytest.approx(refused.size(0.05) + 0.025)
    later = [each.after(0.01, passed=False) for each in (passed, refused)]
    assert later[0] == later[1]


def test_promising_is_what_would_pass_if_it_went_on_like_that() -> None:
    rng = np.random.default_rng(8)
    noise = rng.normal(size=20)
    old = episodes(noise[:10])
    for gain in np.linspace(-1, 3, 9):
        new = episodes(noise[10:] - gain)
        twice = probability_of_chance(
            episodes(np.tile(new.costs, 2)), episodes(np.tile(old.costs, 2))
        )
        assert is_promising(new, old, 0.01) == (twice < 0.01)
    assert not is_promising(episodes(noise[10:] + 5), old, 0.01)
    assert is_promising(episodes(noise[10:] - 5), old, 0.01)


def a_run_errs(draw, trial, rng, candidates: int = 30) -> bool:
    """Return whether one of a run's candidates is accepted, none of which is better."""
    accepted, budget = draw(rng, 10), ErrorBudget()
    for _ in range(candidates):
        candidate = trial(rng, 10)
        while True:
            size = budget.size(0.05)
            budget = budget.after(size, passed=False)
            passes = probability_of_chance(candidate, accepted) < size
            if not (passes or is_promising(candidate, accepted, budget.size(0.05))):
                break
            if excess_of_an_outlier(candidate, accepted, 0.01 * np.median(accepted.costs)) > 0:
                break
            if passes:
                return True
            if len(accepted.costs) <= len(candidate.costs):
                accepted += draw(rng, 10)
            else:
                candidate += trial(rng, 10)
    return False


def skewed_costs(correlation: float, residual, noise: float = 0.0):
    """Return a function that draws episodes whose costs and residuals are skewed as a plant's."""

    def draw(rng, count: int) -> PlantEpisodes:
        predicted, rest = rng.exponential(size=count), residual.rvs(count, random_state=rng)
        costs = 1 + correlation * predicted + np.sqrt(1 - correlation**2) * rest
        return PlantEpisodes(costs + noise * rng.normal(size=count), predicted)

    return draw


SAME = skewed_costs(0.3, stats.expon())
NEARLY_EXACT = skewed_costs(0.99, stats.lognorm(1))
NOISY = skewed_costs(0.99, stats.expon(), 0.05)
NOISIER = skewed_costs(0.99, stats.expon(), 0.5)
PAIRS = {
    "correlation .3": (SAME, SAME),
    "correlation .99": (NEARLY_EXACT, NEARLY_EXACT),
    "noisy plant": (NOISIER, NOISIER),
    "candidates that scatter more": (NOISY, NOISIER),
}


@pytest.mark.parametrize(
    ("name", "runs"),
    # A thousand where chance comes nearest to 5 %.
    [*((name, 40) for name in PAIRS), pytest.param("noisy plant", 1000, marks=pytest.mark.slow)],
)
def test_of_runs_with_thirty_candidates_that_are_no_better_few_accept_any(name, runs) -> None:
    """Tests of 5 % each, as on a single candidate, would err in two runs of five."""
    rng, pair = np.random.default_rng(77), PAIRS[name]
    wrong = sum(a_run_errs(*pair, rng) for _ in range(runs))
    assert wrong <= (0.05 * runs if runs == 1000 else stats.binom.ppf(0.999, runs, 0.05))


def test_with_a_tail_the_worst_starts_count_on_average() -> None:
    mpc, allowed = np.full(100, 20.0), Tolerance(margin=0.2, tail=0.05, typical=20.0)
    costs = mpc - 0.5

    def reason(worst: list[float], rule: Tolerance = allowed) -> str:
        policy = costs.copy()
        policy[: len(worst)] = mpc[: len(worst)] + worst
        nothing = np.zeros((100, 4), np.int64)
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


@pytest.mark.parametrize("covariate", [True, False])
def test_an_outlier_is_beyond_the_upper_prediction_limit_of_its_start(covariate) -> None:
    rng = np.random.default_rng(0)
    predicted = rng.uniform(1, 9, 12)
    old = episodes(3 + 2 * predicted + rng.normal(size=12), predicted if covariate else [5.0] * 12)
    at = np.array([2.0, 5.0, 30.0])
    new = episodes(np.zeros(3), at if covariate else [5.0] * 3)
    X = np.column_stack([np.ones(12), predicted])[:, : 1 + covariate]
    A = np.column_stack([np.ones(3), at])[:, : 1 + covariate]
    coefficients = np.linalg.lstsq(X, old.costs, rcond=None)[0]
    freedom = 12 - X.shape[1]
    s = np.sqrt(np.sum((old.costs - X @ coefficients) ** 2) / freedom)
    leverage = np.diag(A @ np.linalg.inv(X.T @ X) @ A.T)
    limit = stats.t.isf(OUTLIER / 3, freedom) * s * np.sqrt(1 + leverage)
    for k in range(3):
        for share, found in ((0.999, 0.0), (1.001, 1.001 * limit[k])):
            costs = A @ coefficients
            costs[k] += share * limit[k]
            one = PlantEpisodes(costs, new.predicted)
            assert excess_of_an_outlier(one, old) == pytest.approx(found, rel=1e-6)
            if found:
                assert excess_of_an_outlier(one, old, 0.0005 * limit[k]) == pytest.approx(found)
                assert excess_of_an_outlier(one, old, 0.0015 * limit[k]) == 0
    costs = A @ coefficients + 2 * limit
    worst = PlantEpisodes(costs, new.predicted)
    assert excess_of_an_outlier(worst, old) == pytest.approx(2 * limit.max())


def test_where_a_start_has_no_prediction_the_mean_alone_is_the_line() -> None:
    rng = np.random.default_rng(1)
    predicted, costs = rng.uniform(1, 9, 10), rng.normal(size=10)
    old = episodes(costs, predicted)
    new = PlantEpisodes(np.array([costs.mean() + 50, 0.0]), np.array([1.0, NAN]))
    assert excess_of_an_outlier(new, old) == pytest.approx(50)


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
    assert paired.loses_to_the_mpc(mpc + np.array([1e-9, 0, 0])) and not paired.loses_to_the_mpc(
        mpc
    )
    assert paired.loses_to_the_mpc(np.array([NAN, 0.0, 0.0]))


def test_the_first_start_of_several_is_named() -> None:
    now = np.zeros((3, 4), np.int64)
    now[1:, 3] = 2
    said = PairedEpisodes(np.ones(3), np.ones(3), NONE, Tolerance(1.0)).objection(np.ones(3), now)
    assert said == "2 starts with an input that moves too far in one step, the first is number 1"


def test_episodes_of_one_policy_add_up() -> None:
    log = ((np.zeros((3, 1)), np.zeros((2, 1))),)
    both = PlantEpisodes(np.array([1.0]), np.array([2.0]), log) + PlantEpisodes(
        np.array([3.0]), np.array([4.0])
    )
    assert both.costs.tolist() == [1, 3] and both.predicted.tolist() == [2, 4]
    assert both.log == log


def test_rounding_is_no_difference_and_a_prediction_that_hardly_varies_is_none() -> None:
    old = episodes([1.0, 1.0 + 1e-13, 1.0])
    assert analyze_covariance(episodes([1.0, 1.0, 1.0]), old) == (0.0, 1.0)
    rng = np.random.default_rng(0)
    costs = rng.normal(size=8)
    for size, same in ((1e-10, True), (1e-8, False)):
        predicted = 1.0 + size * rng.uniform(size=8)
        chance = analyze_covariance(
            episodes(costs[:4], predicted[:4]), episodes(costs[4:], predicted[4:])
        )[1]
        plain = analyze_covariance(episodes(costs[:4]), episodes(costs[4:]))[1]
        assert (chance == plain) == same
