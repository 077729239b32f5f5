"""How a candidate is decided on: `decide` tries it on known starts, then on new ones.

`decide` changes nothing: it returns the evidence from there on. A candidate that fails as a whole
may pass in single regions or in part; a policy that loses on new starts gives way to a smaller
correction, to an earlier policy, or to the MPC. What "no worse" means is in `sb3_yann.compare`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._validation import Array
from sb3_yann.compare import (
    AcceptanceRule,
    Scores,
    Starts,
    Verdict,
    is_above,
    less_safe,
)
from sb3_yann.control.linearization.wrapper_stack import require_state_shown
from sb3_yann.control.mpc.bound_excess import excess_of_episodes
from sb3_yann.guard.state import Decision, Evidence, Outcome
from sb3_yann.policy.checkpoint import ActorCheckpoint
from sb3_yann.policy.observations import normalized
from sb3_yann.policy.policies import StartsAsMPC
from sb3_yann.rollout import (
    EnvPool,
    Rows,
    Source,
    Trajectories,
    preserve_rng,
    rollout,
)

PARTS_OF_THE_WAY = 0.5, 0.25
"""How far towards a refused candidate, and which shares of a correction that lost, are tried."""
MAX_LOST_SHARE = 0.2
"""Share of losing starts beyond which regions are not dropped one after the other."""

Play = Callable[[ActorCheckpoint, Sequence[int]], Scores]
"""From a checkpoint and seeds to the scores of its episodes; raises Unplayable."""


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


def decide(
    evidence: Evidence, candidate: ActorCheckpoint, play: Play, settings: GuardSettings
) -> tuple[Evidence, Decision] | None:
    """Return the evidence after a candidate, and the decision on it.

    None where the candidate differs from the accepted policy only in regions that no episode comes
    through.
    """
    before, rule = evidence.accepted, settings.rule
    changed = before.changed_regions(candidate)
    diverged = candidate.has_diverged()
    if not diverged and not np.any(changed & evidence.scores.visits.any(axis=0)):
        return None

    # The whole candidate on the known starts; else single regions; else part of the way to it.
    scores, verdict = try_on_known(evidence, candidate, play)
    hopeless = verdict.breaks_limit
    after, share = evidence, 0.0
    if scores is not None and verdict.accepted:
        after, share = evidence.with_visited(candidate, scores), 1.0
    elif scores is not None and not hopeless:
        hopeless = verdict.above_mpc and not settings.keep_if_worse
        if rule.by_region:
            after = _accept_regions(evidence, candidate, scores, play)
    if not verdict.accepted and not diverged and rule.backtrack:
        if before.has_networks_of(after.accepted):
            after, share = _accept_part_of_the_way(evidence, candidate, play)

    # Whatever is new is confirmed on new starts.
    tried, confirmed = after.accepted, Verdict()
    if not before.has_networks_of(tried):
        after, confirmed = _confirm(after, play, rule, settings.n_new_starts)
    if not tried.has_networks_of(after.accepted):
        share = 0.0

    reason = verdict.reason or confirmed.reason
    rejections = evidence.rejections + 1 if reason else 0
    hopeless = hopeless or confirmed.breaks_limit
    restored = bool(reason) and (rejections >= settings.patience or hopeless)
    after = replace(after, rejections=0 if restored else rejections)
    regions = _accepted_regions(before, candidate, after.accepted) if reason else []
    return after, _decision(after, settings, scores, reason, restored, regions, share)


def decide_at_end(
    evidence: Evidence, play: Play, settings: GuardSettings
) -> tuple[Evidence, Decision | None]:
    """Return the evidence after the final new starts, and the decision where it is a refusal."""
    rule = settings.rule
    bar = rule.standard_errors, rule.least_gain if rule.cvar_alpha else 0.0
    after, verdict = _confirm(evidence, play, rule, settings.n_final_starts, *bar)
    if verdict.accepted:
        return after, None
    regions = _accepted_regions(evidence.mpc, evidence.accepted, after.accepted)
    reason = f"at the end, {verdict.reason}"
    return after, _decision(after, settings, evidence.scores, reason, True, regions)


def try_before_training(
    evidence: Evidence, candidate: ActorCheckpoint, play: Play, settings: GuardSettings
) -> tuple[Evidence, Decision | None]:
    """Return the evidence after a policy that has learnt before, and the decision on a refusal."""
    scores, verdict = try_on_known(evidence, candidate, play)
    if scores is not None and verdict.accepted:
        return evidence.with_visited(candidate, scores), None
    reason = f"before training, {verdict.reason}"
    return evidence, _decision(evidence, settings, scores, reason, True)


def try_on_known(
    evidence: Evidence, candidate: ActorCheckpoint, play: Play
) -> tuple[Scores | None, Verdict]:
    """Return a candidate's scores on the known starts, and the verdict on it."""
    if candidate.has_diverged():
        reason = "a parameter of the actor is not a finite number, or too large"
        return None, Verdict(reason, breaks_limit=True)
    try:
        scores = play(candidate, evidence.starts.seeds)
    except Unplayable as error:
        return None, Verdict(str(error), breaks_limit=True)
    return scores, evidence.verdict(scores)


