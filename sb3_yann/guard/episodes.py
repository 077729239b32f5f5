"""Episodes of the guard's simulator, and what they say about a policy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_yann.evaluation import Episodes, Predictor, evaluate
from sb3_yann.guard.judging import Paired

if TYPE_CHECKING:
    from sb3_yann.guard.callback import ImprovementGuard


@dataclass(frozen=True)
class Evidence:
    """The accepted policy's episodes: what a candidate is compared with.

    ``visits[i, r]`` says whether the episode from start i comes through region r: the others go on
    as they are, whatever the network of r becomes.
    """

    seeds: tuple[int, ...]
    paired: Paired
    visits: NDArray[np.bool_]

    def and_also(self, other: Evidence) -> Evidence:
        """Return the evidence from the starts of both."""
        return Evidence(
            (*self.seeds, *other.seeds),
            self.paired.and_also(other.paired),
            np.concatenate([self.visits, other.visits]),
        )


class NotFinite(Exception):
    """An action of the policy is not a finite number; envs need not put up with one."""


@dataclass(frozen=True)
class _FinitePolicy:
    policy: Predictor
    seen: Callable[[Any], Any]

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, Any]:
        actions, state = self.policy.predict(self.seen(observation), deterministic=deterministic)
        if not np.all(np.isfinite(actions)):
            raise NotFinite
        return actions, state


def play(guard: ImprovementGuard, env: Any, seeds: Sequence[int]) -> Episodes:
    """Return the present policy's episodes; raises NotFinite."""
    return evaluate(_FinitePolicy(guard.policy, _seen(guard)), env, seeds)


def judged(guard: ImprovementGuard, env: Any) -> tuple[Episodes | None, str]:
    """Return the episodes of the present policy and what speaks against it, if anything."""
    if not all(bool(th.isfinite(each).all()) for each in guard.policy.actor.parameters()):
        return None, "a parameter of the actor is not a finite number"
    evidence: Evidence = guard.state.evidence
    try:
        played = play(guard, env, evidence.seeds)
    except NotFinite:
        return None, "an action of the actor is not a finite number"
    return played, evidence.paired.objection(played.costs, unsafe(played))


def evidence_of(guard: ImprovementGuard, played: Episodes) -> Evidence:
    """Return what stands for the policy of these episodes, from the starts of the accepted one."""
    evidence: Evidence = guard.state.evidence
    paired = replace(evidence.paired, costs=played.costs, violations=unsafe(played))
    return Evidence(evidence.seeds, paired, visits_of(guard, played))


def unsafe(played: Episodes) -> NDArray[np.int64]:
    """Return the violations of each episode; to be terminated counts as one."""
    return np.maximum(played.violations, played.terminated)


def _seen(guard: ImprovementGuard) -> Callable[[Any], Any]:
    """Return what turns an observation of the simulator into one that the policy has learnt from.

    The simulator is an env like the one below a VecNormalize.
    """
    normalize = guard.model.get_vec_normalize_env()
    return (lambda observation: observation) if normalize is None else normalize.normalize_obs


def visits_of(guard: ImprovementGuard, played: Episodes) -> NDArray[np.bool_]:
    """Return which regions each episode comes through, shape (episodes, regions)."""
    layer, seen = guard.policy.actor.mu, _seen(guard)
    visits = np.zeros((len(played.costs), len(layer.gains)), dtype=bool)
    for visited, states in zip(visits, played.observations, strict=True):
        theta = guard.policy.theta(seen(states[:-1]))
        visited[layer.locate(theta)[0].cpu().numpy()] = True
    return visits
