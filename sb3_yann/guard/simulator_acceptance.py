"""Decisions by paired episodes in a simulator."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np

from sb3_yann.guard.actor_checkpoint import ActorCheckpoint, changed, same, same_networks
from sb3_yann.guard.episodes import (
    Evidence,
    Outcome,
    Unplayable,
    all_or_nothing,
    evaluate_candidate,
    finite,
    outcome_of,
    played,
)
from sb3_yann.guard.new_starts import VIOLATES, confirm_on_new_starts, remember
from sb3_yann.guard.preconditions import check_simulator, first_episodes
from sb3_yann.guard.region_mixing import accept_parts, accept_visited, taken_over
from sb3_yann.guard.state import Decision, GuardState

if TYPE_CHECKING:
    from sb3_yann.guard.callback import ImprovementGuard


PART: Final = "accepted in part"
REPLAYED = 5
"""Starts from which the accepted policy is played again when a run goes on."""


class SimulatorAcceptance:
    """Tries each candidate on the same seeded starts, and what is to be accepted on new ones."""

    def __init__(
        self,
        env: str | gym.Env[Any, Any] | Callable[[], gym.Env[Any, Any]],
        n_starts: int,
        fresh: int,
        final: int,
        seed: int,
        every: int,
        margin: float,
        by_region: bool,
        patience: int,
        wander: bool,
    ) -> None:
        self.env, self.every, self.margin, self.by_region = env, every, margin, by_region
        self.patience, self.wander = patience, wander
        self.fresh, self.final = fresh, final
        self.seeds = range(seed, seed + n_starts)
        self.settings: dict[str, Any] = {"env": _name(env), "seeds": self.seeds, "margin": margin}

    def start(self, guard: ImprovementGuard) -> None:
        """Check that the simulator is another env than the training env, and a like one."""
        check_simulator(self.env, self.settings["env"], guard.training_env)
        self._final: ActorCheckpoint | None = None
        self.last_trial = -self.every  # the first episode that ends is always followed by a trial

    def still_holds(self, guard: ImprovementGuard) -> bool:
        """Return whether the accepted policy's episodes are still what the evidence says.

        The settings name the simulator; another one may have the same name.
        """
        evidence: Evidence | None = guard.state.evidence
        if evidence is None:
            return False
        last = len(evidence.seeds) - 1
        some = np.unique(np.linspace(0, last, REPLAYED).astype(int))
        present, expected = ActorCheckpoint.of(guard.policy), evidence.accepted.at(some)
        try:
            guard.state.accepted.restore(guard.policy)
            again = outcome_of(
                guard, played(guard, self.env, [evidence.seeds[int(i)] for i in some])
            )
        except Unplayable:
            return False
        finally:
            present.restore(guard.policy)
        close = np.allclose(again.costs, expected.costs, rtol=1e-5, atol=1e-3 * evidence.margin)
        return close and np.array_equal(again.unsafe, expected.unsafe)

    def first_evidence(self, guard: ImprovementGuard, known: GuardState | None) -> None:
        """Play the MPC's episodes, and accept what is no worse at the start.

        That may be the policy that is accepted by a run with other settings, whose hard starts
        stay, and the present one.
        """
        state, present = guard.state, ActorCheckpoint.of(guard.policy)
        candidates, seeds = [present], (*self.seeds,)
        state.next_start = self.seeds.stop
        if known is not None:
            candidates = [known.accepted, present]
            state.fresh, state.next_start = known.fresh, max(known.next_start, self.seeds.stop)
            hard = set(getattr(known.evidence, "seeds", ())) - {*known.settings.get("seeds", ())}
            seeds = (*seeds, *sorted(hard - {*seeds}))
        if not guard.policy.actor.mu.network.is_zero():
            guard.mpc.restore(guard.policy)
        mpc = first_episodes(guard, self.env, self.settings["env"], seeds)
        margin = self.margin * float(np.median(np.abs(mpc.costs[: len(self.seeds)])))
        guard.accept(Evidence(seeds, mpc, mpc, margin))
        for candidate in candidates:
            if same(candidate, guard.policy):
                continue
            candidate.restore(guard.policy)
            outcome, reason = evaluate_candidate(guard, self.env)
            if outcome is not None and not reason:
                accept_visited(guard, candidate, outcome)
            else:
                state.accepted.restore(guard.policy)
                self._report(guard, outcome, f"before training, {reason}", [], returned=True)
        for checkpoint, _ in [] if known is None else known.passed:
            remember(guard, checkpoint, None)
        remember(guard, state.accepted, state.evidence.accepted)

    def before_steps(self, guard: ImprovementGuard) -> None:
        """Do nothing: the training env may meet any candidate."""

    def step(self, guard: ImprovementGuard) -> None:
        """Try the present policy where an episode has ended and it is time."""
        if np.any(guard.locals["dones"]) and guard.state.episodes - self.last_trial >= self.every:
            self.last_trial = guard.state.episodes
            self._try(guard)

    def end(self, guard: ImprovementGuard) -> None:
        """Try the last candidate, and what is accepted then on ``final`` new starts."""
        state = guard.state
        # There is no later: what is refused now returns.
        state.rejections = self.patience - 1
        try:
            self._try(guard)
        finally:
            state.rejections = 0
        last = state.accepted
        if last is self._final:  # the Zoo ends its first callback a second time
            return
        with all_or_nothing(guard):
            reason = confirm_on_new_starts(guard, self, self.final)
        self._final = accepted = state.accepted
        accepted.restore(guard.policy)
        if reason:
            regions = taken_over(guard.mpc, last, accepted)
            self._report(guard, None, f"at the end, {reason}", regions, returned=True)

    def _try(self, guard: ImprovementGuard) -> None:
        if same(guard.state.accepted, guard.policy):
            return
        before = guard.state.accepted
        with all_or_nothing(guard) as candidate:
            if self._plays_alike(guard, candidate):
                return
            outcome, reason, returned = self._judge(guard, candidate)
        accepted = guard.state.accepted
        regions = taken_over(before, candidate, accepted) if reason else []
        self._report(guard, outcome, reason, regions, returned)

    def _plays_alike(self, guard: ImprovementGuard, candidate: ActorCheckpoint) -> bool:
        """Return whether it differs only where none of the accepted policy's episodes comes."""
        visited = guard.state.evidence.visits.any(0)
        return finite(guard) and not np.any(changed(guard.state.accepted, candidate) & visited)

    def _judge(
        self, guard: ImprovementGuard, candidate: ActorCheckpoint
    ) -> tuple[Outcome | None, str, bool]:
        """Return the candidate's episodes, why it is refused, and whether the actor returns."""
        state = guard.state
        before: tuple[ActorCheckpoint, Evidence] = state.accepted, state.evidence
        outcome, reason = evaluate_candidate(guard, self.env)
        hopeless = outcome is None or bool(np.any(outcome.unsafe > before[1].accepted.unsafe))
        if outcome is not None and not reason:
            accept_visited(guard, candidate, outcome)
        elif outcome is not None and not hopeless:
            hopeless = not self.wander and before[1].paired.loses_to_the_mpc(outcome.costs)
            if self.by_region:
                accept_parts(guard, self.env, candidate, outcome)
        moved = not same_networks(before[0], state.accepted)
        lost = confirm_on_new_starts(guard, self, self.fresh) if moved else ""
        returned = False
        if reason or lost:
            state.rejections += 1
            hopeless = hopeless or VIOLATES in lost
            returned = hopeless or state.rejections >= self.patience
        if returned or not (reason or lost):
            state.rejections = 0
        (state.accepted if returned else candidate).restore(guard.policy)
        return outcome, reason or lost, returned

    def _report(
        self,
        guard: ImprovementGuard,
        outcome: Outcome | None,
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
                candidate_cost=np.nan if outcome is None else float(outcome.costs.mean()),
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
