"""The reactor improved from a log alone: `python -m experiments.twin`, ten minutes on two cores.

Ten logs of the MPC for each case, on none of which anything was tuned; 100 starts of the plant that
are in no log. Prints the table of docs/twin.md.
"""

from __future__ import annotations

import os
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
import torch as th
from stable_baselines3 import DDPG

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
SEEDS = range(20, 30)
STARTS = range(30_000, 30_100)


class Outcome(NamedTuple):
    """What came of one log; changes are in percent of the MPC's mean cost on the plant."""

    trusted: bool
    reidentified: float
    """What the MPC of the re-identified model costs more, without any learning."""
    change: float
    worst: float
    violations: int
    seconds: float


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


def run(case: str, seed: int) -> Outcome:
    """Fit a twin to a log, improve the policy in it, and play it on the plant."""
    th.set_num_threads(1)
    problem = problems.cstr()
    twin = PlantTwin.fit(problem, log(*CASES[case], seed), seed=seed)
    if not twin.trusted:
        return Outcome(False, 0.0, 0.0, 0.0, 0, 0.0)
    model = DDPG("YannPolicy", "CSTR-v0", policy_kwargs={"problem": problem}, device="cpu")
    began = time.perf_counter()
    improve(model, twin, seed=seed)
    seconds = time.perf_counter() - began
    ours = evaluate(model, "CSTR-v0", STARTS)
    mpc = evaluate(problem.explicit(), "CSTR-v0", STARTS)
    again = evaluate(twin.reidentified().explicit(), "CSTR-v0", STARTS)
    excess = 100 * (ours.costs - mpc.costs) / mpc.costs.mean()
    linear = 100 * (again.costs.mean() / mpc.costs.mean() - 1)
    violations = int(ours.violations.sum())
    return Outcome(True, linear, excess.mean(), excess.max(), violations, seconds)


def row(case: str, outcomes: list[Outcome]) -> str:
    """Return a case's row of the table."""
    trusted = [each for each in outcomes if each.trusted]
    change, linear = (np.array([each[k] for each in outcomes]) for k in (2, 1))
    worst = max(each.worst for each in outcomes)
    violations = sum(each.violations for each in outcomes)
    seconds = f"{np.median([each.seconds for each in trusted]):.0f}" if trusted else ""
    spreads = (
        f"{np.median(each):+.2f} ({each.min():+.2f} to {each.max():+.2f})"
        for each in (change, linear)
    )
    parts = (case, f"{len(trusted)} of {len(outcomes)}", *spreads, f"{np.sum(change < -1.9)}")
    return " | ".join(("", *parts, f"{worst:+.2f}", f"{violations}", seconds, "")).strip()


def main() -> None:
    """Print the table."""
    print("| log | trusted | change of the mean cost, % | re-identified MPC, % "
          "| seeds below -1.9 % | worst start, % | violations | improve, s |")  # fmt: skip
    print("| --- | --- | --- | --- | ---: | ---: | ---: | ---: |")
    with ProcessPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        for case in CASES:
            print(row(case, [*pool.map(partial(run, case), SEEDS)]), flush=True)


if __name__ == "__main__":
    main()
