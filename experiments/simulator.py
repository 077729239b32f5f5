"""What `improve` makes of a simulator: `python -m experiments.simulator`, some hours of one core.

Three seeds on each plant, fifty episodes that nothing has seen, beside what `headroom` finds on the
same fifty. Nothing was set for any plant. Writes the table of docs/simulator.md; with names of
plants it does their runs. PC-Gym's plants are in `experiments.pcgym`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3 import DDPG

from experiments import FINGERPRINT, tank_disturbed
from experiments import headroom as plants
from experiments.markdown import number, spread, table
from experiments.runner import Outcome, Run, load_all, run_all
from experiments.strangers import STRANGERS
from experiments.strangers import case as stranger
from experiments.summary import quote
from sb3_yann import LinearMPC, YannPolicy, headroom, improve
from sb3_yann.audit.closed_loops import Controller, maker, of_law, play
from sb3_yann.audit.own_units import showing_theta
from sb3_yann.evaluation.episodes import Source
from sb3_yann.twin.gradient import actor

SEEDS, TESTS = range(40, 43), range(2000, 2050)
OURS, PLANS = "improve in a simulator", "headroom"
HEADER = (
    "plant", "MPC", "headroom, %", "`improve`, %", "of the headroom, %", "worst episode, %",
    "changed", "violations", "seconds",
)  # fmt: skip
BEGIN, END = "<!-- simulator: begin -->\n", "<!-- simulator: end -->"

Case = tuple[LinearMPC, Source]


def _headroom_case(name: str) -> Case:
    found = plants.CASES[name]()
    return found.mpc, found.plant  # type: ignore[return-value]


def _catalog_case(name: str) -> Case:
    found = plants.of_catalog(name)
    return found.mpc, found.plant  # type: ignore[return-value]


def _tank_case(name: str) -> Case:
    found = tank_disturbed.CASES[name]()
    return found.mpc, found.make


CASES: dict[str, Callable[[], Case]] = {
    "reactor": partial(_catalog_case, "CSTR"),
    "reactor, true model": partial(_catalog_case, "CSTR, true model"),
    "pendulum, Q = diag(1, 0.1)": partial(_catalog_case, "pendulum, Q = diag(1, 0.1)"),
    "pendulum, Q = I": partial(_catalog_case, "pendulum, Q = I"),
    "worn tank, set-points": partial(_headroom_case, "worn tank, set-points"),
    "worn tank, an observer": partial(_tank_case, "set-points, an observer"),
    "worn tank, waves, a measured flow": partial(_tank_case, "waves, a measured flow"),
    "pH": partial(stranger, "pH"),
    "van de Vusse's reactor": partial(stranger, "van de Vusse's reactor"),
    "van de Vusse's reactor, an observer": partial(stranger, "van de Vusse's reactor", True),
    "bioreactor": partial(stranger, "bioreactor"),
    "bioreactor, an observer": partial(stranger, "bioreactor", True),
    "conical tank": partial(stranger, "conical tank"),
}
assert STRANGERS.keys() <= CASES.keys()


def case_of(name: str) -> Case:
    """Return the MPC of a plant, and what makes the plant."""
    sys.path.append(plants.EXAMPLES)
    return CASES[name]()


def execute(run: Run) -> Outcome:
    """Return what came of a run on the tested episodes; without training those of plans."""
    mpc, env = case_of(run.plant)
    began, none = time.perf_counter(), np.zeros(0)
    extra: dict[str, np.ndarray] = {}
    if run.learner == PLANS:
        found = headroom(mpc, env, n_starts=len(TESTS), seed=TESTS[0])
        costs, violations = np.array([found.mpc_costs, found.best_costs]), np.zeros((2, len(TESTS)))
        seconds = time.perf_counter() - began
    else:
        make = maker(env)
        options = {"gamma": min(mpc.gamma, 0.99), "seed": run.seed, "device": "cpu"}
        model = DDPG(YannPolicy, make(), policy_kwargs={"problem": mpc}, **options)
        result = improve(model, env, seed=run.seed)
        seconds = time.perf_counter() - began
        act = actor(model.policy.actor.mu, mpc)
        acting: list[Controller] = [of_law(mpc), lambda t, theta, running: act(theta)]
        shown = showing_theta(make, mpc)
        played = [play(mpc, shown, TESTS, each) for each in acting]
        costs = np.array([each.costs for each in played])
        violations = np.array([each.violations for each in played])
        extra["accepted"] = np.array(float(result.accepted))
    return Outcome(np.arange(2), costs, violations, none, none, none, extra, seconds)


def runs(names: Sequence[str]) -> list[Run]:
    """Return all runs, those of one seed before those of the next."""
    found = [Run(name, PLANS, 0, 0) for name in names]
    return found + [Run(name, OURS, seed, 0) for seed in SEEDS for name in names]


def rows(outcomes: Mapping[Run, Outcome]) -> list[list[str]]:
    """Return the rows of the table: medians and ranges over the seeds."""
    found = []
    for name in CASES:
        ours = [each for run, each in outcomes.items() if (run.plant, run.learner) == (name, OURS)]
        if not ours:
            continue
        plans = outcomes.get(Run(name, PLANS, 0, 0))
        base = ours[0].test_costs[0]
        change = np.array([100 * (each.test_costs[1].mean() / base.mean() - 1) for each in ours])
        worst = max(100 * ((each.test_costs[1] - base) / base.mean()).max() for each in ours)
        more = sum(int(np.sum(each.test_violations[1] > each.test_violations[0])) for each in ours)
        accepted = sum(bool(each.extra["accepted"]) for each in ours)
        total, share = "", ""
        if plans is not None:
            best = 100 * (plans.test_costs[1].mean() / plans.test_costs[0].mean() - 1)
            total = number(best)
            share = spread(100 * change / best, 0, "") if best < -0.5 else ""
        seconds = f"{np.median([each.seconds for each in ours]):.0f}"
        cells = number(base.mean()), total, spread(change), share, f"{worst:+.2f}"
        found.append([name, *cells, f"{accepted} of {len(ours)}", f"{more}", seconds])
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Do the runs that are missing, print the table and quote it."""
    parser = argparse.ArgumentParser(prog="python -m experiments.simulator", description=__doc__)
    parser.add_argument("plants", nargs="*", metavar="PLANT", help="all by default")
    parser.add_argument("--jobs", type=int, default=-1, help="processes (all cores)")
    parser.add_argument("--results", type=Path, default=Path("out/paper"), help="of the runs")
    parser.add_argument("--report-only", action="store_true", help="of the runs that are done")
    parser.add_argument("--report", type=Path, default=Path("docs"), help="folder of the page")
    options = parser.parse_args(arguments)
    th.set_num_threads(1)
    wanted, folder = runs(options.plants or [*CASES]), options.results
    if not options.report_only:
        run_all(wanted, execute, folder, fingerprint=FINGERPRINT, jobs=options.jobs)
    text = table(HEADER, rows(load_all(runs([*CASES]), folder, FINGERPRINT)))
    print(text)
    if quote(text, options.report / "simulator.md", BEGIN, END):
        print(f"Written: {options.report / 'simulator.md'}")


if __name__ == "__main__":
    main()
