"""Confirming on new starts what is about to be accepted; the hardest that it loses are kept."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sb3_yann.guard.actor_checkpoint import ActorCheckpoint
from sb3_yann.guard.episodes import Evidence, Outcome, Starts, Unplayable, play
from sb3_yann.guard.options import AcceptanceRule
from sb3_yann.guard.region_mixing import accept_parts, accepted_regions
from sb3_yann.guard.session import GuardSession
from sb3_yann.guard.statistics import is_above

ROUNDS = 3
"""How often the parts of what lost on new starts are played from others."""
SMALLER = 0.5, 0.25
"""Shares of its correction that a policy keeps which lost on new starts."""
MEMORY, MOST_KEPT = 10_000_000, 20
"""Bytes and number of earlier accepted checkpoints that are kept."""


def confirm_on_new_starts(
    session: GuardSession,
    n_starts: int,
    rule: AcceptanceRule,
    sure: float = 0.0,
    least: float = 0.0,
) -> str:
    """Play what is accepted from new starts; return why it was refused, empty where it was not.

    Of half or a quarter of its correction, and the latest earlier checkpoint that passes all of
    these starts, the better one is accepted instead; else the MPC.
    The hardest starts join those of every later candidate. Where the rule says so, single regions
    of what lost may still be accepted, and are confirmed on other new starts.

    Parameters
    ----------
    session : GuardSession
        Its accepted policy is tried.
    n_starts : int
        Number of new starts.
    rule : AcceptanceRule
        Whether regions, and smaller corrections, are tried.
    sure : float, default 0
        How many standard errors its mean cost, and the tail's, must be clear of the MPC's.
    least : float, default 0
        What it must gain on average, as a fraction of the MPC's mean cost.
    """
    tried = session.state.accepted
    reason = _confirm(session, n_starts, rule, (sure, least))
    return f"{reason}; {_what_acts(session, tried)}" if reason else ""


def _confirm(
    session: GuardSession, n_starts: int, rule: AcceptanceRule, bar: tuple[float, float]
) -> str:
    first, state = "", session.state
    for _ in range(ROUNDS):
        lost, evidence = state.accepted, state.evidence
        if n_starts == 0 or not session.has_learned(lost):
            return first
        new = _new_starts(session, n_starts, bar)
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
        _accept_less(session, lost if rule.retreat else session.mpc, new, hard)
        safe = state.accepted, state.evidence
        if rule.by_region:
            known = None if outcome is None else evidence.accepted.extended_by(outcome.at(hard))
            accept_parts(session, lost, known)
        if state.accepted is safe[0]:
            return first
    state.accept(*safe)  # what has not been confirmed on new starts is not accepted
    return first


def _what_acts(session: GuardSession, tried: ActorCheckpoint) -> str:
    """Say what is accepted in the place of a policy that lost."""
    accepted = session.state.accepted
    if not session.has_learned(accepted):
        return "the guard falls back to the MPC"
    for share in SMALLER:
        if accepted.has_networks_of(tried.shrunk(share)):
            return f"{100 * share:g} % of its correction is kept"
    if accepted_regions(session.mpc, tried, accepted):
        return "what it has learnt in other regions is kept"
    return "an earlier policy is restored"


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


def _new_starts(session: GuardSession, n_starts: int, bar: tuple[float, float]) -> Starts:
    """Return as many new starts, without those where the MPC's own cost is not finite."""
    state = session.state
    seeds = range(state.next_start, state.next_start + n_starts)
    state.new_starts, state.next_start = state.new_starts + n_starts, seeds.stop
    mpc, tolerance = play(session, session.mpc, seeds), state.evidence.tolerance
    finite = np.flatnonzero(np.isfinite(mpc.costs))
    new = Starts((*seeds,), mpc, tolerance, len(finite), *bar).at(finite)
    if not new.seeds:
        raise ValueError(
            f"The MPC's own cost is a finite number on none of {n_starts} new starts of the "
            "guard's env, so policies cannot be compared there. Its rewards must be finite."
        )
    return new


def _accept_less(
    session: GuardSession, lost: ActorCheckpoint, new: Starts, hard: NDArray[np.int64]
) -> None:
    """Accept a smaller correction or the latest earlier checkpoint that passes, else the MPC.

    It is tried on new starts, of which ``hard`` join the known ones.
    """
    state = session.state
    known = state.evidence.joined_with(new.at(hard))
    smaller = [(lost.shrunk(share), None) for share in SMALLER if session.has_learned(lost)]
    best, outcome = session.mpc, known.mpc
    for group in (smaller, [*reversed(state.passed)]):
        for checkpoint, had in group:
            try:
                found = _passing(session, checkpoint, had, new, hard)
            except Unplayable:
                continue
            if not is_above(found.costs, outcome.costs):
                best, outcome = checkpoint, found
            break
    state.accept(best, _evidence(known, outcome))
    if best is not session.mpc:
        keep_passed(session, best, outcome)


def _evidence(known: Starts, accepted: Outcome) -> Evidence:
    return Evidence(known.seeds, known.mpc, known.tolerance, known.n_starts, accepted=accepted)


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
    _check(new.at(np.concatenate([hard, others])), on_new)
    had = 0 if outcome is None else len(outcome.costs)
    on_known = _play_unless_lost(session, checkpoint, known.at(np.arange(had, len(known.seeds))))
    if outcome is not None:
        on_known = outcome.extended_by(on_known)
    everywhere = on_known.extended_by(on_hard)
    _check(known.joined_with(new.at(hard)), everywhere)
    return everywhere


def _play_unless_lost(
    session: GuardSession, checkpoint: ActorCheckpoint, starts: Starts
) -> Outcome:
    """Return a checkpoint's outcome; raise Unplayable where it loses already by these starts."""
    outcome = play(session, checkpoint, starts.seeds) if starts.seeds else starts.mpc
    if starts.seeds and starts.loses(outcome):
        raise Unplayable("it loses against the MPC")
    return outcome


def _check(starts: Starts, outcome: Outcome) -> None:
    if starts.loses(outcome) or starts.mean_is_above(outcome):
        raise Unplayable("it is worse than the MPC")
