"""How a candidate is decided on: `decide` tries it on known starts, then on new ones.

`decide` changes nothing: it returns the evidence from there on. Each trial is one sequence of
pairs: a few starts, then twice as many, until the policy is surely better, or hopeless. A candidate
that fails may pass in some regions, or in part. What "no worse" means is in `sb3_yann.compare`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._validation import Array, message_of
from sb3_yann.compare import (
    TOO_LITTLE,
    AcceptanceRule,
    NewSeeds,
    PairedTrial,
    Scores,
    Starts,
    Verdict,
    less_safe,
    level_of_look,
    looks,
    no_worse,
)
from sb3_yann.control.mpc.bound_excess import excess_of_episodes
from sb3_yann.control.wrapper_stack import require_state_shown
from sb3_yann.env_pool import EnvPool
from sb3_yann.guard.state import Decision, DecisionKind, Evidence, Play
from sb3_yann.policy.checkpoint import ActorCheckpoint
from sb3_yann.policy.observations import normalized
from sb3_yann.policy.policies import StartsAsMPC
from sb3_yann.rollout import Rows, Trajectories, preserve_rng, rollout

FIRST_STARTS = 5  # starts of a trial of its first look
PARTS_OF_THE_WAY = 0.5, 0.25
"""How far towards a refused candidate, and which shares of a correction that lost, are tried."""


class Unplayable(Exception):
    """The policy's episodes cannot be played to their end; the message says why."""


@dataclass(frozen=True)
class GuardSettings:
    """Name of the simulator, seeds of the known starts; the rest as in `ImprovementGuard`."""

    env: str
    seeds: range
    n_new_starts: int
    n_final_starts: int
    eval_freq: int
    patience: int
    keep_if_worse: bool
    rule: AcceptanceRule

    @property
    def of_evidence(self) -> dict[str, Any]:
        """Those that the evidence depends on."""
        names = ("margin", "cvar_alpha", "excess_room", "max_input_step")
        rule = {name: getattr(self.rule, name) for name in names}
        return {"env": self.env, "seeds": self.seeds, **rule}

    @property
    def least_gain(self) -> float:
        """What a policy must gain; a strict rule takes any gain."""
        return self.rule.least_gain if self.rule.cvar_alpha else 0.0


def decide(
    evidence: Evidence, candidate: ActorCheckpoint, play: Play, settings: GuardSettings
) -> tuple[Evidence, Decision] | None:
    """Return the evidence after a candidate, and the decision on it.

    None where the candidate differs from the accepted policy only in regions that no episode comes
    through.
    """
    before = evidence.accepted
    rule = settings.rule
    changed = before.changed_regions(candidate)
    diverged = candidate.has_diverged()
    if not diverged and not np.any(changed & evidence.scores.visits.any(axis=0)):
        return None
    tried = _accept(evidence, candidate, play, settings)
    after = tried.evidence
    verdict = tried.verdict
    reason = verdict.reason
    share = float(verdict.accepted)
    hopeless = verdict.breaks_limit or (verdict.above_mpc and not settings.keep_if_worse)
    # What is as good as the accepted policy costs no patience.
    rejections = evidence.rejections + (TOO_LITTLE not in reason) if reason else 0
    restored = bool(reason) and (rejections >= settings.patience or hopeless)
    # Candidates that follow each other are alike: parts of the first and of the last are tried.
    if reason and not diverged and TOO_LITTLE not in reason and (restored or rejections == 1):
        for part, its_share in _parts(before, candidate, tried.scores, tried.others, rule):
            found = _accept(after, part, play, settings)
            after = found.evidence
            if found.verdict.accepted:
                share = its_share
            if found.verdict.accepted or TOO_LITTLE in found.verdict.reason:
                break  # a smaller part gains less
    after = replace(after, rejections=0 if restored else rejections)
    regions = _accepted_regions(before, candidate, after.accepted) if reason else []
    return after, _decision(after, tried.mean, reason, restored, regions, share)


