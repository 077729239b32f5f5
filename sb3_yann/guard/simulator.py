"""Decisions by paired episodes in a simulator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_yann.evaluation import Episodes, evaluate
from sb3_yann.guard.judging import Paired
from sb3_yann.guard.record import Decision
from sb3_yann.guard.snapshot import Snapshot, network_of, same

if TYPE_CHECKING:
    from sb3_yann.guard.callback import ImprovementGuard


@dataclass(frozen=True)
class Evidence:
    """The accepted policy's episodes: what a candidate is compared with.

    ``visits[i, r]`` says whether the episode from start i comes through region r: the others go on
    as they are, whatever the network of r becomes.
    """

    paired: Paired
    visits: NDArray[np.bool_]


class SimulatorTrials:
    """Tries each candidate on the same seeded starts."""

    def __init__(
        self,
        env: str | gym.Env[Any, Any] | Callable[[], gym.Env[Any, Any]],
        n_starts: int,
        seed: int,
        every: int,
        margin: float,
        by_region: bool,
        patience: int,
    ) -> None:
        self.env, self.every, self.margin, self.by_region = env, every, margin, by_region
        self.patience, self.rejections = patience, 0
        self.seeds = range(seed, seed + n_starts)
        self.settings = {"env": _name(env), "seeds": self.seeds, "margin": margin}

    def start(self, guard: ImprovementGuard) -> None:
        """Check that the simulator is not the training env."""
        training = [env.unwrapped for env in getattr(guard.training_env, "envs", [])]
        if isinstance(self.env, gym.Env) and any(self.env.unwrapped is env for env in training):
            raise ValueError(
                "The guard's env is the training env, whose episodes its own would interrupt. "
                "Give it another one, e.g. its id."
            )
        self.last_trial = -self.every  # the first episode that ends is always followed by a trial

    def first_evidence(self, guard: ImprovementGuard) -> None:
        """Play the episodes of the MPC, and accept the policy if it is no worse at the start."""
        mpc = evaluate(guard.policy.problem.explicit(), self.env, self.seeds)
        margin = self.margin * float(np.median(np.abs(mpc.costs)))
        paired = Paired(mpc.costs, mpc.costs, mpc.violations, margin)
        present = self._play(guard, self.seeds)
        if paired.objection(present.costs, present.violations) and _has_learnt(guard):
            guard.accept_the_mpc()
            present = self._play(guard, self.seeds)
        guard.accept(self._evidence(guard, paired, present))

    def step(self, guard: ImprovementGuard) -> None:
        """Try the present policy where an episode has ended and it is time."""
        if np.any(guard.locals["dones"]) and guard.state.episodes - self.last_trial >= self.every:
            self.last_trial = guard.state.episodes
            self._try(guard)

    def end(self, guard: ImprovementGuard) -> None:
        """Try the last candidate."""
        self._try(guard)

    def _try(self, guard: ImprovementGuard) -> None:
        if same(guard.state.accepted, guard.policy):
            return
        evidence: Evidence = guard.state.evidence
        played, reason = None, "a parameter of the actor is not a finite number"
        if all(bool(th.isfinite(each).all()) for each in network_of(guard.policy.actor)):
            played = self._play(guard, self.seeds)
            reason = evidence.paired.objection(played.costs, played.violations)
        regions: list[int] = []
        returned = False
        if played is not None and not reason:
            guard.accept(self._evidence(guard, evidence.paired, played))
            self.rejections = 0
        else:
            broken = played is None or np.any(played.violations > evidence.paired.violations)
            candidate = Snapshot.of(guard.policy)
            if self.by_region and not broken:
                regions = self._accept_regions(guard, candidate)
            self.rejections += 1
            returned = bool(broken) or self.rejections >= self.patience
            if returned:
                self.rejections = 0
            (guard.state.accepted if returned else candidate).restore(guard.policy)
        paired = guard.state.evidence.paired
        guard.decide(
            Decision(
                guard.num_timesteps,
                guard.state.episodes,
                "accepted" if not reason else "accepted in part" if regions else "rejected",
                reason,
                returned,
                np.nan if played is None else float(played.costs.mean()),
                float(paired.costs.mean()),
                float(paired.mpc_costs.mean()),
                float(np.max(paired.costs - paired.mpc_costs)),
                tuple(regions),
                guard.state.step,
            )
        )

    def _accept_regions(self, guard: ImprovementGuard, candidate: Snapshot) -> list[int]:
        """Take over the regions of the candidate that improve the accepted policy, one by one.

        Only the episodes that come through a region are played again. Leaves the policy changed.
        """
        accepted = []
        for region in np.argsort(-guard.state.evidence.visits.sum(0), kind="stable").tolist():
            evidence: Evidence = guard.state.evidence
            starts = np.flatnonzero(evidence.visits[:, region])
            before = guard.state.accepted
            mixed = before.with_regions(candidate, [region])
            if len(starts) == 0 or all(
                th.equal(value, before.actor[name]) for name, value in mixed.actor.items()
            ):
                continue
            mixed.restore(guard.policy)
            played = self._play(guard, [self.seeds[i] for i in starts])
            costs, violations = evidence.paired.costs.copy(), evidence.paired.violations.copy()
            costs[starts], violations[starts] = played.costs, played.violations
            if costs.mean() < evidence.paired.costs.mean() and not evidence.paired.objection(
                costs, violations
            ):
                visits = evidence.visits.copy()
                visits[starts] = _visits(guard, played)
                paired = replace(evidence.paired, costs=costs, violations=violations)
                guard.accept(Evidence(paired, visits), mixed)
                accepted.append(region)
        return accepted

    def _play(self, guard: ImprovementGuard, seeds: Sequence[int]) -> Episodes:
        return evaluate(guard.policy, self.env, seeds)

    def _evidence(self, guard: ImprovementGuard, paired: Paired, played: Episodes) -> Evidence:
        paired = replace(paired, costs=played.costs, violations=played.violations)
        return Evidence(paired, _visits(guard, played))


def _visits(guard: ImprovementGuard, played: Episodes) -> NDArray[np.bool_]:
    """Return which regions each episode comes through, shape (episodes, regions)."""
    layer = guard.policy.actor.mu
    visits = np.zeros((len(played.costs), len(layer.gains)), dtype=bool)
    for visited, states in zip(visits, played.observations, strict=True):
        theta = th.as_tensor(states[:-1], dtype=th.float32, device=guard.model.device)
        visited[layer.locate(theta)[0].cpu().numpy()] = True
    return visits


def _has_learnt(guard: ImprovementGuard) -> bool:
    """Return whether the actor may differ from the MPC at all."""
    return bool(guard.policy.actor.optimizer.state_dict()["state"])


def _name(env: Any) -> str:
    if isinstance(env, str):
        return env
    if isinstance(env, gym.Env):
        return env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    return getattr(env, "__qualname__", repr(env))
