"""The reactor commissioned without a simulator: `python -m experiments.commissioning`, an hour.

Ten runs of 60 episodes for each case, on seeds on which nothing was tuned; 100 starts of the plant
that no run has seen. Prints the tables of docs/commissioning.md.
"""

from __future__ import annotations

import json
import os
import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import DDPG

from experiments.markdown import spread
from experiments.optimum import cstr_optimum
from experiments.twin import NOISE, STARTS
from sb3_yann import Commissioning
from sb3_yann.evaluation import evaluate
from sb3_yann_envs import problems

CASES = {
    "no noise": (0.0, True),
    "sensor noise of .001 mol/L and .03 K": (1.0, True),
    "no noise, reidentify=False": (0.0, False),
}
SEEDS = range(40, 50)
BATCHES, FIRST = 4, 4  # 4 + 8 + 16 + 32 episodes


class Noisy(gym.Wrapper[Any, Any, Any, Any]):
    """A plant whose sensors are noisy."""

    def __init__(self, env: gym.Env[Any, Any], noise: float, seed: int) -> None:
        super().__init__(env)
        self.noise, self.rng = noise * NOISE, np.random.default_rng(seed)

    def reset(self, **kwargs: Any) -> Any:
        """Begin an episode."""
        observation, info = self.env.reset(**kwargs)
        return self._read(observation), info

    def step(self, action: Any) -> Any:
        """Take a step."""
        observation, *rest = self.env.step(action)
        return (self._read(observation), *rest)

    def _read(self, observation: Any) -> Any:
        return (observation + self.noise * self.rng.standard_normal(4)).astype(np.float32)


class Outcome(NamedTuple):
    """What came of one run; changes are in percent of the MPC's mean cost on the plant."""

    change: float
    worst: float
    excess: float
    violations: int
    alarms: int
    strange: int


def run(case: str, seed: int) -> Outcome:
    """Commission the reactor, then play the policy that it ends with."""
    th.set_num_threads(1)
    problem, first = problems.cstr(), 200_000 + 1000 * seed
    model = DDPG("YannPolicy", "CSTR-v0", policy_kwargs={"problem": problem}, device="cpu")
    noise, reidentify = CASES[case]
    plant = Noisy(gym.make("CSTR-v0"), noise, seed)
    with tempfile.TemporaryDirectory() as folder:
        options = {"batch": FIRST, "seed": first, "reidentify": reidentify}
        work = Commissioning(model, plant, log_path=folder, **options)
        work.run(BATCHES)
        strange = strange_inputs(Path(folder))
    ours, mpc = (evaluate(each, "CSTR-v0", STARTS) for each in (model, problem.explicit()))
    change = 100 * (ours.costs - mpc.costs) / mpc.costs.mean()
    played = evaluate(problem.explicit(), "CSTR-v0", range(first, first + len(work.episodes)))
    costs = np.array([-each.reward for each in work.episodes])
    excess = 100 * (costs - played.costs).sum() / played.costs.sum()
    violations = sum(each.violations for each in work.episodes) + int(ours.violations.sum())
    alarms = sum(each.alarm is not None for each in work.episodes)
    return Outcome(change.mean(), change.max(), excess, violations, alarms, strange)


def strange_inputs(folder: Path) -> int:
    """Return how many inputs of a record are neither the MPC's nor the accepted model's."""
    law, count, models = problems.cstr().explicit(), 0, dict[str, Any]()
    lines = (folder / "commissioning.jsonl").read_text(encoding="utf-8").splitlines()
    for event in map(json.loads, lines[1:]):
        if event["event"] == "batch":
            if event["verdict"] == "accepted":
                here = event["from_here"]
                models[here["policy"]] = DDPG.load(folder / here["model"], device="cpu")
        if event["event"] != "episode":
            continue
        theta, u = np.array(event["thetas"])[:-1], np.array(event["actions"])
        allowed = law(theta)
        if event["acts"] != "MPC":
            acted = models[event["acts"]].predict(theta.astype(np.float32), deterministic=True)[0]
            until = len(u) if event["alarm"] is None else event["step"] + 1
            allowed = np.concatenate([acted[:until], allowed[until:]])
        count += int(np.sum(np.abs(u - allowed) > 1e-4 * np.ptp([law.u_min, law.u_max])))
    return count


def row(case: str, outcomes: list[Outcome], possible: float) -> str:
    """Return a case's row of the table."""
    change, worst, excess, violations, alarms, strange = map(np.array, zip(*outcomes, strict=True))
    closed = 100 * change / possible
    counts = f"{violations.sum()}", f"{alarms.sum()}", f"{strange.sum()}"
    gap, close = spread(closed, 0, ""), f"{np.sum(closed >= 85)}"
    parts = case, spread(change), gap, close, f"{worst.max():+.2f}", spread(excess), *counts
    return " | ".join(("", *parts, "")).strip()


def main() -> None:
    """Print the table."""
    law = problems.cstr().explicit()
    mpc = evaluate(law, "CSTR-v0", STARTS)
    best = cstr_optimum([each[0] for each in mpc.observations])
    possible = 100 * (best.mean() - mpc.costs.mean()) / mpc.costs.mean()
    print(f"The optimum costs {possible:+.2f} % against the MPC.")
    heads = (
        "plant", "change of the mean cost, %", "gap closed, %", "runs above 85 %",
        "worst start, %", "excess cost of the 60 episodes, %", "violations", "alarms",
        "inputs of others",
    )  # fmt: skip
    print(" | ".join(("", *heads, "")).strip())
    print("| --- | --- | --- | ---: | ---: | --- | ---: | ---: | ---: |")
    with ProcessPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        for case in CASES:
            outcomes = [*pool.map(partial(run, case), SEEDS)]
            print(row(case, outcomes, possible), flush=True)


if __name__ == "__main__":
    main()