def decide_at_end(
    evidence: Evidence, play: Play, settings: GuardSettings
) -> tuple[Evidence, Decision | None]:
    """Confirm what is accepted on the final new starts; return the evidence, and a refusal.

    Where it loses, its parts and earlier checkpoints are tried, the best on known starts first,
    else the MPC is accepted. All that are tried share the probability of an error.
    """
    tried = evidence.accepted
    rule = settings.rule
    if settings.n_final_starts == 0 or not tried.has_learned():
        return evidence, None
    seeds = NewSeeds(evidence.next_seed)
    trial = _new_trial(evidence, play, seeds, at_end=True)
    evidence, verdict = _on_all_known(evidence, play)
    is_known_to_lose = not verdict.accepted
    scores: Scores | None = evidence.scores
    of_mpc = evidence.starts.mpc.at(slice(len(evidence.scores.costs)))
    if not is_known_to_lose:
        scores, verdict = _confirm(trial, tried, settings, level_of_look(rule.significance, 1))
        of_mpc = trial.mpc_scores
    evidence = replace(evidence, next_seed=seeds.next)
    if scores is not None and verdict.accepted:
        return replace(evidence, confirmed=(trial.starts, scores)), None

    mean = evidence.mean_of(evidence.scores)
    after = evidence.without_passed(tried)
    if not is_known_to_lose:
        after, _ = _with_hard_starts(after, trial.starts, scores)
    mpc = after = replace(after, accepted=after.mpc, scores=after.starts.mpc)
    parts = [each for each, _ in _parts(mpc.mpc, tried, scores, of_mpc, rule)]
    others = list[tuple[float, Evidence]]()
    for policy in (*parts, *reversed(mpc.passed)):
        known, its_scores, found = try_on_known(mpc, policy, play, settings)
        if its_scores is not None and found.accepted:
            others.append((known.mean_of(its_scores)[0], known.with_visited(policy, its_scores)))
    others.sort(key=lambda each: each[0])
    for number, (_, other) in enumerate(others, start=2):
        part, found = _on_all_known(other, play)
        if not found.accepted:
            continue
        level = level_of_look(rule.significance, number)
        scores, found = _confirm(trial, part.accepted, settings, level)
        if scores is not None and found.accepted:
            after = replace(part.with_passed(part.accepted), confirmed=(trial.starts, scores))
            break
    after = replace(after, next_seed=seeds.next)
    regions = _accepted_regions(evidence.mpc, tried, after.accepted)
    reason = f"at the end, {verdict.reason}; {_what_acts(after, tried)}"
    return after, _decision(after, mean, reason, True, regions)


def _on_all_known(evidence: Evidence, play: Play) -> tuple[Evidence, Verdict]:
    """Return whether the accepted policy is no worse than the MPC on all known starts.

    It may have been accepted by few of them, and others have refused candidates like it.
    """
    starts = evidence.starts
    mpc = starts.mpc
    try:
        evidence = evidence.known_up_to(len(starts.seeds), play)
    except Unplayable as error:
        return evidence, Verdict(str(error), breaks_limit=True)
    return evidence, no_worse(
        evidence.scores, mpc, mpc, starts.tolerance, names=starts.seeds, n_hard=starts.n_hard
    )


def try_before_training(
    evidence: Evidence, candidate: ActorCheckpoint, play: Play, settings: GuardSettings
) -> tuple[Evidence, Decision | None]:
    """Return the evidence after a policy that has learnt before, and the decision on a refusal."""
    evidence, scores, verdict = try_on_known(evidence, candidate, play, settings)
    if scores is not None and verdict.accepted:
        return evidence.with_visited(candidate, scores), None
    reason = f"before training, {verdict.reason}"
    return evidence, _decision(evidence, evidence.mean_of(scores), reason, True)


def try_on_known(
    evidence: Evidence, candidate: ActorCheckpoint, play: Play, settings: GuardSettings
) -> tuple[Evidence, Scores | None, Verdict]:
    """Play a candidate from the known starts until they tell; return its scores and the verdict.

    The evidence that is returned has the accepted policy's scores on the same starts.
    """
    if candidate.has_diverged():
        reason = "a parameter of the actor is not a finite number, or too large"
        return evidence, None, Verdict(reason, breaks_limit=True)
    known = evidence.starts
    verdict = Verdict()
    trial = PairedTrial(play, evidence.mpc, known, NewSeeds(evidence.next_seed))
    counts = [known.n_hard + each for each in looks(FIRST_STARTS, len(settings.seeds))]
    try:
        for look in trial.stages(candidate, counts):
            count = len(trial.scores.costs)
            evidence = evidence.known_up_to(count, play)
            level = level_of_look(settings.rule.significance, look)
            accepted = evidence.scores.at(slice(count))
            verdict = trial.verdict(level, accepted, least_gain=settings.least_gain)
            if verdict.is_hopeless or (verdict.accepted and verdict.is_sure):
                break
    except Unplayable as error:
        return evidence, None, Verdict(str(error), breaks_limit=True)
    lost = np.flatnonzero(known.lost(trial.scores))
    evidence = replace(evidence, lost=tuple(known.seeds[i] for i in lost))
    if verdict.accepted and verdict.is_hopeless:
        verdict = verdict._replace(reason=f"{TOO_LITTLE} over the accepted policy")
    return evidence, trial.scores, verdict


