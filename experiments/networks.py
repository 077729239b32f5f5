"""One network for each region of the law, or one for all: `python -m experiments.networks`.

Both learn with no setting but a target rate of 0.02, from the same starts. Beside the costs it is
measured how far the input moves in closed loop, since actuators wear. Prints the table; runs that
are done are kept in `out/networks`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from experiments import catalog
from experiments.markdown import spread
from experiments.measures import OURS
from experiments.runner import Outcome, Run, run_all

FOLDER = Path("out/networks")
PLANTS = "CSTR", "pendulum, Q = diag(1, 0.1)"
FORMS = {"per region": f"{OURS}, no settings", "shared": f"{OURS}, no settings, one network"}
SEEDS = range(40, 50)
EPISODES = 50


def rows(plant: str, mpc: Outcome, runs: dict[str, list[Outcome]]) -> list[str]:
    """Return the rows of a plant's table: for each form the runs of its seeds."""
    lines = [f"| {plant} | MPC | {mpc.test_costs.mean():.2f} |  | 1.00 | 1.00 | 0 |  |"]
    for form, found in runs.items():
        costs = [run.test_costs[-1].mean() for run in found]
        worst = max((run.test_costs[-1] - mpc.test_costs[-1]).max() for run in found)
        steps, variations = (
            [ratio(run, mpc) for run in found] for ratio in (step_ratio, variation_ratio)
        )
        violations = sum(int(run.training_violations.sum()) for run in found)
        violations += sum(int(run.test_violations[-1].sum()) for run in found)
        cost, step, variation = (spread(each, sign="") for each in (costs, steps, variations))
        measured = cost, f"{worst:+.2f}", step, variation
        lines.append(f"|  | {form} | {' | '.join(measured)} | {violations} | {len(found)} |")
    return lines


def step_ratio(run: Outcome, mpc: Outcome) -> float:
    """Return the largest step of the input in any test episode, over the MPC's largest."""
    return float(run.extra["largest_step"].max() / mpc.extra["largest_step"].max())


def variation_ratio(run: Outcome, mpc: Outcome) -> float:
    """Return how far the input moves in all test episodes together, over the same of the MPC."""
    return float(run.extra["variation"].sum() / mpc.extra["variation"].sum())


def main(seeds: Sequence[int] = SEEDS) -> None:
    """Run what is missing, and print the table."""
    fixed = [Run(plant, "MPC", 0, 0) for plant in PLANTS]
    learnt = [
        Run(plant, learner, seed, EPISODES)
        for seed in seeds
        for plant in PLANTS
        for learner in FORMS.values()
    ]
    found = run_all(
        [*fixed, *learnt], catalog.execute, FOLDER, fingerprint=catalog.FINGERPRINT, jobs=1
    )
    print("| plant | networks | test cost | worst start | largest step | total variation "
          "| violations | seeds |")  # fmt: skip
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for plant, mpc in zip(PLANTS, fixed, strict=True):
        runs = {
            form: [found[run] for run in learnt if (run.plant, run.learner) == (plant, learner)]
            for form, learner in FORMS.items()
        }
        print("\n".join(rows(plant, found[mpc], runs)))


if __name__ == "__main__":
    main([int(seed) for seed in sys.argv[1:]] or SEEDS)
