"""Confirming on new starts what is about to be accepted; the hardest that it loses are kept."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sb3_yann.guard.actor_checkpoint import ActorCheckpoint
from sb3_yann.guard.episodes import Evidence, Outcome, Starts, Unplayable, play
from sb3_yann.guard.region_mixing import accept_parts
from sb3_yann.guard.session import GuardSession

ROUNDS = 3
"""How often the parts of what lost on new starts are played from others."""
MEMORY, MOST_KEPT = 10_000_000, 20
"""Bytes and number of earlier accepted checkpoints that are kept."""


def confirm_on_new_starts(session: GuardSession, n_starts: int, by_region: bool) -> str:
    """Play what is accepted from new starts; return why it was refused, empty where it was not.

    The latest earlier checkpoint that passes all of these starts is accepted instead, else the MPC.
    The hardest starts join those of every later candidate. With ``by_region``, single regions of
    what lost may still be accepted, and are confirmed on other new starts.
    """
    first, state = "", session.state
    for _ in range(ROUNDS):
        lost, evidence = state.accepted, state.evidence
        if n_starts == 0 or not session.has_learned(lost):
            return first
        new = _new_starts(session, n_starts)
        outcome: Outcome | None = None
        try:
            outcome = play(session, lost, new.seeds)
            reason = new.objection(outcome)
        except Unplayable as error:
            reason = f"on new starts, {error}"
        if not reason:
            keep_passed(session, lost, evidence.accepted)
            return first
        first = first or reason
        drop_passed(session, lost)
        hard = new.hardest(outcome)
        _accept_earlier(session, new, hard)
        safe = state.accepted, state.evidence
        if by_region:
            known = None if outcome is None else evidence.accepted.extended_by(outcome.at(hard))
            accept_parts(session, lost, known)
        if state.accepted is safe[0]:
            return first
    state.accept(*safe)  # what has not been confirmed on new starts is not accepted
    return first


def keep_passed(
    session: GuardSession, checkpoint: ActorCheckpoint, outcome: Outcome | None
) -> None:
    """Keep what was accepted, with its outcome on the known starts, as far as memory allows."""
    drop_passed(session, checkpoint)
    if checkpoint.has_networks_of(session.mpc):  # which is always there
        return
    passed = session.state.passed
    passed.append((checkpoint, outcome))
    most = min(len(passed), MOST_KEPT, max(1, MEMORY // checkpoint.size))
    del passed[:-most]


def drop_passed(session: GuardSession, checkpoint: ActorCheckpoint) -> None:
    """Drop a checkpoint that lost on new starts after all."""
    passed = session.state.passed
    passed[:] = [each for each in passed if not each[0].has_networks_of(checkpoint)]


def _new_starts(session: GuardSession, n_starts: int) -> Starts:
    """Return as many new starts, without those where the MPC's own cost is not finite."""
    state = session.state
    seeds = range(state.next_start, state.next_start + n_starts)
    state.new_starts, state.next_start = state.new_starts + n_starts, seeds.stop
    new = Starts((*seeds,), play(session, session.mpc, seeds), state.evidence.margin)
    new = new.at(np.flatnonzero(np.isfinite(new.mpc.costs)))
    if not new.seeds:
        raise ValueError(
            f"The MPC's own cost is a finite number on none of {n_starts} new starts of the "
            "guard's env, so policies cannot be compared there. Its rewards must be finite."
        )
    return new


def _accept_earlier(session: GuardSession, new: Starts, hard: NDArray[np.int64]) -> None:
    """Accept the latest earlier checkpoint that loses on no new start, else the MPC."""
    state = session.state
    known = state.evidence.joined_with(new.at(hard))
    for checkpoint, outcome in reversed(state.passed):
        try:
            everywhere = _passing(session, checkpoint, outcome, new, hard)
        except Unplayable:
            continue
        state.accept(checkpoint, Evidence(known.seeds, known.mpc, known.margin, everywhere))
        keep_passed(session, checkpoint, everywhere)
        return
    state.accept(session.mpc, Evidence(known.seeds, known.mpc, known.margin, known.mpc))


def _passing(
    session: GuardSession,
    checkpoint: ActorCheckpoint,
    outcome: Outcome | None,
    new: Starts,
    hard: NDArray[np.int64],
) -> Outcome:
    """Return a checkpoint's outcome on the known starts and the hard ones; else raise Unplayable.

    The hard ones come first: they are few, and most checkpoints lose some. Then come the other new
    ones, and those known ones that its ``outcome`` lacks.
    """
    known: Evidence = session.state.evidence
    others = np.setdiff1d(np.arange(len(new.seeds)), hard)
    on_hard = _play_unless_lost(session, checkpoint, new.at(hard))
    on_new = on_hard.extended_by(_play_unless_lost(session, checkpoint, new.at(others)))
    _check_mean(new.at(np.concatenate([hard, others])), on_new)
    had = 0 if outcome is None else len(outcome.costs)
    on_known = _play_unless_lost(session, checkpoint, known.at(np.arange(had, len(known.seeds))))
    if outcome is not None:
        on_known = outcome.extended_by(on_known)
    everywhere = on_known.extended_by(on_hard)
    _check_mean(known.joined_with(new.at(hard)), everywhere)
    return everywhere


def _play_unless_lost(
    session: GuardSession, checkpoint: ActorCheckpoint, starts: Starts
) -> Outcome:
    """Return a checkpoint's outcome; raise Unplayable where it loses one of the starts."""
    outcome = play(session, checkpoint, starts.seeds) if starts.seeds else starts.mpc
    if starts.lost(outcome).any():
        raise Unplayable("a start is lost")
    return outcome


def _check_mean(starts: Starts, outcome: Outcome) -> None:
    if starts.mean_is_above(outcome):
        raise Unplayable("the mean cost is above the MPC's")
