"""The reactor improved from a log alone: `python -m experiments.twin`, half an hour on two cores.

Ten logs of the MPC for each case, on none of which anything was tuned; 100 starts of the plant that
are in no log. Writes the table into docs/twin.md, and the picture beside it; `make paper` does so
too. What is done lies in out/paper; to do it again, delete its files cstr-from-a-log-* there.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import DDPG

from experiments import FINGERPRINT
from experiments.markdown import spread, table
from experiments.measures import MPC, OPTIMUM
from experiments.optimum import cstr_optimum
from experiments.pictures import save_from_a_log
from experiments.runner import Outcome, Run, run_all
from experiments.summary import quote
from sb3_yann import PlantTwin, improve
from sb3_yann.evaluation import evaluate
from sb3_yann_envs import problems

NOISE = np.array([0.001, 0.001, 0.001, 0.03])  # mol/L and K
CASES = {
    "five episodes": (5, 0.0),
    "two episodes": (2, 0.0),
    "five episodes, sensor noise of .001 mol/L and .03 K": (5, 1.0),
    "the same with ten times the noise": (5, 10.0),
}
PLANT = "CSTR, from a log"
SEEDS = range(20, 30)
STARTS = range(30_000, 30_100)
HEADER = ("log", "trusted", "change of the mean cost, %", "without the log's box, %",
          "re-identified MPC, %", "gap closed, %", "seeds below -1.9 %", "worst start, %",
          "without the box, %", "violations", "improve, s")  # fmt: skip
BEGIN, END = "<!-- from a log: begin -->\n", "<!-- from a log: end -->"


def runs(seeds: Sequence[int] = SEEDS) -> list[Run]:
    """Return the MPC, the optimum, and each case with each seed."""
    fixed = [Run(PLANT, name, 0, 0) for name in (MPC, OPTIMUM)]
    return [*fixed, *(Run(PLANT, case, seed, 0) for case in CASES for seed in seeds)]


def log(episodes: int, noise: float, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return episodes of the MPC, which acts on what noisy sensors show."""
    law, rng = problems.cstr().explicit(), np.random.default_rng(seed)
    seen: list[np.ndarray] = []

    def act(observation: np.ndarray) -> np.ndarray:
        seen.append(observation + noise * NOISE * rng.standard_normal(4))
        return np.asarray(law(seen[-1]))

    found = []
    for number in range(episodes):
        seen.clear()
        played = evaluate(act, "CSTR-v0", [70_000 + 100 * seed + number])
        last = played.observations[0][-1] + noise * NOISE * rng.standard_normal(4)
        states = np.concatenate([np.array(seen).reshape(-1, 4), last[None]])
        found.append((states, played.actions[0]))
    return found


def execute(run: Run) -> Outcome:
    """Fit a twin to a log, improve the policy in it, and play it on the plant.

    Where the twin is not trusted the MPC is played.
    """
    mpc, seconds, trusted = problems.cstr(), 0.0, True
    policy: Any = mpc.explicit()
    if run.learner in CASES:
        twin = PlantTwin.fit(mpc, log(*CASES[run.learner], run.seed), seed=run.seed)
        trusted = twin.trusted
    if run.learner in CASES and trusted:
        policy, seconds = improved(twin, run.seed)
    played = evaluate(policy, "CSTR-v0", STARTS)
    costs, violations = played.costs, played.violations
    if run.learner == OPTIMUM:
        costs, violations = cstr_optimum([each[0] for each in played.observations]), 0 * violations
    none, others = np.zeros(0), {"unconfined": costs, "reidentified": costs}
    if run.learner in CASES and trusted:
        free, _ = improved(twin, run.seed, confine=False)
        others["unconfined"] = evaluate(free, "CSTR-v0", STARTS).costs
        others["reidentified"] = evaluate(twin.reidentified().explicit(), "CSTR-v0", STARTS).costs
    extra = {"trusted": np.array(trusted), **others}
    return Outcome(np.zeros(1), costs[None], violations[None], none, none, none, extra, seconds)


