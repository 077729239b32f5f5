"""The table of docs/headroom.md on the observer: its figures, and the runs behind them."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from experiments import catalog, observer
from experiments.measures import MPC, OBSERVER, OPTIMUM, REIDENTIFIED
from experiments.runner import Outcome, Run, load
from experiments.yardsticks import Learner
from sb3_yann.evaluation import evaluate

pytest.importorskip("scipy", minversion="1.15")  # of the extra `paper`

REACTOR, PENDULUM = observer.PLANTS


def outcome(costs, violations=(0, 0)) -> Outcome:
    none = np.zeros(0)
    return Outcome([0], [costs], [violations], none, none, none)


def learnt(costs) -> Outcome:
    tests, played = [[10.0, 30.0], costs], np.zeros(50)
    return Outcome([0, 50], tests, np.zeros((2, 2)), played, played, played)


def test_a_row_compares_with_the_mpc_and_with_the_observer() -> None:
    outcomes = {
        Run(REACTOR, MPC, 0, 0): outcome([10.0, 30.0]),
        Run(REACTOR, OBSERVER, 0, 0): outcome([11.0, 14.0], violations=(0, 3)),
        Run(REACTOR, observer.LEARNER, 40, 50): learnt([8.0, 12.0]),
        Run(REACTOR, observer.LEARNER, 41, 50): learnt([9.0, 13.0]),
    }
    plain, beside, ours = observer.rows(outcomes, REACTOR)
    assert plain[1:] == (MPC, "20.00", "+0.00", "+60.00", "0 of 2", "+0.00", "0")
    assert beside[1:] == (OBSERVER, "12.50", "-37.50", "+0.00", "1 of 2", "+1.00", "1")
    median = "10.50 (10.00 to 11.00), 2 seeds"
    expected = (observer.LEARNER, median, "-47.50", "-16.00", "4 of 4", "-1.00", "0")
    assert ours[1:] == expected


@pytest.mark.parametrize("plant", [REACTOR, PENDULUM])
@pytest.mark.parametrize("learner", [OBSERVER, REIDENTIFIED])
def test_what_was_recorded_is_what_is_played(plant, learner, monkeypatch) -> None:
    monkeypatch.setattr(catalog, "TEST_SEEDS", catalog.TEST_SEEDS[:2])
    run = Run(plant, learner, 0, 0)
    recorded = load(run, observer.RECORDED, catalog.FINGERPRINT)
    assert recorded is not None
    costs = catalog.execute(run).test_costs[0]
    np.testing.assert_allclose(costs, recorded.test_costs[0, :2], rtol=1e-4)


def test_the_observer_sees_the_plant_and_its_policy_is_taught_by_the_stage_cost() -> None:
    given = catalog.PLANTS[REACTOR]
    plant = catalog.observed(given)
    plain, seen = (evaluate(lambda _: [3.0], each.env, [0]) for each in (given, plant))
    assert seen.costs[0] == plain.costs[0]
    recorder = catalog.Recorder(gym.make(plant.env_id))
    build = catalog.LEARNERS[observer.LEARNER]
    learner: Learner = build(lambda: plant.taught(recorder), 0, plant=plant)
    theta = seen.observations[0][:-1]
    law, space = plant.problem().explicit(), recorder.action_space
    actions = learner.policy.predict(theta.astype(np.float32), deterministic=True)[0]
    np.testing.assert_allclose(actions, law(theta), atol=1e-5 * np.ptp([space.low, space.high]))
    env = learner.model.get_env()
    env.seed(0)
    theta = env.reset()
    reward = env.step(np.zeros((1, 1), np.float32))[1][0]
    assert reward == pytest.approx(-plant.problem().stage_cost(theta[0], [0.0]), rel=1e-5)


def test_the_table_is_put_between_the_marks_of_the_page(tmp_path, capsys) -> None:
    page = tmp_path / "headroom.md"
    page.write_text(f"before\n{observer.BEGIN}old\n{observer.END}\nafter\n", encoding="utf-8")
    observer.main(["--results", str(tmp_path / "runs"), "--report", str(tmp_path)])
    text = page.read_text(encoding="utf-8")
    assert text.startswith("before\n") and text.endswith("\nafter\n") and "old" not in text
    for plant in observer.PLANTS:
        for learner in (MPC, OBSERVER, REIDENTIFIED, OPTIMUM):
            assert f"| {plant} | {learner} |" in text
    assert f"| {REACTOR} | {OBSERVER} |" in capsys.readouterr().out
    assert not [*(tmp_path / "runs").iterdir()]  # all of them are recorded
