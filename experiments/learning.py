"""What is gained over the MPC on each plant: `python -m experiments.learning`, hours of one core.

Three seeds, fifty episodes that nothing has seen, beside what `headroom` finds on the same fifty;
and the reactor from logs of its MPC alone, ten of a kind. Nothing was set for any plant. Writes the
tables of docs/improve.md; with names of plants it does their runs. PC-Gym's are in
`experiments.pcgym`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.markdown import number, quote, spread, table
from experiments.measures import IMPROVED, OBSERVER
from experiments.optimum import cstr_optimum
from experiments.pictures import RIVALS, save_in_short
from experiments.plants import CASES, Case
from experiments.runner import RESULTS, Outcome, Run, load_all, run_all
from sb3_yann import LinearMPC, PlantTwin, headroom, improve, offset_free
from sb3_yann.evaluation import evaluate
from sb3_yann.rollout import Trajectories
from sb3_yann.wrappers import ObserveDisturbance, StageCost
from sb3_yann_envs import problems

SEEDS = range(3)
LOG_SEEDS = range(40, 50)
TESTS = range(2000, 2050)
PLANNED = "headroom"
HEADER = (
    "plant",
    "MPC",
    "headroom, %",
    "`improve`, %",
    "of the headroom, %",
    "worst episode, %",
    "changed",
    "violations",
    "steps of the simulator",
    "largest move, variation",
    "seconds",
)

FROM_A_LOG = "CSTR, from a log"
SENSOR_NOISE = np.array([0.001, 0.001, 0.001, 0.03])
"""Standard deviation of the sensors: mol/L, and K for the last one."""
LOGS = {
    "five episodes": (5, 0.0),
    "two episodes": (2, 0.0),
    "five episodes, sensor noise of .001 mol/L and .03 K": (5, 1.0),
    "the same with ten times the noise": (5, 10.0),
}
"""Episodes, and times the noise."""
LOG_HEADER = (
    "log",
    "trusted",
    "change of the mean cost, %",
    "gap closed, %",
    "worst start, %",
    "violations",
    "seconds",
)


def costs_on(mpc: LinearMPC, make: Callable[[], Any], policy: Any) -> Trajectories:
    """Return the tested episodes, whose costs are stage costs."""
    return evaluate(policy, lambda: StageCost(make(), mpc, violation_cost=0.0), TESTS)


def offset_free_on(case: Case) -> Trajectories:
    """Return the tested episodes of the offset-free MPC, with the costs of the MPC without it.

    The steady state of its own stage cost moves with the estimates: such costs are not comparable.
    """
    mpc, observer = offset_free(case.mpc)
    bounds = mpc.disturbances.d_min, mpc.disturbances.d_max

    def make() -> Any:
        return ObserveDisturbance(
            StageCost(case.make(), case.mpc, violation_cost=0.0), observer, *bounds
        )

    return evaluate(mpc.explicit(), make, TESTS)


def moves_of(played: Trajectories) -> tuple[float, float]:
    """Return the largest step of an input from sample to sample, and the mean of all steps."""
    steps = np.concatenate([np.abs(np.diff(each, axis=0)) for each in played.actions])
    return float(steps.max()), float(steps.mean())


def execute(run: Run) -> Outcome:
    """Return what came of a run on the tested episodes: first the MPC, then what is compared."""
    if run.plant == FROM_A_LOG:
        return _from_a_log(run)
    case = CASES[run.plant]()
    started = time.perf_counter()
    extra: dict[str, Any] = {}
    if run.learner == PLANNED:
        found = headroom(case.mpc, case.make, n_starts=len(TESTS), seed=TESTS[0])
        costs = np.array([found.mpc_costs, found.best_costs])
        violations = np.zeros(costs.shape)
        seconds = time.perf_counter() - started
    elif run.learner == OBSERVER:
        seconds = 0.0
        played = [costs_on(case.mpc, case.make, case.mpc.explicit()), offset_free_on(case)]
        costs = np.array([each.costs for each in played])
        violations = np.array([each.violations for each in played])
    else:
        result = improve(case.mpc, case.make, seed=run.seed)
        seconds = time.perf_counter() - started
        both = (case.mpc.explicit(), result.model)
        played = [costs_on(case.mpc, case.make, each) for each in both]
        costs = np.array([each.costs for each in played])
        violations = np.array([each.violations for each in played])
        moves = np.array([moves_of(each) for each in played])
        extra |= {"accepted": float(result.accepted), "steps": float(result.steps)}
        extra |= {"step": moves[1, 0] / moves[0, 0], "variation": moves[1, 1] / moves[0, 1]}
    return _untrained([0, 1], costs, violations, extra, seconds)


def _from_a_log(run: Run) -> Outcome:
    """Fit a twin to a log, improve the policy in it, and play it on the reactor."""
    mpc = problems.cstr()
    law = mpc.explicit()
    policy: Any = law
    trusted = True
    started = time.perf_counter()
    if run.learner in LOGS:
        twin = PlantTwin.fit(mpc, reactor_log(*LOGS[run.learner], run.seed), seed=run.seed)
        trusted = twin.trusted
    if run.learner in LOGS and trusted:
        policy = improve(mpc, twin, seed=run.seed).model
    seconds = time.perf_counter() - started
    before = evaluate(law, "CSTR-v0", TESTS)
    after = evaluate(policy, "CSTR-v0", TESTS)
    costs = np.array([before.costs, after.costs])
    violations = np.array([before.violations, after.violations])
    if run.learner == PLANNED:
        costs[1] = cstr_optimum([each[0] for each in before.observations])
    return _untrained([0, 1], costs, violations, {"trusted": trusted}, seconds)


def reactor_log(episodes: int, noise: float, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return episodes of the reactor's MPC, which acts on what noisy sensors show."""
    law = problems.cstr().explicit()
    rng = np.random.default_rng(seed)
    readings: list[np.ndarray] = []

    def read(observation: np.ndarray) -> np.ndarray:
        readings.append(observation + noise * SENSOR_NOISE * rng.standard_normal(4))
        return readings[-1]

    found = []
    for number_ in range(episodes):
        readings.clear()
        played = evaluate(lambda each: law(read(each)), "CSTR-v0", [70_000 + 100 * seed + number_])
        read(played.observations[0][-1])
        found.append((np.array(readings).reshape(-1, 4), played.actions[0]))
    return found


