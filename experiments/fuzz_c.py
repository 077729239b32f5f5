"""Fuzz exported C code, guided by coverage: `python -m experiments.fuzz_c --seconds 3600`.

Policies and laws of many kinds are exported, compiled by clang with the sanitizers of addresses and
of undefined behavior, and fed by libFuzzer: each input is a sequence of readings, requests and
manual outputs for a controller that keeps its state. `fuzz_target.c` says what must hold. Needs
clang with its runtime (Debian, Ubuntu: `apt install clang libclang-rt-14-dev`, with the number of
clang), the tests beside it, and Linux or macOS.
"""

from __future__ import annotations

import argparse
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sb3_yann import Checks, Controller, LinearModel, LinearMPC, export
from sb3_yann.deployment.c_text import literal
from sb3_yann.deployment.c_text import table as c_table

HERE = Path(__file__).parent
SANITIZERS = "address,undefined,float-divide-by-zero,float-cast-overflow"
FLAGS = ["-std=c99", "-O1", "-g", "-fno-sanitize-recover=all", "-Wall", "-Wextra"]
LONGEST = 2048
"""Bytes of an input at most: some two hundred steps."""
PARTS = ["plant.o", "fuzz_target.o", "plant_selftest.o"]
SAYS = re.compile(r"does not hold|runtime error|ERROR: |    #\d .*plant|Test unit written")
"""Lines of a crash that say what it was."""
SEEDS = 20
"""Inputs at random that the corpus begins with."""
ROOM = {"double": 1e-9, "float": 2e-5}
"""How far an output may be beyond a bound, in parts of the input's range."""
NONE = "clang's fuzzer is not there: on Debian and Ubuntu, apt install clang libclang-rt-14-dev"


@dataclass(frozen=True)
class Case:
    """What is exported, and how."""

    make: Callable[[], Any]
    options: dict[str, Any] = field(default_factory=dict)
    tested: bool = True
    """Whether its self-test must pass."""


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


def cases() -> dict[str, Case]:
    """Return the ten kinds of policies of the tests, a law without bounds and an MPC with rates."""
    sys.path[:0] = [str(HERE.parent / "tests" / "support")]
    from torch import nn

    import deployed
    import general_problems
    import sample_laws

    def unbounded() -> LinearMPC:
        model = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1)
        return LinearMPC(
            model, Q=np.eye(2), R=[[0.1]], horizon=3, x_min=[-5, -2], x_max=[5, 2]
        )  # fmt: skip

    found = {name: Case(lambda n=name: deployed.policy_of(n)) for name in deployed.CASES}
    found["no bounds of the inputs"] = Case(unbounded)
    found["an MPC with rates, absolute"] = Case(
        lambda: general_problems.solved("servo with rates"), {"absolute": True}
    )
    found["networks that overflow"] = Case(
        lambda: deployed.disturbed(sample_laws.solved("reactor"), size=1e25, activation_fn=nn.ReLU),
        tested=False,
    )
    return found


def checks_of(number: int, rest: Any, half: Any) -> Checks:
    """Return the checks of the case of a number: by default, strict, or none at all in between."""
    if number % 3 == 0:
        return Checks()
    if number % 3 == 1:
        low, high = rest - 1.5 * half, rest + 1.5 * half
        return Checks(low, high, frozen_after=3, hold=2, recover=2, transfer=3)
    return Checks(frozen_after=1, hold=0, recover=0, transfer=0, late_after=None)


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


