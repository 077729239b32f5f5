"""Decisions by paired episodes in a simulator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_yann.evaluation import Episodes, Predictor, evaluate, one_env
from sb3_yann.guard.judging import Paired
from sb3_yann.guard.record import Decision
from sb3_yann.guard.snapshot import Snapshot, same

if TYPE_CHECKING:
    from sb3_yann.guard.callback import ImprovementGuard


PART: Final = "accepted in part"
MOST_LOST = 0.2
"""Share of losing starts beyond which no part of a candidate is looked for."""


@dataclass(frozen=True)
class Evidence:
    """The accepted policy's episodes: what a candidate is compared with.

    ``visits[i, r]`` says whether the episode from start i comes through region r: the others go on
    as they are, whatever the network of r becomes.
    """

    paired: Paired
    visits: NDArray[np.bool_]


class _NotFinite(Exception):
    """An action of the policy is not a finite number; envs need not put up with one."""


@dataclass(frozen=True)
class _FinitePolicy:
    policy: Predictor
    seen: Callable[[Any], Any]

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, Any]:
        actions, state = self.policy.predict(self.seen(observation), deterministic=deterministic)
        if not np.all(np.isfinite(actions)):
            raise _NotFinite
        return actions, state


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
        wander: bool,
    ) -> None:
        self.env, self.every, self.margin, self.by_region = env, every, margin, by_region
        self.patience, self.wander = patience, wander
        self.seeds = range(seed, seed + n_starts)
        self.settings = {"env": _name(env), "seeds": self.seeds, "margin": margin}

    def start(self, guard: ImprovementGuard) -> None:
        """Check that the simulator is another env than the training env, and a like one."""
        training = [env.unwrapped for env in getattr(guard.training_env, "envs", [])]
        with one_env(self.env) as env:
            if any(env.unwrapped is each for each in training):
                raise ValueError(
                    "The guard's env is the training env, whose episodes its own would interrupt. "
                    "Give it another one, e.g. its id."
                )
            ours, theirs = env.observation_space.shape, guard.training_env.observation_space.shape
            if ours != theirs or env.action_space != guard.training_env.action_space:
                raise ValueError(
                    f"The guard's env {_name(self.env)} has observations of shape {ours} and "
                    f"{env.action_space}; the training env has {theirs} and "
                    f"{guard.training_env.action_space}. Give the guard a simulator of this plant."
                )
        self.last_trial = -self.every  # the first episode that ends is always followed by a trial

    def first_evidence(self, guard: ImprovementGuard) -> None:
        """Play the MPC's episodes, and accept the policy if it is no worse at the start."""
        present = Snapshot.of(guard.policy)
        if not guard.policy.actor.mu.network.is_zero():
            guard.become_the_mpc()
        # By the actor, not the law in float64: the MPC itself is to be no worse to the last bit.
        mpc = self._play(guard, self.seeds)
        again = self._play(guard, self.seeds)
        for seed, first, second in zip(self.seeds, mpc.costs, again.costs, strict=True):
            if not np.isclose(first, second, rtol=1e-6, atol=0, equal_nan=True):
                raise ValueError(
                    f"The MPC played two episodes of the guard's env {_name(self.env)} from the "
                    f"seed {seed}, at costs of {first:g} and {second:g}. Episodes are compared in "
                    "pairs: all that is random in the env must come from self.np_random."
                )
        margin = self.margin * float(np.median(np.abs(mpc.costs)))
        paired = Paired(mpc.costs, mpc.costs, unsafe(mpc), margin)
        guard.accept(self._evidence(guard, paired, mpc))
        if same(present, guard.policy):
            return
        present.restore(guard.policy)
        played, reason = self._judged(guard, paired)
        if played is not None and not reason:
            guard.accept(self._evidence(guard, paired, played))
        else:
            guard.state.accepted.restore(guard.policy)
            self._report(guard, played, f"before training, {reason}", [], returned=True)

    def step(self, guard: ImprovementGuard) -> None:
        """Try the present policy where an episode has ended and it is time."""
        if np.any(guard.locals["dones"]) and guard.state.episodes - self.last_trial >= self.every:
            self.last_trial = guard.state.episodes
            self._try(guard)

    def end(self, guard: ImprovementGuard) -> None:
        """Try the last candidate."""
        # There is no later: what is refused now returns.
        guard.state.rejections = self.patience - 1
        self._try(guard)

    def _try(self, guard: ImprovementGuard) -> None:
        if same(guard.state.accepted, guard.policy):
            return
        evidence: Evidence = guard.state.evidence
        played, reason = self._judged(guard, evidence.paired)
        if played is not None and not reason:
            guard.accept(self._evidence(guard, evidence.paired, played))
            guard.state.rejections = 0
            self._report(guard, played, reason, [], returned=False)
            return
        candidate = Snapshot.of(guard.policy)
        regions: list[int] = []
        hopeless = True
        if played is not None and not np.any(unsafe(played) > evidence.paired.violations):
            hopeless = not self.wander and evidence.paired.loses_to_the_mpc(played.costs)
            if self.by_region:
                regions = self._accept_the_rest(guard, candidate, played)
                regions = sorted({*regions, *self._accept_regions(guard, candidate)})
        guard.state.rejections += 1
        returned = hopeless or guard.state.rejections >= self.patience
        if returned:
            guard.state.rejections = 0
        (guard.state.accepted if returned else candidate).restore(guard.policy)
        self._report(guard, played, reason, regions, returned)

    def _judged(self, guard: ImprovementGuard, paired: Paired) -> tuple[Episodes | None, str]:
        """Return the episodes of the present policy and what speaks against it, if anything."""
        if not all(bool(th.isfinite(each).all()) for each in guard.policy.actor.parameters()):
            return None, "a parameter of the actor is not a finite number"
        try:
            played = self._play(guard, self.seeds)
        except _NotFinite:
            return None, "an action of the actor is not a finite number"
        return played, paired.objection(played.costs, unsafe(played))

    def _report(
        self,
        guard: ImprovementGuard,
        played: Episodes | None,
        reason: str,
        regions: list[int],
        returned: bool,
    ) -> None:
        paired = guard.state.evidence.paired
        guard.decide(
            Decision(
                timestep=guard.num_timesteps,
                episode=guard.state.episodes,
                verdict="accepted" if not reason else PART if regions else "rejected",
                reason=reason,
                returned=returned,
                candidate_cost=np.nan if played is None else float(played.costs.mean()),
                accepted_cost=float(paired.costs.mean()),
                mpc_cost=float(paired.mpc_costs.mean()),
                worst_start=float(np.max(paired.costs - paired.mpc_costs)),
                regions=tuple(regions),
            )
        )

    def _accept_the_rest(
        self, guard: ImprovementGuard, candidate: Snapshot, played: Episodes
    ) -> list[int]:
        """Give back the regions by which few starts lose, until what is left can be accepted.

        The region to give back is the one that the losing starts come through and the winning ones
        least. Leaves the policy changed.
        """
        evidence: Evidence = guard.state.evidence
        paired, visited = evidence.paired, (evidence.visits | _visits(guard, played)).any(0)
        before = guard.state.accepted
        kept = [i for i in np.flatnonzero(visited).tolist() if _differs(before, candidate, i)]
        while len(kept) > 1:
            lost = paired.lost(played.costs)
            if not lost.any() or lost.mean() > MOST_LOST:
                break
            visits, won = _visits(guard, played), played.costs < paired.costs - paired.margin
            blame, credit = visits[lost].sum(0)[kept], visits[won].sum(0)[kept]
            if not blame.any():
                break
            kept.pop(int(np.argmax(blame / (blame + credit + 1e-9))))
            mixed = before.with_regions(candidate, kept)
            mixed.restore(guard.policy)
            try:
                played = self._play(guard, self.seeds)
            except _NotFinite:
                break
            gained = played.costs.mean() < paired.costs.mean()
            if gained and not paired.objection(played.costs, unsafe(played)):
                guard.accept(self._evidence(guard, paired, played), mixed)
                return kept
        return []

    def _accept_regions(self, guard: ImprovementGuard, candidate: Snapshot) -> list[int]:
        """Take over the regions of the candidate that improve the accepted policy, one by one.

        Only the episodes that come through a region are played again. Leaves the policy changed.
        """
        accepted = []
        for region in np.argsort(-guard.state.evidence.visits.sum(0), kind="stable").tolist():
            evidence: Evidence = guard.state.evidence
            starts = np.flatnonzero(evidence.visits[:, region])
            before = guard.state.accepted
            if len(starts) == 0 or not _differs(before, candidate, region):
                continue
            mixed = before.with_regions(candidate, [region])
            mixed.restore(guard.policy)
            try:
                played = self._play(guard, [self.seeds[i] for i in starts])
            except _NotFinite:
                continue
            costs, violations = evidence.paired.costs.copy(), evidence.paired.violations.copy()
            costs[starts], violations[starts] = played.costs, unsafe(played)
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
        return evaluate(_FinitePolicy(guard.policy, _seen(guard)), self.env, seeds)

    def _evidence(self, guard: ImprovementGuard, paired: Paired, played: Episodes) -> Evidence:
        paired = replace(paired, costs=played.costs, violations=unsafe(played))
        return Evidence(paired, _visits(guard, played))


