"""Runs are saved one by one, resumed, kept apart by their settings, and may be done by dask."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest
import torch

from experiments.runner import Outcome, Run, RunsFailed, path_of, run_all

LocalCluster = pytest.importorskip("distributed").LocalCluster  # of the extra `paper`
cluster = pytest.importorskip("experiments.cluster")
RUNS = [Run("CSTR", "YANN-RL", seed, 10 * seed) for seed in range(3)]


def outcome(run: Run, starts: int = 4) -> Outcome:
    """Return numbers that depend on the run alone."""
    rng, tested = np.random.default_rng(run.seed), np.arange(0, run.episodes + 1, 5)
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


def test_what_is_saved_is_not_done_again(tmp_path) -> None:
    first = run_all(RUNS, outcome, tmp_path, jobs=1, progress=False)
    again = run_all(RUNS, forbidden, tmp_path, jobs=1, progress=False)
    assert list(first) == list(again) == RUNS
    assert all(same(first[run], again[run]) and same(first[run], outcome(run)) for run in RUNS)
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.slow
def test_a_failing_run_is_reported_and_the_others_are_kept(tmp_path, capfd) -> None:
    def fails(run: Run) -> Outcome:
        if run.seed == 1:
            raise ArithmeticError("seed one diverged")
        return outcome(run)

    with pytest.raises(RunsFailed, match=r"1 run\(s\) failed") as caught:
        run_all(RUNS, fails, tmp_path, jobs=2)
    assert list(caught.value.outcomes) == [RUNS[0], RUNS[2]]
    assert "ArithmeticError: seed one diverged" in caught.value.failures[RUNS[1]]
    assert f"FAILED: {RUNS[1]}" in capfd.readouterr().out

    done = []

    def counts(run: Run) -> Outcome:
        done.append(run)
        return outcome(run)

    assert list(run_all(RUNS, counts, tmp_path, jobs=1, progress=False)) == RUNS
    assert done == [RUNS[1]]


@pytest.mark.slow
def test_workers_are_other_processes_with_one_thread(tmp_path) -> None:
    outcomes = run_all(RUNS, outcome, tmp_path, jobs=2, progress=False)
    assert os.getpid() not in {int(o.extra["pid"]) for o in outcomes.values()}
    assert {int(o.extra["threads"]) for o in outcomes.values()} == {1}


def test_the_longest_run_starts_first(tmp_path) -> None:
    order = []

    def notes(run: Run) -> Outcome:
        order.append(run.seed)
        return outcome(run)

    run_all(RUNS, notes, tmp_path, jobs=1, progress=False)
    assert order == [2, 1, 0]


def test_an_interruption_leaves_what_is_finished(tmp_path) -> None:
    def interrupted(run: Run) -> Outcome:
        if run.seed == 1:
            raise KeyboardInterrupt
        return outcome(run)

    with pytest.raises(KeyboardInterrupt):
        run_all(RUNS, interrupted, tmp_path, jobs=1, progress=False)
    assert [run for run in RUNS if path_of(run, tmp_path, "").exists()] == [RUNS[2]]


SCRIPT = """
import sys, time
from test_runner import RUNS, outcome
from experiments.runner import run_all
def slow(run):
    time.sleep(0 if run.seed == 2 else 60)
    return outcome(run)
run_all(RUNS, slow, sys.argv[1], jobs=1, progress=False)
"""


@pytest.mark.slow
def test_a_killed_parent_loses_only_the_runs_in_flight(tmp_path) -> None:
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    parent = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, tmp_path],
        env={**os.environ, "PYTHONPATH": paths},
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + 60
    while not path_of(RUNS[2], tmp_path, "").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(parent.pid, signal.SIGKILL)
    parent.wait()

    done = []

    def counts(run: Run) -> Outcome:
        done.append(run.seed)
        return outcome(run)

    assert len(run_all(RUNS, counts, tmp_path, jobs=1, progress=False)) == 3
    assert done == [1, 0]


@pytest.mark.parametrize("keep", [0, 100, -20])
def test_a_file_that_is_not_whole_is_made_again(keep, tmp_path) -> None:
    run_all(RUNS, outcome, tmp_path, jobs=1, progress=False)
    broken = path_of(RUNS[1], tmp_path, "")
    broken.write_bytes(broken.read_bytes()[:keep])
    repaired = run_all(RUNS, outcome, tmp_path, jobs=1, progress=False)
    assert same(repaired[RUNS[1]], outcome(RUNS[1]))
    run_all(RUNS, forbidden, tmp_path, jobs=1, progress=False)


def test_outcomes_of_other_settings_are_not_used(tmp_path) -> None:
    run_all(RUNS, outcome, tmp_path, fingerprint="a", jobs=1, progress=False)
    with pytest.raises(RunsFailed, match="should not run"):
        run_all(RUNS, forbidden, tmp_path, fingerprint="b", jobs=1, progress=False)
    longer = [Run("CSTR", "YANN-RL", 0, 50)]
    with pytest.raises(RunsFailed):
        run_all(longer, forbidden, tmp_path, fingerprint="a", jobs=1, progress=False)


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


@pytest.mark.slow
def test_dask_gives_the_same(tmp_path) -> None:
    def traced(run: Run) -> Outcome:  # local, therefore sent by value as ours are
        if run.seed == 1:
            raise ArithmeticError("seed one diverged")
        seen = "experiments.runner" in sys.modules
        rng, tested = np.random.default_rng(run.seed), np.arange(0, run.episodes + 1, 5)
        costs, e = rng.random((len(tested), 2)), np.zeros(run.episodes)
        return Outcome(tested, costs, 0 * costs, e, e, e, {"by_name": np.array(seen)}, 1.0)

    with pytest.raises(RunsFailed) as local:
        run_all(RUNS, traced, tmp_path / "joblib", jobs=2, progress=False)
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
    ) as machines:
        address = machines.scheduler_address
        with pytest.raises(RunsFailed) as remote:
            run_all(RUNS, traced, tmp_path / "dask", dask=address, progress=False)
    assert "ArithmeticError" in remote.value.failures[RUNS[1]]
    assert list(remote.value.outcomes) == list(local.value.outcomes) == [RUNS[0], RUNS[2]]
    for run, found in remote.value.outcomes.items():
        assert same(found, local.value.outcomes[run])
        assert not found.extra["by_name"]
        assert path_of(run, tmp_path / "dask", "").exists()
    assert all(run_all([run], forbidden, tmp_path / "dask") for run in remote.value.outcomes)


@pytest.mark.slow
def test_dask_workers_with_several_threads_are_refused(tmp_path) -> None:
    with LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=":0"
    ) as machines:
        with pytest.raises(ValueError, match="--nthreads 1"):
            run_all(RUNS, outcome, tmp_path, dask=machines.scheduler_address, progress=False)


CACHED = """
import functools

@functools.lru_cache(maxsize=7)
def double(number):
    return 2 * number

def answer(number):
    return double(number), double.cache_parameters()["maxsize"]
"""


def test_code_travels_by_value_with_its_caches(monkeypatch) -> None:
    module = types.ModuleType("experiments.made_up")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(CACHED, vars(module))
    sent = cluster.by_value(functools.partial(module.answer, 21))
    there = (
        "import pickle, sys; print(pickle.load(sys.stdin.buffer)(), 'experiments' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", there], input=sent, capture_output=True)
    assert done.stdout.decode().split("\n")[0] == "(42, 7) False", done.stderr.decode()
