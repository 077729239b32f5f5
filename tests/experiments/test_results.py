"""The figures of the tables by hand, and the report as a whole."""

import sys
import types

import numpy as np
import pytest

import experiments
from experiments.__main__ import main
from experiments.measures import rows_of
from experiments.results import in_short, write_report
from experiments.runner import Outcome, Run

pytest.importorskip("scipy", minversion="1.15")  # of the extra `paper`

MPC_COSTS = np.array([100.0, 300.0])  # mean 200
OPTIMUM = np.array([90.0, 290.0])  # mean 190


def fixed(costs) -> Outcome:
    none = np.zeros(0)
    return Outcome([0], [costs], [np.zeros(len(costs))], none, none, none, {}, 1.0)


def learned(final, initial=MPC_COSTS, excess=0.0, unsafe=0, episodes=50) -> Outcome:
    """Return a run that is tested before, half way, and after; `excess` is over all episodes."""
    tests = [initial, initial, final] if episodes == 50 else [initial, final, initial, initial]
    checkpoints = [0, 25, 50] if episodes == 50 else [0, 50, 100, 200]
    mpc = np.full(episodes, 7.0)
    violations = np.zeros(episodes)
    violations[:unsafe] = 1
    seen = np.zeros(np.shape(tests))
    return Outcome(checkpoints, tests, seen, mpc + excess / episodes, mpc, violations, {}, 60.0)


def reactor(ours=None, ddpg_final=(200.0, 400.0), plant="CSTR", seeds=10) -> dict[Run, Outcome]:
    outcomes = {
        Run(plant, "MPC", 0, 0): fixed(MPC_COSTS),
        Run(plant, "optimum", 0, 0): fixed(OPTIMUM),
    }
    for seed in range(seeds):
        worse = np.array(ddpg_final)
        outcomes[Run(plant, "DDPG", seed, 50)] = learned(worse, worse + 100 + seed, 4000.0, 3)
        outcomes[Run(plant, "YANN-RL", seed, 50)] = ours or learned(OPTIMUM + 1, excess=-20.0)
    return outcomes


def pendulum(final=(1.0, 30.0), mpc=(1.0, 200.0), optimum=(0.9, 29.1)) -> dict[Run, Outcome]:
    name = "pendulum, Q = I"
    outcomes = {Run(name, "MPC", 0, 0): fixed(mpc), Run(name, "optimum", 0, 0): fixed(optimum)}
    for seed in range(10):
        outcomes[Run(name, "YANN-RL", seed, 50)] = learned(np.array(final), np.array(mpc))
    return outcomes


def test_the_report_is_whole(tmp_path) -> None:
    notes = tmp_path / "notes.md"
    notes.write_text("## What was tried\n\nThis | and *that*.\n", encoding="utf-8")
    outcomes = {**reactor(), **pendulum()}
    outcomes[Run("CSTR", "YANN-RL, guard off", 0, 50)] = learned(OPTIMUM)
    outcomes[Run("CSTR", "YANN-RL", 0, 200)] = learned(OPTIMUM, episodes=200)
    paths = write_report(outcomes, tmp_path / "docs", notes=notes)
    names = ["results.md", "results-cstr.png", "results-pendulum-q-i.png"]
    assert [path.name for path in paths] == names
    assert all(path.stat().st_size > 1000 for path in paths)
    text = paths[0].read_text(encoding="utf-8")
    for heading in (
        "How this was made",
        "The paper's averages",
        "After 50 training episodes",
        "Longer training",
        "Learning curves",
        "What was tried",
    ):
        assert f"\n## {heading}\n" in text
    assert text.endswith("This | and *that*.\n")
    assert "![CSTR](results-cstr.png)" in text
    assert "| CSTR | 200 | **YANN-RL** | 1 | 200.00 |" in text


@pytest.fixture
def catalog(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    outcomes = reactor(seeds=1)
    module = types.ModuleType("experiments.catalog")
    module.RUNS = [*outcomes]
    module.QUICK = [*outcomes][:3]
    module.execute = outcomes.__getitem__
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(experiments, "catalog", module, raising=False)
    return module


def test_the_command_writes_its_report(catalog, tmp_path, capsys) -> None:
    assert main(["--jobs", "1", "--results", "here.sqlite"]) == 0
    assert "docs/results.md" in capsys.readouterr().out
    page = (tmp_path / "docs/results.md").read_text()
    assert '`make paper ARGS="--jobs 1 --results here.sqlite"`' in page
    assert main(["--quick", "--jobs", "1", "--only", "cstr / (MPC|optimum)"]) == 0
    assert (tmp_path / "out/paper-quick/results.md").exists()
    assert "2 of 3 runs" in capsys.readouterr().out
    catalog.execute = None  # what is finished is not run again
    assert main(["--jobs", "1", "--results", "here.sqlite"]) == 0


def row_of(outcomes, plant: str, episodes: int, learner: str):
    return next(row for row in rows_of(outcomes, plant, episodes) if row.learner == learner)


def test_a_row_by_hand() -> None:
    runs = {
        Run("CSTR", "YANN-RL", 0, 50): learned([96.0, 296.0], excess=-10.0),  # mean 196
        Run("CSTR", "YANN-RL", 1, 50): learned([92.0, 292.0], excess=30.0, unsafe=2),  # 192
        Run("CSTR", "YANN-RL", 2, 50): learned([106.0, 298.0], excess=5.0, unsafe=1),  # 202
        Run("CSTR", "YANN-RL", 3, 50): learned([94.0, 294.0], excess=7.0),  # 194
    }
    row = row_of({**reactor(seeds=0), **runs}, "CSTR", 50, "YANN-RL")
    assert (row.seeds, row.median, row.low, row.high) == (4, 195, 192, 202)
    assert (row.worst, row.worst_share) == (6, 3)
    assert row.excess == pytest.approx(6)
    assert (row.unsafe_training, row.unsafe_tests) == (3, 0)


def test_the_short_table_has_a_row_for_each_plant_that_was_learnt() -> None:
    more = {Run("CSTR", "YANN-RL, a simulator explored", 0, 50): learned([91.0, 290.0])}
    _, _, *rows, empty, legend = in_short({**reactor(), **more, **pendulum()}).splitlines()
    assert rows == [
        "| CSTR | 190.00 | 200.00 | — | **190.50**, -9.00 | 300.00 (300.00 to 300.00) |",
        "| pendulum, Q = I | 15.00 | 100.50 | — | **15.50 (15.50 to 15.50)**, +0.00 | — |",
    ]
    assert empty == "" and "after 50 training episodes, over 2 starts" in legend
    left = {run: out for run, out in reactor().items() if run.learner != "YANN-RL"}
    assert in_short(left) == ""
