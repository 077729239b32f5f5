"""The quick form of the benchmark: the command itself, from its sections to its report."""

import numpy as np
import pytest

from benchmarks import peers
from benchmarks.problems import double_integrator
from fresh_process import run_module


@pytest.mark.nightly
def test_the_quick_form_runs_to_its_report(tmp_path) -> None:
    run_module(tmp_path, "benchmarks", "--quick")
    folder = tmp_path / "out" / "bench-quick"
    report = (folder / "performance.md").read_text(encoding="utf-8")
    for heading in ("The law in numpy, one point", "Exactness", "Offline solution"):
        assert f"## {heading}" in report


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