class _Tried(NamedTuple):
    """What came of a candidate: its mean cost, over how many known starts.

    Then its scores there and on new starts, and those that it was compared with.
    """

    evidence: Evidence
    verdict: Verdict
    mean: tuple[float, int]
    scores: Scores | None = None
    others: Scores | None = None


def _accept(
    evidence: Evidence, candidate: ActorCheckpoint, play: Play, settings: GuardSettings
) -> _Tried:
    """Accept a candidate that is no worse on the known starts, and confirmed on new ones."""
    evidence, scores, verdict = try_on_known(evidence, candidate, play, settings)
    tried = _Tried(evidence, verdict, evidence.mean_of(scores))
    if scores is None:
        return tried
    others = evidence.scores.at(slice(len(scores.costs)))
    tried = tried._replace(scores=scores, others=others)
    if not verdict.accepted:
        return tried
    after = evidence.with_visited(candidate, scores)
    if settings.n_new_starts == 0 or not after.accepted.has_learned():
        return tried._replace(evidence=after)
    seeds = NewSeeds(evidence.next_seed)
    trial = _new_trial(evidence, play, seeds)
    new, verdict = _confirm(trial, after.accepted, settings)
    if verdict.accepted:
        after = replace(after, next_seed=seeds.next, new=trial.starts)
        return tried._replace(evidence=after.with_passed(after.accepted), verdict=verdict)
    if new is not None:
        scores = scores.extended_by(new)
        others = others.extended_by(trial.mpc_scores)
    evidence = replace(evidence, next_seed=seeds.next)
    after = _after_loss(evidence, trial.starts, new, play)
    return _Tried(after, verdict, tried.mean, scores, others)


def _new_trial(
    evidence: Evidence, play: Play, seeds: NewSeeds, at_end: bool = False
) -> PairedTrial:
    """Return a trial on starts that have decided on no candidate but by confirming it.

    They are the same until a policy loses there, and others at the end.
    """
    starts = evidence.starts
    new = evidence.new
    if new is None or at_end:
        new = Starts((), starts.mpc.at(slice(0)), starts.tolerance)
    return PairedTrial(play, evidence.mpc, new, seeds)


def _confirm(
    trial: PairedTrial,
    policy: ActorCheckpoint,
    settings: GuardSettings,
    significance: float | None = None,
) -> tuple[Scores | None, Verdict]:
    """Return a policy's scores on new starts, and whether it is no worse than the MPC.

    With a ``significance`` it is the final trial: the gain must be sure at it, over all looks, and
    large enough, but for a strict rule.
    """
    rule = settings.rule
    strict = significance is not None and not rule.cvar_alpha
    level = 0.2  # one-sided, until the end: the policy has passed on the known starts
    counts = looks(FIRST_STARTS, settings.n_new_starts)
    demands: dict[str, Any] = {}
    if significance is not None:
        # The worst 5 % of forty are two.
        counts = looks(40, settings.n_final_starts)
        demands = {"least_gain": settings.least_gain, "tail_errors": rule.standard_errors}
        demands["must_gain"] = not strict
    verdict = Verdict()
    try:
        for look in trial.stages(policy, counts):
            level = level if significance is None else level_of_look(significance, look)
            verdict = trial.verdict(level, **demands)
            if verdict.is_hopeless or (verdict.accepted and verdict.is_sure and not strict):
                break
    except Unplayable as error:
        return None, Verdict(f"on new starts, {error}")
    if verdict.accepted:
        return trial.scores, verdict
    reason = f"on {len(trial.scores.costs)} new starts, {verdict.reason}"
    return trial.scores, verdict._replace(reason=reason)


