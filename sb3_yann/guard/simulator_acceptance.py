"""Accepts or refuses a candidate by paired episodes in a simulator.

`_judge` decides; `statistics.PairedEpisodes.objection` says why a candidate is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_yann.compare import EXCESS_ROOM
from sb3_yann.guard.actor_checkpoint import ActorCheckpoint
from sb3_yann.guard.episodes import (
    VIOLATES,
    Evidence,
    Outcome,
    Unplayable,
    evaluate_candidate,
    outcome_of,
    play_episodes,
)
from sb3_yann.guard.new_starts import confirm_on_new_starts, keep_passed
from sb3_yann.guard.options import AcceptanceRule
from sb3_yann.guard.preconditions import check_simulator, first_episodes
from sb3_yann.guard.region_mixing import (
    accept_part_way,
    accept_parts,
    accept_visited,
    accepted_regions,
)
from sb3_yann.guard.session import GuardSession
from sb3_yann.guard.state import GuardState, Verdict
from sb3_yann.guard.statistics import Tolerance

PART: Final = "accepted in part"
REPLAYED = 5
"""Starts from which the accepted policy is played again when a run goes on."""


@dataclass
class SimulatorAcceptance:
    """Plays each candidate from the same seeded starts, and confirms it on new ones.

    Attributes
    ----------
    name : str, that of the simulator
    seeds : range, the seeded starts
    n_new_starts, n_final_starts, eval_every, patience : int, as in :class:`ImprovementGuard`
    keep_if_worse, rule : bool and AcceptanceRule, likewise
    """

    name: str
    seeds: range
    n_new_starts: int
    n_final_starts: int
    eval_every: int
    patience: int
    keep_if_worse: bool
    rule: AcceptanceRule

    @property
    def settings(self) -> dict[str, Any]:
        """What the evidence depends on."""
        bound = self.rule.largest_step
        steps = {} if bound is None else {"largest_step": bound}
        tolerance = {
            "margin": self.rule.margin,
            "tail": self.rule.tail,
            "excess_room": self.rule.excess_room,
        }
        return {"env": self.name, "seeds": self.seeds, **tolerance, **steps}

    def start(self, session: GuardSession) -> None:
        """Check that the simulator is another env than the training env, and a like one."""
        check_simulator(session, self.name)
        self.final: ActorCheckpoint | None = None

    def still_holds(self, session: GuardSession) -> bool:
        """Return whether some episodes are still what the evidence says: only a name is known."""
        evidence: Evidence | None = session.state.evidence
        if evidence is None:
            return False
        some = np.unique(np.linspace(0, len(evidence.seeds) - 1, REPLAYED).astype(int))
        seeds, expected = evidence.at(some).seeds, evidence.accepted.at(some)
        try:
            again = outcome_of(session, play_episodes(session, session.state.accepted, seeds))
        except Unplayable:
            return False
        close = np.allclose(
            again.costs, expected.costs, rtol=1e-5, atol=1e-3 * evidence.tolerance.margin
        )
        alike = again.unsafe.shape == expected.unsafe.shape
        return close and alike and np.allclose(again.unsafe, expected.unsafe, atol=EXCESS_ROOM)

    def first_evidence(self, session: GuardSession, known: GuardState | None) -> None:
        """Play the MPC's episodes; accept the present or an earlier run's policy if no worse.

        The earlier run's hard starts stay.
        """
        state, present = session.state, ActorCheckpoint.of(session.policy)
        candidates, seeds = [present], (*self.seeds,)
        state.next_start = self.seeds.stop
        if known is not None:
            candidates = [known.accepted, present]
            state.new_starts = known.new_starts
            state.next_start = max(known.next_start, self.seeds.stop)
            hard = set(getattr(known.evidence, "seeds", ())) - {*known.settings.get("seeds", ())}
            seeds = (*seeds, *sorted(hard - {*seeds}))
        mpc = first_episodes(session, self.name, seeds, self.rule.largest_step)
        typical = float(np.median(np.abs(mpc.costs[: len(self.seeds)])))
        tolerance = Tolerance(
            self.rule.margin * typical, self.rule.tail, typical, self.rule.excess_room
        )
        state.accept(session.mpc, Evidence(seeds, mpc, tolerance, len(seeds), accepted=mpc))
        leading = session.mpc
        for candidate in candidates:
            if not candidate.has_networks_of(leading):
                leading = self._first_trial(session, candidate)
        leading.restore(session.policy)
        for checkpoint, _ in [] if known is None else known.passed:
            keep_passed(session, checkpoint, None)
        keep_passed(session, state.accepted, state.evidence.accepted)

    def _first_trial(self, session: GuardSession, candidate: ActorCheckpoint) -> ActorCheckpoint:
        """Return what goes on from here: a candidate that is accepted, else what was."""
        outcome, reason = evaluate_candidate(session, candidate)
        if outcome is not None and not reason:
            accept_visited(session, candidate, outcome)
            return candidate
        self._report(session, outcome, f"before training, {reason}", [], restored=True)
        return session.state.accepted

    def step(self, session: GuardSession, dones: NDArray[np.bool_]) -> None:
        """Try the policy where an episode (n_envs,) has ended and it is time."""
        state = session.state
        last, now = state.last_trial, state.episodes
        if np.any(dones) and (last is None or now - last >= self.eval_every):
            state.last_trial = now
            self.try_candidate(session)

    def end(self, session: GuardSession) -> None:
        """Try the last candidate, and confirm what is accepted on the final new starts."""
        state = session.state
        # There is no later: a candidate that is refused now is not kept.
        state.rejections = self.patience - 1
        try:
            self.try_candidate(session)
        finally:
            state.rejections = 0
        last = state.accepted
        known: Outcome = state.evidence.accepted
        if last is self.final:  # the Zoo ends its first callback a second time
            return
        with session.all_or_nothing():
            bar = self.rule.standard_errors, self.rule.least_gain if self.rule.tail else 0.0
            reason = confirm_on_new_starts(session, self.n_final_starts, self.rule, *bar)
        self.final = accepted = state.accepted
        accepted.restore(session.policy)
        if reason:
            regions = accepted_regions(session.mpc, last, accepted)
            self._report(session, known, f"at the end, {reason}", regions, restored=True)

    def try_candidate(self, session: GuardSession) -> None:
        """Accept the present policy, whole or in part, or refuse it."""
        state, before = session.state, session.state.accepted
        if before.is_actor_of(session.policy):
            return
        candidate = ActorCheckpoint.of(session.policy)
        changed = before.changed_regions(candidate)
        if not candidate.has_diverged() and not np.any(changed & state.evidence.visits.any(0)):
            return  # it differs only where no episode of the accepted policy comes through
        with session.all_or_nothing():
            outcome, reason, restored, share = self._judge(session, candidate)
        if restored:
            state.accepted.restore(session.policy)
        regions = accepted_regions(before, candidate, state.accepted) if reason else []
        self._report(session, outcome, reason, regions, restored, share)

    def _judge(
        self, session: GuardSession, candidate: ActorCheckpoint
    ) -> tuple[Outcome | None, str, bool, float]:
        """Return a candidate's episodes, why it is refused, whether to restore, and the share."""
        state, rule = session.state, self.rule
        before: tuple[ActorCheckpoint, Evidence] = state.accepted, state.evidence
        outcome, reason = evaluate_candidate(session, candidate)
        hopeless = outcome is None or outcome.breaks_more_than(before[1].accepted, rule.excess_room)
        share = 0.0 if reason else 1.0
        if outcome is not None and not reason:
            accept_visited(session, candidate, outcome)
        elif outcome is not None and not hopeless:
            hopeless = not self.keep_if_worse and before[1].paired.loses_to_the_mpc(outcome.costs)
            if rule.by_region:
                accept_parts(session, candidate, outcome)
        untouched = reason and before[0].has_networks_of(state.accepted)
        if untouched and rule.retreat and not candidate.has_diverged():
            share = accept_part_way(session, candidate)
        on_trial, lost = state.accepted, ""
        if not before[0].has_networks_of(on_trial):
            lost = confirm_on_new_starts(session, self.n_new_starts, rule)
        refused = bool(reason or lost)
        state.rejections = state.rejections + 1 if refused else 0
        out_of_patience = state.rejections >= self.patience or hopeless or VIOLATES in lost
        restored = refused and out_of_patience
        if restored:
            state.rejections = 0
        kept = on_trial.has_networks_of(state.accepted)
        return outcome, reason or lost, restored, share if kept else 0.0

    def _report(
        self,
        session: GuardSession,
        outcome: Outcome | None,
        reason: str,
        regions: list[int],
        restored: bool,
        share: float = 0.0,
    ) -> None:
        paired = session.state.evidence.paired
        fixed = slice(len(self.seeds))  # the hard starts come and go: costs must be comparable
        verdict: Verdict = "accepted" if not reason else PART if regions or share else "rejected"
        cost = np.nan if outcome is None else float(outcome.costs[fixed].mean())
        costs = cost, float(paired.costs[fixed].mean()), float(paired.mpc_costs[fixed].mean())
        worst_start = float(np.max((paired.costs - paired.mpc_costs)[fixed]))
        session.decide(verdict, reason, restored, costs, worst_start, tuple(regions), share=share)


def name_of(env: Any) -> str:
    """Return a name of a simulator that is the same in another process."""
    if isinstance(env, str):
        return env
    if isinstance(env, gym.Env):
        spec = env.spec
        return type(env.unwrapped).__name__ if spec is None else f"{spec.id}{spec.kwargs or ''}"
    if isinstance(env, partial):  # its repr holds an address, which the next process does not have
        return f"{name_of(env.func)}{env.args}{env.keywords}"
    return getattr(env, "__qualname__", repr(env))
