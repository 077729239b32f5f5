"""The examples run from any folder, print their table and save their picture."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


PRINTED = {
    "cstr": ["regions=7", "mean"],
    "pendulum": ["regions=7", "mean"],
    "own_plant": [
        "sampled every 10",
        "set-point of h2 (cm)",
        "regions and",
        "The reward is the cost of the problem in all of",
        "50 unseen set-point sequences",
        "violations",
        "episodes that cost more",
    ],
    "built_in": [
        "sampled every 0.05",
        "Unstable: 1 of 2 poles grow",
        "The reward is the cost of the problem in all of 100 steps",
        "50 unseen starts",
        "episodes that cost more",
    ],
    "quadrotor": ["OnlineLaw(constraints=241", "100 unseen starts", "episodes that cost more"],
}


NIGHTLY = [pytest.param(name, marks=pytest.mark.nightly) for name in PRINTED if name != "cstr"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cstr", *NIGHTLY])
def test_the_example_runs_to_its_picture(name, tmp_path) -> None:
    done = subprocess.run(
        [sys.executable, EXAMPLES / f"{name}.py", "--episodes", "1"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "COLUMNS": "100"},
    )
    assert done.returncode == 0, done.stderr
    for each in PRINTED[name]:
        assert each in done.stdout
    assert (tmp_path / "out" / f"{name}.png").stat().st_size > 10_000


PROGRAMS = [path for path in sorted(EXAMPLES.glob("*.py")) if "def main" in path.read_text("utf-8")]


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.name)
def test_an_example_fits_a_page(path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) < 80


@pytest.mark.slow
def test_a_log_becomes_a_report_and_a_better_controller(tmp_path) -> None:
    done = subprocess.run(
        [sys.executable, EXAMPLES / "from_a_log.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "COLUMNS": "100"},
    )
    assert done.returncode == 0, done.stderr
    assert "Verdict: trusted." in (tmp_path / "out" / "twin.txt").read_text(encoding="utf-8")
    costs = re.findall(r"mean cost +(.*) \(MPC\) -> (.*)", done.stdout)[0]
    before, after = map(float, costs)
    assert after < 0.99 * before and "violations: 0" in done.stdout
    assert (tmp_path / "out" / "from_a_log.zip").exists()
    assert (tmp_path / "out" / "from_a_log.png").stat().st_size > 10_000


@pytest.mark.slow
def test_three_tags_become_a_page_and_code(tmp_path) -> None:
    done = subprocess.run(
        [sys.executable, EXAMPLES / "outputs_only.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "COLUMNS": "100"},
    )
    assert done.returncode == 0, done.stderr
    assert "order 2" in done.stdout and "act for [3] samples" in done.stdout
    reached = re.search(r"the kettle is at (.*) °C", done.stdout)
    assert abs(float(reached[1]) - 82) < 0.3
    assert (tmp_path / "out" / "kettle.html").stat().st_size > 10_000
    built = ["gcc", "-std=c99", "kettle.c", "kettle_selftest.c", "-lm", "-o", "test"]
    if shutil.which("gcc"):
        subprocess.run(built, cwd=tmp_path / "out", check=True)
        subprocess.run([tmp_path / "out" / "test"], check=True)


@pytest.mark.nightly
def test_a_cloned_policy_forgets_and_a_yann_policy_does_not(tmp_path) -> None:
    done = subprocess.run(
        [sys.executable, EXAMPLES / "cloned_policy.py", "--episodes", "1"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "COLUMNS": "100"},
    )
    assert done.returncode == 0, done.stderr
    rows = re.findall(r"│ (\d) +│ ([\d.,]+) \(\d+\) +│ ([\d.,]+) \(\d+\)", done.stdout)
    costs = {int(n): [float(each.replace(",", "")) for each in rest] for n, *rest in rows}
    assert costs[0][0] == pytest.approx(costs[0][1], rel=0.01)  # both are the MPC at first
    assert costs[1][0] > 1.1 * costs[0][0] and costs[1][1] == costs[0][1]