def _with_hard_starts(
    evidence: Evidence, new: Starts, scores: Scores | None
) -> tuple[Evidence, NDArray[np.int64]]:
    """Let the hardest starts of a policy that lost on new ones join the known ones; return which.

    Others take the place of the new ones.
    """
    hard = np.zeros(1, dtype=np.int64) if scores is None else new.hardest(scores)
    starts = evidence.starts.with_hard(new, hard)
    return replace(evidence, starts=starts, new=None, confirmed=None), hard


def _after_loss(evidence: Evidence, new: Starts, scores: Scores | None, play: Play) -> Evidence:
    """Return the evidence after a policy has lost on new starts.

    What is accepted must pass on all of these; else the latest earlier checkpoint that does is
    accepted, or the MPC.
    """
    after, hard = _with_hard_starts(evidence, new, scores)
    count = slice(1 if scores is None else len(scores.costs))
    mpc = new.mpc.at(count)
    passed = reversed(evidence.without_passed(evidence.accepted).passed)
    earlier = [(each, evidence.scores.at(slice(0))) for each in passed]
    if not evidence.accepted.has_networks_of(evidence.mpc):
        earlier.insert(0, (evidence.accepted, evidence.scores))
    for checkpoint, known in earlier:
        try:
            its = play(checkpoint, new.seeds[count])
        except Unplayable:
            continue
        if no_worse(its, mpc, mpc, new.tolerance).accepted:
            return replace(after, accepted=checkpoint, scores=its.at(hard).extended_by(known))
        after = after.without_passed(checkpoint)
    return replace(after, accepted=after.mpc, scores=after.starts.mpc)


def _parts(
    accepted: ActorCheckpoint,
    candidate: ActorCheckpoint,
    scores: Scores | None,
    others: Scores | None,
    rule: AcceptanceRule,
) -> Iterator[tuple[ActorCheckpoint, float]]:
    """Yield parts of a candidate that was refused, and which share of the way to it each is.

    By region: the networks of those through which it wins more than it loses, by the episodes that
    come through.
    """
    if rule.by_region and scores is not None and others is not None:
        more = np.nan_to_num(scores.costs - others.costs, nan=np.inf)
        more[less_safe(scores.unsafe, others.unsafe).any(axis=1)] = np.inf
        visits = scores.visits | others.visits
        changed = accepted.changed_regions(candidate)
        lost = np.where(visits, np.maximum(more, 0.0)[:, None], 0.0).sum(axis=0)
        won = np.where(visits, np.maximum(-more, 0.0)[:, None], 0.0).sum(axis=0)
        kept = changed & (won > lost)
        if kept.any() and np.any(changed & visits.any(axis=0) & ~kept):
            yield accepted.with_regions(candidate, np.flatnonzero(kept).tolist()), 0.0
    if rule.backtrack:
        learned = accepted.has_learned()
        for share in PARTS_OF_THE_WAY:
            part = accepted.part_way(candidate, share) if learned else candidate.shrunk(share)
            yield part, share


def _decision(
    evidence: Evidence,
    of_candidate: tuple[float, int],
    reason: str,
    restored: bool,
    regions: Sequence[int] = (),
    share: float = 0.0,
) -> Decision:
    starts = evidence.starts
    costs = evidence.scores.costs
    verdict: DecisionKind = "accepted"
    if reason:
        verdict = "accepted in part" if regions or share else "rejected"
    more = (costs - starts.mpc.costs[: len(costs)])[starts.n_hard :]
    of_accepted = evidence.mean_of(evidence.scores)
    of_mpc = evidence.mean_of(starts.mpc)
    return Decision(
        verdict=verdict,
        reason=reason,
        restored=restored,
        candidate_cost=of_candidate[0],
        accepted_cost=of_accepted[0],
        mpc_cost=of_mpc[0],
        played=(of_candidate[1], of_accepted[1], of_mpc[1]),
        worst_start=float(np.max(more, initial=-np.inf)),
        regions=tuple(regions),
        share=share,
    )


def _accepted_regions(
    before: ActorCheckpoint, candidate: ActorCheckpoint, accepted: ActorCheckpoint
) -> list[int]:
    """Return the regions in which the accepted networks are new, and the candidate's."""
    new = before.changed_networks(accepted) & ~candidate.changed_networks(accepted)
    return list(map(int, np.flatnonzero(new)))


