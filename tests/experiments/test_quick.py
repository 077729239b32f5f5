"""The quick form of the experiments: the command itself, from its runs to its report."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def paper(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "experiments", "--quick", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_quick_form_runs_to_its_report_and_does_nothing_twice(tmp_path) -> None:
    assert "9 of 9 runs" in paper(tmp_path)
    folder = tmp_path / "out" / "paper-quick"
    report = (folder / "results.md").read_text(encoding="utf-8")
    assert "## After 8 training episodes" in report
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", report):
        assert (folder / picture).stat().st_size > 10_000
    runs = {path: path.stat().st_mtime_ns for path in (folder / "runs").iterdir()}
    paper(tmp_path)
    assert {path: path.stat().st_mtime_ns for path in (folder / "runs").iterdir()} == runs
