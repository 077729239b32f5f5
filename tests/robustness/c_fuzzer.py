"""Fuzz exported C code, guided by coverage: ``FUZZ_SECONDS=3600 make test-all ARGS="-k fuzzer"``.

Policies and laws of many kinds are exported, compiled by clang with the sanitizers of addresses and
of undefined behavior, and fed by libFuzzer: each input is a sequence of readings, requests and
manual outputs for a controller that keeps its state. `fuzz_target.c` says what must hold. Needs
clang with its runtime (Debian, Ubuntu: `apt install clang libclang-rt-14-dev`, with the number of
clang), the tests beside it, and Linux or macOS.
"""

from __future__ import annotations

import os
import re
import resource
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

SANITIZERS = "address,undefined,float-divide-by-zero,float-cast-overflow"
FLAGS = ["-std=c99", "-O1", "-g", "-fno-sanitize-recover=all", "-Wall", "-Wextra"]
LONGEST = 2048
"""Bytes of an input at most: some two hundred steps."""
PARTS = ["plant.o", "fuzz_target.o", "plant_selftest.o"]
SAYS = re.compile(r"does not hold|runtime error|ERROR: |    #\d .*plant|Test unit written")
"""Lines of a crash that say what it was."""
ROUND = 20.0
"""Seconds of a core that a case has before the next one's turn."""
SEEDS = 20
"""Inputs at random that the corpus begins with."""
NONE = "clang's fuzzer is not there: on Debian and Ubuntu, apt install clang libclang-rt-14-dev"


@dataclass
class Found:
    """What came of a case: so many executions, each of some steps, in so many seconds of a core.

    ``edges`` of ``all_edges`` of the exported code were reached; ``crashes`` are what was said.
    """

    executions: int = 0
    steps: int = 0
    edges: int = 0
    all_edges: int = 0
    seconds: float = 0.0
    crashes: list[str] = field(default_factory=list)

    def add(self, later: Found) -> None:
        """Add what came of the same case later."""
        self.executions += later.executions
        self.steps += later.steps
        self.seconds += later.seconds
        self.edges, self.all_edges = later.edges, later.all_edges
        self.crashes += later.crashes


def missing(folder: Path) -> str:
    """Return why nothing can be fuzzed here, or ""."""
    clang = shutil.which("clang")
    if clang is None:
        return NONE
    (folder / "one.c").write_text(
        "#include <stddef.h>\n#include <stdint.h>\n"
        "int LLVMFuzzerTestOneInput(const uint8_t *d, size_t n) { return (void)d, (void)n, 0; }\n"
    )
    built = [clang, f"-fsanitize=fuzzer,{SANITIZERS}", "one.c", "-o", "one"]
    made = subprocess.run(built, cwd=folder, capture_output=True, text=True)
    if made.returncode == 0:
        made = subprocess.run(["./one", "-runs=1"], cwd=folder, capture_output=True, text=True)
    if made.returncode == 0:
        return ""
    said = made.stderr.strip().splitlines() or ["nothing"]
    return f"{NONE}. It said: {said[0]}"


def build(folder: Path) -> None:
    """Compile ``fuzz``, and ``bare``, whose edges are those of the exported code alone.

    RuntimeError with what the compiler said if it does not compile.
    """
    for name, guards in (("fuzz", [f"-fsanitize={SANITIZERS}"]), ("bare", [])):
        flags = ["clang", *FLAGS, *guards]
        for words in (
            [*flags, "-fsanitize=fuzzer-no-link", "-c", "plant.c"],
            [*flags, "-c", "fuzz_target.c"],
            [*flags, "-Dmain=selftest", "-c", "plant_selftest.c"],
            [*flags, "-fsanitize=fuzzer", *PARTS, "-lm", "-o", name],
        ):
            made = subprocess.run(words, cwd=folder, capture_output=True, text=True)
            if made.returncode:
                raise RuntimeError(made.stderr)


def feed(folder: Path, seconds: float, seed: int = 1) -> Found:
    """Run a fuzzer for so many seconds of one core, and return what it found.

    Its corpus is kept in the folder and grows; what crashed it lies beside.
    """
    found, corpus, rng = Found(), folder / "corpus", np.random.default_rng(seed)
    corpus.mkdir(exist_ok=True)
    for k in range(SEEDS):  # long ones too, from the start
        (corpus / f"seed{k}").write_bytes(rng.bytes(int(LONGEST ** rng.uniform(0.3, 1))))
    words = [
        "./fuzz", "corpus", f"-max_len={LONGEST}", "-timeout=60", "-print_final_stats=1",
        "-artifact_prefix=crash-", "-use_value_profile=1", f"-seed={seed}", "-rss_limit_mb=4096",
    ]  # fmt: skip
    before = _used()
    said = _said(words, folder, FUZZ_SECONDS=f"{seconds:g}")
    found.seconds = _used() - before
    found.executions = _last(r"stat::number_of_executed_units: (\d+)", said)
    found.steps = _last(r"^steps: (\d+)", said)
    if "exiting as requested" not in said:
        lines = [each for each in said.splitlines() if SAYS.search(each)]
        found.crashes.append("\n".join(lines) or said[-2000:])
    said = _said(["./bare", "corpus", "-runs=0"], folder)
    found.edges = _last(r"cov: (\d+)", said)
    found.all_edges = _last(r"Loaded 1 modules +\((\d+) inline 8-bit counters\)", said)
    return found


def _said(words: Sequence[str], folder: Path, **environment: str) -> str:
    """Return what a program says as errors."""
    options: dict[str, Any] = {"capture_output": True, "text": True, "errors": "replace"}
    ran = subprocess.run(words, cwd=folder, env={**os.environ, **environment}, **options)
    return str(ran.stderr)


def _used() -> float:
    """Return the seconds of a core that all children took which have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _last(pattern: str, said: str) -> int:
    """Return the last number of a pattern in what was said, or 0."""
    return int(([*re.findall(pattern, said, re.MULTILINE)] or [0])[-1])