def _decision(
    evidence: Evidence,
    settings: GuardSettings,
    scores: Scores | None,
    reason: str,
    restored: bool,
    regions: Sequence[int] = (),
    share: float = 0.0,
) -> Decision:
    first = slice(len(settings.seeds))  # hard starts come and go: costs must be comparable
    costs, mpc_costs = evidence.scores.costs[first], evidence.starts.mpc.costs[first]
    verdict: Outcome = "accepted"
    if reason:
        verdict = "accepted in part" if regions or share else "rejected"
    return Decision(
        verdict=verdict,
        reason=reason,
        restored=restored,
        candidate_cost=np.nan if scores is None else float(scores.costs[first].mean()),
        accepted_cost=float(costs.mean()),
        mpc_cost=float(mpc_costs.mean()),
        worst_start=float(np.max(costs - mpc_costs)),
        regions=tuple(regions),
        share=share,
    )


def _accepted_regions(
    before: ActorCheckpoint, candidate: ActorCheckpoint, accepted: ActorCheckpoint
) -> list[int]:
    """Return the regions in which the accepted networks are new, and the candidate's."""
    new = before.changed_networks(accepted) & ~candidate.changed_networks(accepted)
    return [int(region) for region in np.flatnonzero(new)]


def _accept_part_of_the_way(
    evidence: Evidence, candidate: ActorCheckpoint, play: Play
) -> tuple[Evidence, float]:
    """Accept what lies half or a quarter of the way to a refused candidate; return the share."""
    for share in PARTS_OF_THE_WAY:
        between = evidence.accepted.part_way(candidate, share)
        try:
            scores = play(between, evidence.starts.seeds)
        except Unplayable:
            continue
        if evidence.improves(scores):
            return evidence.with_visited(between, scores), share
    return evidence, 0.0


def _accept_regions(
    evidence: Evidence, candidate: ActorCheckpoint, scores: Scores | None, play: Play
) -> Evidence:
    """Accept regions of a refused candidate; its scores are None where it cannot be played."""
    # In another box of theta no mixture is what was played, anywhere.
    if scores is not None and evidence.accepted.is_confined_as(candidate):
        evidence = _accept_all_but_losing(evidence, candidate, scores, play)
    return _accept_one_by_one(evidence, candidate, scores, play)


def _accept_all_but_losing(
    evidence: Evidence, candidate: ActorCheckpoint, scores: Scores, play: Play
) -> Evidence:
    """Drop the regions by which few starts lose, until the others can be accepted.

    Losing starts come through the dropped region most, winning ones least. Only its episodes are
    played again.
    """
    before, starts = evidence.accepted, evidence.starts
    visited = (evidence.scores.visits | scores.visits).any(axis=0)
    kept = np.flatnonzero(before.changed_regions(candidate) & visited).tolist()
    while len(kept) > 1:
        lost = starts.excess(scores) > 1.0
        if not lost.any() or lost.mean() > MAX_LOST_SHARE:
            break
        won = scores.costs < evidence.scores.costs - starts.tolerance.margin
        blame = scores.visits[lost].sum(axis=0)[kept]
        credit = scores.visits[won].sum(axis=0)[kept]
        if not blame.any():
            break
        dropped = kept.pop(int(np.argmax(blame / (blame + credit + 1e-9))))
        mixed = before.with_regions(candidate, kept)
        again = np.flatnonzero(scores.visits[:, dropped])
        try:
            scores = scores.replaced(again, _play_some(evidence, mixed, again, play))
        except Unplayable:
            break
        if evidence.improves(scores):
            return evidence.with_visited(mixed, scores)
    return evidence


def _accept_one_by_one(
    evidence: Evidence, candidate: ActorCheckpoint, scores: Scores | None, play: Play
) -> Evidence:
    """Accept the regions of the candidate that improve the accepted policy, one by one."""
    for region in np.argsort(-evidence.scores.visits.sum(axis=0), kind="stable").tolist():
        visiting = np.flatnonzero(evidence.scores.visits[:, region])
        if len(visiting) == 0 or not evidence.accepted.changed_regions(candidate)[region]:
            continue
        mixed = evidence.accepted.with_regions(candidate, [region])
        known, trial = visiting[:0], evidence.scores
        if scores is not None:
            # The candidate's own episodes, if they meet no region where the mixture is another.
            other = mixed.changed_regions(candidate)
            known = visiting[~scores.visits[visiting][:, other].any(axis=1)]
            trial = trial.replaced(known, scores.at(known))
            if len(known) and _lose_already(evidence, trial, known):
                continue  # whatever the others cost
        others = np.setdiff1d(visiting, known)
        try:
            trial = trial.replaced(others, _play_some(evidence, mixed, others, play))
        except Unplayable:
            continue
        if evidence.improves(trial):
            evidence = evidence.with_accepted(mixed, trial)
    return evidence


