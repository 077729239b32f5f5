"""What a guard's decisions come to, in words."""

from __future__ import annotations

import math
from collections import Counter

from sb3_yann.guard.state import GuardState, relative_change
from sb3_yann.policy.policies import YannPolicy

LITTLE = 1e-3
"""A gain below this, relative to the MPC's cost, is called none."""
ADVICE = {
    "too little a gain": "see by headroom(mpc, env) what there is to gain",
    "new starts": "raise n_starts: the known starts do not show what the new ones do",
    "violation": "bound the policy (max_correction), or tighten the MPC's own limits",
    "the env ends": "bound the policy (max_correction), or tighten the MPC's own limits",
    "finite": "lower the learning rate; CostAudit shows what the critic is told",
    "too far": "take networks='shared', whose policy is continuous",
    "costs": "bound the policy (max_correction), or allow the worst starts more (rule.margin)",
    "mean cost": "see by headroom(mpc, env) what there is to gain, and by CostAudit whether the "
    "reward is the MPC's cost",
}
"""What helps against a reason for a refusal that holds such words: the first one that does."""


def summary_of(state: GuardState, policy: YannPolicy) -> str:
    """Return some lines for a reader: what is accepted, what was refused and why, what helps."""
    decisions, n_starts = state.decisions, len(state.settings["seeds"])
    costs, mpc_costs = (
        each.costs[:n_starts] for each in (state.evidence.accepted, state.evidence.mpc)
    )
    lines = [_accepted(state, float(costs.mean()), float(mpc_costs.mean()), n_starts)]
    if not state.accepted.is_actor_of(policy):
        lines.append(
            "The model's policy is another one, which no guard has accepted: "
            "restore_accepted(model) gives it the accepted one."
        )
    if not decisions:
        updates, needed = int(policy.critic_updates), policy.critic_warmup
        lines.append("The guard has tried no candidate yet.")
        if updates <= needed:
            lines.append(
                f"The critic has had {updates} updates, and the actor moves after critic_warmup = "
                f"{needed}. Train longer, or lower critic_warmup."
            )
        return "\n".join(lines)
    last, counts = decisions[-1], Counter(each.verdict for each in decisions)
    lines.append(
        f"Candidates: {counts['accepted']} accepted, {counts['accepted in part']} in part, "
        f"{counts['rejected']} refused, in {last.episode} episodes."
    )
    refusals = Counter(_kind(each.reason) for each in decisions if each.verdict == "rejected")
    if refusals:
        kind, count = refusals.most_common(1)[0]
        example = next(each.reason for each in decisions if _kind(each.reason) == kind)
        lines.append(f"Refused most often ({count} times): {example}.")
        lines.append(f"What may help: {ADVICE[kind]}." if kind in ADVICE else "")
    return "\n".join(filter(None, lines))


def _accepted(state: GuardState, cost: float, mpc_cost: float, n_starts: int) -> str:
    if state.mpc is not None and state.accepted.has_networks_of(state.mpc):
        return f"The policy accepted last is the MPC: it costs {mpc_cost:.6g} on {n_starts} starts."
    change = relative_change(cost, mpc_cost)
    if abs(cost - mpc_cost) <= LITTLE * abs(mpc_cost):
        return (
            f"The policy accepted last is not the MPC, and gains nothing: it costs {cost:.6g} on "
            f"{n_starts} starts, the MPC {mpc_cost:.6g}."
        )
    less = "less" if cost < mpc_cost else "more"
    size = f"{100 * abs(change):.2g} % {less} than" if math.isfinite(change) else f"{less} than"
    return (
        f"The policy accepted last costs {cost:.6g}, {size} the MPC's {mpc_cost:.6g}, on "
        f"{n_starts} starts."
    )


def _kind(reason: str) -> str:
    return next((words for words in ADVICE if words in reason), reason)