def improved(twin: PlantTwin, seed: int, **options: bool) -> tuple[DDPG, float]:
    """Return a policy that was improved in a twin, and the seconds that took."""
    model = DDPG("YannPolicy", "CSTR-v0", policy_kwargs={"problem": twin.problem}, device="cpu")
    began = time.perf_counter()
    improve(model, twin, seed=seed, **options)
    return model, time.perf_counter() - began


def excess(outcomes: Mapping[Run, Outcome]) -> dict[str, np.ndarray]:
    """Return what each start costs above the MPC (seeds, starts), in % of the MPC's mean."""
    mpc = outcomes[Run(PLANT, MPC, 0, 0)].test_costs[0]
    found: dict[str, list[np.ndarray]] = {}
    for run, outcome in outcomes.items():
        more = 100 * (outcome.test_costs[0] - mpc) / mpc.mean()
        found.setdefault(run.learner, []).append(more)
    return {name: np.array(each) for name, each in found.items()}


def rows(outcomes: Mapping[Run, Outcome]) -> list[tuple[str, ...]]:
    """Return the rows of the table; the optimum is the last."""
    more, found, base = excess(outcomes), [], outcomes[Run(PLANT, MPC, 0, 0)].test_costs[0]
    best = more[OPTIMUM].mean()
    for case in CASES:
        of = [outcome for run, outcome in outcomes.items() if run.learner == case]
        if not of:
            continue
        change, mpc = more[case].mean(axis=1), base.mean()
        free, linear = (
            np.array([100 * (each.extra[name].mean() / mpc - 1) for each in of])
            for name in ("unconfined", "reidentified")
        )
        worst_free = max((each.extra["unconfined"] - base).max() for each in of)
        seconds = [each.seconds for each in of if each.extra["trusted"]]
        found.append((
            case,
            f"{len(seconds)} of {len(of)}",
            *map(spread, (change, free, linear)),
            f"{100 * np.median(change) / best + 0.0:.0f}",
            f"{np.sum(change < -1.9)}",
            f"{more[case].max():+.2f}",
            f"{100 * worst_free / mpc:+.2f}",
            f"{sum(int(each.test_violations.sum()) for each in of)}",
            f"{np.median(seconds):.0f}" if seconds else "",
        ))  # fmt: skip
    worst = f"{more[OPTIMUM].max():+.2f}"
    return [*found, ("the optimum", "", f"{best:+.2f}", "", "", "100", "", worst, "", "0", "")]


def write_report(outcomes: Mapping[Run, Outcome], folder: Path) -> list[Path]:
    """Save ``from-a-log.png``, quote the table in ``twin.md`` if it is there, return the paths.

    Nothing is written without the MPC, the optimum and a case.
    """
    more = excess(outcomes) if Run(PLANT, MPC, 0, 0) in outcomes else {}
    changes = {case: more[case].mean(axis=1) for case in CASES if case in more}
    if OPTIMUM not in more or not changes:
        return []
    written = [save_from_a_log(changes, float(more[OPTIMUM].mean()), folder)]
    page = folder / "twin.md"
    if quote(table(HEADER, rows(outcomes), texts=5), page, BEGIN, END):
        written.append(page)
    return written


def main(arguments: Sequence[str] | None = None) -> None:
    """Do the runs that are missing, print the table and save the picture."""
    parser = argparse.ArgumentParser(prog="python -m experiments.twin", description=__doc__)
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="of each case")
    parser.add_argument("--jobs", type=int, default=-1, help="processes (all cores)")
    parser.add_argument("--results", type=Path, default=Path("out/paper"), help="of the runs")
    parser.add_argument("--report", type=Path, default=Path("docs"), help="folder of the report")
    options = parser.parse_args(arguments)
    wanted, folder = runs(SEEDS[: options.seeds]), options.results
    found = run_all(wanted, execute, folder, fingerprint=FINGERPRINT, jobs=options.jobs)
    print(table(HEADER, rows(found), texts=5))
    for path in write_report(found, options.report):
        print(f"Written: {path}")


if __name__ == "__main__":
    main()
