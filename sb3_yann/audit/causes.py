"""Why a reward is not the cost of the problem: explanations, from the simplest on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.audit.sample import EXACT, Line, Sample
from sb3_yann.audit.scaling import scaled_entries

LATEST = 3
"""Steps of delay that are looked for."""
MOST_REPEATS = 10


class Cause(NamedTuple):
    """A short name, an explanation, whether options of the reward may help, and a cure.

    The cure holds where no other cause explains as much; until then it is not in the explanation.
    """

    name: str
    explanation: str
    scales: bool = False
    cure: str = ""


UNKNOWN = Cause(
    "unknown",
    "none that the audit knows. Compare the env's reward with problem.stage_cost(theta, u) step by "
    "step: weights, units, what an observation means.",
    scales=True,
)


def not_finite(
    lost: NDArray[np.bool_], records: Sequence[dict[str, Any]], other: Cause | None = None
) -> Cause:
    """Return that rewards or observations are lost, which was the first, and what else is wrong."""
    first = records[int(np.argmax(lost))]
    reward = first["reward"]
    what = "an observation" if np.isfinite(reward) else f"the reward, {reward:g},"
    return Cause(
        "not finite",
        f"in {lost.sum()} of {len(lost)} steps a reward or an observation is not a finite number, "
        f"first {what} of step {first['step']}: the env or a sensor fails. The steps are left out."
        + ("" if other is None else f" In the others, {other.name}: {other.explanation}"),
    )


def likely_cause(sample: Sample, tolerance: float) -> Cause:
    """Return what is exact, or else what is within the tolerance; all of it where it is several.

    Near a steady state many explanations are nearly right, hence exact ones go first.
    """
    if np.ptp(sample.rewards[sample.counted]) <= 1e-9 * np.abs(sample.rewards).max():
        return Cause("constant", f"every reward is {sample.rewards[0]:g}, whatever happens.")
    for width in (EXACT, tolerance):
        straight = _straight_line(sample, width)
        if straight is not None:
            return straight
        causes = [explain(sample, width) for explain in _EXPLANATIONS]
        scaled = [
            Cause(name, text, cure=cure) for name, text, cure in scaled_entries(sample, width)
        ]
        if found := [each for each in causes if each is not None] + scaled:
            return all_of(found)
    return _repeated_action(sample, 20 * tolerance) or UNKNOWN


def all_of(found: list[Cause]) -> Cause:
    """Return the only cause with its cure, or the first that names the others, without any."""
    first, others = found[0], found[1:]
    if not others:
        return first._replace(explanation=first.explanation + first.cure)
    listed = " ".join(f"({i}) {each.name}: {each.explanation}" for i, each in enumerate(found, 1))
    return first._replace(
        explanation=f"one of {len(found)} that explain these steps equally well, so none is sure. "
        f"{listed} Compare the env's reward with problem.stage_cost(theta, u) at states and inputs "
        "far apart before you change anything."
    )


def _straight_line(sample: Sample, tolerance: float) -> Cause | None:
    line = Line.through(sample)
    predicted = (sample.offset - line.scale * -sample.cost - line.offset) / sample.scale
    if line.scale == 0 or not sample.agrees(predicted, tolerance):
        return None
    if line.scale < 0:
        size = "" if abs(line.scale + 1) < 1e-3 else f" (times {-line.scale:.6g})"
        return Cause(
            "sign flipped",
            f"the env returns the cost itself{size} as its reward. The learner would maximize it: "
            "return minus the cost.",
        )
    found = f"the reward is {line.scale:.6g} times minus the cost"
    if line.offset == 0:
        why = "a TransformReward, another unit, a factor dt, or an action that is repeated."
        return Cause("scaled", f"{found}: {why}", scales=True)
    why = "a TransformReward, a bonus for each step, or a cost of what is not zero at the origin."
    return Cause("scaled and shifted", f"{found}, plus {line.offset:.6g}: {why}", scales=True)


def _clipped(sample: Sample, tolerance: float) -> Cause | None:
    seen = sample.rewards[sample.counted]
    low, high = seen.min(), seen.max()
    expected = sample.offset - sample.scale * sample.cost
    beyond = (expected < low) | (expected > high)
    # The limits are met by more steps than the one that would set them in any case.
    met = max(np.count_nonzero(seen == low), np.count_nonzero(seen == high))
    predicted = (sample.offset - np.clip(expected, low, high)) / sample.scale
    if not beyond[sample.counted].any() or met < 2 or not sample.agrees(predicted, tolerance):
        return None
    return Cause(
        "clipped",
        f"rewards are clipped to [{low:.6g}, {high:.6g}], as ClipReward does: the critic's cost "
        "goes on beyond that. Leave the clipping out.",
    )


def _timing(sample: Sample, tolerance: float) -> Cause | None:
    for steps in range(1, LATEST + 1):
        theta, known = sample.earlier(sample.following, 1 - steps)
        if sample.agrees(sample.stage_cost(theta, sample.u), tolerance, known):
            if steps == 1 and not _observations_are_late(sample):
                return Cause(
                    "next state",
                    "the cost is c(s', u), of the state after the step, where the problem has "
                    "c(s, u). Compute it before the env steps.",
                )
            return Cause(
                "delayed observation",
                f"the cost is that of an observation {steps} step(s) later, as with "
                "DelayObservation. The law needs the present state: leave the delay out, or put "
                "the inputs that are under way into the model's state.",
            )
    cost, known = sample.earlier(sample.cost, 1)
    if sample.agrees(cost, tolerance, known):
        return Cause("late reward", "the reward comes one step after the cost it stands for.")
    return None


def _observations_are_late(sample: Sample) -> bool:
    """Tell whether observations follow an earlier action rather than the one just sent."""
    if sample.blank[sample.begins].all():  # what DelayObservation shows at first
        return True
    before, known = sample.earlier(sample.u, 1)
    errors = [sample.step(sample.theta, u) - sample.following for u in (before, sample.u)]
    late, present = np.median(np.linalg.norm(errors, axis=2), axis=1)
    return bool(known.any() and late < present)


def _sticky_action(sample: Sample, tolerance: float) -> Cause | None:
    """Follow the action that the env holds: at each step the one sent, or the one held before."""
    held, late, fresh = sample.u.copy(), 0, 0
    cost = sample.cost.copy()
    spread = np.abs(sample.implied - sample.cost)[sample.counted].mean()
    for t in range(1, len(cost)):
        if sample.episode[t] != sample.episode[t - 1]:
            continue
        again = float(sample.stage_cost(sample.theta[t : t + 1], held[t - 1 : t])[0])
        sent, kept = abs(sample.implied[t] - cost[t]), abs(sample.implied[t] - again)
        if kept < sent:
            held[t], cost[t] = held[t - 1], again
        late += kept < sent - tolerance * spread
        fresh += sent < kept - tolerance * spread
    if late and fresh and sample.agrees(cost, tolerance):
        return Cause(
            "sticky action",
            f"in {late} steps the cost is that of the previous action, as with StickyAction: the "
            "env does not always do what it is told.",
        )
    before, known = sample.earlier(sample.u, 1)
    if sample.agrees(sample.stage_cost(sample.theta, before), tolerance, known):
        return Cause(
            "late action",
            "the cost is that of the previous action: the env acts one step late. Put the input "
            "that is under way into the model's state.",
        )
    return None


def _normalized_reward(sample: Sample, tolerance: float) -> Cause | None:
    """Run the statistics of `gymnasium.wrappers.NormalizeReward` on minus the cost."""
    # Its discount is not known.
    for gamma in dict.fromkeys((sample.gamma, 0.99, 0.9, 0.95, 0.98, 0.995, 0.999, 1.0)):
        if sample.agrees(sample.cost * _running_factors(sample, gamma), tolerance):
            return Cause(
                "normalized reward",
                "the reward is divided by running statistics, as by NormalizeReward: its unit "
                "changes as they do. Leave it out; reward_scale is for a constant factor.",
            )
    return None


def _running_factors(sample: Sample, gamma: float) -> Array:
    """Return what each cost would be multiplied by, had the statistics begun with the sample."""
    factors = np.ones(len(sample.cost))
    for t, cost in enumerate(sample.cost):
        if sample.first[t]:
            mean, variance, count, total = 0.0, 1.0, 1e-4, 0.0
        total = total * gamma * (not sample.terminated[t]) - float(cost)
        delta, before, count = total - mean, count, count + 1
        mean += delta / count
        variance = (variance * before + delta**2 * before / count) / count
        factors[t] = 1 / np.sqrt(variance + 1e-8)
    return factors


def _repeated_action(sample: Sample, tolerance: float) -> Cause | None:
    """Compare with sums over steps in between: of the model, or on the way to the next state."""
    whole = ~np.r_[sample.begins[1:], False]  # an episode may end before the last repetition
    for k in range(2, MOST_REPEATS + 1):
        for cost in _sums(sample, k):
            if sample.agrees(cost, tolerance, whole):
                why = (
                    f"the reward is about the sum of {k} steps with the same action, as with "
                    "RepeatAction, ActionRepeat or frame skipping. The model of the MPC must have "
                    f"{k} times the sampling time of the env, and {k} times its weights."
                )
                return Cause("repeated action", why, scales=True)
    return None


def _sums(sample: Sample, k: int) -> Iterator[Array]:
    total: Array = np.zeros(len(sample.cost))
    theta = sample.theta
    for _ in range(k):
        total = total + sample.stage_cost(theta, sample.u)
        theta = sample.step(theta, sample.u)
    yield total
    way = sample.following - sample.theta
    yield np.sum([sample.stage_cost(sample.theta + way * i / k, sample.u) for i in range(k)], 0)


_EXPLANATIONS = (
    _clipped,
    _timing,
    _sticky_action,
    _normalized_reward,
    _repeated_action,
)
