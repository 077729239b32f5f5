"""Accepting what a refused candidate has learnt in single regions, whose networks are separate."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann.guard.actor_checkpoint import ActorCheckpoint, changed
from sb3_yann.guard.episodes import Evidence, Outcome, Unplayable, play

if TYPE_CHECKING:
    from sb3_yann.guard.callback import ImprovementGuard

MOST_LOST = 0.2
"""Share of losing starts beyond which no part of a candidate is looked for."""


def accept_visited(guard: ImprovementGuard, candidate: ActorCheckpoint, outcome: Outcome) -> None:
    """Accept the candidate in the regions that its episodes come through.

    They say nothing of the others: there the networks stay those that were accepted before.
    """
    before, visited = guard.state.accepted, outcome.visits.any(0)
    if np.any(changed(before, candidate) & ~visited):
        candidate = before.with_regions(candidate, np.flatnonzero(visited).tolist())
    guard.accept(guard.state.evidence.of(outcome), candidate)


def accept_parts(
    guard: ImprovementGuard, env: Any, candidate: ActorCheckpoint, outcome: Outcome | None
) -> None:
    """Take over what regions of a refused candidate can be accepted. Changes the policy.

    The outcome is the candidate's from the known starts, None where it cannot be played.
    """
    if outcome is not None:
        _accept_the_rest(guard, env, candidate, outcome)
    _accept_regions(guard, env, candidate, outcome)


def _accept_the_rest(
    guard: ImprovementGuard, env: Any, candidate: ActorCheckpoint, outcome: Outcome
) -> None:
    """Give back the regions by which few starts lose, until what is left can be accepted.

    The region to give back is the one that the losing starts come through and the winning ones
    least; only the episodes that come through it are played again. Leaves the policy changed.
    """
    evidence: Evidence = guard.state.evidence
    paired, visited = evidence.paired, (evidence.visits | outcome.visits).any(0)
    before = guard.state.accepted
    kept = np.flatnonzero(changed(before, candidate) & visited).tolist()
    while len(kept) > 1:
        lost = paired.lost(outcome.costs)
        if not lost.any() or lost.mean() > MOST_LOST:
            break
        won = outcome.costs < paired.costs - paired.margin
        blame, credit = outcome.visits[lost].sum(0)[kept], outcome.visits[won].sum(0)[kept]
        if not blame.any():
            break
        given_back = kept.pop(int(np.argmax(blame / (blame + credit + 1e-9))))
        mixed = before.with_regions(candidate, kept)
        mixed.restore(guard.policy)
        starts = np.flatnonzero(outcome.visits[:, given_back])
        try:
            outcome = outcome.replaced(starts, _play_some(guard, env, starts))
        except Unplayable:
            break
        gained = outcome.costs.mean() < paired.costs.mean()
        if gained and not paired.objection(outcome.costs, outcome.unsafe):
            accept_visited(guard, mixed, outcome)
            return


def _accept_regions(
    guard: ImprovementGuard, env: Any, candidate: ActorCheckpoint, outcome: Outcome | None
) -> None:
    """Take over the regions of the candidate that improve the accepted policy, one by one.

    Only the episodes that come through a region are played again, and of these only those that
    the candidate's own do not stand for. Leaves the policy changed.
    """
    for region in np.argsort(-guard.state.evidence.visits.sum(0), kind="stable").tolist():
        evidence: Evidence = guard.state.evidence
        starts = np.flatnonzero(evidence.visits[:, region])
        before = guard.state.accepted
        if len(starts) == 0 or not changed(before, candidate)[region]:
            continue
        mixed = before.with_regions(candidate, [region])
        known = _same_episodes(starts, candidate, mixed, outcome)
        trial = evidence.accepted
        if outcome is not None:
            trial = trial.replaced(known, outcome.at(known))
            if _worse_than_the_mpc_somewhere(evidence, trial, known):
                continue
        mixed.restore(guard.policy)
        others = np.setdiff1d(starts, known)
        try:
            trial = trial.replaced(others, _play_some(guard, env, others))
        except Unplayable:
            continue
        paired = evidence.paired
        gained = trial.costs.mean() < paired.costs.mean()
        if gained and not paired.objection(trial.costs, trial.unsafe):
            guard.accept(evidence.of(trial), mixed)


def _play_some(guard: ImprovementGuard, env: Any, starts: NDArray[np.int64]) -> Outcome:
    """Return what comes of the present policy from some of the known starts."""
    evidence: Evidence = guard.state.evidence
    if len(starts) == 0:
        return evidence.accepted.at(starts)
    return play(guard, env, [evidence.seeds[i] for i in starts])


def _same_episodes(
    starts: NDArray[np.int64],
    candidate: ActorCheckpoint,
    mixed: ActorCheckpoint,
    outcome: Outcome | None,
) -> NDArray[np.int64]:
    """Return the starts whose episodes are the candidate's: they meet no region that differs."""
    if outcome is None:
        return starts[:0]
    differs = outcome.visits[starts][:, changed(mixed, candidate)].any(1)
    return np.asarray(starts[~differs])


def _worse_than_the_mpc_somewhere(
    evidence: Evidence, trial: Outcome, some: NDArray[np.int64]
) -> bool:
    """Return whether some starts alone suffice to refuse, whatever the others cost."""
    lost = evidence.paired.lost(trial.costs)[some]
    return bool(lost.any() or np.any(trial.unsafe[some] > evidence.accepted.unsafe[some]))


def taken_over(
    before: ActorCheckpoint, candidate: ActorCheckpoint, accepted: ActorCheckpoint
) -> list[int]:
    """Return the regions in which the accepted networks are new, and the candidate's."""
    new = changed(before, accepted) & ~changed(candidate, accepted)
    return [int(region) for region in np.flatnonzero(new)]
