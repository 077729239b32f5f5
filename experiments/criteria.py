"""What was required of the learner, and whether the outcomes reach it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from experiments.markdown import number
from experiments.measures import (
    EXPLORED,
    HELD,
    MPC,
    NEAR,
    OPTIMUM,
    OURS,
    Row,
    Standing,
    standing,
)
from experiments.runner import Outcome, Run

EPISODES = 50
SEEDS = 10
EQUAL = 1e-4
"""Relative difference of two means that counts as none: single precision over an episode."""
RIVALS = ("DDPG", "residual RL")


@dataclass(frozen=True)
class Criterion:
    """One line of the table.

    Attributes
    ----------
    plant, learner, required : str
    figure : str
        What was found.
    holds : bool
    seeds : int
        With fewer than were asked for, what holds is not reached yet.
    """

    plant: str
    learner: str
    required: str
    figure: str
    holds: bool
    seeds: int = SEEDS

    @property
    def reached(self) -> str:
        """Return yes, no, or how far the seeds go."""
        if not self.holds:
            return "**no**"
        return "yes" if self.seeds >= SEEDS else f"so far ({self.seeds} of {SEEDS} seeds)"


def criteria(outcomes: Mapping[Run, Outcome]) -> list[Criterion]:
    """Return every criterion whose runs are there."""
    found: list[Criterion] = []
    for plant in dict.fromkeys(run.plant for run in outcomes):
        at = standing(outcomes, plant, EPISODES)
        for name in (EXPLORED, OURS):
            if name in at.learners and MPC in at.learners:
                found += [*_criteria_of(at, name)]
    return found


def _criteria_of(at: Standing, ours: str) -> Iterator[Criterion]:
    if "pendulum" in at.plant:
        yield from _held(at, ours)
        yield from _near_the_optimum(at, ours)
        yield _not_above(at, ours, "the mean is never above the MPC's")
    elif "true model" in at.plant:
        yield _not_above(at, ours, "not worse than the MPC in any seed")
    else:
        yield from _safe_and_better(at, ours)
        yield from _share_of_the_optimum(at, ours)
        yield from _ahead_of_the_rivals(at, ours)


def _not_above(at: Standing, ours: str, required: str) -> Criterion:
    means, base = _means(at, ours)
    figure = f"largest {100 * (means.max() - base) / base:+.2f} %"
    return Criterion(
        at.plant, ours, required, figure, bool(_at_most(means, base).all()), len(means)
    )


def _held(at: Standing, ours: str) -> Iterator[Criterion]:
    final, mpc = at.final(ours), at.final(MPC)
    assert final is not None and mpc is not None
    held = mpc[0] < HELD
    if not held.any():
        return
    costs, more = final[:, held], final[:, held] - mpc[0, held]
    lost = int((costs >= HELD).sum())
    yield Criterion(
        at.plant,
        ours,
        "every start that the MPC holds is held in every seed",
        f"{lost} of {costs.size} lost ({held.sum()} starts)",
        lost == 0,
        len(final),
    )
    yield Criterion(
        at.plant,
        ours,
        "and costs at most 0.05 more",
        f"largest {number(more.max(), 3, '+')}",
        bool(more.max() <= 0.05),
        len(final),
    )


def _near_the_optimum(at: Standing, ours: str) -> Iterator[Criterion]:
    row = at.row(ours)
    if row.near is not None:
        required = f"the mean is within {100 * (NEAR - 1):.0f} % of the optimum in 9 of 10 seeds"
        figure = f"{row.near} of {row.seeds} seeds"
        yield Criterion(at.plant, ours, required, figure, row.near >= 0.9 * row.seeds, row.seeds)


def _safe_and_better(at: Standing, ours: str) -> Iterator[Criterion]:
    row, (means, base) = at.row(ours), _means(at, ours)
    assert row.change is not None and row.worst_share is not None
    unsafe = f"{row.unsafe_training} episodes in {row.seeds} seeds"
    largest = f"largest {100 * (means.max() - base) / base:+.2f} %"
    improved = f"{-row.change:.2f} %"
    worst = f"{number(row.worst_share, sign='+')} % ({number(row.worst, sign='+')})"
    for required, figure, holds in (
        ("no violation in training", unsafe, row.unsafe_training == 0),
        ("final mean below the MPC's in every seed", largest, row.below == row.seeds),
        ("median improvement at least 2.2 %", improved, -row.change >= 2.2),
        (
            "no test start worse than the MPC by more than 1 % of the MPC's mean cost",
            worst,
            row.worst_share <= 1,
        ),
    ):
        yield Criterion(at.plant, ours, required, figure, holds, row.seeds)


def _share_of_the_optimum(at: Standing, ours: str) -> Iterator[Criterion]:
    row = at.row(ours)
    if row.closed is not None:
        required = "median improvement at least 85 % of what the optimum leaves"
        yield Criterion(
            at.plant, ours, required, f"{row.closed:.1f} %", row.closed >= 85, row.seeds
        )


def _ahead_of_the_rivals(at: Standing, ours: str) -> Iterator[Criterion]:
    own = at.row(ours)
    for name in RIVALS:
        if name not in at.learners:
            continue
        rival = at.row(name)
        seeds = min(own.seeds, rival.seeds)
        if OPTIMUM in at.learners:
            required = f"{name} at least five times as far from the optimum"
            yield _times(at, ours, required, (rival.distance, own.distance), 5, seeds)
        required = f"{name} at least twenty times the excess cost while learning"
        yield _times(at, ours, required, (_median_excess(rival), _median_excess(own)), 20, seeds)


def _times(
    at: Standing,
    ours: str,
    required: str,
    figures: tuple[float | None, float | None],
    factor: float,
    seeds: int,
) -> Criterion:
    """Compare a rival's figure with ours."""
    theirs, own = figures
    if theirs is None or own is None:
        return Criterion(at.plant, ours, required, "not known", False, seeds)
    if own <= 0:
        figure = f"{theirs:,.2f} against {own:,.2f}: ours is not above zero"
        return Criterion(at.plant, ours, required, figure, theirs > 0, seeds)
    figure = f"{theirs / own:,.1f} times ({theirs:,.2f} against {own:,.2f})"
    return Criterion(at.plant, ours, required, figure, theirs >= factor * own, seeds)


def _median_excess(row: Row) -> float | None:
    return None if row.excess is None else row.excess[0]


def _means(at: Standing, ours: str) -> tuple[np.ndarray, float]:
    final, mpc = at.final(ours), at.final(MPC)
    assert final is not None and mpc is not None
    return final.mean(axis=1), float(mpc[0].mean())


def _at_most(means: np.ndarray, base: float) -> np.ndarray:
    return means <= base * (1 + EQUAL)
