"""Episodes of a checkpoint in the guard's simulator, and what they say about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.compare import EXCESS_ROOM, less_safe, unsafe_columns
from sb3_yann.control.mpc.bound_excess import excess_of_episodes
from sb3_yann.evaluation.episodes import LONGEST, Episodes, evaluate
from sb3_yann.guard.actor_checkpoint import DIVERGED, ActorCheckpoint
from sb3_yann.guard.rng import preserve_rng
from sb3_yann.guard.session import GuardSession
from sb3_yann.guard.statistics import PairedEpisodes, Tolerance, is_above, told_apart

HARDEST = 10
"""New starts that join those of every later candidate at a time."""
WEARS = 3
"""The column of large steps of an input: after all others there is no patience."""
VIOLATES: Final = "violates a limit"


class Outcome(NamedTuple):
    """What came of a policy's episodes, in the order of their seeds.

    Costs count the penalty of soft bounds. What is ``unsafe`` (episodes, 7) is that of
    :func:`~sb3_yann.compare.unsafe_columns`. ``visits`` (episodes, regions) tells which regions it
    comes through: other networks have no effect on it.
    """

    costs: Array
    unsafe: Array
    visits: NDArray[np.bool_]

    def breaks_more_than(self, other: Outcome, room: float = EXCESS_ROOM) -> bool:
        """Return whether it is less safe: a large step of an input wears, and breaks nothing."""
        return bool(np.any(np.delete(less_safe(self.unsafe, other.unsafe, room), WEARS, axis=1)))

    def at(self, index: Any) -> Outcome:
        """Return some of the episodes."""
        return Outcome._make(each[index] for each in self)

    def extended_by(self, other: Outcome) -> Outcome:
        """Return the episodes of both."""
        return Outcome._make(map(np.concatenate, zip(self, other, strict=True)))

    def replaced(self, index: Any, other: Outcome) -> Outcome:
        """Return a copy with other episodes in some places."""
        copy = Outcome._make(each.copy() for each in self)
        for ours, theirs in zip(copy, other, strict=True):
            ours[index] = theirs
        return copy


@dataclass(frozen=True)
class Starts:
    """Starts, and what came of them under the MPC.

    Attributes
    ----------
    seeds, mpc : tuple of int and Outcome
    tolerance : Tolerance, what they may cost more than with the MPC
    n_starts : int, of so many they are those that count
    sure : float, how many standard errors the mean cost, and the tail's, must be clear of the MPC's
    least : float, what the mean must gain, as a fraction of the MPC's
    """

    seeds: tuple[int, ...]
    mpc: Outcome
    tolerance: Tolerance
    n_starts: int
    sure: float = 0.0
    least: float = 0.0

    def at(self, index: Any) -> Starts:
        """Return some of them, which stand for as many."""
        seeds = tuple(np.array(self.seeds)[index].tolist())
        mpc, bar = self.mpc.at(index), (self.sure, self.least)
        return Starts(seeds, mpc, self.tolerance, self.n_starts, *bar)

    def joined_with(self, other: Starts) -> Starts:
        """Return the starts of both."""
        seeds, count = (*self.seeds, *other.seeds), self.n_starts + other.n_starts
        return Starts(seeds, self.mpc.extended_by(other.mpc), self.tolerance, count)

    def excess(self, outcome: Outcome) -> Array:
        """Return what each costs more than with the MPC, in what it may; inf for nan."""
        return self.tolerance.excess(self.mpc.costs, outcome.costs)

    def more_unsafe(self, outcome: Outcome) -> NDArray[np.bool_]:
        """Return which break a limit, end early or are not finite, more often than with the MPC."""
        return np.asarray(
            less_safe(outcome.unsafe, self.mpc.unsafe, self.tolerance.excess_room).any(1)
        )

    def lost(self, outcome: Outcome) -> NDArray[np.bool_]:
        """Return which a policy loses against the MPC."""
        return (self.excess(outcome) > 1.0) | self.more_unsafe(outcome)

    def loses(self, outcome: Outcome) -> bool:
        """Return whether a policy loses too many or too much of them, or is less safe."""
        excess = self.excess(outcome)
        costly = bool(self.tolerance.objection(excess, self.n_starts, self.sure))
        return costly or bool(self.more_unsafe(outcome).any())

    def mean_is_above(self, outcome: Outcome) -> bool:
        """Return whether the mean cost is above the MPC's, by more than rounding.

        Where it must be clear of it, its upper confidence limit must be below, and it itself by
        the least gain.
        """
        more = outcome.costs - self.mpc.costs
        error = self.sure * more.std() / np.sqrt(len(more)) if self.sure else 0.0
        above = is_above(outcome.costs, self.mpc.costs, error)
        return above or self.gains_too_little(outcome)

    def gains_too_little(self, outcome: Outcome) -> bool:
        """Return whether the mean cost is not below the MPC's by the least gain."""
        gained = self.mpc.costs.mean() - outcome.costs.mean()
        return bool(self.least and not gained >= self.least * np.abs(self.mpc.costs).mean())

    def objection(self, outcome: Outcome) -> str:
        """Return why a policy is refused on these starts, empty where it is not."""
        if self.loses(outcome):
            first = self.hardest(outcome)[0]
            unsafe, breaks = (
                self.more_unsafe(outcome).any(),
                outcome.breaks_more_than(self.mpc, self.tolerance.excess_room),
            )
            also = f" and {VIOLATES if breaks else 'moves an input too far'}" if unsafe else ""
            more = (outcome.costs - self.mpc.costs)[first]
            return (
                f"{self.lost(outcome).sum()} of {len(self.seeds)} new starts lose against the MPC, "
                f"seed {self.seeds[first]} costs {more:.4g} more{also}"
            )
        if self.mean_is_above(outcome):
            mean, mpc = outcome.costs.mean(), self.mpc.costs.mean()
            costs = told_apart(mean, mpc)
            found = f"mean cost {costs[0]} on {len(self.seeds)} new starts, MPC {costs[1]}"
            if is_above(outcome.costs, self.mpc.costs):
                return found
            little = self.gains_too_little(outcome)
            return f"{found}: too little a gain" if little else f"{found}: not surely below"
        return ""

    def hardest(self, outcome: Outcome | None) -> NDArray[np.int64]:
        """Return the hardest that cost more than with the MPC; the first without an outcome."""
        if outcome is None:
            return np.zeros(1, dtype=np.int64)
        excess, more = self.excess(outcome), self.more_unsafe(outcome)
        order = np.argsort(np.where(more, -np.inf, -excess), kind="stable")
        worse = self.lost(outcome)
        return order[: min(HARDEST, worse.sum() or np.count_nonzero(excess > 0))]