def _what_acts(evidence: Evidence, tried: ActorCheckpoint) -> str:
    """Say what is accepted in the place of a policy that lost."""
    accepted = evidence.accepted
    if not accepted.has_learned():
        return "the guard falls back to the MPC"
    for share in PARTS_OF_THE_WAY:
        if accepted.has_networks_of(tried.shrunk(share)):
            return f"{100 * share:g} % of its correction is kept"
    if _accepted_regions(evidence.mpc, tried, accepted):
        return "what it has learnt in other regions is kept"
    return "an earlier policy is restored"


@dataclass(eq=False)
class Player:
    """Plays checkpoints in the guard's simulator; the policy stays as it is.

    Inputs may move by ``max_input_step`` (m,) from one sample to the next. To the cost of an
    episode ``offset`` is added, what that of the reward takes from one of the MPC's. Whether its
    env ``pays_cost`` of the problem, as the policy scales it, is known once the MPC has played.
    Once Ctrl-C has restored the accepted policy, it is ``interrupted``, and restores nothing else.
    ``steps`` are those of the simulator that all episodes took.
    """

    model: OffPolicyAlgorithm
    policy: StartsAsMPC
    envs: EnvPool
    mpc: ActorCheckpoint
    max_input_step: Array | None = None
    offset: float = 0.0
    pays_cost: bool = True
    interrupted: bool = False
    steps: int = 0

    def __call__(self, checkpoint: ActorCheckpoint, seeds: Sequence[int]) -> Scores:
        """Return a checkpoint's scores; raise Unplayable if an action or the env is at fault."""
        try:
            return self.scores(self.episodes(checkpoint, seeds))
        except Unplayable:
            raise
        except Exception as error:
            if self.interrupted:  # a simulator has made of it what it can, e.g. in compiled code
                raise KeyboardInterrupt from error
            self.episodes(self.mpc, seeds)  # an error under the MPC as well is the env's own
            raise Unplayable(
                f"the simulator failed: {type(error).__name__}: {message_of(error)}"
            ) from error

    def episodes(self, checkpoint: ActorCheckpoint, seeds: Sequence[int]) -> Trajectories:
        """Return a checkpoint's episodes; raise Unplayable, or what the env raises."""
        own = {key: each.clone() for key, each in self.policy.actor.state_dict().items()}
        try:
            self.policy.actor.load_state_dict(checkpoint.actor)
            with preserve_rng():
                played = rollout(self._act, self.envs, seeds, check=self._check)
            self.steps += int(played.lengths.sum())
            if self.interrupted:  # and a simulator has swallowed it
                raise KeyboardInterrupt
            return played
        finally:
            if not self.interrupted:
                self.policy.actor.load_state_dict(own)

    def scores(self, played: Trajectories) -> Scores:
        """Return what the episodes cost and break, and the regions that they come through."""
        layer = self.policy.actor.mu
        own = played.mapped(self.theta, self.policy.inputs)
        excess = excess_of_episodes(self.policy.problem, own.pairs)
        far: Any = 0
        if self.max_input_step is not None:
            moved = [np.abs(np.diff(each, axis=0)) for each in played.actions]
            far = [np.any(each > self.max_input_step, axis=1).sum() for each in moved]
        visits = np.zeros((len(played.costs), layer.n_networks), dtype=bool)
        for visited, theta in zip(visits, own.observations, strict=True):
            visited[layer.regions(th.as_tensor(theta[:-1]))] = True
        unsafe = replace(played, excess=excess).unsafe(far)
        penalty = self.policy.critic_options.reward_scale * excess.penalty
        return Scores(played.costs + self.offset + penalty, unsafe, visits)

    def theta(self, observations: NDArray[Any]) -> Array:
        """Return theta in deviations (steps, n_theta) of what the simulator shows."""
        seen = self.policy.theta(normalized(self.model, observations))
        return np.asarray(seen.double().cpu().numpy())

    def _check(self, env: Any) -> None:
        if isinstance(env, gym.Env):  # others are copies of one that has no wrappers
            require_state_shown(env, self.policy.observation_given)

    def _act(self, t: int, observations: NDArray[Any], rows: Rows) -> NDArray[Any]:
        actions, _ = self.policy.predict(normalized(self.model, observations), deterministic=True)
        if not np.all(np.isfinite(actions)):  # of a subclass: the actor itself puts out no NaN
            raise Unplayable("an action of the actor is not a finite number")
        return np.asarray(actions)
