"""New starts for what is about to be accepted: the hardest of those by which it loses are kept."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from sb3_yann.guard.actor_checkpoint import ActorCheckpoint, same_networks
from sb3_yann.guard.episodes import Evidence, Outcome, Unplayable, play
from sb3_yann.guard.region_mixing import accept_parts

if TYPE_CHECKING:
    from sb3_yann.guard.callback import ImprovementGuard
    from sb3_yann.guard.simulator_acceptance import SimulatorAcceptance

HARDEST = 10
"""New starts that are added at a time to those of every later trial."""
ROUNDS = 3
"""How often the parts of what lost on new starts are tried on others."""
ROUNDING = 1e-6
"""Relative difference of mean costs that float32 makes between batches of other sizes."""
MEMORY, MOST_KEPT = 10_000_000, 20
"""Bytes and number of earlier accepted policies that are kept to go back to."""
VIOLATES: Final = "violates a limit"


@dataclass(frozen=True)
class NewStarts:
    """Starts that no trial has had, and what came of them under the MPC."""

    seeds: tuple[int, ...]
    mpc: Outcome
    margin: float

    def at(self, index: Any) -> NewStarts:
        """Return some of them."""
        seeds = tuple(np.array(self.seeds)[index].tolist())
        return NewStarts(seeds, self.mpc.at(index), self.margin)

    def excess(self, outcome: Outcome) -> NDArray[np.float64]:
        """Return what each costs more than with the MPC; inf where that cannot be told."""
        return np.asarray(np.nan_to_num(outcome.costs - self.mpc.costs, nan=np.inf))

    def more_unsafe(self, outcome: Outcome) -> NDArray[np.bool_]:
        """Return which violate a limit more often than with the MPC, or are terminated."""
        return np.asarray((outcome.unsafe > self.mpc.unsafe).any(1))

    def lost(self, outcome: Outcome) -> NDArray[np.bool_]:
        """Return which a policy loses against the MPC."""
        return (self.excess(outcome) > self.margin) | self.more_unsafe(outcome)

    def mean_is_above(self, outcome: Outcome) -> bool:
        """Return whether the mean cost is above the MPC's, by more than rounding."""
        rounding = ROUNDING * np.abs(self.mpc.costs).mean()
        return not outcome.costs.mean() <= self.mpc.costs.mean() + rounding

    def objection(self, outcome: Outcome) -> str:
        """Return why a policy is refused on these starts, empty where it is not."""
        lost, excess = self.lost(outcome), self.excess(outcome)
        if lost.any():
            first = self.hardest(outcome)[0]
            return (
                f"{lost.sum()} of {len(self.seeds)} new starts lose against the MPC, seed "
                f"{self.seeds[first]} costs {excess[first]:.4g} more"
                + (f" and {VIOLATES}" if self.more_unsafe(outcome).any() else "")
            )
        if self.mean_is_above(outcome):
            return (
                f"mean cost {outcome.costs.mean():.6g} on {len(self.seeds)} new starts, "
                f"MPC {self.mpc.costs.mean():.6g}"
            )
        return ""

    def hardest(self, outcome: Outcome | None) -> NDArray[np.int64]:
        """Return the places of the hardest of those that cost more than with the MPC.

        The first one where there is no outcome.
        """
        if outcome is None:
            return np.zeros(1, dtype=np.int64)
        excess, more = self.excess(outcome), self.more_unsafe(outcome)
        order = np.argsort(np.where(more, -np.inf, -excess), kind="stable")
        worse = self.lost(outcome)
        return order[: min(HARDEST, worse.sum() or np.count_nonzero(excess > 0))]


def confirm_on_new_starts(
    guard: ImprovementGuard, trials: SimulatorAcceptance, n_starts: int
) -> str:
    """Try what is accepted on new starts; where it loses, go back to what was accepted before.

    That is the last of what was accepted earlier that passes on all of these starts, or the MPC.
    The hardest starts are among those of every later trial. The regions of what lost may be
    accepted one by one, and are then tried on new starts as well. Returns why it went back, empty
    where it did not. Leaves the policy changed.
    """
    first, state = "", guard.state
    for _ in range(ROUNDS):
        lost, evidence = state.accepted, state.evidence
        new = _new_starts(guard, trials, n_starts)
        if new is None:
            return first
        if not new.seeds:
            raise ValueError(
                f"The MPC's own cost is not a finite number on any of {n_starts} new starts of the "
                "guard's env: policies cannot be compared there."
            )
        outcome, reason = _tried(guard, trials, new)
        if not reason:
            remember(guard, lost, evidence.accepted)
            return first
        first = first or reason
        forget(guard, lost)
        hard = new.hardest(outcome)
        _go_back(guard, trials, new, hard)
        safe = state.accepted, state.evidence
        if trials.by_region:
            known = None if outcome is None else evidence.accepted.and_also(outcome.at(hard))
            accept_parts(guard, trials.env, lost, known)
        if state.accepted is safe[0]:
            return first
    state.accepted, state.evidence = safe  # what has not been tried on new starts is not accepted
    return first