@dataclass(frozen=True)
class Evidence(Starts):
    """The MPC's episodes and the accepted policy's: what a candidate is compared with.

    Attributes
    ----------
    seeds : tuple of int, the known starts
    mpc, accepted : Outcome, what came of the MPC and of the accepted policy
    tolerance : Tolerance, what they may cost more than with the MPC
    n_starts : int, of so many they are those that count
    sure, least : float, as of all starts
    """

    accepted: Outcome = field(kw_only=True)

    @property
    def paired(self) -> PairedEpisodes:
        """The costs that a candidate's are compared with."""
        costs = self.mpc.costs, self.accepted.costs
        # Neither is exceeded: a tolerance over the accepted policy alone would add up.
        unsafe = np.minimum(self.accepted.unsafe, self.mpc.unsafe)
        return PairedEpisodes(*costs, unsafe, self.tolerance, self.n_starts)

    @property
    def visits(self) -> NDArray[np.bool_]:
        """Regions that the accepted policy's episodes come through."""
        return self.accepted.visits


class Unplayable(Exception):
    """The policy's episodes cannot be played to their end; the message says why."""


@dataclass(frozen=True)
class _FinitePolicy:
    session: GuardSession

    @property
    def told(self) -> bool:
        """Whether the user said what an env shows."""
        return self.session.policy.told

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, Any]:
        seen = self.session.seen(observation)
        actions, state = self.session.policy.predict(seen, deterministic=deterministic)
        if not np.all(np.isfinite(actions)):  # of a subclass: the actor itself puts out no NaN
            raise Unplayable("an action of the actor is not a finite number")
        return actions, state


def play_episodes(
    session: GuardSession, checkpoint: ActorCheckpoint, seeds: Sequence[int]
) -> Episodes:
    """Return a checkpoint's episodes; raise Unplayable, or what the env raises."""
    with session.playing(checkpoint), preserve_rng():
        return evaluate(_FinitePolicy(session), session.envs, seeds)


def play(session: GuardSession, checkpoint: ActorCheckpoint, seeds: Sequence[int]) -> Outcome:
    """Return what comes of a checkpoint from seeded starts. The policy stays as it is.

    Raise Unplayable if an action is not finite, or if the env raises an error under this
    checkpoint, but not under the MPC from the same starts: an error of both is the env's own.
    """
    try:
        return outcome_of(session, play_episodes(session, checkpoint, seeds))
    except Unplayable:
        raise
    except Exception as error:
        if session.interrupted:  # a simulator has made of it what it can, e.g. in compiled code
            raise KeyboardInterrupt from error
        play_episodes(session, session.mpc, seeds)
        raise Unplayable(f"the simulator failed: {type(error).__name__}: {error}") from error


def outcome_of(session: GuardSession, episodes: Episodes) -> Outcome:
    """Return what matters of the episodes."""
    finite = [np.all(np.isfinite(each)) for each in episodes.observations]
    lost = ~(np.isfinite(episodes.costs) & finite)
    bound = session.state.input_step
    moved = [np.abs(np.diff(each, axis=0)) for each in episodes.actions]
    far = [0 if bound is None else np.any(each > bound, axis=1).sum() for each in moved]
    policy, layer = session.policy, session.policy.actor.mu
    thetas = [policy.theta(session.seen(states)) for states in episodes.observations]
    inputs = [policy.inputs(actions) for actions in episodes.actions]
    pairs = zip((each.double().cpu().numpy() for each in thetas), inputs, strict=True)
    excess = excess_of_episodes(policy.problem, pairs)
    lengths = np.array([len(each) for each in episodes.actions])
    sooner = np.where(episodes.terminated, LONGEST + 1 - lengths, 0)  # 0 where it did not end it
    unsafe = unsafe_columns(episodes.violations, sooner, lost, excess, far)
    visits = np.zeros((len(episodes.costs), layer.n_networks), dtype=bool)
    for visited, theta in zip(visits, thetas, strict=True):
        visited[layer.regions(theta[:-1])] = True
    return Outcome(episodes.costs + excess.penalty, unsafe, visits)


def evaluate_candidate(
    session: GuardSession, candidate: ActorCheckpoint
) -> tuple[Outcome | None, str]:
    """Return a candidate's episodes from the known starts, and why it is refused, if it is."""
    if candidate.has_diverged():
        return None, DIVERGED
    evidence: Evidence = session.state.evidence
    try:
        outcome = play(session, candidate, evidence.seeds)
    except Unplayable as error:
        return None, str(error)
    return outcome, evidence.paired.objection(outcome.costs, outcome.unsafe)
