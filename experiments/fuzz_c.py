"""Fuzz exported C code, guided by coverage: `python -m experiments.fuzz_c --seconds 3600`.

Policies and laws of many kinds are exported, compiled by clang with the sanitizers of addresses and
of undefined behavior, and fed by libFuzzer: each input is a sequence of readings, requests and
manual outputs for a controller that keeps its state. `fuzz_target.c` says what must hold. Needs
clang with its runtime (Debian, Ubuntu: `apt install clang libclang-rt-14-dev`, with the number of
clang), the tests beside it, and Linux or macOS.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from experiments.fuzz_cases import cases, write

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


def fuzz(chosen: str, precisions: Sequence[str], seconds: float, keep: Path | None) -> list[Found]:
    """Fuzz all cases whose name holds some text, and print a row for each.

    Parameters
    ----------
    chosen : str
        "" is all.
    precisions : sequence of {"double", "float"}
        Of the code.
    seconds : float
        Of one core, altogether; compiling comes on top.
    keep : Path or None
        Where the code, the corpora and what crashes are kept.
    """
    pairs = [
        (number + (precision == "float"), name, precision, case)
        for number, (name, case) in enumerate(cases().items())
        for precision in precisions
        if chosen in name
    ]
    with tempfile.TemporaryDirectory() as temporary:
        folders = {}
        for number, name, precision, case in pairs:
            own = (keep or Path(temporary)) / re.sub(r"\W+", "_", f"{name} {precision}")
            own.mkdir(parents=True, exist_ok=True)
            write(case, number, precision, own)
            build(own)
            folders[f"{name}, {precision}"] = own
        return _in_rounds(folders, seconds)


def _in_rounds(folders: dict[str, Path], seconds: float) -> list[Found]:
    """Feed all fuzzers, each for a while, again and again, but for those that crashed."""
    found = {name: Found() for name in folders}
    share = seconds / max(1, len(folders))
    rounds = max(1, round(share / ROUND))
    for k in range(rounds):
        for name, folder in folders.items():
            if found[name].crashes:
                continue
            found[name].add(feed(folder, share / rounds, seed=k + 1))
            if k == rounds - 1 or found[name].crashes:
                print(f"{name}: {_in_words([found[name]])}", *found[name].crashes, sep="\n")
        print(f"round {k + 1} of {rounds}: {_in_words([*found.values()])}", flush=True)
    return [*found.values()]


def _in_words(found: Sequence[Found]) -> str:
    """Return what was found, altogether."""
    executions, steps, seconds, edges, all_edges = (
        sum(getattr(each, name) for each in found)
        for name in ("executions", "steps", "seconds", "edges", "all_edges")
    )
    crashes = sum(len(each.crashes) for each in found)
    return (
        f"{executions:,} executions, {steps:,} steps, in {seconds:.0f} s of one core; "
        f"{edges:,} of {all_edges:,} edges; {crashes} crashes"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Fuzz, report, and return 1 where something crashed, 2 where nothing can be fuzzed."""
    parser = argparse.ArgumentParser(prog="python -m experiments.fuzz_c", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60, help="of one core, for all cases")
    parser.add_argument("--case", default="", help="part of a case's name; default: all")
    parser.add_argument("--precision", choices=["double", "float"], help="default: both")
    parser.add_argument("--keep", type=Path, help="folder for code, corpora and crashes")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        why = missing(Path(folder))
    if why:
        print(why, file=sys.stderr)
        return 2
    precisions = [options.precision] if options.precision else ["double", "float"]
    begun = time.perf_counter()
    found = fuzz(options.case, precisions, options.seconds, options.keep)
    if not found:
        print(f"No case is called {options.case!r}: {', '.join(cases())}", file=sys.stderr)
        return 2
    spent = time.perf_counter() - begun
    print(f"{len(found)} controllers: {_in_words(found)}; {spent:.0f} s with compiling")
    return int(any(each.crashes for each in found))


if __name__ == "__main__":
    sys.exit(main())
