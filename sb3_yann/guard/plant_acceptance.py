"""Accepts or refuses a candidate by the training episodes alone: a plant without a simulator."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from sb3_yann.guard.actor_checkpoint import DIVERGED, ActorCheckpoint, diverged
from sb3_yann.guard.covariate import Recorder, predict_by_twin, predicted_cost
from sb3_yann.guard.options import AcceptanceRule
from sb3_yann.guard.preconditions import check_acts_alone
from sb3_yann.guard.session import GuardSession
from sb3_yann.guard.state import GuardState, Verdict
from sb3_yann.guard.statistics import (
    Logged,
    PlantEpisodes,
    analyze_covariance,
    excess_of_an_outlier,
    is_promising,
)
from sb3_yann.policy._sb3_hooks import is_under_way

Phase = Literal["first", "learning", "trial", "again"]


@dataclass
class BlockEvidence:
    """Episodes of the MPC, of the accepted policy, and of the block that is being played.

    Attributes
    ----------
    phase : str, "first", "learning", "trial" or "again"; the actor learns in the second only
        The accepted policy plays "again" while it is not clear yet what a candidate is worth.
    mpc, accepted : PlantEpisodes or None, those of the MPC and of the accepted policy, if known
    costs : list of float, those of the block's episodes so far
    predicted : list of float, what the MPC costs on its own model; empty while the actor learns
    resting : ActorCheckpoint or None, what the actor stays in this block, None while it learns
    terminates : bool, whether the env itself has ended an episode of an accepted policy
    log : tuple of pairs of ndarray, thetas and inputs of the block's episodes, as ``predicted``
    candidate : ActorCheckpoint or None, the policy on trial after its first block
    on_trial : PlantEpisodes or None, its episodes
    left_out : int, episodes of the first block whose cost is not known
    """

    phase: Phase = "first"
    mpc: PlantEpisodes | None = None
    accepted: PlantEpisodes | None = None
    costs: list[float] = field(default_factory=list)
    predicted: list[float] = field(default_factory=list)
    resting: ActorCheckpoint | None = None
    terminates: bool = False
    log: tuple[Logged, ...] = ()
    candidate: ActorCheckpoint | None = None
    on_trial: PlantEpisodes | None = None
    left_out: int = 0

    @property
    def played(self) -> PlantEpisodes:
        """The block's episodes."""
        return PlantEpisodes(np.array(self.costs), np.array(self.predicted), self.log)