def _lose_already(evidence: Evidence, trial: Scores, index: NDArray[np.int64]) -> bool:
    """Return whether some episodes are lost against the MPC, or less safe than those accepted."""
    starts, own = evidence.starts.at(index), trial.at(index)
    allowed = np.minimum(evidence.scores.unsafe, evidence.starts.mpc.unsafe)[index]
    less = less_safe(own.unsafe, allowed, starts.tolerance.excess_room)
    return starts.is_lost(own) or bool(np.any(less))


def _play_some(
    evidence: Evidence, checkpoint: ActorCheckpoint, index: NDArray[np.int64], play: Play
) -> Scores:
    """Return the scores of a checkpoint on some of the known starts."""
    if len(index) == 0:
        return evidence.scores.at(index)
    return play(checkpoint, [evidence.starts.seeds[i] for i in index])


def _confirm(
    evidence: Evidence,
    play: Play,
    rule: AcceptanceRule,
    n_starts: int,
    standard_errors: float = 0.0,
    least_gain: float = 0.0,
) -> tuple[Evidence, Verdict]:
    """Play what is accepted from new starts; return the evidence from there on, and the verdict.

    Where it loses, the better one of half or a quarter of its correction, and the latest earlier
    checkpoint that passes all of these starts, is accepted instead; else the MPC. The hardest
    starts join the known ones. Where the rule says so, single regions of what lost may still be
    accepted, and are confirmed on other new starts.
    """
    first, tried = Verdict(), evidence.accepted
    for _ in range(3):  # what is left of a policy that lost is tried on others
        lost = evidence.accepted
        if n_starts == 0 or not lost.has_learned():
            break
        evidence, new = _new_starts(evidence, play, n_starts)
        new = replace(new, standard_errors=standard_errors, least_gain=least_gain)
        scores: Scores | None = None
        try:
            scores = play(lost, new.seeds)
            verdict = new.verdict(scores)
        except Unplayable as error:
            verdict = Verdict(f"on new starts, {error}")
        if verdict.accepted:
            evidence = evidence.with_passed(lost, evidence.scores)
            break
        first = verdict if first.accepted else first
        hard = new.hardest(scores)
        known = None if scores is None else evidence.scores.extended_by(scores.at(hard))
        smaller = lost if rule.backtrack else evidence.mpc
        safe = evidence = _fall_back(evidence.without_passed(lost), smaller, new, hard, play)
        if rule.by_region:
            evidence = _accept_regions(safe, lost, known, play)
        if evidence.accepted is safe.accepted:
            break
    else:  # what has not been confirmed on new starts is not accepted
        evidence = safe
    if first.accepted:
        return evidence, first
    return evidence, first._replace(reason=f"{first.reason}; {_what_acts(evidence, tried)}")


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


def _new_starts(evidence: Evidence, play: Play, n_starts: int) -> tuple[Evidence, Starts]:
    """Return as many new starts, without those where the MPC's own cost is not finite."""
    seeds = range(evidence.next_seed, evidence.next_seed + n_starts)
    mpc = play(evidence.mpc, seeds)
    finite = np.flatnonzero(np.isfinite(mpc.costs))
    if len(finite) == 0:
        raise ValueError(
            f"The MPC's own cost is a finite number on none of {n_starts} new starts of the "
            "guard's env, so policies cannot be compared there. Its rewards must be finite."
        )
    new = Starts((*seeds,), mpc, evidence.starts.tolerance, len(finite)).at(finite)
    return replace(evidence, next_seed=seeds.stop), new


def _fall_back(
    evidence: Evidence, lost: ActorCheckpoint, new: Starts, hard: NDArray[np.int64], play: Play
) -> Evidence:
    """Accept a smaller correction or the latest earlier checkpoint that passes, else the MPC.

    Each is tried on the new starts, of which ``hard`` join the known ones.
    """
    known = evidence.starts.joined_with(new.at(hard))
    smaller: list[tuple[ActorCheckpoint, Scores | None]] = []
    if lost.has_learned():
        smaller = [(lost.shrunk(share), None) for share in PARTS_OF_THE_WAY]
    best, scores = evidence.mpc, known.mpc
    for group in (smaller, [*reversed(evidence.passed)]):
        for checkpoint, had in group:
            found = _scores_if_passed(evidence.starts, known, checkpoint, had, new, hard, play)
            if found is not None:
                if not is_above(found.costs, scores.costs):
                    best, scores = checkpoint, found
                break
    after = replace(evidence, accepted=best, starts=known, scores=scores)
    return after if best is evidence.mpc else after.with_passed(best, scores)


