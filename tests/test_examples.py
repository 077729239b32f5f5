"""The examples run from any folder, print their table and save their picture."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.parametrize("name", ["cstr", "pendulum"])
def test_the_example_runs_to_its_picture(name, tmp_path) -> None:
    done = subprocess.run(
        [sys.executable, EXAMPLES / f"{name}.py", "--episodes", "1"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "COLUMNS": "100"},
    )
    assert done.returncode == 0, done.stderr
    assert "regions=7" in done.stdout
    assert "mean" in done.stdout
    assert (tmp_path / "out" / f"{name}.png").stat().st_size > 10_000


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_fits_a_page(path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) < 80
