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

from experiments import pcgym
from experiments.markdown import quote
from experiments.results import in_short, write_report
from experiments.runner import RESULTS, RunsFailed, load_all, run_all

BEGIN = "<!-- results: begin -->\n"
END = "<!-- results: end -->"


def main(arguments: Sequence[str] | None = None) -> int:
    """Do the runs that are missing, write the report, and return the exit status."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    options = _parser().parse_args(given)
    console = Console(soft_wrap=True, highlight=False)
    from experiments import catalog

    quick = Path("out/paper-quick")
    runs = catalog.QUICK if options.quick else catalog.RUNS
    results = options.results or (quick / "results.sqlite" if options.quick else RESULTS)
    report_folder = quick if options.quick else Path("docs")
    failed: RunsFailed | None = None
    if not options.report_only:
        pattern = re.compile(options.only, re.IGNORECASE)
        wanted = [run for run in runs if pattern.search(str(run))]
        where = f"the workers of {options.dask}" if options.dask else "this machine"
        console.print(f"{len(wanted)} runs on {where}, saved in {results}.")
        try:
            run_all(wanted, catalog.execute, results, jobs=options.jobs, dask=options.dask)
        except RunsFailed as error:
            failed = error
        except KeyboardInterrupt:
            console.print(f"Interrupted. What is finished lies in {results} and is not run again.")
            return 130
    outcomes = load_all(runs, results)
    of_pcgym = {run: each for run, each in outcomes.items() if run.plant in pcgym.PLANTS}
    of_paper = {run: each for run, each in outcomes.items() if run not in of_pcgym}
    written = pcgym.write_report(of_pcgym, report_folder)
    if of_paper:
        command = f'make paper ARGS="{shlex.join(given)}"' if given else "make paper"
        written += write_report(of_paper, report_folder, command=command)
        readme = Path("README.md")
        if not options.quick and quote(in_short(of_paper), readme, BEGIN, END):
            written.append(readme)
    for path in written:
        console.print(f"Written: {path}")
    console.print(f"{len(outcomes)} of {len(runs)} runs are in {results}.")
    if failed:
        console.print(str(failed), style="red", markup=False)
    return 1 if failed or not outcomes else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m experiments", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a few short runs, in minutes")
    parser.add_argument("--jobs", type=int, default=-1, help="processes (all cores)")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a dask cluster")
    parser.add_argument("--results", type=Path, metavar="FILE", help="of the runs")
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
