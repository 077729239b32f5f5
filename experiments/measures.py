"""What the tables say about one learner on one plant, computed from the outcomes of its runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.stats import bootstrap, trim_mean

from experiments.runner import Outcome, Run
from sb3_yann._validation import Array

OURS, MPC, OPTIMUM = "YANN-RL", "MPC", "optimum"
BARE, EXPLORED = f"{OURS}, no settings", f"{OURS}, a simulator explored"
OBSERVER, REIDENTIFIED = "MPC with observer", "re-identified MPC"
FIRST = (OPTIMUM, MPC, OBSERVER, REIDENTIFIED, "LQR", OURS)
HELD = 50.0
"""A pendulum that costs less than this was held upright."""
NEAR = 1.1
"""Within ten per cent of the optimum."""

interquartile_mean = partial(trim_mean, proportiontocut=0.25)


@dataclass(frozen=True)
class Standing:
    """All learners on one plant after the same number of training episodes.

    Attributes
    ----------
    plant : str
    episodes : int
    learners : dict of str to tuple of Outcome
        In the order of the tables, and of the seeds; each ends at `episodes`.
    """

    plant: str
    episodes: int
    learners: Mapping[str, tuple[Outcome, ...]]

    def final(self, learner: str) -> Array | None:
        """Return the cost of each test start, shape (seeds, starts)."""
        runs = self.learners.get(learner)
        return np.array([run.test_costs[-1] for run in runs]) if runs else None

    def row(self, learner: str) -> Row:
        """Return the figures of one learner."""
        return _row(self, learner)

    def tables(self) -> tuple[list[Row], list[Row]]:
        """Return the rows of the learners, and those of ours and its variants."""
        variants = [name for name in self.learners if name.startswith(OURS)]
        others = [name for name in self.learners if name == OURS or name not in variants]
        return [self.row(name) for name in others], [self.row(name) for name in variants]


@dataclass(frozen=True)
class Row:
    """One learner on one plant; None where there is nothing to compare with.

    Attributes
    ----------
    median, low, high : float
        Of the seeds' mean costs over all test starts.
    iqm : float
        The interquartile mean of the same.
    interval : (float, float) or None
        Its bootstrap interval over the seeds, 95 %.
    change : float or None
        The median against the MPC's mean, in per cent of it.
    closed : float or None
        Share of the gap from the MPC to the optimum that is closed, in per cent.
    below, above : int or None
        Seeds whose mean is below and above the MPC's.
    worst, worst_share : float or None
        Largest cost above the MPC's over all seeds and starts; and in per cent of the MPC's mean.
    distance : float or None
        The median less the optimum's mean.
    excess : (float, float, float) or None
        Median, smallest and largest sum over training of the cost above the MPC's.
    unsafe_training, unsafe_tests : int
        Episodes with a violation, over all seeds.
    held : float or None
        Largest cost above the MPC's on the starts that the MPC holds.
    near : int or None
        Seeds whose mean is within ten per cent of the optimum's.
    """

    learner: str
    seeds: int
    median: float
    low: float
    high: float
    iqm: float
    interval: tuple[float, float] | None
    change: float | None
    closed: float | None
    below: int | None
    above: int | None
    worst: float | None
    worst_share: float | None
    distance: float | None
    excess: tuple[float, float, float] | None
    unsafe_training: int
    unsafe_tests: int
    held: float | None
    near: int | None


def plants_of(outcomes: Mapping[Run, Outcome]) -> list[str]:
    """Return the plants in the order of their first run."""
    return list(dict.fromkeys(run.plant for run in outcomes))


def standing(outcomes: Mapping[Run, Outcome], plant: str, episodes: int) -> Standing:
    """Return what each learner reached on a plant; a longer run is read at its checkpoint."""
    found: dict[str, dict[int, Outcome]] = {}
    for run in sorted(outcomes, key=lambda run: run.episodes):
        outcome = outcomes[run]
        fixed = run.episodes == 0
        if run.plant == plant and (fixed or episodes in outcome.checkpoints):
            found.setdefault(run.learner, {}).setdefault(run.seed, outcome.at(episodes))
    names = list(dict.fromkeys(run.learner for run in outcomes if run.learner in found))
    names.sort(key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))
    learners = {name: tuple(found[name][seed] for seed in sorted(found[name])) for name in names}
    return Standing(plant, episodes, learners)


def interval_of(values: Sequence[float] | Array) -> tuple[float, float] | None:
    """Return the 95 % bootstrap interval of the interquartile mean over seeds."""
    if len(values) < 2:
        return None
    found = bootstrap(
        (values,),
        interquartile_mean,
        method="percentile",
        n_resamples=5000,
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(found.low), float(found.high)


def excess_of(runs: Sequence[Outcome]) -> Array | None:
    """Return for each seed what its training cost above the MPC from the same starts."""
    if not all(len(run.training_costs) for run in runs):
        return None
    return np.array([(run.training_costs - run.training_mpc_costs).sum() for run in runs])


def _row(at: Standing, learner: str) -> Row:
    runs, final = at.learners[learner], at.final(learner)
    assert final is not None
    means, excess = final.mean(axis=1), excess_of(runs)
    median = float(np.median(means))
    return Row(
        learner=learner,
        seeds=len(runs),
        median=median,
        low=float(means.min()),
        high=float(means.max()),
        iqm=float(interquartile_mean(means)),
        interval=interval_of(means),
        excess=None
        if excess is None
        else (float(np.median(excess)), float(excess.min()), float(excess.max())),
        unsafe_training=sum(int((run.training_violations > 0).sum()) for run in runs),
        unsafe_tests=sum(int((run.test_violations[-1] > 0).sum()) for run in runs),
        **_against_mpc(final, at.final(MPC), "pendulum" in at.plant),
        **_against_optimum(median, means, at.final(MPC), at.final(OPTIMUM)),
    )


def _against_mpc(final: Array, mpc: Array | None, holds: bool) -> dict[str, float | int | None]:
    names = ("change", "below", "above", "worst", "worst_share", "held")
    if mpc is None:
        return dict.fromkeys(names)
    means, base, more = final.mean(axis=1), float(mpc[0].mean()), final - mpc[0]
    held = mpc[0] < HELD
    values = (
        100 * (float(np.median(means)) - base) / base,
        int((means < base).sum()),
        int((means > base).sum()),
        float(more.max()),
        100 * float(more.max()) / base,
        float(more[:, held].max()) if holds and held.any() else None,
    )
    return dict(zip(names, values, strict=True))


def _against_optimum(
    median: float, means: Array, mpc: Array | None, optimum: Array | None
) -> dict[str, float | int | None]:
    if optimum is None:
        return dict.fromkeys(("closed", "distance", "near"))
    best = float(optimum[0].mean())
    gap = float(mpc[0].mean()) - best if mpc is not None else 0.0
    return {
        "closed": 100 * (gap - (median - best)) / gap if gap else None,
        "distance": median - best,
        "near": int((means <= NEAR * best).sum()),
    }