def limits(data: dict[str, Any], precision: str, tested: bool) -> str:
    """Return fuzz_limits.h: what must hold, taken from the controller in Python."""
    m, rated = len(data["action_scale"]), len(data["change"]) > 0
    scale, shift = data["action_scale"], data["action_shift"]
    low, high = np.sort(data["bounds"] * scale + shift, axis=0)
    middle, half = box_of(data)
    bounded = np.isfinite(low) & np.isfinite(high)
    span = np.where(bounded, high - low, 2 * scale)
    numbers = {
        "lowest": low, "highest": high, "range_of": span,
        "room": ROOM[precision] * (span + np.abs(shift)),
        "middle": middle, "half": half,
        "reading_min": data["obs_min"], "reading_max": data["obs_max"],
    }  # fmt: skip
    if rated:  # what the env shows of an output: output * shown_per + shown_at
        assert np.array_equal(data["obs_matrix"], np.eye(len(middle)))
        per = 1 / (scale * data["per_input"])
        numbers["change_min"], numbers["change_max"] = data["change"] * scale
        numbers["shown_per"] = per
        numbers["shown_at"] = data["middle"] / data["per_input"] - shift * per
        numbers["shown_at"] = numbers["shown_at"] - data["obs_offset"][-m:]
    flags: dict[str, Any] = {
        "MOST": "FLT_MAX" if precision == "float" else "DBL_MAX",
        "LEAST": "1e-45f" if precision == "float" else "5e-324",
        "LATE_AFTER": literal(float(data["late_after"]), precision),
        **{name.upper(): int(data[name]) for name in ("frozen_after", "hold", "recover")},
        "TRANSFER": int(data["transfer"]),
        "RATED": int(rated),
        "TESTED": int(tested),
        "READS_THETA": int(np.array_equal(data["obs_matrix"], np.eye(len(middle)))),
        "UNBOUNDED": int(not bounded.all()),
    }
    lines = [f"#define {name} {value}" for name, value in flags.items()]
    real = np.float32 if precision == "float" else np.float64
    lines += [
        c_table("plant_real", name, np.asarray(each, real), precision)
        for name, each in numbers.items()
    ]
    return "\n".join([*lines, ""])


def box_of(data: dict[str, Any]) -> tuple[Any, Any]:
    """Return the middle and the half-widths of the readings (n_obs,) in the box of theta."""
    low, high = data["box"]
    back = np.linalg.pinv(data["obs_matrix"])
    half = np.abs(back) @ ((high - low) / 2)
    return back @ ((low + high) / 2 - data["obs_offset"]), np.where(half > 0, half, 1.0)


def write(case: Case, number: int, precision: str, folder: Path) -> None:
    """Export a case with the checks of its number, and write what must hold of it."""
    given = case.make()
    export(given, folder / "plant.npz", **case.options)
    own = checks_of(number, *box_of(Controller.load(folder / "plant.npz").data))
    export(given, folder / "plant.npz", checks=own, **case.options)
    export(given, folder / "plant.c", checks=own, precision=precision, **case.options)
    data = Controller.load(folder / "plant.npz").data
    (folder / "fuzz_limits.h").write_text(limits(data, precision, case.tested))
    shutil.copy(HERE / "fuzz_target.c", folder)


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

    Its corpus is kept in the folder, and what crashed it beside.
    """
    found, corpus, rng = Found(), folder / "corpus", np.random.default_rng(seed)
    corpus.mkdir(exist_ok=True)
    for k in range(SEEDS):  # long ones too, from the start
        (corpus / f"seed{k}").write_bytes(rng.bytes(int(LONGEST ** rng.uniform(0.3, 1))))
    while not found.crashes and found.seconds < seconds - 0.5:
        rest = max(1, round(seconds - found.seconds))
        words = [
            "./fuzz", "corpus", f"-max_total_time={rest}", f"-max_len={LONGEST}", "-timeout=25",
            "-print_final_stats=1", "-artifact_prefix=crash-", "-use_value_profile=1",
            f"-seed={seed}", "-rss_limit_mb=4096",
        ]  # fmt: skip
        before = _used()
        ran = subprocess.run(words, cwd=folder, capture_output=True, text=True, errors="replace")
        found.seconds += _used() - before
        seed += 1
        found.executions += _last(r"stat::number_of_executed_units: (\d+)", ran.stderr)
        found.steps += _last(r"^steps: (\d+)", ran.stderr)
        if ran.returncode:
            lines = [each for each in ran.stderr.splitlines() if SAYS.search(each)]
            found.crashes.append("\n".join(lines) or ran.stderr[-2000:])
    words = ["./bare", "corpus", "-runs=0"]
    ran = subprocess.run(words, cwd=folder, capture_output=True, text=True, errors="replace")
    found.edges = _last(r"cov: (\d+)", ran.stderr)
    found.all_edges = _last(r"Loaded 1 modules +\((\d+) inline 8-bit counters\)", ran.stderr)
    return found


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
    outcomes = []
    for number, name, precision, case in pairs:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            if keep is not None:
                folder = keep / re.sub(r"\W+", "_", f"{name} {precision}")
                folder.mkdir(parents=True, exist_ok=True)
            write(case, number, precision, folder)
            build(folder)
            found = feed(folder, seconds / len(pairs))
        outcomes.append(found)
        print(
            f"{name}, {precision}: {_in_words([found])}",
            *found.crashes, sep="\n", flush=True,
        )  # fmt: skip
    return outcomes


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
