"""Runs a few lines in a Python process of their own, with the import path of this one."""

from __future__ import annotations

import os
import subprocess
import sys


def run_python(
    code: str, *args: str, stdin: bytes = b"", timeout: float | None = None
) -> subprocess.CompletedProcess[bytes]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    return subprocess.run(
        [sys.executable, "-c", code, *args],
        input=stdin,
        capture_output=True,
        env=environment,
        timeout=timeout,
    )
