"""What a guard keeps: the evidence, its decisions and their record, the state of a model."""

from __future__ import annotations

import csv
import io
import math
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import count
from pathlib import Path
from typing import Any, Literal

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_yann._archive import atomic_write
from sb3_yann._validation import Array, check_type, warn
from sb3_yann.compare import Scores, Starts, less_safe
from sb3_yann.evaluation import paired_rows, summary_lines
from sb3_yann.policy.checkpoint import ActorCheckpoint
from sb3_yann.policy.policies import StartsAsMPC

Play = Callable[[ActorCheckpoint, Sequence[int]], Scores]
"""From a checkpoint and seeds to the scores of its episodes."""
DecisionKind = Literal["accepted", "accepted in part", "rejected"]


@dataclass(frozen=True)
class Evidence:
    """What a candidate is compared with.

    ``accepted`` is the policy accepted last, ``mpc`` has the weights that it goes on to learn from.
    ``scores`` are the accepted policy's on as many of the known ``starts`` as it has played.
    ``passed`` are accepted checkpoints that new starts have confirmed, the latest last;
    ``rejections`` come in a row. ``confirmed`` are the final starts that the accepted policy has
    passed, and its scores there. Policies are confirmed on ``new`` starts until one loses there;
    the next one has the seed ``next_seed``. ``reference`` are the costs on all known starts but the
    hard ones of the last accepted policy that has played them, else the MPC's. The last policy that
    was tried on known starts ``lost`` those of these seeds.
    """

    accepted: ActorCheckpoint
    mpc: ActorCheckpoint
    starts: Starts
    scores: Scores
    next_seed: int
    passed: tuple[ActorCheckpoint, ...] = ()
    rejections: int = 0
    confirmed: tuple[Starts, Scores] | None = None
    new: Starts | None = None
    reference: Array | None = None
    lost: tuple[int, ...] = ()

    @property
    def to_learn(self) -> tuple[int, ...]:
        """Seeds of starts that policies have lost: the hard ones, and those of the last one."""
        return tuple(dict.fromkeys((*self.starts.seeds[: self.starts.n_hard], *self.lost)))

    def mean_of(self, scores: Scores | None) -> tuple[float, int]:
        """Return a policy's mean cost over all known starts but the hard ones, nan without scores.

        From those that it has played, whose number follows: what the accepted policy costs on all,
        or the reference, times what it costs of that there.
        """
        usual = slice(self.starts.n_hard, None)
        costs = np.empty(0) if scores is None else scores.costs[usual]
        if not len(costs):
            return math.nan, 0
        known = self.scores.costs[usual]
        if len(known) < len(self.starts.mpc.costs[usual]):
            known = self.starts.mpc.costs[usual] if self.reference is None else self.reference
        own = known[: len(costs)]
        mean = costs.mean()
        if len(costs) < len(known) and (size := np.abs(own).sum()):
            mean = known.mean() + (costs - own).sum() / size * np.abs(known).mean()
        return float(mean), len(costs)

    def known_up_to(self, count: int, play: Play) -> Evidence:
        """Return the evidence with the accepted policy's scores on so many starts at least."""
        had = len(self.scores.costs)
        if had >= count:
            return self
        more = play(self.accepted, self.starts.seeds[had:count])
        return replace(self, scores=self.scores.extended_by(more))

    def with_visited(self, candidate: ActorCheckpoint, scores: Scores) -> Evidence:
        """Return the evidence with a candidate accepted in the regions that its episodes visit.

        In all regions where its networks count in another box of theta: no mixture was played.
        """
        visited = scores.visits.any(axis=0)
        changed = self.accepted.changed_regions(candidate)
        if self.accepted.is_confined_as(candidate) and np.any(changed & ~visited):
            candidate = self.accepted.with_regions(candidate, np.flatnonzero(visited).tolist())
        found = replace(self, accepted=candidate, scores=scores, confirmed=None)
        if len(scores.costs) < len(self.starts.seeds):
            return found
        return replace(found, reference=scores.costs[self.starts.n_hard :])

    def without_passed(self, checkpoint: ActorCheckpoint) -> Evidence:
        """Return the evidence without an earlier checkpoint, which lost on new starts after all."""
        passed = [each for each in self.passed if not each.has_networks_of(checkpoint)]
        return replace(self, passed=tuple(passed))

    def with_passed(self, checkpoint: ActorCheckpoint) -> Evidence:
        """Return the evidence with one more earlier checkpoint, as far as memory allows."""
        kept = self.without_passed(checkpoint)
        if checkpoint.has_networks_of(self.mpc):  # which is always there
            return kept
        passed = (*kept.passed, checkpoint)
        # Of earlier accepted checkpoints at most five are kept, or 10 MB.
        most = min(len(passed), 5, max(1, 10_000_000 // checkpoint.size))
        return replace(kept, passed=passed[-most:])


@dataclass(frozen=True, kw_only=True)
class Decision:
    """One decision of the guard.

    Parameters
    ----------
    verdict : str
        "accepted", "accepted in part" (the networks of some regions only) or "rejected".
    candidate_cost, accepted_cost, mpc_cost : float
        Mean cost of the candidate, the policy accepted now and the MPC, over the first
        ``n_eval_episodes``: the same in each decision. The hard starts that joined them are left
        out. One that was decided on before it had played all has the mean of the last accepted one
        that did, or of the MPC, times what it costs of that where it has played. That of a
        candidate that could not be played is nan; the reason says why.
    played : tuple of int
        On how many of these starts the candidate, the accepted policy and the MPC have played.
    timestep, episode : int
        Steps and episodes of training until then.
    reason : str
        Why not all of it was accepted.
    restored : bool
        Whether the accepted checkpoint was restored.
    worst_start : float
        Largest excess of the accepted policy over the MPC on one of these starts.
    regions : tuple of int
        Regions whose networks were accepted, where it was a part.
    step : float
        Factor of the actor's learning rate from now on.
    share : float
        How far towards the candidate what was accepted lies: 1, a half, a quarter, or 0.

    Examples
    --------
    >>> from sb3_yann import Decision
    >>> Decision(verdict="accepted", candidate_cost=3, accepted_cost=3, mpc_cost=4).step
    1.0
    """

    timestep: int = 0
    episode: int = 0
    verdict: DecisionKind
    reason: str = ""
    restored: bool = False
    candidate_cost: float
    accepted_cost: float
    mpc_cost: float
    played: tuple[int, int, int] = (0, 0, 0)
    worst_start: float = 0.0
    regions: tuple[int, ...] = ()
    step: float = 1.0
    share: float = 0.0

    def __str__(self) -> str:
        """Return a line for a reader."""
        reason = f" ({self.reason})" * bool(self.reason)
        costs = "candidate {}, accepted policy {}, MPC {}".format(*self.costs_in_words())
        return f"Episode {self.episode}: {self.verdict}{reason}; means of all starts: {costs}"

    @property
    def changes(self) -> tuple[float, float]:
        """How much more the candidate and the accepted policy cost than the MPC, relative to it."""
        size = abs(self.mpc_cost) or math.nan
        more = self.candidate_cost - self.mpc_cost, self.accepted_cost - self.mpc_cost
        return more[0] / size, more[1] / size

    def costs_in_words(self) -> list[str]:
        """Return the three costs; of how many starts where that is not all."""
        found = list[str]()
        costs = self.candidate_cost, self.accepted_cost, self.mpc_cost
        for cost, played, change in zip(costs, self.played, (*self.changes, math.nan), strict=True):
            details = [f"{100 * change:+.3g} %"] * math.isfinite(change)
            if 0 < played < self.played[-1]:
                details.append(f"estimated from {played} of {self.played[-1]} starts")
            number = f"{cost:.6g}" if math.isfinite(cost) else "not known"
            found.append(f"{number} ({', '.join(details)})" if details else number)
        return found


@dataclass
class GuardState:
    """All that a stopped run needs to go on; it travels in the model's zip.

    ``settings`` are what the evidence depends on, ``max_input_step`` (m,), ``steps`` and ``offset``
    the `Player`'s. ``step`` is the factor of the actor's learning rate; ``episodes`` of training
    are over, and so many were when the last candidate was tried.
    """

    settings: dict[str, Any]
    evidence: Evidence
    max_input_step: Array | None = None
    step: float = 1.0
    episodes: int = 0
    last_trial: int | None = None
    steps: int = field(default=0, compare=False)  # with those that check a run that goes on
    decisions: list[Decision] = field(default_factory=list)
    offset: float = 0.0

    @property
    def accepted(self) -> ActorCheckpoint:
        """The policy accepted last."""
        return self.evidence.accepted


def restore_accepted(model: BaseAlgorithm) -> None:
    """Give the model the policy that a guard accepted last, bit for bit.

    `learn` does so at its end and after Ctrl-C. Call it after another exception, and for a model
    that was saved during training. A model without a guard is a ValueError.

    Examples
    --------
    >>> from stable_baselines3 import DDPG
    >>> from sb3_yann import ImprovementGuard, NoActionNoise, restore_accepted
    >>> model = DDPG("YannPolicy", "CSTR-v0", device="cpu")
    >>> guard = ImprovementGuard("CSTR-v0", n_eval_episodes=2, n_new_starts=2)
    >>> _ = model.learn(1, callback=[NoActionNoise(), guard])
    >>> restore_accepted(model)
    """
    check_type("model", model, BaseAlgorithm, "a DDPG or TD3 model")
    state = getattr(model, "guard_state", None)
    policy = model.policy
    if not isinstance(state, GuardState) or not isinstance(policy, StartsAsMPC):
        name = type(model).__name__
        raise ValueError(f"No ImprovementGuard has been at work on this {name}: pass one to learn.")
    state.accepted.restore(policy)
    policy.actor_step = 1.0


class Record:
    """The CSV file of a guard's decisions; training goes on where it cannot be written."""

    def __init__(self, path: Path, decisions: list[Decision]) -> None:
        """Write the decisions so far; keep what the file holds of another run beside it.

        A run that goes on from a checkpoint drops what it had decided after it.
        """
        self.path = path
        self.failed = False  # to be written: a warning has said so
        if path.is_file():
            ours = as_csv(decisions)
            theirs = path.read_bytes().decode(errors="replace")
            if not ours.startswith(theirs) and not (decisions and theirs.startswith(ours)):
                numbered = (path.with_name(f"{path.stem}.{i}{path.suffix}") for i in count(1))
                beside = next(each for each in numbered if not each.exists())
                os.rename(path, beside)
                warn(f"{path} held the record of another run: it is {beside} now.")
        self.write(decisions)

    def write(self, decisions: list[Decision]) -> None:
        """Write all decisions, or none of them; warn once where that fails."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(self.path) as part:
                part.write_text(as_csv(decisions), encoding="utf-8", newline="")
            self.failed = False
        except OSError as error:
            if self.failed:
                return
            self.failed = True
            warn(
                f"The guard's record {self.path} could not be written ({error}). Training goes on; "
                "guard.decisions has all decisions, and the record is completed once there is room."
            )


def as_csv(decisions: list[Decision]) -> str:
    """Return a line for each decision, below their names."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, [each.name for each in fields(Decision)])
    writer.writeheader()
    for each in decisions:
        several = {name: " ".join(map(str, getattr(each, name))) for name in ("regions", "played")}
        writer.writerow({**asdict(each), **several})
    return text.getvalue()


REFUSAL_ADVICE = {
    "too little a gain": "see by headroom(mpc, env) what can be gained, and take improve(mpc, env)",
    "new starts": "raise n_eval_episodes: the known starts do not show what the new ones do",
    "violation": "bound the policy (max_correction), or tighten the MPC's own limits",
    "the env ends": "bound the policy (max_correction), or tighten the MPC's own limits",
    "finite": "lower the learning rate; CostAudit shows what the critic learns from",
    "too far": "take networks='shared', whose policy is continuous",
    "costs": "bound the policy (max_correction), or allow the worst starts more (rule.margin)",
    "mean cost": "see by headroom(mpc, env) what can be gained, which improve(mpc, env) takes, and "
    "by CostAudit whether the reward is the MPC's cost",
}
"""What helps against a reason for a refusal that holds such words: the first one that does."""


def summary_of(state: GuardState, policy: StartsAsMPC, eval_freq: int = 1) -> str:
    """Return some lines for a reader: what is accepted, what was refused and why, what helps."""
    decisions = state.decisions
    evidence = state.evidence
    starts, scores = evidence.confirmed or (evidence.starts, evidence.scores)
    played = slice(starts.n_hard, len(scores.costs))
    ours = scores.at(played)
    mpc = starts.mpc.at(played)
    rows = paired_rows(ours.costs, mpc.costs)
    rows["change"] += " from the final starts" * (evidence.confirmed is not None)
    gains = bool(ours.costs.mean() < mpc.costs.mean() - 1e-3 * abs(mpc.costs.mean()))
    what = "better than the MPC" if gains else "not the MPC, and gains nothing"
    if state.accepted.has_networks_of(evidence.mpc):
        what = "the MPC"
    verdict = f"The policy accepted last is {what}."
    if not state.accepted.is_actor_of(policy):
        verdict += (
            " The model's policy is another one, which no guard has accepted: "
            "restore_accepted(model) gives it the accepted one."
        )
    less = int(less_safe(ours.unsafe, mpc.unsafe, starts.tolerance.excess_room).any(axis=1).sum())
    violations = f"more than the MPC's from {less} of {len(ours.costs)} starts"
    if evidence.confirmed and (lost := np.array(starts.seeds)[starts.lost(scores)].tolist()):
        violations += (
            f"; {len(lost)} cost more by more than the margin, which the rule allows: seeds "
            f"{', '.join(map(str, lost[:10]))}{', ...' * (len(lost) > 10)}"
        )
    counts = Counter(each.verdict for each in decisions)
    last = decisions[-1].reason if decisions else ""
    refused = [each.reason for each in decisions if each.verdict == "rejected"]
    kinds = [next((words for words in REFUSAL_ADVICE if words in why), why) for why in refused]
    candidates = "none was tried yet"
    refusals = more = ""
    if decisions:
        candidates = (
            f"{counts['accepted']} accepted, {counts['accepted in part']} in part, "
            f"{counts['rejected']} refused, in {decisions[-1].episode} episodes"
        )
    elif (updates := int(policy.critic_updates)) <= (needed := policy.critic_warmup):
        more = (
            f"the critic has had {updates} updates, and the actor moves after critic_warmup = "
            f"{needed}: train longer, or lower critic_warmup"
        )
    if kinds:
        kind, times = Counter(kinds).most_common(1)[0]
        refusals = f"most often ({times} times): {refused[kinds.index(kind)]}"
        more = REFUSAL_ADVICE.get(kind, "")
        more *= not (gains and "improve(" in more)  # it has found a gain
    candidates += f", one every eval_freq = {eval_freq} episodes, not steps" * (eval_freq > 1)
    return summary_lines(
        verdict,
        **rows,
        violations=violations,
        steps=f"{state.steps:,} of the guard's simulator" if state.steps else "",
        candidates=candidates,
        refused=refusals,
        end=last * last.startswith("at the end"),
        next=more,
    )
