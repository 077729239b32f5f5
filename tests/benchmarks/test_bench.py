"""The quick form of the benchmark: the command itself, from its sections to its report."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import exactness, gpu, peers
from benchmarks.criteria import criteria
from benchmarks.problems import double_integrator
from benchmarks.records import Figure, Figures
from benchmarks.timing import Stopwatch, Task
from fresh_process import run_module
from sb3_yann.control import PiecewiseAffine
from sb3_yann_envs import problems


@pytest.mark.slow
def test_the_quick_form_runs_to_its_report(tmp_path) -> None:
    run_module(tmp_path, "benchmarks", "--quick")
    folder = tmp_path / "out" / "bench-quick"
    report = (folder / "performance.md").read_text(encoding="utf-8")
    for heading in ("In short", "The law in numpy, one point", "Exactness", "Memory"):
        assert f"## {heading}" in report
    assert "| no point uncovered, misplaced or doubled | 0 of 10,000 | yes |" in report
    assert (folder / "performance.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_devices_are_compared_where_there_are_no_learners_and_no_solvers(tmp_path) -> None:
    problems.cstr().explicit().save(tmp_path / "law.npz")
    absent = ("stable_baselines3", "ppopt", "daqp", "control", "cvxopt", "gymnasium", "rich")
    block = f"import sys; sys.modules.update(dict.fromkeys({absent!r}))"
    code = (
        f"{block}; import importlib.util as u; find = u.find_spec\n"
        f"u.find_spec = lambda name, *a: None if name in {absent!r} else find(name, *a)\n"
        "from benchmarks import gpu; gpu.BATCHES = (1, 8); sys.exit(gpu.main(['law.npz']))"
    )
    (tmp_path / "alone.py").write_text(code)
    assert "7 regions" in run_module(tmp_path, "alone")


def test_regions_that_overlap_and_gaps_between_them_are_counted() -> None:
    strips = {"A": [[1.0], [-1.0]] * 3, "starts": [0, 2, 4], "gains": np.zeros((3, 1, 1))}
    bounds = {"u_min": [-1], "u_max": [1], "theta_min": [0], "theta_max": [6]}
    law = PiecewiseAffine(
        **strips, **bounds, offsets=np.zeros((3, 1)), b=[2.0, 0.0, 3.0, -1.0, 6.0, -4.0]
    )
    held, covered = exactness.scan(np.array([[0.5], [1.5], [2.0], [3.5], [5.0]]), law)
    assert held.tolist() == [1, 2, 1, 0, 1]
    assert covered.tolist() == [True, True, True, False, True]


def test_points_on_facets_and_vertices_are_among_those_that_are_tried() -> None:
    law = double_integrator().explicit()
    points = exactness.sample(law, 900)
    slack = np.abs(law.b - points @ law.A.T)
    touched = (slack < 1e-9).sum(axis=1)
    assert len(points) == 900
    assert (touched[:300] == 0).mean() > 0.9  # random
    assert (touched[300:] >= 1).all()  # facets
    assert (touched[600:] >= 2).all()  # vertices
    assert exactness.scan(points[300:], law)[1].all()


def test_the_peers_compute_the_law() -> None:
    mpc = double_integrator()
    law, program = mpc.explicit(), mpc.condensed()
    solve = peers.daqp_online(program, 1)
    solution = peers.ppopt_solution(program, law, overlap=False)
    for theta in ([0.3, -0.2], [4.0, -1.0], [-2.0, 1.9]):
        point = np.array(theta)
        assert np.abs(solve(point) - law(point)) < 1e-9
        assert np.abs(solution.evaluate(point[:, None])[0] - law(point)) < 1e-9


def test_the_device_pays_from_the_batch_on_from_which_it_is_always_faster() -> None:
    seconds = {1: (1, 9), 256: (2, 1), 10_000: (3, 4), 100_000: (9, 5)}
    found = {
        (device, batch): np.full(3, float(each[k]))
        for batch, each in seconds.items()
        for k, device in enumerate(("cpu", "cuda"))
    }
    assert gpu.pays_from(found) == 100_000
    assert gpu.pays_from({**found, ("cuda", 100_000): np.full(3, 10.0)}) is None


def test_a_requirement_is_judged_by_the_median_of_the_ratios_turn_by_turn() -> None:
    figures = Figures()
    figures.add([Figure("law, one point", "ours", "7", np.array([1e-6, 1e-6, 4e-6]))])
    slow = np.array([3e-6, 1.5e-6, 7e-6])  # 3, 1.5 and 1.75 times
    figures.add([Figure("law, one point", peers.DAQP, "7", slow)])
    (line,) = criteria(figures)
    assert line.found.startswith("1.75×") and not line.holds


def test_tasks_are_measured_in_turns_on_the_same_inputs() -> None:
    seen: dict[str, list[int]] = {"a": [], "b": []}
    tasks = {name: Task(calls.append, range(5)) for name, calls in seen.items()}
    found = Stopwatch(repeats=4).compare(tasks)
    assert {name: len(each) for name, each in found.items()} == {"a": 4, "b": 4}
    assert seen["a"][-1] in range(5) and (found["a"] > 0).all()
