"""An observer beside the MPC, and learning on top of it: `python -m experiments.observer`.

Nothing is trained but with seeds as arguments: then the reactor's policy starts as the MPC with
the observer. Prints the table, and puts it into docs/headroom.md. Runs that are done lie in
out/paper; those of experiments/runs are used as well.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments import catalog
from experiments.markdown import number, table
from experiments.measures import MPC, OBSERVER, OPTIMUM, OURS, REIDENTIFIED, standing
from experiments.runner import Outcome, Run, load_all, run_all
from experiments.summary import quote

PLANTS = "CSTR", "pendulum, Q = diag(1, 0.1)"
LEARNER = f"{OURS}, no settings, from the {OBSERVER}"
EPISODES = 50
RECORDED = Path("experiments/runs")
HEADER = ("plant", "controller", "mean cost", "against MPC, %", f"against {OBSERVER}, %",
          "starts cheaper than the MPC's", "worst start", "violations")  # fmt: skip
BEGIN, END = "<!-- observer: begin -->\n", "<!-- observer: end -->"


def runs(seeds: Sequence[int] = ()) -> list[Run]:
    """Return what is not trained on both plants, and a training of the reactor for each seed."""
    fixed = [Run(p, name, 0, 0) for p in PLANTS for name in (MPC, OBSERVER, REIDENTIFIED, OPTIMUM)]
    return [*fixed, *(Run(PLANTS[0], LEARNER, seed, EPISODES) for seed in seeds)]


def rows(outcomes: Mapping[Run, Outcome], plant: str) -> list[tuple[str, ...]]:
    """Return the rows of a plant; those of a learner are the median and the range of its seeds."""
    at, found = standing(outcomes, plant, EPISODES), []
    mpc, observer = (np.array(at.final(name)) for name in (MPC, OBSERVER))
    for learner in (MPC, OBSERVER, REIDENTIFIED, LEARNER, OPTIMUM):
        costs = at.final(learner)
        if costs is None:
            continue
        means, row = costs.mean(axis=1), at.row(learner)
        seeds = f" ({number(row.low)} to {number(row.high)}), {row.seeds} seeds"
        found.append((
            plant,
            learner,
            number(row.median) + (seeds if learner == LEARNER else ""),
            *(number(100 * (np.median(means) / base.mean() - 1), sign="+")
              for base in (mpc, observer)),
            f"{np.sum(costs < mpc)} of {costs.size}",
            number(row.worst, sign="+"),
            f"{row.unsafe_training + row.unsafe_tests}",
        ))  # fmt: skip
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Do the runs that are missing, print the table and quote it."""
    parser = argparse.ArgumentParser(prog="python -m experiments.observer", description=__doc__)
    parser.add_argument("seeds", type=int, nargs="*", help="of the training; none by default")
    parser.add_argument("--jobs", type=int, default=-1, help="processes (all cores)")
    parser.add_argument("--results", type=Path, default=Path("out/paper"), help="of the runs")
    parser.add_argument("--report", type=Path, default=Path("docs"), help="folder of the page")
    options = parser.parse_args(arguments)
    wanted = runs(options.seeds)
    found = load_all(wanted, RECORDED, catalog.FINGERPRINT)
    missing = [run for run in wanted if run not in found]
    settings = {"fingerprint": catalog.FINGERPRINT, "jobs": options.jobs}
    found |= run_all(missing, catalog.execute, options.results, **settings)
    text = table(HEADER, [row for plant in PLANTS for row in rows(found, plant)], texts=2)
    print(text)
    if quote(text, options.report / "headroom.md", BEGIN, END):
        print(f"Written: {options.report / 'headroom.md'}")


if __name__ == "__main__":
    main()
