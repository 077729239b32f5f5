"""Decisions by paired episodes in a simulator."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np

from sb3_yann.evaluation import Episodes, one_env
from sb3_yann.guard.episodes import Evidence, evidence_of, judged, play, unsafe, visits_of
from sb3_yann.guard.fresh import VIOLATES, settle
from sb3_yann.guard.judging import Paired
from sb3_yann.guard.record import Decision
from sb3_yann.guard.regions import accept_parts, taken_over
from sb3_yann.guard.snapshot import Snapshot, same, same_networks

if TYPE_CHECKING:
    from sb3_yann.guard.callback import ImprovementGuard


PART: Final = "accepted in part"
MEMORY = 50_000_000
"""Bytes of earlier accepted policies that are kept to go back to."""


class SimulatorTrials:
    """Tries each candidate on the same seeded starts, and what is to be accepted on new ones."""

    def __init__(
        self,
        env: str | gym.Env[Any, Any] | Callable[[], gym.Env[Any, Any]],
        n_starts: int,
        fresh: int,
        seed: int,
        every: int,
        margin: float,
        by_region: bool,
        patience: int,
        wander: bool,
    ) -> None:
        self.env, self.every, self.margin, self.by_region = env, every, margin, by_region
        self.patience, self.wander, self.fresh = patience, wander, fresh
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
        # Not saved with the model: a resumed run that has to go back goes back to the MPC.
        self.passed: list[Snapshot] = []
        self._final: Snapshot | None = None
        self.last_trial = -self.every  # the first episode that ends is always followed by a trial

    def first_evidence(self, guard: ImprovementGuard) -> None:
        """Play the MPC's episodes, and accept the policy if it is no worse at the start."""
        present = Snapshot.of(guard.policy)
        if not guard.policy.actor.mu.network.is_zero():
            guard.mpc.restore(guard.policy)
        # By the actor, not the law in float64: the MPC itself is to be no worse to the last bit.
        mpc = play(guard, self.env, self.seeds)
        again = play(guard, self.env, self.seeds)
        for seed, first, second in zip(self.seeds, mpc.costs, again.costs, strict=True):
            if not np.isclose(first, second, rtol=1e-6, atol=0, equal_nan=True):
                raise ValueError(
                    f"The MPC played two episodes of the guard's env {_name(self.env)} from the "
                    f"seed {seed}, at costs of {first:g} and {second:g}. Episodes are compared in "
                    "pairs: all that is random in the env must come from self.np_random."
                )
        margin = self.margin * float(np.median(np.abs(mpc.costs)))
        paired = Paired(mpc.costs, mpc.costs, unsafe(mpc), margin)
        guard.accept(Evidence((*self.seeds,), paired, visits_of(guard, mpc)))
        if same(present, guard.policy):
            return
        present.restore(guard.policy)
        played, reason = judged(guard, self.env)
        if played is not None and not reason:
            guard.accept(evidence_of(guard, played))
        else:
            guard.state.accepted.restore(guard.policy)
            self._report(guard, played, f"before training, {reason}", [], returned=True)

    def step(self, guard: ImprovementGuard) -> None:
        """Try the present policy where an episode has ended and it is time."""
        if np.any(guard.locals["dones"]) and guard.state.episodes - self.last_trial >= self.every:
            self.last_trial = guard.state.episodes
            self._try(guard)

    def end(self, guard: ImprovementGuard) -> None:
        """Try the last candidate, and what is accepted then on ten times as many new starts."""
        # There is no later: what is refused now returns.
        guard.state.rejections = self.patience - 1
        self._try(guard)
        last = guard.state.accepted
        if last is self._final:  # the Zoo ends its first callback a second time
            return
        reason = settle(guard, self, 10 * self.fresh)
        self._final = accepted = guard.state.accepted
        accepted.restore(guard.policy)
        if reason:
            regions = taken_over(guard.mpc, last, accepted)
            self._report(guard, None, f"at the end, {reason}", regions, returned=True)

    def remember(self, snapshot: Snapshot) -> None:
        """Keep what passed on new starts, as far as memory allows."""
        self.forget(snapshot)
        self.passed.append(snapshot)
        most = max(1, min(len(self.passed), MEMORY // snapshot.size))
        del self.passed[:-most]

    def forget(self, snapshot: Snapshot) -> None:
        """Remove what lost on new starts after all."""
        self.passed = [each for each in self.passed if not same_networks(each, snapshot)]

    def _try(self, guard: ImprovementGuard) -> None:
        if same(guard.state.accepted, guard.policy):
            return
        before = guard.state.accepted, guard.state.evidence
        candidate = Snapshot.of(guard.policy)
        played, reason = judged(guard, self.env)
        hopeless = played is None or bool(np.any(unsafe(played) > before[1].paired.violations))
        if played is not None and not reason:
            guard.accept(evidence_of(guard, played), candidate)
        elif played is not None and not hopeless:
            hopeless = not self.wander and before[1].paired.loses_to_the_mpc(played.costs)
            if self.by_region:
                accept_parts(guard, self.env, candidate, played)
        moved = not same_networks(before[0], guard.state.accepted)
        lost = settle(guard, self, self.fresh) if moved else ""
        if not reason and not lost:
            guard.state.rejections = 0
            self._report(guard, played, "", [], returned=False)
            return
        guard.state.rejections += 1
        hopeless = hopeless or VIOLATES in lost
        returned = hopeless or guard.state.rejections >= self.patience
        if returned:
            guard.state.rejections = 0
        accepted = guard.state.accepted
        (accepted if returned else candidate).restore(guard.policy)
        regions = taken_over(before[0], candidate, accepted)
        self._report(guard, played, reason or lost, regions, returned)

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


def _name(env: Any) -> str:
    if isinstance(env, str):
        return env
    if isinstance(env, gym.Env):
        spec = env.spec
        return type(env.unwrapped).__name__ if spec is None else f"{spec.id}{spec.kwargs or ''}"
    if isinstance(env, partial):  # its repr holds an address, which the next process does not have
        return f"{_name(env.func)}{env.args}{env.keywords}"
    return getattr(env, "__qualname__", repr(env))
