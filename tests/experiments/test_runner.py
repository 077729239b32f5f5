"""Runs are saved one by one in one file, resumed, and may be done by dask."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from experiments import runner
from experiments.runner import Outcome, Run, RunsFailed, load_all, run_all

RUNS = [Run("CSTR", "YANN-RL", seed, 10 * seed) for seed in range(3)]


@pytest.fixture
def results(tmp_path: Path) -> Path:
    return tmp_path / "results.sqlite"


def outcome(run: Run, starts: int = 4) -> Outcome:
    """Return numbers that depend on the run alone."""
    rng = np.random.default_rng(run.seed)
    tested = np.arange(0, run.episodes + 1, 5)
    shape = len(tested), starts
    return Outcome(
        checkpoints=tested,
        test_costs=rng.random(shape),
        test_violations=np.zeros(shape, int),
        training_costs=rng.random(run.episodes),
        training_mpc_costs=rng.random(run.episodes),
        training_violations=rng.integers(2, size=run.episodes),
        extra={"pid": np.array(os.getpid()), "threads": np.array(torch.get_num_threads())},
        seconds=1.5,
    )


def same(one: Outcome, other: Outcome) -> bool:
    names = [name for name in vars(one) if name != "extra"]
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


def forbidden(run: Run) -> Outcome:
    raise AssertionError(f"{run} should not run")


def test_what_is_saved_is_not_done_again(results) -> None:
    first = run_all(RUNS, outcome, results, jobs=1, progress=False)
    again = run_all(RUNS, forbidden, results, jobs=1, progress=False)
    assert list(first) == list(again) == RUNS
    assert all(same(first[run], again[run]) and same(first[run], outcome(run)) for run in RUNS)


@pytest.mark.slow
def test_a_failing_run_is_reported_and_the_others_are_kept(results, capfd) -> None:
    def fails(run: Run) -> Outcome:
        if run.seed == 1:
            raise ArithmeticError("seed one diverged")
        return outcome(run)

    with pytest.raises(RunsFailed, match=r"1 run\(s\) failed") as caught:
        run_all(RUNS, fails, results, jobs=2)
    assert list(caught.value.outcomes) == [RUNS[0], RUNS[2]]
    assert "ArithmeticError: seed one diverged" in caught.value.failures[RUNS[1]]
    assert f"FAILED: {RUNS[1]}" in capfd.readouterr().out

    done = []

    def counts(run: Run) -> Outcome:
        done.append(run)
        return outcome(run)

    assert list(run_all(RUNS, counts, results, jobs=1, progress=False)) == RUNS
    assert done == [RUNS[1]]


def test_the_longest_run_starts_first(results) -> None:
    order = []

    def notes(run: Run) -> Outcome:
        order.append(run.seed)
        return outcome(run)

    run_all(RUNS, notes, results, jobs=1, progress=False)
    assert order == [2, 1, 0]


def test_an_interruption_leaves_what_is_finished(results) -> None:
    def interrupted(run: Run) -> Outcome:
        if run.seed == 1:
            raise KeyboardInterrupt
        return outcome(run)

    with pytest.raises(KeyboardInterrupt):
        run_all(RUNS, interrupted, results, jobs=1, progress=False)
    assert [*load_all(RUNS, results)] == [RUNS[2]]


def test_outcomes_of_other_settings_are_not_used(results, monkeypatch) -> None:
    run_all(RUNS, outcome, results, jobs=1, progress=False)
    assert not load_all([Run("CSTR", "YANN-RL", 0, 50)], results)
    monkeypatch.setattr(runner, "FINGERPRINT", "others")
    assert not load_all(RUNS, results)


@pytest.mark.nightly
def test_dask_gives_the_same_with_one_thread_each(results) -> None:
    distributed = pytest.importorskip("distributed")  # of the extra `paper`
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
    ) as machines:
        found = run_all(RUNS, outcome, results, dask=machines.scheduler_address, progress=False)
    assert all(same(found[run], outcome(run)) for run in RUNS)
    assert os.getpid() not in {int(each.extra["pid"]) for each in found.values()}
    assert {int(each.extra["threads"]) for each in found.values()} == {1}


def test_a_long_run_holds_the_short_one() -> None:
    long = outcome(Run("CSTR", "YANN-RL", 3, 20))
    short = long.at(10)
    assert short.checkpoints.tolist() == [0, 5, 10]
    assert short.test_costs.tolist() == long.test_costs[:3].tolist()
    assert short.training_costs.tolist() == long.training_costs[:10].tolist()
    with pytest.raises(ValueError, match="7 training episodes"):
        long.at(7)
    fixed = outcome(Run("CSTR", "MPC", 0, 0))
    assert fixed.at(50) is fixed


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"checkpoints": []}, "checkpoints"),
        ({"test_costs": np.zeros((1, 4))}, "each checkpoint"),
        ({"test_violations": np.zeros((3, 3))}, "differ in shape"),
        ({"training_costs": np.zeros(1)}, "differ in length"),
        ({"extra": {"bad": np.array([None])}}, "plain arrays"),
    ],
)
def test_an_outcome_must_fit_together(change, message) -> None:
    good = outcome(RUNS[1])
    with pytest.raises(ValueError, match=message):
        Outcome(**{**vars(good), **change})
