"""Run the paper's experiments, and write the report on them.

make paper [ARGS="--quick"]
"""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from experiments import pcgym, twin
from experiments.results import in_short, write_report
from experiments.runner import Outcome, Run, RunsFailed, load_all, run_all
from experiments.summary import quote


def main(arguments: Sequence[str] | None = None) -> int:
    """Do the runs that are missing, write the report, and return the exit status."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    options = _parser().parse_args(given)
    console = Console(soft_wrap=True, highlight=False)
    from experiments import catalog

    quick = Path("out/paper-quick")
    runs = catalog.QUICK if options.quick else catalog.RUNS
    folder = options.results or (quick / "runs" if options.quick else Path("out/paper"))
    report_folder = quick if options.quick else Path("docs")
    failed: RunsFailed | None = None
    if not options.report_only:
        try:
            _run(runs, folder, options, console)
        except RunsFailed as error:
            failed = error
        except KeyboardInterrupt:
            console.print(f"Interrupted. What is finished lies in {folder} and is not run again.")
            return 130
    everything = load_all(runs, folder, catalog.FINGERPRINT)
    from_logs = {run: each for run, each in everything.items() if run.plant == twin.PLANT}
    strangers = {run: each for run, each in everything.items() if run.plant in pcgym.PLANTS}
    apart = from_logs.keys() | strangers.keys()
    outcomes = {run: each for run, each in everything.items() if run not in apart}
    if outcomes:
        command = f'make paper ARGS="{shlex.join(given)}"' if given else "make paper"
        for path in write_report(outcomes, report_folder, command=command):
            console.print(f"Written: {path}")
        if not options.quick and quote(in_short(outcomes), Path("README.md")):
            console.print("Written: the results in README.md")
    for path in (
        *twin.write_report(from_logs, report_folder),
        *pcgym.write_report(strangers, report_folder),
    ):
        console.print(f"Written: {path}")
    console.print(f"{len(everything)} of {len(runs)} runs are in {folder}.")
    if failed:
        console.print(str(failed), style="red", markup=False)
    return 1 if failed or not everything else 0


def _run(
    runs: Sequence[Run], folder: Path, options: argparse.Namespace, console: Console
) -> dict[Run, Outcome]:
    from experiments import catalog

    pattern = re.compile(options.only, re.IGNORECASE)
    wanted = [run for run in runs if pattern.search(str(run))]
    where = f"the workers of {options.dask}" if options.dask else "this machine"
    console.print(f"{len(wanted)} runs on {where}, saved in {folder}.")
    return run_all(
        wanted,
        catalog.execute,
        folder,
        fingerprint=catalog.FINGERPRINT,
        jobs=options.jobs,
        dask=options.dask,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m experiments", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a few short runs, in minutes")
    parser.add_argument("--jobs", type=int, default=-1, help="processes (all cores)")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a dask cluster")
    parser.add_argument("--results", type=Path, metavar="DIR", help="of the runs (out/paper)")
    parser.add_argument(
        "--only",
        metavar="PATTERN",
        default="",
        help='regular expression, searched in "plant / learner / seed 0 / 50 episodes"',
    )
    parser.add_argument("--report-only", action="store_true", help="run nothing")
    return parser


if __name__ == "__main__":
    sys.exit(main())
