"""Readers of damaged files, settings and command lines raise what they document, or read the same.

``python -m experiments.fuzz --count 100000`` does the same for longer.
"""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from experiments import fuzz as fuzzing
from experiments.fuzz import TARGETS, Target, Wrong, damaged, fuzz, main

COUNTS = {"command line": 60}

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="no alarm")


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_nothing_is_found(target: str) -> None:
    found = fuzz(target, COUNTS.get(target, 200), seed=7)
    assert found.wrong == []
    assert len(found.outcomes) > 1  # both are met: what is refused, and what is taken


def test_damage_changes_what_is_damaged() -> None:
    content, rng = bytes(range(200)), np.random.default_rng(0)
    assert sum(damaged(content, rng) == content for _ in range(100)) < 5
    assert damaged(b"", rng) == b""


FAULTS = {
    "another error": KeyError("gains"),
    "another law": Wrong("another law was read"),
    "an error without a word": ValueError(),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_would_be_found(fault: str, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def attempt(rng: np.random.Generator) -> str:
        raise FAULTS[fault]

    monkeypatch.setattr(fuzzing, "TARGETS", {"one": lambda folder: Target(attempt)})
    assert len(fuzz("one", 3).wrong) == 3
    assert main(["--count", "1"]) == 1
    assert "one (0, 0)" in capsys.readouterr().out


def test_a_reader_that_hangs_would_be_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def target(folder: Path) -> Target:
        def attempt(rng: np.random.Generator) -> str:
            while True:
                pass

        return Target(attempt)

    monkeypatch.setattr(fuzzing, "TARGETS", {"one": target})
    monkeypatch.setattr(fuzzing, "SECONDS", 1)
    assert "more than 1 seconds" in fuzz("one", 1).wrong[0]
