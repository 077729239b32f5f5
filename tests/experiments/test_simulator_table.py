"""The table of improve in simulators holds what its runs do, and its runs do what it says."""

from __future__ import annotations

import numpy as np
import pytest

from experiments import simulator
from experiments.runner import Outcome, Run
from experiments.simulator import CASES, HEADER, OURS, PLANS, SEEDS, TESTS, execute, rows, runs
from sb3_yann.commissioning.simulator_twin import FIRST

pytest.importorskip("scipy", minversion="1.15")  # of the extra `paper`


def outcome(costs, violations=((0, 0), (0, 0)), accepted=True, seconds=1.0) -> Outcome:
    none, extra = np.zeros(0), {"accepted": np.array(float(accepted))}
    return Outcome([0, 1], costs, np.array(violations), none, none, none, extra, seconds)


def test_a_row_holds_medians_ranges_and_what_was_lost() -> None:
    outcomes = {
        Run("pH", PLANS, 0, 0): outcome([[10.0, 30.0], [10.0, 20.0]]),  # a quarter less
        Run("pH", OURS, 40, 0): outcome([[10.0, 30.0], [8.0, 24.0]], seconds=3),
        Run("pH", OURS, 41, 0): outcome([[10.0, 30.0], [14.0, 10.0]], [[0, 0], [2, 1]], seconds=5),
        Run("pH", OURS, 42, 0): outcome([[10.0, 30.0], [10.0, 30.0]], [[1, 0], [1, 0]], False, 9),
    }
    (row,) = rows(outcomes)
    assert dict(zip(HEADER, row, strict=True)) == {
        "plant": "pH",
        "MPC": "20.00",
        "headroom, %": "-25.00",
        "`improve`, %": "-20.00 (-40.00 to +0.00)",
        "of the headroom, %": "80 (0 to 160)",
        "worst episode, %": "+20.00",
        "changed": "2 of 3",
        "violations": "2",
        "seconds": "5",
    }


def test_no_share_is_told_of_what_is_hardly_there() -> None:
    outcomes = {
        Run("pH", PLANS, 0, 0): outcome([[10.0, 30.0], [10.0, 29.9]]),
        Run("pH", OURS, 40, 0): outcome([[10.0, 30.0], [10.0, 29.8]]),
    }
    (row,) = rows(outcomes)
    shown = dict(zip(HEADER, row, strict=True))
    assert shown["headroom, %"] == "-0.25"
    assert shown["of the headroom, %"] == ""


def test_each_plant_is_planned_once_and_improved_with_every_seed() -> None:
    done = runs(["pH"])
    assert done[0] == Run("pH", PLANS, 0, 0)
    assert [run.seed for run in done if run.learner == OURS] == [*SEEDS]
    assert len(runs([*CASES])) == len(CASES) * (1 + len(SEEDS))


def test_no_episode_that_is_tested_was_searched() -> None:
    assert max(TESTS) < FIRST


@pytest.mark.slow
def test_a_run_compares_the_policy_with_the_mpc_on_the_same_episodes(monkeypatch) -> None:
    monkeypatch.setattr(simulator, "TESTS", TESTS[:4])
    plans, ours = (execute(Run("pH", learner, 40, 0)) for learner in (PLANS, OURS))
    assert np.allclose(plans.test_costs[0], ours.test_costs[0])
    assert ours.test_costs[1].mean() < 0.8 * ours.test_costs[0].mean()
    assert ours.extra["accepted"]
