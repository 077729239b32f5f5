"""New starts for what is about to be accepted: those by which it loses are kept for good."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sb3_yann.evaluation import Episodes
from sb3_yann.guard.episodes import Evidence, NotFinite, judged, play, unsafe, visits_of
from sb3_yann.guard.judging import Paired
from sb3_yann.guard.regions import accept_parts
from sb3_yann.guard.snapshot import Snapshot

if TYPE_CHECKING:
    from sb3_yann.guard.callback import ImprovementGuard
    from sb3_yann.guard.simulator import SimulatorTrials

HARDEST = 10
"""New starts that are added at a time to those of every later trial."""
ROUNDS = 3
"""How often the parts of what lost on new starts are tried on others."""
VIOLATES: Final = "violates a limit"


@dataclass(frozen=True)
class _Hard:
    """New starts by which a policy lost."""

    reason: str
    seeds: tuple[int, ...]


def settle(guard: ImprovementGuard, trials: SimulatorTrials, n_starts: int) -> str:
    """Try what is accepted on new starts; where it loses, go back to what was accepted before.

    That is the last of what passed such a test and does not lose on these starts, or the MPC. The
    starts are among those of every later trial. The regions of what lost may be accepted one by
    one, and are then tried on new starts as well. Returns why it went back, empty where it did
    not. Leaves the policy changed.
    """
    first, state = "", guard.state
    for _ in range(ROUNDS):
        lost = state.accepted
        hard = _hard_starts(guard, trials, n_starts)
        if hard is None:
            trials.remember(lost)
            return first
        first = first or hard.reason
        trials.forget(lost)
        _go_back(guard, trials, hard)
        safe = state.accepted, state.evidence
        if trials.by_region:
            lost.restore(guard.policy)
            played, _ = judged(guard, trials.env)
            if played is not None:
                accept_parts(guard, trials.env, lost, played)
        if state.accepted is safe[0]:
            return first
    state.accepted, state.evidence = safe  # what has not been tried on new starts is not accepted
    return first


def _hard_starts(guard: ImprovementGuard, trials: SimulatorTrials, n_starts: int) -> _Hard | None:
    """Return those of so many new starts on which the accepted policy loses to the MPC."""
    state = guard.state
    state.accepted.restore(guard.policy)
    if n_starts == 0 or guard.policy.actor.mu.network.is_zero():
        return None
    begin = trials.seeds.stop + state.fresh
    state.fresh += n_starts
    seeds = range(begin, begin + n_starts)
    guard.mpc.restore(guard.policy)
    mpc = play(guard, trials.env, seeds)
    state.accepted.restore(guard.policy)
    try:
        played = play(guard, trials.env, seeds)
    except NotFinite:
        reason = "an action of the actor is not a finite number on new starts"
        return _Hard(reason, (seeds[0],))
    excess = np.nan_to_num(played.costs - mpc.costs, nan=np.inf)
    more = unsafe(played) > unsafe(mpc)
    worse = (excess > state.evidence.paired.margin) | more
    if not worse.any():
        return None
    order = np.argsort(np.where(worse, np.where(more, -np.inf, -excess), np.inf), kind="stable")
    hardest = order[: min(worse.sum(), HARDEST)]
    reason = (
        f"{worse.sum()} of {n_starts} new starts lose against the MPC, seed "
        f"{seeds[hardest[0]]} costs {excess[hardest[0]]:.4g} more"
    )
    if more.any():
        reason += f" and {VIOLATES}"
    return _Hard(reason, tuple(seeds[i] for i in hardest))


def _go_back(guard: ImprovementGuard, trials: SimulatorTrials, hard: _Hard) -> None:
    """Accept the last of what was accepted that does not lose on any start, or the MPC."""
    paired = guard.state.evidence.paired
    seeds = (*guard.state.evidence.seeds, *hard.seeds)
    guard.mpc.restore(guard.policy)
    mpc = play(guard, trials.env, seeds)
    for snapshot in reversed(trials.passed):
        snapshot.restore(guard.policy)
        for some in (hard.seeds, seeds):  # most fail on the first, which are few
            played = play(guard, trials.env, some)
            rest = slice(len(seeds) - len(some), None)
            more = unsafe(played) > unsafe(mpc)[rest]
            if not np.all(played.costs - mpc.costs[rest] <= paired.margin) or more.any():
                break
        else:
            _accept(guard, snapshot, seeds, mpc, played)
            return
    _accept(guard, guard.mpc, seeds, mpc, mpc)


def _accept(
    guard: ImprovementGuard,
    snapshot: Snapshot,
    seeds: tuple[int, ...],
    mpc: Episodes,
    played: Episodes,
) -> None:
    snapshot.restore(guard.policy)
    margin = guard.state.evidence.paired.margin
    paired = Paired(mpc.costs, played.costs, unsafe(played), margin)
    guard.accept(Evidence(seeds, paired, visits_of(guard, played)), snapshot)