class PlantAcceptance:
    """Lets the actor learn for a block of episodes, then rest for a block that is tested."""

    def __init__(self, rule: AcceptanceRule) -> None:
        self.rule = rule
        self.settings = {"env": None, "trial_episodes": rule.trial_episodes}

    def start(self, session: GuardSession) -> None:
        """Begin with the episodes that start now; one that is under way does not count."""
        check_acts_alone(session.model)
        model, n_envs = session.model, session.model.n_envs
        # SB3 goes on amid an episode where its steps are not counted from 0 again.
        going_on = model.num_timesteps > 0 and is_under_way(model)
        self.costs, self.lengths = np.zeros(n_envs), np.zeros(n_envs, dtype=int) + going_on
        self.violated = np.zeros(n_envs, dtype=bool)
        self.accepted_led = np.zeros(n_envs, dtype=bool)  # whether for all of the episode so far
        self.recorders = [Recorder() for _ in range(n_envs)]
        self.blocks, self.block = np.full(n_envs, -1), 0

    def still_holds(self, session: GuardSession) -> bool:
        """Return whether the evidence is there; a plant cannot be played again."""
        evidence = session.state.evidence
        if evidence is None:
            return False
        if evidence.phase == "trial" and session.state.accepted.is_actor_of(session.policy):
            self._begin(session, "learning")  # Ctrl-C has ended the trial
        return True

    def first_evidence(self, session: GuardSession, known: GuardState | None) -> None:
        """Begin with a block of episodes of the present policy, or of what is accepted already."""
        refused, policy = False, session.policy
        if known is not None:  # nobody has found out how good another present policy is
            refused = not known.accepted.is_actor_of(policy)
            known.accepted.restore(policy)
        if diverged(policy.actor.parameters()):  # only the MPC is left
            refused = True
            session.mpc.restore(policy)
        present = ActorCheckpoint.of(policy)
        session.state.accept(present, BlockEvidence(resting=present))
        if refused:
            self._report(session, "rejected", "before training, it is not accepted", np.nan)

    def before_steps(self, session: GuardSession) -> None:
        """Restore the accepted policy before one that has diverged acts on the plant."""
        if diverged(session.policy.actor.parameters()):
            self._restore(session, DIVERGED)

    def record(self, session: GuardSession, actions: Any) -> None:
        """Note the thetas of the present step, and the actions (n_envs, m) in [-1, 1]."""
        starting = self.lengths == 0
        if _evidence(session).phase == "learning" and not starting.any():
            return  # no twin is fitted to episodes in which the actor learns
        observations = session.model._last_obs  # s_t, before the step
        theta = session.policy.theta(observations).double().cpu().numpy()  # type: ignore[arg-type]
        for i in range(len(theta)):
            if starting[i]:
                self.recorders[i] = Recorder()
            self.recorders[i].add(theta[i], actions[i])

    def step(self, session: GuardSession, dones: Any, rewards: Any, infos: Any) -> None:
        """Count the step; decide where a block is over.

        Parameters
        ----------
        session : GuardSession
            The model under guard.
        dones, rewards : ndarray, shape (n_envs,)
            Whether each episode ends here, and the rewards of the step.
        infos : sequence of dict
            The info of each env.
        """
        state, evidence = session.state, _evidence(session)
        self._enroll(session)
        if self.accepted_led.any() and not state.accepted.is_actor_of(session.policy):
            self.accepted_led[:] = False
        if evidence.resting is not None and not evidence.resting.is_actor_of(session.policy):
            self._restore(session, "the actor was changed while it rested")
        for i, done in enumerate(dones):
            self.costs[i] -= float(rewards[i])
            self.lengths[i] += 1
            self._watch_limits(session, i, bool(done), infos[i])
            if done:
                self._end_episode(session, i, infos[i])
        if len(evidence.costs) >= self.rule.trial_episodes:
            self._end_block(session)
        session.policy.actor_step = self.actor_step(session)

    def actor_step(self, session: GuardSession) -> float:
        """Return the factor of the learning rate: 0 while the actor rests."""
        rests = _evidence(session).phase != "learning" or self.violated.any()
        return 0.0 if rests else session.state.step

    def end(self, session: GuardSession) -> None:
        """Leave an unfinished block undecided: the accepted policy stays, and learns again."""
        if _evidence(session).phase != "first":
            self._begin(session, "learning")

    def _enroll(self, session: GuardSession) -> None:
        """Count episodes that start now as the block's, before anything ends the block.

        The first to end would be the short ones, where several envs are side by side.
        """
        starting = np.flatnonzero(self.lengths == 0)
        if len(starting) == 0:
            return
        self.accepted_led[starting] = True
        for i in starting:
            counted = len(_evidence(session).costs) + np.count_nonzero(self.blocks == self.block)
            # Where theta is not finite, nobody knows what it should cost from there.
            known = np.all(np.isfinite(self.recorders[i].thetas[0]))
            if known and counted < self.rule.trial_episodes:
                self.blocks[i] = self.block

    def _watch_limits(self, session: GuardSession, i: int, done: bool, info: Any) -> None:
        """Restore the accepted policy if a limit is violated, or the env itself ends an episode."""
        state, evidence = session.state, _evidence(session)
        terminated = done and not info.get("TimeLimit.truncated", False)
        if not (info.get("violation", False) or (terminated and not evidence.terminates)):
            return
        self.violated[i] = True
        if not state.accepted.is_actor_of(session.policy):
            self._restore(session, "a limit was violated")
        elif terminated and self.accepted_led[i]:
            evidence.terminates = True

    def _end_episode(self, session: GuardSession, i: int, info: Any) -> None:
        """Add an episode to the block, if it is one of the block's."""
        evidence = _evidence(session)
        if self.blocks[i] == self.block:
            if evidence.phase == "first" and not np.isfinite(self.costs[i]):
                self._leave_out(evidence, self.costs[i])
            else:
                evidence.costs.append(float(self.costs[i]))
                if evidence.phase != "learning":
                    problem, recorder = session.policy.problem, self.recorders[i]
                    last = session.policy.theta(info["terminal_observation"][None]).cpu().numpy()
                    evidence.log += (recorder.episode(problem, last[0]),)
                    start = recorder.thetas[0].astype(np.float64)
                    evidence.predicted.append(predicted_cost(problem, start, self.lengths[i]))
        self.costs[i], self.lengths[i], self.violated[i] = 0.0, 0, False
        self.blocks[i] = -1

    def _leave_out(self, evidence: BlockEvidence, cost: float) -> None:
        """Leave an episode out of the first block; raise ValueError if too many are."""
        evidence.left_out += 1
        if (lost := evidence.left_out) >= self.rule.trial_episodes:
            raise ValueError(
                f"{lost} episodes of the guard's first block cost no finite number, the "
                f"last {cost:g}. Policies are compared by costs. Rewards must be finite numbers."
            )

    def _begin(self, session: GuardSession, phase: Phase) -> None:
        evidence = _evidence(session)
        evidence.phase = phase
        evidence.costs, evidence.predicted, evidence.log = [], [], ()
        evidence.resting = None if phase == "learning" else ActorCheckpoint.of(session.policy)
        if phase in ("first", "learning"):
            evidence.candidate = evidence.on_trial = None
        self.block += 1

    def _restore(self, session: GuardSession, reason: str) -> None:
        """Restore the accepted policy at once, whatever the block."""
        state = session.state
        state.accepted.restore(session.policy)
        known = [(each.reason, each.episode) for each in state.decisions[-1:]]
        if known != [(reason, state.episodes)]:  # one decision for it in each episode
            self._report(session, "rejected", reason, np.nan)
        self._begin(session, "first" if _evidence(session).accepted is None else "learning")

    def _end_block(self, session: GuardSession) -> None:
        evidence = _evidence(session)
        played, phase = evidence.played, evidence.phase
        if phase == "learning":
            self._begin(session, "trial")
        elif evidence.accepted is None:
            evidence.accepted = played
            if session.policy.actor.mu.network.is_zero():
                evidence.mpc = replace(played, log=())
            self._begin(session, "learning")
        elif phase == "again":
            evidence.accepted += played
            self._judge(session)
        elif session.state.accepted.is_actor_of(session.policy):  # nothing to be tried
            self._begin(session, "learning")
        else:
            evidence.candidate = ActorCheckpoint.of(session.policy)
            evidence.on_trial = played if evidence.on_trial is None else evidence.on_trial + played
            self._judge(session)

    def _judge(self, session: GuardSession) -> None:
        """Accept the policy on trial, refuse it, or play a block more where it is promising."""
        state, evidence = session.state, _evidence(session)
        candidate, on_trial, known = evidence.candidate, evidence.on_trial, evidence.accepted
        assert candidate is not None and on_trial is not None and known is not None
        new, old, who = predict_by_twin(session, on_trial, known)
        size = state.budget.size(self.rule.significance)
        passed, outlier, reason = self._compare(new, old, size)
        state.budget = state.budget.after(size, passed)
        next_size = state.budget.size(self.rule.significance)
        if not (passed or outlier) and is_promising(new, old, next_size):
            again = len(old.costs) <= len(new.costs)
            (state.accepted if again else candidate).restore(session.policy)
            self._begin(session, "again" if again else "trial")
            return
        if passed:
            evidence.accepted = on_trial
            state.accept(candidate, evidence)
        state.accepted.restore(session.policy)
        verdict: Verdict = "accepted" if passed else "rejected"
        self._report(session, verdict, reason.format(who), float(on_trial.costs.mean()))
        self._begin(session, "learning")

    def _compare(
        self, new: PlantEpisodes, old: PlantEpisodes, size: float
    ) -> tuple[bool, bool, str]:
        """Return whether a test of that size passes, whether an episode is an outlier, and why."""
        difference, chance = analyze_covariance(new, old)
        beyond = excess_of_an_outlier(new, old, self.rule.margin * float(np.median(old.costs)))
        if lost := np.count_nonzero(~np.isfinite(new.costs)):
            return False, True, f"{lost} of {len(new.costs)} episodes cost no finite number"
        reason = f"{difference:+.4g} from the same starts by {{}}, p = {chance:.3g}"
        if beyond > 0:
            return False, True, f"{reason}, but one start costs {beyond:.4g} more than it should"
        passed = chance < size
        return passed, False, reason if passed else f"{reason}, not below {size:.2g}"

    def _report(self, session: GuardSession, verdict: Verdict, reason: str, cost: float) -> None:
        evidence = _evidence(session)
        known = evidence.accepted, evidence.mpc
        means = [np.nan if each is None else float(each.costs.mean()) for each in known]
        costs, share = (cost, means[0], means[1]), float(verdict == "accepted")
        session.decide(verdict, reason, verdict == "rejected", costs, share=share)


def _evidence(session: GuardSession) -> BlockEvidence:
    evidence: BlockEvidence = session.state.evidence
    return evidence
