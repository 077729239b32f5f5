"""Accepting what a refused candidate has learnt in single regions, whose networks are separate."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th

from sb3_yann.evaluation import Episodes
from sb3_yann.guard.episodes import Evidence, NotFinite, evidence_of, play, unsafe, visits_of
from sb3_yann.guard.snapshot import Snapshot

if TYPE_CHECKING:
    from sb3_yann.guard.callback import ImprovementGuard

MOST_LOST = 0.2
"""Share of losing starts beyond which no part of a candidate is looked for."""


def accept_parts(guard: ImprovementGuard, env: Any, candidate: Snapshot, played: Episodes) -> None:
    """Take over what regions of a refused candidate can be accepted. Changes the policy."""
    _accept_the_rest(guard, env, candidate, played)
    _accept_regions(guard, env, candidate)


def _accept_the_rest(
    guard: ImprovementGuard, env: Any, candidate: Snapshot, played: Episodes
) -> None:
    """Give back the regions by which few starts lose, until what is left can be accepted.

    The region to give back is the one that the losing starts come through and the winning ones
    least. Leaves the policy changed.
    """
    evidence: Evidence = guard.state.evidence
    paired, visited = evidence.paired, (evidence.visits | visits_of(guard, played)).any(0)
    before = guard.state.accepted
    kept = [i for i in np.flatnonzero(visited).tolist() if differs(before, candidate, i)]
    while len(kept) > 1:
        lost = paired.lost(played.costs)
        if not lost.any() or lost.mean() > MOST_LOST:
            break
        visits, won = visits_of(guard, played), played.costs < paired.costs - paired.margin
        blame, credit = visits[lost].sum(0)[kept], visits[won].sum(0)[kept]
        if not blame.any():
            break
        kept.pop(int(np.argmax(blame / (blame + credit + 1e-9))))
        mixed = before.with_regions(candidate, kept)
        mixed.restore(guard.policy)
        try:
            played = play(guard, env, evidence.seeds)
        except NotFinite:
            break
        gained = played.costs.mean() < paired.costs.mean()
        if gained and not paired.objection(played.costs, unsafe(played)):
            guard.accept(evidence_of(guard, played), mixed)
            return


def _accept_regions(guard: ImprovementGuard, env: Any, candidate: Snapshot) -> None:
    """Take over the regions of the candidate that improve the accepted policy, one by one.

    Only the episodes that come through a region are played again. Leaves the policy changed.
    """
    for region in np.argsort(-guard.state.evidence.visits.sum(0), kind="stable").tolist():
        evidence: Evidence = guard.state.evidence
        starts = np.flatnonzero(evidence.visits[:, region])
        before = guard.state.accepted
        if len(starts) == 0 or not differs(before, candidate, region):
            continue
        mixed = before.with_regions(candidate, [region])
        mixed.restore(guard.policy)
        try:
            played = play(guard, env, [evidence.seeds[i] for i in starts])
        except NotFinite:
            continue
        costs, violations = evidence.paired.costs.copy(), evidence.paired.violations.copy()
        costs[starts], violations[starts] = played.costs, unsafe(played)
        if costs.mean() < evidence.paired.costs.mean() and not evidence.paired.objection(
            costs, violations
        ):
            visits = evidence.visits.copy()
            visits[starts] = visits_of(guard, played)
            paired = replace(evidence.paired, costs=costs, violations=violations)
            guard.accept(Evidence(evidence.seeds, paired, visits), mixed)


def differs(before: Snapshot, candidate: Snapshot, region: int) -> bool:
    """Return whether the region's network is another one."""
    return not all(
        th.equal(value[region], candidate.actor[name][region])
        for name, value in before.networks().items()
    )


def taken_over(before: Snapshot, candidate: Snapshot, accepted: Snapshot) -> list[int]:
    """Return the regions in which the accepted networks are new, and the candidate's."""
    n_regions = len(next(iter(accepted.networks().values())))
    return [
        i
        for i in range(n_regions)
        if differs(before, accepted, i) and not differs(candidate, accepted, i)
    ]