def _scores_if_passed(
    before: Starts,
    known: Starts,
    checkpoint: ActorCheckpoint,
    had: Scores | None,
    new: Starts,
    hard: NDArray[np.int64],
    play: Play,
) -> Scores | None:
    """Return a checkpoint's scores on the known starts where it is no worse than the MPC there.

    The hard ones come first: they are few, and most checkpoints lose some. Then come the other new
    ones, and those known ``before`` that its scores ``had`` lack.
    """
    others = np.setdiff1d(np.arange(len(new.seeds)), hard)
    lacking = np.arange(0 if had is None else len(had.costs), len(before.seeds))
    parts = []
    for starts in (new.at(hard), new.at(others), before.at(lacking)):
        scores = starts.mpc  # of no starts
        if starts.seeds:
            try:
                scores = play(checkpoint, starts.seeds)
            except Unplayable:
                return None
            if starts.is_lost(scores):
                return None
        parts.append(scores)
    on_known = parts[2] if had is None else had.extended_by(parts[2])
    everywhere = on_known.extended_by(parts[0])
    for starts, scores in (
        (new.at(np.concatenate([hard, others])), parts[0].extended_by(parts[1])),
        (known, everywhere),
    ):
        if starts.is_lost(scores) or starts.mean_is_above(scores):
            return None
    return everywhere


class Player:
    """Plays checkpoints in the guard's simulator; the policy stays as it is.

    Inputs may move by ``max_input_step`` (m,) from one sample to the next. Whether its env
    ``pays_cost`` of the problem, as the policy scales it, is known once the MPC has played. Once
    Ctrl-C has restored the accepted policy, it is ``interrupted``, and restores nothing else.
    """

    def __init__(
        self, model: OffPolicyAlgorithm, policy: StartsAsMPC, env: Source, mpc: ActorCheckpoint
    ) -> None:
        self.model, self.policy, self.mpc, self.envs = model, policy, mpc, EnvPool(env)
        self.max_input_step: Array | None = None
        self.pays_cost = True
        self.interrupted = False

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
            raise Unplayable(f"the simulator failed: {type(error).__name__}: {error}") from error

    def episodes(self, checkpoint: ActorCheckpoint, seeds: Sequence[int]) -> Trajectories:
        """Return a checkpoint's episodes; raise Unplayable, or what the env raises."""
        own = {key: each.clone() for key, each in self.policy.actor.state_dict().items()}
        try:
            self.policy.actor.load_state_dict(checkpoint.actor)
            with preserve_rng():
                played = rollout(self._act, self.envs, seeds, check=self._check)
            if self.interrupted:  # and a simulator has swallowed it
                raise KeyboardInterrupt
            return played
        finally:
            if not self.interrupted:
                self.policy.actor.load_state_dict(own)

    def scores(self, played: Trajectories) -> Scores:
        """Return what the episodes cost and break, and the regions that they come through."""
        policy, layer = self.policy, self.policy.actor.mu
        thetas = [self.theta(each) for each in played.observations]
        inputs = [policy.inputs(each) for each in played.actions]
        excess = excess_of_episodes(policy.problem, zip(thetas, inputs, strict=True))
        far: Any = 0
        if self.max_input_step is not None:
            moved = [np.abs(np.diff(each, axis=0)) for each in played.actions]
            far = [np.any(each > self.max_input_step, axis=1).sum() for each in moved]
        visits = np.zeros((len(played.costs), layer.n_networks), dtype=bool)
        for visited, theta in zip(visits, thetas, strict=True):
            visited[layer.regions(th.as_tensor(theta[:-1]))] = True
        unsafe = replace(played, excess=excess).unsafe(far)
        return Scores(played.costs + excess.penalty, unsafe, visits)

    def theta(self, observations: NDArray[Any]) -> Array:
        """Return theta in deviations (steps, n_theta) of what the simulator shows."""
        seen = self.policy.theta(normalized(self.model, observations))
        return np.asarray(seen.double().cpu().numpy())

    def close(self) -> None:
        """Close the envs that were made; one that was given is the caller's."""
        if not isinstance(self.envs.source, gym.Env):
            self.envs.close()

    def _check(self, env: Any) -> None:
        if isinstance(env, gym.Env):
            require_state_shown(env, self.policy.observation_given)

    def _act(self, t: int, observations: NDArray[Any], rows: Rows) -> NDArray[Any]:
        seen = normalized(self.model, observations)
        actions, _ = self.policy.predict(seen, deterministic=True)
        if not np.all(np.isfinite(actions)):  # of a subclass: the actor itself puts out no NaN
            raise Unplayable("an action of the actor is not a finite number")
        return np.asarray(actions)
