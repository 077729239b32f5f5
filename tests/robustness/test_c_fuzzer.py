"""Exported C, fuzzed: nothing is found, and a fault would be. ``FUZZ_SECONDS`` says how long."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

pytest.importorskip("resource")
from c_fuzzer import build, feed, missing
from c_fuzzer_cases import cases, write


@pytest.fixture(scope="module")
def needs_fuzzer(tmp_path_factory: pytest.TempPathFactory) -> None:
    why = missing(tmp_path_factory.mktemp("one"))
    if why:
        pytest.skip(why)


@pytest.mark.parametrize("precision", ["float", "double"])
@pytest.mark.parametrize("name", cases())
def test_nothing_is_found(name, precision, needs_fuzzer, tmp_path: Path) -> None:
    write(cases()[name], [*cases()].index(name) + (precision == "float"), precision, tmp_path)
    build(tmp_path)
    seconds = float(os.environ.get("FUZZ_SECONDS", 2)) / (2 * len(cases()))
    found = feed(tmp_path, seconds)
    assert found.crashes == []
    assert found.executions > 5 and found.edges <= found.all_edges


RATED = "references and rates"
FAULTS = {
    "a bound": (
        "reactor", "= between(target[i], low[i], high[i]);", "= target[i];", "action[i] <= highest",
    ),
    "a rate": (RATED, "&& previous_is_lost(state, obs)", "&& 0", "change_m"),
    "an index": (
        RATED, "for (int i = 0; i < N_OBS; i++)", "for (int i = 0; i <= N_OBS; i++)", "index",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_would_be_found(fault: str, needs_fuzzer, tmp_path: Path) -> None:
    name, right, wrong, said = FAULTS[fault]
    write(cases()[name], 1, "double", tmp_path)
    code, limits = tmp_path / "plant.c", tmp_path / "fuzz_limits.h"
    assert right in code.read_text()
    code.write_text(code.read_text().replace(right, wrong))
    # The self-test, which may notice as well, is asked in the test below.
    limits.write_text(limits.read_text().replace("#define TESTED 1", "#define TESTED 0"))
    build(tmp_path)
    (crash,) = feed(tmp_path, 20).crashes
    assert said in crash
    assert list(tmp_path.glob("crash-*")) or fault == "an index"  # the self-test met that one


def test_a_self_test_that_fails_ends_it(needs_fuzzer, tmp_path: Path) -> None:
    write(cases()["reactor"], 0, "double", tmp_path)
    code = tmp_path / "plant.c"
    code.write_text(code.read_text().replace("state->sound = RECOVER;", "state->sound = 0;"))
    build(tmp_path)
    (crash,) = feed(tmp_path, 1).crashes
    assert "does not hold: selftest() == 0" in crash


def test_a_clang_without_its_fuzzer_is_quoted(monkeypatch, tmp_path: Path) -> None:
    clang = tmp_path / "clang"
    clang.write_text("#!/bin/sh\necho cannot find libclang_rt.fuzzer.a >&2\nexit 1\n")
    clang.chmod(0o755)
    monkeypatch.setattr(shutil, "which", lambda name: str(clang))
    assert missing(tmp_path).endswith("It said: cannot find libclang_rt.fuzzer.a")
