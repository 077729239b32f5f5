"""Runs lines or a module in a Python process of their own, with the import path of this one."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def run_python(
    code: str, *arguments: object, folder: Path = ROOT, **environment: str
) -> tuple[str, str]:
    """Run lines of code, and return what they printed and what they said on stderr."""
    done = _run(folder, "-c", code, *arguments, **environment)
    return done.stdout, done.stderr


def run_module(folder: Path, module: str, *arguments: object) -> str:
    """Run ``python -m module`` in a folder, and return what it printed."""
    return _run(folder, "-m", module, *arguments).stdout


def _run(folder: Path, *arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    # The root comes first: `tests` has folders of the same names as what is run.
    path = os.pathsep.join([str(ROOT), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path, **environment},
        capture_output=True,
        text=True,
        timeout=1800,
    )
    assert done.returncode == 0, done.stderr
    return done