def _untrained(
    checkpoints: list[int], costs: Any, violations: Any, extra: dict[str, Any], seconds: float
) -> Outcome:
    none = np.zeros(0)
    return Outcome(checkpoints, costs, violations, none, none, none, extra, seconds)  # type: ignore[arg-type]


def runs(names: Sequence[str]) -> list[Run]:
    """Return all runs, those of one seed before those of the next."""
    learners = {name: [*LOGS] if name == FROM_A_LOG else [IMPROVED] for name in names}
    fixed = [Run(name, PLANNED, 0, 0) for name in names]
    fixed += [Run(name, OBSERVER, 0, 0) for name in names if name in RIVALS]
    seeds = {name: LOG_SEEDS if name == FROM_A_LOG else SEEDS for name in names}
    return fixed + [
        Run(name, learner, seeds[name][i], 0)
        for i in range(max(map(len, seeds.values())))
        for name in names
        if i < len(seeds[name])
        for learner in learners[name]
    ]


def rows(outcomes: Mapping[Run, Outcome]) -> list[list[str]]:
    """Return the rows of the plants: medians and ranges over the seeds."""
    found = []
    for name in CASES:
        ours = [
            out for run, out in outcomes.items() if (run.plant, run.learner) == (name, IMPROVED)
        ]
        if not ours:
            continue
        change, worst, more = _against_mpc(ours)
        plans = outcomes.get(Run(name, PLANNED, 0, 0))
        total = ""
        share = ""
        if plans is not None:
            best = _against_mpc([plans])[0][0]
            total = number(best)
            share = spread(100 * change / best, 0, "") if best < -0.5 else ""
        found.append(
            [
                name,
                number(ours[0].test_costs[0].mean()),
                total,
                spread(change),
                share,
                f"{worst:+.2f}",
                f"{sum(bool(each.extra['accepted']) for each in ours)} of {len(ours)}",
                f"{more}",
                f"{_median(ours, 'steps'):,.0f}",
                ", ".join(
                    f"{np.median([e.extra[k] for e in ours]):.2f}" for k in ("step", "variation")
                ),
                f"{np.median([each.seconds for each in ours]):.0f}",
            ]
        )
    return found


