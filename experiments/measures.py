"""What the tables say about one learner on one plant, computed from the outcomes of its runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from experiments.runner import Outcome, Run
from sb3_yann._validation import Array

OURS = "YANN-RL"
MPC = "MPC"
OPTIMUM = "optimum"
BARE = f"{OURS}, no settings"
EXPLORED = f"{OURS}, a simulator explored"
DRAWING = ("SAC", "TQC", "PPO")
"""Algorithms whose policy draws its actions."""
OBSERVER = "MPC with observer"
REIDENTIFIED = "re-identified MPC"
IMPROVED = "improve in a simulator"
FIRST = (OPTIMUM, MPC, OBSERVER, REIDENTIFIED, "LQR", OURS)
"""The order of the tables."""


@dataclass(frozen=True)
class Row:
    """One learner on one plant; None where there is nothing to compare with.

    Attributes
    ----------
    seeds : int
    median, low, high : float
        Of the seeds' mean costs over all test starts.
    worst, worst_share : float or None
        Largest cost above the MPC's over all seeds and starts; and in percent of the MPC's mean.
    excess : float or None
        Median of the sums over training of the cost above the MPC's.
    unsafe_training, unsafe_tests : int
        Episodes with a violation, over all seeds.
    """

    learner: str
    seeds: int
    median: float
    low: float
    high: float
    worst: float | None
    worst_share: float | None
    excess: float | None
    unsafe_training: int
    unsafe_tests: int


def plants_of(outcomes: Mapping[Run, Outcome]) -> list[str]:
    """Return the plants in the order of their first run."""
    return list(dict.fromkeys(run.plant for run in outcomes))


def rows_of(outcomes: Mapping[Run, Outcome], plant: str, episodes: int) -> list[Row]:
    """Return what each learner reached on a plant; a longer run is read at its checkpoint."""
    found: dict[str, dict[int, Outcome]] = {}
    for run in sorted(outcomes, key=lambda run: run.episodes):
        outcome = outcomes[run]
        fixed = run.episodes == 0
        if run.plant == plant and (fixed or episodes in outcome.checkpoints):
            found.setdefault(run.learner, {}).setdefault(run.seed, outcome.at(episodes))
    names = list(dict.fromkeys(run.learner for run in outcomes if run.learner in found))
    names.sort(key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))
    levels = {name: found[name][0].test_costs[-1] for name in (MPC, OPTIMUM) if name in found}
    return [
        _row(name, [found[name][seed] for seed in sorted(found[name])], levels) for name in names
    ]


def _row(learner: str, runs: list[Outcome], levels: Mapping[str, Array]) -> Row:
    final = np.array([run.test_costs[-1] for run in runs])
    means = final.mean(axis=1)
    worst = worst_share = excess = None
    if MPC in levels:
        base = float(levels[MPC].mean())
        worst = float((final - levels[MPC]).max())
        worst_share = 100 * worst / base
    if all(len(run.training_costs) for run in runs):
        sums = [(run.training_costs - run.training_mpc_costs).sum() for run in runs]
        excess = float(np.median(sums))
    return Row(
        learner=learner,
        seeds=len(runs),
        median=float(np.median(means)),
        low=float(means.min()),
        high=float(means.max()),
        worst=worst,
        worst_share=worst_share,
        excess=excess,
        unsafe_training=sum(int((run.training_violations > 0).sum()) for run in runs),
        unsafe_tests=sum(int((run.test_violations[-1] > 0).sum()) for run in runs),
    )