def remember(guard: ImprovementGuard, checkpoint: ActorCheckpoint, outcome: Outcome | None) -> None:
    """Keep what was accepted, with its outcome on the known starts, as far as memory allows."""
    forget(guard, checkpoint)
    if same_networks(checkpoint, guard.mpc):  # which is always there
        return
    passed = guard.state.passed
    passed.append((checkpoint, outcome))
    most = min(len(passed), MOST_KEPT, max(1, MEMORY // checkpoint.size))
    del passed[:-most]


def forget(guard: ImprovementGuard, checkpoint: ActorCheckpoint) -> None:
    """Remove what lost on new starts after all."""
    passed = guard.state.passed
    passed[:] = [each for each in passed if not same_networks(each[0], checkpoint)]


def _new_starts(
    guard: ImprovementGuard, trials: SimulatorAcceptance, n_starts: int
) -> NewStarts | None:
    """Return as many new starts, None where there is nothing to be tried on them."""
    state = guard.state
    state.accepted.restore(guard.policy)
    if n_starts == 0 or guard.policy.actor.mu.network.is_zero():
        return None
    begin = state.next_start
    state.fresh, state.next_start = state.fresh + n_starts, begin + n_starts
    seeds = range(begin, begin + n_starts)
    guard.mpc.restore(guard.policy)
    new = NewStarts((*seeds,), play(guard, trials.env, seeds), state.evidence.margin)
    # Where the MPC's own cost is no number there is nothing to compare with.
    return new.at(np.flatnonzero(np.isfinite(new.mpc.costs)))


def _tried(
    guard: ImprovementGuard, trials: SimulatorAcceptance, new: NewStarts
) -> tuple[Outcome | None, str]:
    """Return what came of the accepted policy on new starts, and what speaks against it."""
    guard.state.accepted.restore(guard.policy)
    try:
        outcome = play(guard, trials.env, new.seeds)
    except Unplayable as error:
        return None, f"on new starts, {error}"
    return outcome, new.objection(outcome)


def _go_back(
    guard: ImprovementGuard, trials: SimulatorAcceptance, new: NewStarts, hard: NDArray[np.int64]
) -> None:
    """Accept the last of what was accepted that loses on no new start, or the MPC."""
    evidence: Evidence = guard.state.evidence
    some = new.at(hard)
    seeds, mpc = (*evidence.seeds, *some.seeds), evidence.mpc.and_also(some.mpc)
    for checkpoint, outcome in reversed(guard.state.passed):
        checkpoint.restore(guard.policy)
        everywhere = _passes(guard, trials, evidence, outcome, new, hard)
        if everywhere is not None:
            guard.accept(Evidence(seeds, mpc, everywhere, evidence.margin), checkpoint)
            remember(guard, checkpoint, everywhere)
            return
    guard.accept(Evidence(seeds, mpc, mpc, evidence.margin), guard.mpc)


def _passes(
    guard: ImprovementGuard,
    trials: SimulatorAcceptance,
    evidence: Evidence,
    outcome: Outcome | None,
    new: NewStarts,
    hard: NDArray[np.int64],
) -> Outcome | None:
    """Return the present policy's outcome on the known starts and the hard ones, if it passes.

    None where it loses. It is played on the hard ones first, which are few and of which most
    policies lose some, then on the other new ones, and on those known ones it has not had.
    """
    others = np.setdiff1d(np.arange(len(new.seeds)), hard)
    known = NewStarts(evidence.seeds, evidence.mpc, evidence.margin)
    missing = known.at(np.arange(0 if outcome is None else len(outcome.costs), len(known.seeds)))
    on_hard = _unless_lost(guard, trials, new.at(hard))
    on_others = None if on_hard is None else _unless_lost(guard, trials, new.at(others))
    if on_hard is None or on_others is None:
        return None
    if new.at(np.concatenate([hard, others])).mean_is_above(on_hard.and_also(on_others)):
        return None
    on_missing = _unless_lost(guard, trials, missing)
    if on_missing is None:
        return None
    on_known = on_missing if outcome is None else outcome.and_also(on_missing)
    everywhere = on_known.and_also(on_hard)
    mpc = evidence.mpc.and_also(new.mpc.at(hard))
    all_known = NewStarts((*known.seeds, *new.at(hard).seeds), mpc, evidence.margin)
    return None if all_known.mean_is_above(everywhere) else everywhere


def _unless_lost(
    guard: ImprovementGuard, trials: SimulatorAcceptance, starts: NewStarts
) -> Outcome | None:
    """Return the present policy's outcome, None where it loses one of the starts."""
    if not starts.seeds:
        return starts.mpc
    try:
        outcome = play(guard, trials.env, starts.seeds)
    except Unplayable:
        return None
    return None if starts.lost(outcome).any() else outcome
