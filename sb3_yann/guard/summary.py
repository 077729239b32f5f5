"""What a guard's decisions come to, in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from sb3_yann.guard.state import Decision

LITTLE = 1e-3
"""A gain below this, relative to the MPC's cost, is called none."""
ADVICE = {
    "new starts": "raise n_starts: the known starts do not show what the new ones do",
    "violation": "bound the policy (max_correction), or tighten the MPC's own limits",
    "terminates": "bound the policy (max_correction), or tighten the MPC's own limits",
    "finite": "lower the learning rate; CostAudit shows what the critic is told",
    "too far": "take networks='shared', whose policy is continuous",
    "costs": "bound the policy (max_correction), or allow the worst starts more (rule.margin)",
    "mean cost": "see by headroom(mpc, env) what there is to gain, and by CostAudit whether the "
    "reward is the MPC's cost",
}
"""What helps against a reason for a refusal that holds such words: the first one that does."""


def summary_of(decisions: Sequence[Decision], n_starts: int) -> str:
    """Return some lines for a reader: what is accepted, what was refused and why, what helps.

    Parameters
    ----------
    decisions : sequence of Decision
        All of them.
    n_starts : int
        Number of starts that the costs are means over.
    """
    if not decisions:
        return (
            "The guard has tried no candidate yet: the policy is the one that training began with."
        )
    last, counts = decisions[-1], Counter(each.verdict for each in decisions)
    change = (last.accepted_cost - last.mpc_cost) / abs(last.mpc_cost or 1.0)
    gain = f"{100 * abs(change):.2g} % {'less' if change < 0 else 'more'} than the MPC's"
    what = f"costs {last.accepted_cost:.6g}, {gain} {last.mpc_cost:.6g}, on {n_starts} starts"
    if abs(change) < LITTLE:
        what = f"gains nothing: it costs {last.accepted_cost:.6g} on {n_starts} starts, as the MPC"
    lines = [
        f"The policy accepted last {what}.",
        f"Candidates: {counts['accepted']} accepted, {counts['accepted in part']} in part, "
        f"{counts['rejected']} refused, in {last.episode} episodes.",
    ]
    refusals = Counter(_kind(each.reason) for each in decisions if each.verdict == "rejected")
    if refusals:
        kind, count = refusals.most_common(1)[0]
        example = next(each.reason for each in decisions if _kind(each.reason) == kind)
        lines.append(f"Refused most often ({count} times): {example}.")
        lines.append(f"What may help: {ADVICE[kind]}." if kind in ADVICE else "")
    return "\n".join(filter(None, lines))


def _kind(reason: str) -> str:
    return next((words for words in ADVICE if words in reason), reason)
