"""The learning tables hold what their runs do, and every plant shows the theta of its MPC."""

import numpy as np
import pytest

from experiments.learning import FROM_A_LOG, HEADER, IMPROVED, PLANNED, main, rows
from experiments.measures import OBSERVER
from experiments.pictures import _shares, save_in_short
from experiments.plants import CASES
from experiments.runner import Outcome, Run, save

pytest.importorskip("scipy", minversion="1.15")  # of the extra `paper`


def outcome(costs, violations=((0, 0), (0, 0)), accepted=True, seconds=1.0) -> Outcome:
    none = np.zeros(0)
    extra = {"accepted": np.array(accepted), "trusted": np.array(accepted)}
    extra |= {"steps": 1000 * seconds, "step": 1.5, "variation": 0.25}
    return Outcome([0, 1], costs, np.array(violations), none, none, none, extra, seconds)


BASE = [10.0, 30.0]
PLANT_RUNS = {
    Run("pH", PLANNED, 0, 0): outcome([BASE, [10.0, 20.0]]),  # a quarter less
    Run("pH", IMPROVED, 0, 0): outcome([BASE, [8.0, 24.0]], seconds=3),
    Run("pH", IMPROVED, 1, 0): outcome([BASE, [14.0, 10.0]], [[0, 0], [2, 1]], seconds=5),
    Run("pH", IMPROVED, 2, 0): outcome([BASE, BASE], [[1, 0], [1, 0]], False, 9),
}
LOG_RUNS = {
    Run(FROM_A_LOG, PLANNED, 0, 0): outcome([BASE, [9.0, 29.0]]),
    Run(FROM_A_LOG, "five episodes", 40, 0): outcome([BASE, [8.0, 31.0]], seconds=7),
    Run(FROM_A_LOG, "two episodes", 40, 0): outcome([BASE, BASE], accepted=False),
}


def test_a_row_holds_medians_ranges_and_what_was_lost() -> None:
    (row,) = rows(PLANT_RUNS)
    assert dict(zip(HEADER, row, strict=True)) == {
        "plant": "pH",
        "MPC": "20.00",
        "headroom, %": "-25.00",
        "`improve`, %": "-20.00 (-40.00 to +0.00)",
        "of the headroom, %": "80 (0 to 160)",
        "worst episode, %": "+20.00",
        "changed": "2 of 3",
        "violations": "2",
        "steps of the simulator": "5,000",
        "largest move, variation": "1.50, 0.25",
        "seconds": "5",
    }


def test_the_tables_are_quoted_between_their_marks(tmp_path) -> None:
    results = tmp_path / "results.sqlite"
    for run, each in (PLANT_RUNS | LOG_RUNS).items():
        save(each, run, results)
    page = tmp_path / "improve.md"
    marks = [f"<!-- {name}: {end} -->\n" for name in ("simulator", "from a log")
             for end in ("begin", "end")]  # fmt: skip
    page.write_text("".join(marks), encoding="utf-8")
    main(["--report-only", "--results", str(results), "--report", str(tmp_path)])
    text = page.read_text(encoding="utf-8")
    assert "| pH | 20.00 |" in text and "| five episodes | 1 of 1 |" in text


@pytest.mark.parametrize("name", CASES)
def test_each_plant_shows_the_theta_of_its_mpc(name, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)  # an example writes a log
    case = CASES[name]()
    env = case.make()
    theta, _ = env.reset(seed=0)
    assert theta.shape == (case.mpc.n_theta,)
    assert env.observation_space.contains(env.step(np.float32(case.mpc.online()(theta)))[0])


def test_the_picture_pairs_costs_with_the_mpc_that_has_no_observer(tmp_path) -> None:
    tried = {
        Run("pH", IMPROVED, 0, 0): outcome([BASE, [8.0, 24.0]]),
        Run("pH", OBSERVER, 0, 0): outcome([BASE, [9.0, 15.0]]),
    }
    shares = {name: (list(costs), mean) for name, (costs, mean) in _shares(tried, "pH").items()}
    assert shares == {
        "policy learnt from the MPC": ([0.8, 0.8], pytest.approx(-0.2)),
        "offset-free MPC": ([0.9, 0.5], pytest.approx(-0.4)),
    }
    (path,) = save_in_short(tried, tmp_path)
    assert path.name == "in-short.png" and path.stat().st_size > 10_000
    assert save_in_short(PLANT_RUNS, tmp_path) == []
