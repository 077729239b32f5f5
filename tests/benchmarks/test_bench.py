"""The quick form of the benchmark: the command itself, from its sections to its report."""

import numpy as np
import pytest

from benchmarks import exactness, peers
from benchmarks.problems import double_integrator
from benchmarks.timing import Stopwatch, Task
from fresh_process import run_module
from sb3_yann.control import PiecewiseAffine


@pytest.mark.nightly
def test_the_quick_form_runs_to_its_report(tmp_path) -> None:
    run_module(tmp_path, "benchmarks", "--quick")
    folder = tmp_path / "out" / "bench-quick"
    report = (folder / "performance.md").read_text(encoding="utf-8")
    for heading in ("The law in numpy, one point", "Exactness", "Offline solution"):
        assert f"## {heading}" in report


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
    law = mpc.explicit()
    program = mpc.condensed()
    solve = peers.daqp_online(program, 1)
    solution = peers.ppopt_solution(program, law, overlap=False)
    for theta in ([0.3, -0.2], [4.0, -1.0], [-2.0, 1.9]):
        point = np.array(theta)
        assert np.abs(solve(point) - law(point)) < 1e-9
        assert np.abs(solution.evaluate(point[:, None])[0] - law(point)) < 1e-9


def test_tasks_are_measured_in_turns_on_the_same_inputs() -> None:
    seen: dict[str, list[int]] = {"a": [], "b": []}
    tasks = {name: Task(calls.append, range(5)) for name, calls in seen.items()}
    found = Stopwatch(repeats=4).compare(tasks)
    assert {name: len(each) for name, each in found.items()} == {"a": 4, "b": 4}
    assert seen["a"][-1] in range(5) and (found["a"] > 0).all()
