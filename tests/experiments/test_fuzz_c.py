"""Exported C, fuzzed for a second: nothing is found, and a fault would be.

``python -m experiments.fuzz_c --seconds 3600`` does the same for longer.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

pytest.importorskip("resource")
from experiments.fuzz_c import build, feed, main, missing
from experiments.fuzz_cases import cases, write


@pytest.fixture(scope="module")
def needs_fuzzer(tmp_path_factory: pytest.TempPathFactory) -> None:
    why = missing(tmp_path_factory.mktemp("one"))
    if why:
        pytest.skip(why)


@pytest.mark.slow
def test_a_second_of_it_finds_nothing(needs_fuzzer, tmp_path: Path) -> None:
    write(cases()["references and rates"], 1, "float", tmp_path)
    build(tmp_path)
    found = feed(tmp_path, 1)
    assert found.crashes == []
    assert found.executions > 5 and found.steps > 100
    assert 100 < found.edges <= found.all_edges


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_self_test_that_fails_ends_it(needs_fuzzer, tmp_path: Path) -> None:
    write(cases()["reactor"], 0, "double", tmp_path)
    code = tmp_path / "plant.c"
    code.write_text(code.read_text().replace("state->sound = RECOVER;", "state->sound = 0;"))
    build(tmp_path)
    (crash,) = feed(tmp_path, 1).crashes
    assert "does not hold: selftest() == 0" in crash


def test_without_clang_it_says_what_to_install(monkeypatch, capsys) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert main([]) == 2
    assert "apt install clang libclang-rt-" in capsys.readouterr().err


def test_a_clang_without_its_fuzzer_is_quoted(monkeypatch, tmp_path: Path) -> None:
    clang = tmp_path / "clang"
    clang.write_text("#!/bin/sh\necho cannot find libclang_rt.fuzzer.a >&2\nexit 1\n")
    clang.chmod(0o755)
    monkeypatch.setattr(shutil, "which", lambda name: str(clang))
    assert missing(tmp_path).endswith("It said: cannot find libclang_rt.fuzzer.a")