def unsafe(played: Episodes) -> NDArray[np.int64]:
    """Return the violations of each episode; to be terminated counts as one."""
    return np.maximum(played.violations, played.terminated)


def _seen(guard: ImprovementGuard) -> Callable[[Any], Any]:
    """Return what turns an observation of the simulator into one that the policy has learnt from.

    The simulator is an env like the one below a VecNormalize.
    """
    normalize = guard.model.get_vec_normalize_env()
    return (lambda observation: observation) if normalize is None else normalize.normalize_obs


def _visits(guard: ImprovementGuard, played: Episodes) -> NDArray[np.bool_]:
    """Return which regions each episode comes through, shape (episodes, regions)."""
    layer, seen = guard.policy.actor.mu, _seen(guard)
    visits = np.zeros((len(played.costs), len(layer.gains)), dtype=bool)
    for visited, states in zip(visits, played.observations, strict=True):
        theta = guard.policy.theta(seen(states[:-1]))
        visited[layer.locate(theta)[0].cpu().numpy()] = True
    return visits


def _differs(before: Snapshot, candidate: Snapshot, region: int) -> bool:
    """Return whether the region's network is another one."""
    return not all(
        th.equal(value[region], candidate.actor[name][region])
        for name, value in before.networks().items()
    )


def _name(env: Any) -> str:
    if isinstance(env, str):
        return env
    if isinstance(env, gym.Env):
        spec = env.spec
        return type(env.unwrapped).__name__ if spec is None else f"{spec.id}{spec.kwargs or ''}"
    if isinstance(env, partial):  # its repr holds an address, which the next process does not have
        return f"{_name(env.func)}{env.args}{env.keywords}"
    return getattr(env, "__qualname__", repr(env))
