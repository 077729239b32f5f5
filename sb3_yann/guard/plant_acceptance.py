"""Decisions by the training episodes alone, for a plant without a simulator."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from sb3_yann.control import LinearMPC
from sb3_yann.guard.actor_checkpoint import ActorCheckpoint, same
from sb3_yann.guard.preconditions import check_acts_alone
from sb3_yann.guard.state import Decision, GuardState
from sb3_yann.guard.statistics import PlantEpisodes, compared, excess_of_an_outlier

if TYPE_CHECKING:
    from sb3_yann.guard.callback import ImprovementGuard
    from sb3_yann.policy.policies import YannPolicy

Array = NDArray[np.float64]
LARGEST = 1e9
"""Parameters beyond this are taken for diverged: the actor's sums could overflow."""


@dataclass
class Evidence:
    """Episodes of the MPC, of the accepted policy, and of the block that is being played.

    ``resting`` is the policy that plays a block in which the actor does not learn; ``terminates``
    says whether an episode of an accepted policy was ended by the env itself.
    """

    phase: Literal["first", "learning", "trial"] = "first"
    mpc: PlantEpisodes | None = None
    accepted: PlantEpisodes | None = None
    costs: list[float] = field(default_factory=list)
    predicted: list[float] = field(default_factory=list)
    resting: ActorCheckpoint | None = None
    terminates: bool = False


