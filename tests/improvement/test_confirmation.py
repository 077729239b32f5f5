"""Pairs of episodes decide: what is no better is hardly ever accepted, what harms never."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sb3_yann.compare import RULE, UNSAFE, unsafe_columns
from sb3_yann.control.mpc.bound_excess import BoundExcess
from sb3_yann.improvement.confirmation import ENOUGH, LOOKS, SimulatorTrial, confirm
from twin_samples import problem


def costs_of(seeds: Any) -> np.ndarray:
    """Return what the MPC costs from each start."""
    return 1.0 + np.array([np.random.default_rng(int(each)).pareto(3.0) for each in seeds])


class Fake:
    """A simulator without a plant: costs are drawn, episodes are numbers.

    Parameters
    ----------
    change : callable
        From the seeds (k,) and a generator to what the policy costs more, relative to the MPC.
    lost, beyond : callable
        From the seeds to those whose MPC's cost is no number; to the policy's largest excess.
    """

    def __init__(self, change: Any, lost: Any = None, beyond: Any = None, seed: int = 0) -> None:
        self.problem = problem()
        self.change = change
        self.next_seed = 0
        self.lost = lost
        self.beyond = beyond
        self.rng = np.random.default_rng(seed)
        self.turn = 0
        self.played = []

    def new_seeds(self, count: int) -> range:
        self.next_seed += count
        return range(self.next_seed - count, self.next_seed)

    def play(self, controller: Any, seeds: Any) -> Any:
        seeds = np.array(seeds)
        mpc = self.turn % 2 == 0
        self.turn += 1
        if mpc:
            self.played.append(len(seeds))
        costs = costs_of(seeds)
        largest = np.zeros(len(seeds))
        if mpc and self.lost is not None:
            costs[self.lost(seeds)] = np.nan
        if not mpc:
            costs = costs * (1 + self.change(seeds, self.rng))
            largest = largest if self.beyond is None else self.beyond(seeds)
        names = np.where(largest > 0, 0, -1)  # the first bound
        excess = BoundExcess(largest, largest, largest, 0 * largest, names)
        unsafe = unsafe_columns(0, 0, ~np.isfinite(costs), excess)
        return SimpleNamespace(costs=costs, unsafe=lambda: unsafe, seeds=seeds)

    def learn(self, played: Any, seeds: Any) -> list[Any]:
        return [*played.seeds]


def act(theta: np.ndarray) -> np.ndarray:
    return np.zeros((len(theta), 1))


def looked(simulator: Fake) -> tuple[Any, SimulatorTrial]:
    return confirm(act, simulator, 7)


def gains(share: float, spread: float) -> Any:
    return lambda seeds, rng: -share + spread * rng.standard_normal(len(seeds))


def test_a_gain_is_accepted_after_forty_pairs_at_the_earliest() -> None:
    simulator = Fake(gains(0.2, 0.001))
    found, pairs = looked(simulator)
    assert found.accepted and found.final and found.iteration == 7 and found.reason == ""
    assert len(pairs.starts.seeds) == ENOUGH == 40
    assert simulator.played == [10, 10, 20]  # each look goes on from the last
    assert pairs.starts.seeds == (*range(40),)
    assert found.logged == pytest.approx(pairs.relative.mean())
    assert found.error == pytest.approx(pairs.relative.std(ddof=1) / np.sqrt(40))
    assert found.change == pytest.approx(
        (pairs.scores.costs.sum() / pairs.starts.mpc.costs.sum()) - 1
    )


def test_what_is_not_sure_after_forty_is_asked_twice_as_many() -> None:
    def gains_of(share: float) -> Any:  # one standard deviation is 1 %
        return lambda seeds, rng: -share + np.where(seeds % 2, 0.01, -0.01)

    found, pairs = looked(Fake(gains_of(0.0027)))  # 1.7 standard errors of 40, 2.4 of 80
    assert found.accepted and len(pairs.starts.seeds) == LOOKS[-1] == 80
    found, pairs = looked(Fake(gains_of(0.0018)))  # 1.6 of 80
    assert not found.accepted and len(pairs.starts.seeds) == LOOKS[-1]
    assert "not sure" in found.reason


def test_starts_that_the_mpc_cannot_finish_are_left_out_and_do_not_count() -> None:
    found, pairs = looked(Fake(gains(0.2, 0.001), lost=lambda seeds: seeds % 8 == 3))
    assert found.accepted and len(pairs.starts.seeds) >= ENOUGH
    assert not any(seed % 8 == 3 for seed in pairs.starts.seeds)
    assert np.isfinite(pairs.starts.mpc.costs).all() and np.isfinite(pairs.scores.costs).all()
    assert len(pairs.starts.seeds) == len(pairs.scores.costs) == len(pairs.episodes)
    with pytest.raises(ValueError, match="cost is a finite number on none of 10 new starts"):
        looked(Fake(gains(0.2, 0.001), lost=lambda seeds: seeds >= 0))


@pytest.mark.parametrize("cost", [np.nan, np.inf])
def test_a_policy_s_cost_that_is_not_finite_is_refused_at_once(cost) -> None:
    found, pairs = looked(Fake(lambda seeds, rng: np.where(seeds == 4, cost, -0.5)))
    assert not found.accepted and len(pairs.starts.seeds) == 10
    said = "1 of 10 starts with a cost or an observation that is no finite number"
    assert found.reason == f"{said}, the first is start 4"
    assert not found.safe
    assert 4 in pairs.lost


def test_a_bound_that_is_broken_is_refused_at_the_first_look_that_shows_it() -> None:
    def beyond(seeds):
        return np.where(seeds == 15, 0.25, 0.0)

    found, pairs = looked(Fake(gains(0.5, 0.001), beyond=beyond))
    assert not found.accepted and not found.safe and len(pairs.starts.seeds) == 20
    assert found.reason.startswith(f"1 of 20 starts with {UNSAFE[4]}, the first is start 15: ")
    assert "exceeds its bound by" in found.reason
    assert pairs.lost == [15]


@pytest.mark.parametrize("excess", [0.0, 1e-4])
def test_where_a_bound_is_in_force_acceptance_takes_all_pairs(excess) -> None:
    beyond = lambda seeds: np.where(seeds == 3, excess, 0.0)  # noqa: E731
    found, pairs = looked(Fake(gains(0.2, 0.001), beyond=beyond))
    assert found.accepted and len(pairs.starts.seeds) == (80 if excess else 40)


@pytest.mark.parametrize(
    ("share", "spread", "said"),
    [
        (-0.05, 0.01, "1 % is allowed: start"),
        (0.5 * RULE.least_gain, 1e-6, "too little a gain"),
        (0.8 * RULE.least_gain, 1e-6, "too little a gain"),
    ],
)
def test_what_costs_more_or_gains_too_little_is_refused_at_the_second_look(
    share, spread, said
) -> None:
    found, pairs = looked(Fake(gains(share, spread)))
    assert not found.accepted and found.safe and len(pairs.starts.seeds) == 20
    assert said in found.reason


def test_ten_starts_from_which_nothing_can_be_gained_refuse_nothing() -> None:
    found, pairs = looked(Fake(lambda seeds, rng: np.where(seeds < 10, 0.001, -0.5)))
    assert found.accepted and len(pairs.starts.seeds) == 40


def test_no_gain_is_accepted_by_chance_in_one_of_twenty_at_most() -> None:
    def change(seeds, rng):  # 0 on average, no start loses more than 1 %
        return 0.01 * (1 - rng.exponential(size=len(seeds)))

    accepted = [looked(Fake(change, seed=seed))[0].accepted for seed in range(200)]
    assert sum(accepted) <= 10


def test_a_mean_gain_does_not_pay_for_the_worst_starts() -> None:
    found, pairs = looked(Fake(lambda seeds, rng: np.where(seeds % 10 == 3, 0.2, -0.5)))
    assert not found.accepted
    assert "the worst 5 % of the starts cost 18.1 % of the median cost more" in found.reason
    assert set(pairs.lost) == {seed for seed in pairs.starts.seeds if seed % 10 == 3}


def test_one_dear_start_that_gains_does_not_hide_that_all_others_lose() -> None:
    dearest = np.argmax(costs_of(range(40)))
    change = lambda seeds, rng: np.where(seeds == dearest, -0.32, 0.009)  # noqa: E731
    pairs = SimulatorTrial(Fake(change))
    assert [*pairs.stages(act, [40])] == [1]
    found, _ = pairs.check(1, RULE.significance, final=True)
    assert found.change < -RULE.least_gain  # all in all it is cheaper
    assert pairs.relative.mean() > 0
    assert not found.accepted and "not sure" in found.reason


@pytest.mark.parametrize("spread", [pytest.param(0.02, marks=pytest.mark.nightly), 0.3])
def test_of_a_thousand_policies_that_are_no_better_at_most_a_twentieth_is_accepted(spread) -> None:
    accepted = 0
    least = LOOKS[-1]
    for seed in range(1000):
        simulator = Fake(gains(0.0, spread), seed=seed)
        simulator.next_seed = 100 * seed
        found, pairs = looked(simulator)
        accepted += found.accepted
        least = min(least, len(pairs.starts.seeds)) if found.accepted else least
    assert accepted <= 50
    assert least >= ENOUGH


def test_another_policy_plays_the_same_starts_and_the_mpc_does_not_again() -> None:
    simulator = Fake(gains(0.2, 0.0))
    pairs = SimulatorTrial(simulator)
    changes = []
    for share in (0.2, 0.3):
        simulator.change = gains(share, 0.0)
        next(pairs.stages(act, [10]))
        simulator.turn = 1  # whose turn is the policy's
        changes.append(pairs.check(1, RULE.significance, final=False)[0].change)
        mpc = pairs.starts.mpc.costs
        np.testing.assert_allclose(pairs.relative, -share * mpc / np.maximum(mpc, np.median(mpc)))
    assert simulator.played == [10] and pairs.starts.seeds == (*range(10),)
    assert changes == pytest.approx([-0.2, -0.3]) and not pairs.lost
