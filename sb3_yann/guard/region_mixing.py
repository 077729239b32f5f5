"""Accepting what a refused candidate has learned in single regions, whose networks are separate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sb3_yann.compare import less_safe
from sb3_yann.guard.actor_checkpoint import ActorCheckpoint
from sb3_yann.guard.episodes import Evidence, Outcome, Unplayable, play
from sb3_yann.guard.session import GuardSession
from sb3_yann.guard.statistics import is_above

MOST_LOST = 0.2
"""Share of losing starts beyond which no part of a candidate is looked for."""

PART_WAY = 0.5, 0.25
"""How far towards a refused candidate what lies between is tried."""


def accept_visited(session: GuardSession, candidate: ActorCheckpoint, outcome: Outcome) -> None:
    """Accept the candidate in those regions that its episodes come through.

    In all of them where its networks count in another box of theta: a mixture was not played.
    """
    state, visited = session.state, outcome.visits.any(0)
    alike = state.accepted.is_confined_as(candidate)
    if alike and np.any(state.accepted.changed_regions(candidate) & ~visited):
        candidate = state.accepted.with_regions(candidate, np.flatnonzero(visited).tolist())
    state.accept(candidate, replace(state.evidence, accepted=outcome))


def accept_parts(
    session: GuardSession, candidate: ActorCheckpoint, outcome: Outcome | None
) -> None:
    """Accept regions of a refused candidate; its outcome is None where it cannot be played."""
    alike = session.state.accepted.is_confined_as(candidate)
    if outcome is not None and alike:  # else no mixture is what was played, anywhere
        _accept_all_but_losing(session, candidate, outcome)
    _accept_one_by_one(session, candidate, outcome)


def _accept_all_but_losing(
    session: GuardSession, candidate: ActorCheckpoint, outcome: Outcome
) -> None:
    """Restore the regions by which few starts lose, until the others can be accepted.

    Losing starts come through the restored region most, winning ones least. Only its episodes are
    played again.
    """
    evidence: Evidence = session.state.evidence
    paired, visited = evidence.paired, (evidence.visits | outcome.visits).any(0)
    before = session.state.accepted
    kept = np.flatnonzero(before.changed_regions(candidate) & visited).tolist()
    while len(kept) > 1:
        lost = paired.lost(outcome.costs)
        if not lost.any() or lost.mean() > MOST_LOST:
            break
        won = outcome.costs < paired.costs - paired.tolerance.margin
        blame, credit = outcome.visits[lost].sum(0)[kept], outcome.visits[won].sum(0)[kept]
        if not blame.any():
            break
        restored = kept.pop(int(np.argmax(blame / (blame + credit + 1e-9))))
        mixed = before.with_regions(candidate, kept)
        starts = np.flatnonzero(outcome.visits[:, restored])
        try:
            outcome = outcome.replaced(starts, _play_some(session, mixed, starts))
        except Unplayable:
            break
        if _improves(evidence, outcome):
            accept_visited(session, mixed, outcome)
            return


def _accept_one_by_one(
    session: GuardSession, candidate: ActorCheckpoint, outcome: Outcome | None
) -> None:
    """Accept the regions of the candidate that improve the accepted policy, one by one."""
    state = session.state
    for region in np.argsort(-state.evidence.visits.sum(0), kind="stable").tolist():
        evidence: Evidence = state.evidence
        starts = np.flatnonzero(evidence.visits[:, region])
        if len(starts) == 0 or not state.accepted.changed_regions(candidate)[region]:
            continue
        mixed = state.accepted.with_regions(candidate, [region])
        known, trial = starts[:0], evidence.accepted
        if outcome is not None:
            # The candidate's own episodes, if they meet no region where the mixture is another.
            other = mixed.changed_regions(candidate)
            known = starts[~outcome.visits[starts][:, other].any(1)]
            trial = trial.replaced(known, outcome.at(known))
            lost = len(known) and evidence.at(known).loses(outcome.at(known))
            if lost or np.any(
                less_safe(
                    trial.unsafe[known],
                    evidence.paired.unsafe[known],
                    evidence.tolerance.excess_room,
                )
            ):
                continue  # whatever the others cost
        others = np.setdiff1d(starts, known)
        try:
            trial = trial.replaced(others, _play_some(session, mixed, others))
        except Unplayable:
            continue
        if _improves(evidence, trial):
            state.accept(mixed, replace(evidence, accepted=trial))


def accept_part_way(session: GuardSession, candidate: ActorCheckpoint) -> float:
    """Accept what lies half or a quarter of the way to a refused candidate; return the share.

    0 where neither is better than what is accepted.
    """
    before, evidence = session.state.accepted, session.state.evidence
    for share in PART_WAY:
        between = before.part_way(candidate, share)
        try:
            outcome = play(session, between, evidence.seeds)
        except Unplayable:
            continue
        if _improves(evidence, outcome):
            accept_visited(session, between, outcome)
            return share
    return 0.0


def _improves(evidence: Evidence, outcome: Outcome) -> bool:
    """Return whether the mean cost falls, and nothing speaks against the policy."""
    gained = is_above(evidence.accepted.costs, outcome.costs)
    return gained and not evidence.paired.objection(outcome.costs, outcome.unsafe)


def _play_some(
    session: GuardSession, checkpoint: ActorCheckpoint, starts: NDArray[np.int64]
) -> Outcome:
    """Return what comes of a checkpoint from some of the known starts."""
    evidence: Evidence = session.state.evidence
    if len(starts) == 0:
        return evidence.accepted.at(starts)
    return play(session, checkpoint, [evidence.seeds[i] for i in starts])


def accepted_regions(
    before: ActorCheckpoint, candidate: ActorCheckpoint, accepted: ActorCheckpoint
) -> list[int]:
    """Return the regions in which the accepted networks are new, and the candidate's."""
    new = before.changed_networks(accepted) & ~candidate.changed_networks(accepted)
    return [int(region) for region in np.flatnonzero(new)]
