"""Episodes of a checkpoint in the guard's simulator, and what they say about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.evaluation.episodes import Episodes, evaluate
from sb3_yann.guard.actor_checkpoint import ActorCheckpoint
from sb3_yann.guard.rng import preserve_rng
from sb3_yann.guard.session import GuardSession
from sb3_yann.guard.statistics import PairedEpisodes


@dataclass(frozen=True)
class Outcome:
    """What came of a policy's episodes, in the order of their seeds.

    Attributes
    ----------
    costs : ndarray, shape (episodes,)
    unsafe : ndarray of int, shape (episodes, 3)
        Steps with a violation, whether the env terminated the episode, and whether its cost or an
        observation is not finite.
    visits : ndarray of bool, shape (episodes, regions)
        Regions that it comes through: networks of the others have no effect on it.
    """

    costs: Array
    unsafe: NDArray[np.int64]
    visits: NDArray[np.bool_]

    def at(self, index: Any) -> Outcome:
        """Return some of the episodes."""
        return Outcome(self.costs[index], self.unsafe[index], self.visits[index])

    def extended_by(self, other: Outcome) -> Outcome:
        """Return the episodes of both."""
        return Outcome(
            np.concatenate([self.costs, other.costs]),
            np.concatenate([self.unsafe, other.unsafe]),
            np.concatenate([self.visits, other.visits]),
        )

    def replaced(self, index: Any, other: Outcome) -> Outcome:
        """Return a copy with other episodes in some places."""
        copy = Outcome(self.costs.copy(), self.unsafe.copy(), self.visits.copy())
        copy.costs[index], copy.unsafe[index] = other.costs, other.unsafe
        copy.visits[index] = other.visits
        return copy


@dataclass(frozen=True)
class Evidence:
    """The MPC's episodes and the accepted policy's: what a candidate is compared with."""

    seeds: tuple[int, ...]
    mpc: Outcome
    accepted: Outcome
    margin: float

    @property
    def paired(self) -> PairedEpisodes:
        """The costs that a candidate's are compared with."""
        return PairedEpisodes(
            self.mpc.costs, self.accepted.costs, self.accepted.unsafe, self.margin
        )

    @property
    def visits(self) -> NDArray[np.bool_]:
        """Regions that the accepted policy's episodes come through."""
        return self.accepted.visits

    def with_accepted(self, accepted: Outcome) -> Evidence:
        """Return the evidence for another accepted policy, from the same starts."""
        return Evidence(self.seeds, self.mpc, accepted, self.margin)


class Unplayable(Exception):
    """The policy's episodes cannot be played to their end; the message says why."""


@dataclass(frozen=True)
class _FinitePolicy:
    session: GuardSession

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, Any]:
        seen = self.session.seen(observation)
        actions, state = self.session.policy.predict(seen, deterministic=deterministic)
        if not np.all(np.isfinite(actions)):  # envs need not put up with it
            raise Unplayable("an action of the actor is not a finite number")
        return actions, state


def play_episodes(
    session: GuardSession, checkpoint: ActorCheckpoint, seeds: Sequence[int]
) -> Episodes:
    """Return a checkpoint's episodes; raise Unplayable, or what the env raises."""
    assert session.simulator is not None  # a plant alone plays nothing
    with session.playing(checkpoint), preserve_rng():
        return evaluate(_FinitePolicy(session), session.simulator, seeds)


def play(session: GuardSession, checkpoint: ActorCheckpoint, seeds: Sequence[int]) -> Outcome:
    """Return what comes of a checkpoint from seeded starts. The policy stays as it is.

    Raises
    ------
    Unplayable
        If an action is not finite, or if the env raises an error under this checkpoint, but not
        under the MPC from the same starts. An error that the MPC meets as well is the env's own.
    """
    try:
        return outcome_of(session, play_episodes(session, checkpoint, seeds))
    except Unplayable:
        raise
    except Exception as error:
        play_episodes(session, session.mpc, seeds)
        reason = f"the simulator failed: {type(error).__name__}: {error}"
        raise Unplayable(reason) from error


def outcome_of(session: GuardSession, episodes: Episodes) -> Outcome:
    """Return what matters of the episodes."""
    finite = [np.all(np.isfinite(each)) for each in episodes.observations]
    lost = ~(np.isfinite(episodes.costs) & finite)
    unsafe = np.column_stack([episodes.violations, episodes.terminated, lost]).astype(np.int64)
    return Outcome(episodes.costs, unsafe, _visits(session, episodes))


def evaluate_candidate(
    session: GuardSession, candidate: ActorCheckpoint
) -> tuple[Outcome | None, str]:
    """Return a candidate's episodes from the known starts, and why it is refused, if it is."""
    if not candidate.is_finite():
        return None, "a parameter of the actor is not a finite number"
    evidence: Evidence = session.state.evidence
    try:
        outcome = play(session, candidate, evidence.seeds)
    except Unplayable as error:
        return None, str(error)
    return outcome, evidence.paired.objection(outcome.costs, outcome.unsafe)


def _visits(session: GuardSession, episodes: Episodes) -> NDArray[np.bool_]:
    layer = session.policy.actor.mu
    visits = np.zeros((len(episodes.costs), len(layer.gains)), dtype=bool)
    for visited, states in zip(visits, episodes.observations, strict=True):
        theta = session.policy.theta(session.seen(states[:-1]))
        visited[layer.regions(theta)] = True
    return visits
