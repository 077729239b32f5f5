"""The worn tank with a disturbance, or with an observer: `python -m experiments.tank_disturbed`.

The first plant is that of examples/own_plant.py: waves, set-points, and a flow that is measured.
Its MPC is identified from a log of the plant when it was new. The second has set-points alone, and
an MPC with an observer, which knows the plant as it was when it was new. Logs are episodes of the
MPC itself. Prints a table of docs/twin.md.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import DDPG

from experiments import headroom as plants
from experiments.markdown import number, spread, table
from sb3_yann import DisturbanceObserver, LinearMPC, PlantTwin, headroom, improve, offset_free
from sb3_yann._validation import Array
from sb3_yann.evaluation import evaluate
from sb3_yann.wrappers import ObserveDisturbance, StageCost

SEEDS, EPISODES = range(20, 30), (5, 10, 50)
"""Of each log, and how many it holds."""
TEST_SEEDS = range(2000, 2100)
HEADER = (
    "plant", "episodes in the log", "MPC", "headroom, %", "`improve`, %", "of the headroom, %",
    "worst start, %", "accepted",
)  # fmt: skip


class Case(NamedTuple):
    """An MPC, what makes its plant, and the observer."""

    mpc: LinearMPC
    make: Callable[[], gym.Env[Any, Any]]
    observer: DisturbanceObserver | None = None


def measured() -> Case:
    """Return the plant of the example, which measures its disturbance."""
    sys.path.append(plants.EXAMPLES)
    case = plants.own_plant()
    return Case(case.mpc, case.plant)


def observed() -> Case:
    """Return the tank with set-points, and an MPC with an observer."""
    case = plants.worn_tank()
    mpc, observer = offset_free(case.mpc)
    bounds = mpc.disturbances.d_min, mpc.disturbances.d_max
    return Case(
        mpc, lambda: StageCost(ObserveDisturbance(case.plant(), observer, *bounds), mpc), observer
    )


CASES = {"waves, a measured flow": measured, "set-points, an observer": observed}


def run(case: Case, episodes: int, seed: int) -> tuple[bool, Array]:
    """Return whether a policy is accepted, and its costs on the plant, from a log of the MPC."""
    seeds = range(100_000 + 100 * seed, 100_000 + 100 * seed + episodes)
    log = evaluate(case.mpc.explicit(), case.make, seeds)
    pairs = [*zip(log.observations, log.actions, strict=True)]
    twin = PlantTwin.fit(case.mpc, pairs, observer=case.observer, seed=seed)
    settings = {"problem": case.mpc}
    model = DDPG("YannPolicy", case.make(), gamma=case.mpc.gamma, policy_kwargs=settings)
    found = improve(model, twin, seed=seed)
    return found.accepted, evaluate(model, case.make, TEST_SEEDS).costs


def rows(name: str, case: Case) -> list[list[str]]:
    """Return the rows of a plant."""
    base = evaluate(case.mpc.explicit(), case.make, TEST_SEEDS).costs
    best = headroom(case.mpc, case.make, n_starts=len(TEST_SEEDS), seed=TEST_SEEDS[0])
    found = []
    for episodes in EPISODES:
        outcomes = [run(case, episodes, seed) for seed in SEEDS]
        change = np.array([100 * (costs.mean() / base.mean() - 1) for _, costs in outcomes])
        share = -change / best.total
        worst = max(100 * (costs - base).max() / base.mean() for _, costs in outcomes)
        accepted = sum(accepted for accepted, _ in outcomes)
        figures = number(base.mean()), number(-100 * best.total), spread(change)
        shown = spread(share, 0, ""), f"{worst:+.2f}", f"{accepted} of {len(outcomes)}"
        found.append([name, f"{episodes}", *figures, *shown])
        print(*found[-1], sep=" | ", flush=True)
    return found


def main() -> None:
    """Print the table."""
    th.set_num_threads(1)
    print(table(HEADER, [row for name, make in CASES.items() for row in rows(name, make())]))


if __name__ == "__main__":
    main()