def _median(outcomes: Sequence[Outcome], name: str) -> float:
    return float(np.median([each.extra[name] for each in outcomes]))


def log_rows(outcomes: Mapping[Run, Outcome]) -> list[list[str]]:
    """Return the rows of the reactor's logs; the optimum closes the gap."""
    plans = outcomes.get(Run(FROM_A_LOG, PLANNED, 0, 0))
    found = []
    for name in LOGS:
        ours = [
            out for run, out in outcomes.items() if (run.plant, run.learner) == (FROM_A_LOG, name)
        ]
        if not ours or plans is None:
            continue
        change, worst, more = _against_mpc(ours)
        closed = 100 * np.median(change) / _against_mpc([plans])[0][0]
        found.append(
            [
                name,
                f"{sum(bool(each.extra['trusted']) for each in ours)} of {len(ours)}",
                spread(change),
                f"{round(closed)}",
                f"{worst:+.2f}",
                f"{more}",
                f"{np.median([each.seconds for each in ours]):.0f}",
            ]
        )
    return found


def _against_mpc(outcomes: Sequence[Outcome]) -> tuple[np.ndarray, float, int]:
    """Return changes of the mean (seeds,) and the worst start, in %, and more violations."""
    costs = np.array([each.test_costs for each in outcomes])
    violations = np.array([each.test_violations for each in outcomes])
    base = costs[:, 0].mean(axis=1)
    change = 100 * (costs[:, 1].mean(axis=1) / base - 1)
    worst = 100 * ((costs[:, 1] - costs[:, 0]) / base[:, None]).max()
    return change, float(worst), int((violations[:, 1] > violations[:, 0]).sum())


def main(arguments: Sequence[str] | None = None) -> None:
    """Do the runs that are missing, print the tables and quote them."""
    parser = argparse.ArgumentParser(prog="python -m experiments.learning", description=__doc__)
    parser.add_argument("plants", nargs="*", metavar="PLANT", help="all by default")
    parser.add_argument("--jobs", type=int, default=-1, help="processes (all cores)")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a dask cluster")
    parser.add_argument("--results", type=Path, default=RESULTS, help="file of the runs")
    parser.add_argument("--report-only", action="store_true", help="of the runs that are done")
    parser.add_argument("--report", type=Path, default=Path("docs"), help="folder of the page")
    options = parser.parse_args(arguments)
    every = [*CASES, FROM_A_LOG]
    if not options.report_only:
        wanted = runs(options.plants or every)
        run_all(wanted, execute, options.results, jobs=options.jobs, dask=options.dask)
    outcomes = load_all(runs(every), options.results)
    page = options.report / "improve.md"
    for mark, header, found in (
        ("simulator", HEADER, rows(outcomes)),
        ("from a log", LOG_HEADER, log_rows(outcomes)),
    ):
        text = table(header, found)
        print(text)
        if found and quote(text, page, f"<!-- {mark}: begin -->\n", f"<!-- {mark}: end -->"):
            print(f"Written: {page}")
    for path in save_in_short(outcomes, options.report):
        print(f"Written: {path}")


if __name__ == "__main__":
    main()