class PlantAcceptance:
    """Lets the actor learn for a block of episodes, then rest for one that is tested."""

    def __init__(self, trial_episodes: int, significance: float) -> None:
        self.trial_episodes, self.significance = trial_episodes, significance
        self.settings = {"env": None, "trial_episodes": trial_episodes}

    def start(self, guard: ImprovementGuard) -> None:
        """Begin with the episodes that start now; one that is under way is not counted."""
        n_envs = guard.training_env.num_envs
        check_acts_alone(guard)
        # SB3 goes on in the midst of an episode where its steps are not counted from 0 again.
        self.costs, self.lengths = np.zeros(n_envs), np.full(n_envs, int(guard.num_timesteps > 0))
        self.violated = np.zeros(n_envs, dtype=bool)
        # Whether the accepted policy has played all of the episode that is under way.
        self.accepted_led = np.zeros(n_envs, dtype=bool)
        self.starts: list[Array] = [np.empty(0)] * n_envs
        self.blocks = np.full(n_envs, -1)
        self.block = 0
        self.returned = "", -1  # why, and after how many episodes, the actor returned last
        self.lost = 0  # episodes of the first block whose cost is not known

    def still_holds(self, guard: ImprovementGuard) -> bool:
        """Return whether the evidence is there; a plant cannot be played again."""
        return guard.state.evidence is not None

    def first_evidence(self, guard: ImprovementGuard, known: GuardState | None) -> None:
        """Begin with a block of episodes of the present policy, or of what is accepted already."""
        other = False
        if known is not None:  # what the present one is, if it is another, nobody has found out
            other = not same(known.accepted, guard.policy)
            known.accepted.restore(guard.policy)
        if diverged(guard.policy):  # there is nothing to return to, but the MPC
            other = True
            guard.mpc.restore(guard.policy)
        guard.accept(evidence := Evidence(resting=ActorCheckpoint.of(guard.policy)))
        if other:
            self._report(guard, evidence, "rejected", "before training, it is not accepted", np.nan)

    def before_steps(self, guard: ImprovementGuard) -> None:
        """Bring the accepted policy back before a diverged one acts on the plant.

        SB3 calls this after each training of the networks, before the next action.
        """
        if diverged(guard.policy):
            reason = "a parameter of the actor is not a finite number, or too large"
            self._return(guard, guard.state.evidence, reason)

    def step(self, guard: ImprovementGuard) -> None:
        """Count the step; decide where a block is over."""
        evidence: Evidence = guard.state.evidence
        self._enrol(guard, evidence)
        if self.accepted_led.any() and not same(guard.state.accepted, guard.policy):
            self.accepted_led[:] = False
        if evidence.resting is not None and not same(evidence.resting, guard.policy):
            self._return(guard, evidence, "the actor was changed while it rested")
        dones, infos = guard.locals["dones"], guard.locals["infos"]
        for i, done in enumerate(dones):
            self.costs[i] -= float(guard.locals["rewards"][i])
            self.lengths[i] += 1
            terminated = bool(done and not infos[i].get("TimeLimit.truncated", False))
            if infos[i].get("violation", False) or (terminated and not evidence.terminates):
                self.violated[i] = True
                if not same(guard.state.accepted, guard.policy):
                    self._return(guard, evidence, "a limit was violated")
                elif terminated and self.accepted_led[i]:
                    evidence.terminates = True
            if done:
                known = np.isfinite(self.costs[i])
                if self.blocks[i] == self.block and not known and evidence.phase == "first":
                    self._lose(i)
                elif self.blocks[i] == self.block:
                    evidence.costs.append(float(self.costs[i]))
                    if evidence.phase != "learning":
                        evidence.predicted.append(
                            predicted_cost(guard.policy.problem, self.starts[i], self.lengths[i])
                        )
                self.costs[i], self.lengths[i], self.violated[i] = 0.0, 0, False
                self.blocks[i] = -1
        if len(evidence.costs) >= self.trial_episodes:
            self._block_is_over(guard, evidence)
        # Nor does the actor learn while an episode goes on in which a limit was violated: until
        # it is over, it is the accepted policy that leads the plant back.
        rests = evidence.phase != "learning" or self.violated.any()
        guard.policy.actor_step = 0.0 if rests else guard.state.step

    def _enrol(self, guard: ImprovementGuard, evidence: Evidence) -> None:
        """Count episodes that start now as the block's, before anything ends the block.

        The first to start are the ones that count, not the first to end: of several envs side by
        side, those would be the short episodes.
        """
        starting = np.flatnonzero(self.lengths == 0)
        if len(starting) == 0:
            return
        self.accepted_led[starting] = True
        theta = guard.policy.theta(guard.model._last_obs).double().cpu().numpy()  # type: ignore[arg-type]
        for i in starting:  # s_t, before the step
            self.starts[i] = theta[i]
            if not np.all(np.isfinite(theta[i])):
                continue  # what it should cost from there is not known
            counted = len(evidence.costs) + np.count_nonzero(self.blocks == self.block)
            if counted < self.trial_episodes:
                self.blocks[i] = self.block

    def end(self, guard: ImprovementGuard) -> None:
        """Leave an unfinished block undecided: the accepted policy stays, and learns again."""
        evidence: Evidence = guard.state.evidence
        if evidence.phase != "first":
            self._next(guard, evidence, "learning")

    def _next(
        self,
        guard: ImprovementGuard,
        evidence: Evidence,
        phase: Literal["first", "learning", "trial"],
    ) -> None:
        evidence.phase = phase
        evidence.costs, evidence.predicted = [], []
        evidence.resting = None if phase == "learning" else ActorCheckpoint.of(guard.policy)
        self.block += 1

    def _return(self, guard: ImprovementGuard, evidence: Evidence, reason: str) -> None:
        """Bring the accepted policy back at once, whatever the block.

        What does so step after step is one decision in each episode.
        """
        guard.state.accepted.restore(guard.policy)
        if self.returned != (reason, guard.state.episodes):
            self._report(guard, evidence, "rejected", reason, np.nan)
        self.returned = reason, guard.state.episodes
        self._next(guard, evidence, "first" if evidence.accepted is None else "learning")

    def _lose(self, i: int) -> None:
        """Leave out an episode of the first block; where no end of that is in sight, say so."""
        self.lost += 1
        if self.lost >= self.trial_episodes:
            raise ValueError(
                f"{self.lost} episodes of the guard's first block cost what is no finite number, "
                f"the last {self.costs[i]:g}: no policy can be compared with that. Rewards must be "
                "finite numbers."
            )

    def _block_is_over(self, guard: ImprovementGuard, evidence: Evidence) -> None:
        if evidence.phase == "learning":
            self._next(guard, evidence, "trial")
            return
        played = PlantEpisodes(np.array(evidence.costs), np.array(evidence.predicted))
        if evidence.phase == "first":
            evidence.accepted = played
            if guard.policy.actor.mu.network.is_zero():
                evidence.mpc = played
        elif not same(guard.state.accepted, guard.policy):
            assert evidence.accepted is not None
            difference, chance = compared(played, evidence.accepted)
            reason = f"{difference:+.4g} from the same starts by the linear model, p = {chance:.3g}"
            beyond = excess_of_an_outlier(played, evidence.accepted)
            if beyond > 0:
                reason += f", but one start costs {beyond:.4g} more than it should"
            if chance < self.significance and not beyond > 0:
                evidence.accepted = played
                guard.accept(evidence)
                self._report(guard, evidence, "accepted", reason, played.costs.mean())
            else:
                guard.state.accepted.restore(guard.policy)
                self._report(guard, evidence, "rejected", reason, played.costs.mean())
        self._next(guard, evidence, "learning")

    def _report(
        self,
        guard: ImprovementGuard,
        evidence: Evidence,
        verdict: Literal["accepted", "rejected"],
        reason: str,
        cost: float,
    ) -> None:
        def mean(episodes: PlantEpisodes | None) -> float:
            return np.nan if episodes is None else float(episodes.costs.mean())

        guard.decide(
            Decision(
                timestep=guard.num_timesteps,
                episode=guard.state.episodes,
                verdict=verdict,
                reason=reason,
                returned=verdict == "rejected",
                candidate_cost=float(cost),
                accepted_cost=mean(evidence.accepted),
                mpc_cost=mean(evidence.mpc),
                worst_start=np.nan,
                regions=(),
            )
        )


def diverged(policy: YannPolicy) -> bool:
    """Return whether a parameter of the actor is not a finite number, or too large."""
    largest = [each.detach().abs().max() for each in policy.actor.parameters()]
    return not all(bool(each <= LARGEST) for each in largest)  # nor does nan pass


def predicted_cost(problem: LinearMPC, start: Array, steps: int) -> float:
    """Return what the MPC costs on its own linear model, from a start, over a number of steps."""
    law, theta, cost = problem.explicit(), start, 0.0
    for _ in range(steps):
        u = law(theta)
        cost += float(problem.stage_cost(theta, u))
        theta = problem.predict(theta, u)
    return cost
