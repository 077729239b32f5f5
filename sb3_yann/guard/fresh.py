"""New starts for what is about to be accepted: those by which it loses are kept for good."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from sb3_yann.guard.episodes import Evidence, NotFinite, judged, play, unsafe, visits_of
from sb3_yann.guard.judging import Paired
from sb3_yann.guard.regions import accept_parts
from sb3_yann.guard.snapshot import Snapshot, same_networks

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
    """New starts by which a policy lost, and how the MPC does there."""

    reason: str
    seeds: tuple[int, ...]
    mpc_costs: NDArray[np.float64]
    mpc_violations: NDArray[np.int64]


def settle(
    guard: ImprovementGuard,
    trials: SimulatorTrials,
    before: tuple[Snapshot, Evidence] | None,
    n_starts: int,
) -> str:
    """Try what is accepted on new starts; where it loses, go back to what was before.

    Or to the MPC, if that loses there as well, or nothing is known. The starts by which it lost
    are among those of every later trial. The regions of either may be accepted one by one, and are
    then tried on new starts as well. Returns why it went back, empty where it did not. Leaves
    the policy changed.
    """
    first, state = "", guard.state
    for _ in range(ROUNDS):
        if before is not None and same_networks(state.accepted, before[0]):
            return first
        lost = state.accepted
        hard = _hard_starts(guard, trials, n_starts)
        if hard is None:
            return first
        first = first or hard.reason
        tested = () if before is None else (before[0],)
        _go_back(guard, trials.env, before, hard)
        before = state.accepted, state.evidence
        for snapshot in (*tested, lost) if trials.by_region else ():
            if not same_networks(state.accepted, snapshot):
                snapshot.restore(guard.policy)
                played, _ = judged(guard, trials.env)
                if played is not None:
                    accept_parts(guard, trials.env, snapshot, played)
    # What has not been tried on new starts is not accepted.
    state.accepted, state.evidence = before or (state.accepted, state.evidence)
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
        return _Hard(reason, (seeds[0],), mpc.costs[:1], unsafe(mpc)[:1])
    excess, more = played.costs - mpc.costs, unsafe(played) > unsafe(mpc)
    worse = ~(excess <= state.evidence.paired.margin) | more
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
    return _Hard(reason, tuple(seeds[i] for i in hardest), mpc.costs[hardest], unsafe(mpc)[hardest])


def _go_back(
    guard: ImprovementGuard, env: Any, before: tuple[Snapshot, Evidence] | None, hard: _Hard
) -> None:
    """Accept what was before, or the MPC, with the hard starts among the others."""
    margin = guard.state.evidence.paired.margin
    if before is not None:
        snapshot, evidence = before
        snapshot.restore(guard.policy)
        played = play(guard, env, hard.seeds)
        paired = Paired(hard.mpc_costs, played.costs, unsafe(played), margin)
        if not (paired.lost(played.costs) | (paired.violations > hard.mpc_violations)).any():
            there = Evidence(hard.seeds, paired, visits_of(guard, played))
            guard.accept(evidence.and_also(there), snapshot)
            return
    seeds = (*guard.state.evidence.seeds, *hard.seeds)
    guard.mpc.restore(guard.policy)
    played = play(guard, env, seeds)
    paired = Paired(played.costs, played.costs, unsafe(played), margin)
    guard.accept(Evidence(seeds, paired, visits_of(guard, played)), guard.mpc)
