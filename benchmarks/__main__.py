"""Measure how fast it is beside its peers, and write the report on it.

make bench [ARGS="--quick"]
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path

# One thread for everything; read at the first import.
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the sections that were asked for, write the report, and return the exit status."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    options = _parser().parse_args(given)
    import torch as th
    from rich.console import Console

    from benchmarks.records import Bench, Figures
    from benchmarks.report import write_report
    from benchmarks.sections import NAMES, run
    from benchmarks.timing import Stopwatch

    th.set_num_threads(1)
    unknown = sorted(set(options.only) - set(NAMES))
    if unknown:
        print(f"There is no section {unknown[0]!r}; the sections are {', '.join(NAMES)}.")
        return 2
    watch = Stopwatch(clock=time.process_time if options.cpu else time.perf_counter)
    if options.quick:
        watch.repeats = 5
        watch.seconds = 0.5
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=180)
    bench = Bench(watch, Figures(), console, options.quick, options.slow)
    began = time.perf_counter()
    run(bench, options.only or NAMES)
    report = options.report
    if report is None and not options.only:
        report = Path("out/bench-quick" if options.quick else "docs") / "performance.md"
    if report is not None:
        command = f'make bench ARGS="{shlex.join(given)}"' if given else "make bench"
        write_report(bench, report, command)
        console.print(f"Written: {report}")
    console.print(
        f"{time.perf_counter() - began:.0f} s; the process had a processor in "
        f"{100 * watch.share:.0f} % of the time of the measurements."
    )
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="seven regions only, in a minute")
    parser.add_argument(
        "--only", metavar="SECTION", nargs="+", default=[],
        help="law, actor, train, solve, exact, memory, suite, large, horizons, online, export, "
        "processes; writes no report unless --report",
    )  # fmt: skip
    parser.add_argument("--report", type=Path, metavar="FILE", help="docs/performance.md")
    parser.add_argument(
        "--slow", action="store_true", help="ppopt's solvers at thousands of regions, minutes each"
    )
    parser.add_argument(
        "--cpu", action="store_true", help="time of the processor, where others are at work on it"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
