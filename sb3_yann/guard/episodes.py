"""Episodes of the guard's simulator, and what they say about a policy."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_yann.evaluation.episodes import Episodes, Predictor, evaluate
from sb3_yann.guard.actor_checkpoint import ActorCheckpoint
from sb3_yann.guard.rng import preserve_rng
from sb3_yann.guard.statistics import Paired

if TYPE_CHECKING:
    from sb3_yann.guard.callback import ImprovementGuard

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Outcome:
    """What came of a policy's episodes, in the order of their seeds.

    Attributes
    ----------
    costs : ndarray, shape (episodes,)
    unsafe : ndarray of int, shape (episodes, 3)
        Steps with a violation, whether the env terminated the episode, and whether its cost or an
        observation is no finite number.
    visits : ndarray of bool, shape (episodes, regions)
        Through which regions it comes: whatever the networks of the others become, the episode
        stays as it is.
    """

    costs: Array
    unsafe: NDArray[np.int64]
    visits: NDArray[np.bool_]

    def at(self, index: Any) -> Outcome:
        """Return some of the episodes."""
        return Outcome(self.costs[index], self.unsafe[index], self.visits[index])

    def and_also(self, other: Outcome) -> Outcome:
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
    def paired(self) -> Paired:
        """What judges the costs of a candidate from these starts."""
        return Paired(self.mpc.costs, self.accepted.costs, self.accepted.unsafe, self.margin)

    @property
    def visits(self) -> NDArray[np.bool_]:
        """Through which regions the accepted policy's episodes come."""
        return self.accepted.visits

    def of(self, accepted: Outcome) -> Evidence:
        """Return what stands for another policy from the same starts."""
        return Evidence(self.seeds, self.mpc, accepted, self.margin)


class Unplayable(Exception):
    """The policy's episodes cannot be played to their end; the message says why."""


@dataclass(frozen=True)
class _FinitePolicy:
    policy: Predictor
    seen: Callable[[Any], Any]

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, Any]:
        actions, state = self.policy.predict(self.seen(observation), deterministic=deterministic)
        if not np.all(np.isfinite(actions)):  # envs need not put up with it
            raise Unplayable("an action of the actor is not a finite number")
        return actions, state


def played(guard: ImprovementGuard, env: Any, seeds: Sequence[int]) -> Episodes:
    """Return the present policy's episodes; raises Unplayable, or what the env raises."""
    with preserve_rng():
        return evaluate(_FinitePolicy(guard.policy, _seen(guard)), env, seeds)


def play(guard: ImprovementGuard, env: Any, seeds: Sequence[int]) -> Outcome:
    """Return what comes of the present policy.

    Raises
    ------
    Unplayable
        If an action is not finite, or if the env raises an error under this policy, but not under
        the MPC from the same starts. An error that the MPC meets as well is the env's own.
    """
    try:
        return outcome_of(guard, played(guard, env, seeds))
    except Unplayable:
        raise
    except Exception as error:
        if guard.interrupted:  # what a simulator has made of it in compiled code of its own
            raise KeyboardInterrupt from error
        present = ActorCheckpoint.of(guard.policy)
        guard.mpc.restore(guard.policy)
        try:
            played(guard, env, seeds)
        finally:
            if not guard.interrupted:
                present.restore(guard.policy)
        reason = f"the simulator failed: {type(error).__name__}: {error}"
        raise Unplayable(reason) from error


def outcome_of(guard: ImprovementGuard, episodes: Episodes) -> Outcome:
    """Return what matters of the episodes."""
    finite = [np.all(np.isfinite(each)) for each in episodes.observations]
    lost = ~(np.isfinite(episodes.costs) & finite)
    unsafe = np.column_stack([episodes.violations, episodes.terminated, lost]).astype(np.int64)
    return Outcome(episodes.costs, unsafe, _visits(guard, episodes))


def evaluate_candidate(guard: ImprovementGuard, env: Any) -> tuple[Outcome | None, str]:
    """Return the episodes of the present policy and what speaks against it, if anything."""
    if not finite(guard):
        return None, "a parameter of the actor is not a finite number"
    evidence: Evidence = guard.state.evidence
    try:
        outcome = play(guard, env, evidence.seeds)
    except Unplayable as error:
        return None, str(error)
    return outcome, evidence.paired.objection(outcome.costs, outcome.unsafe)


def finite(guard: ImprovementGuard) -> bool:
    """Return whether all parameters of the actor are finite numbers."""
    return all(bool(th.isfinite(each).all()) for each in guard.policy.actor.parameters())


@contextmanager
def all_or_nothing(guard: ImprovementGuard) -> Iterator[ActorCheckpoint]:
    """Yield the candidate; bring it back, and what was accepted, if it is cut off by an error.

    Or by Ctrl-C: what is under trial stands in the place of what is accepted until it is over.
    """
    state, candidate = guard.state, ActorCheckpoint.of(guard.policy)
    before = state.accepted, state.evidence, [*state.passed]
    guard.before_trial = before
    try:
        yield candidate
    except BaseException:
        state.accepted, state.evidence, state.passed = before
        if not guard.interrupted:
            candidate.restore(guard.policy)
        raise
    finally:
        guard.before_trial = None


def _seen(guard: ImprovementGuard) -> Callable[[Any], Any]:
    """Return what turns an observation of the simulator into one that the policy has learnt from.

    The simulator is an env like the one below a VecNormalize.
    """
    normalize = guard.model.get_vec_normalize_env()
    return (lambda observation: observation) if normalize is None else normalize.normalize_obs


def _visits(guard: ImprovementGuard, episodes: Episodes) -> NDArray[np.bool_]:
    layer, seen = guard.policy.actor.mu, _seen(guard)
    visits = np.zeros((len(episodes.costs), len(layer.gains)), dtype=bool)
    for visited, states in zip(visits, episodes.observations, strict=True):
        theta = guard.policy.theta(seen(states[:-1]))
        visited[layer.regions(theta)] = True
    return visits
