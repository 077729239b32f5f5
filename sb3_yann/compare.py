"""What "no worse" means: the only place that compares a policy's episodes with another's.

Three questions, in this order: is the policy less safe in any episode, do the worst starts cost too
much on average (their conditional value at risk), is the mean cost higher?
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sb3_yann._validation import Array, check_bool, check_range
from sb3_yann.control.mpc.bound_excess import BoundExcess, BoundNames

UNSAFE = (
    "violations",
    "an episode that the env ends, or that ends sooner",
    "a cost or an observation that is no finite number",
    "an input that moves too far in one step",
    "a larger excess over the problem's bounds",
    "a larger summed excess over the problem's bounds",
)
"""What the first columns of ``unsafe`` are; the others are what it takes to compare them."""
ENDED = 1
INPUT_STEP = 3
LARGEST_EXCESS = 4
SUMMED_EXCESS = 5
ANY_BOUND = 6
MISSING = 7
WORST = 8
"""Columns: how an episode ends; steps in which an input moves too far; the excess over hard bounds,
and over soft ones too; minus the number of steps; which bound is exceeded most."""
EXCESS_ROOM = 1e-3  # half-widths of a bound by which an excess may be larger: less is noise
EXCESS_SHARE = 0.1
"""Share of the MPC's own excess by which it may be larger: an MPC that rides a bound is no veto."""
COST_ROUNDING = 1e-6
"""Of a mean cost: what float32 actions and batches of other sizes make of one policy's."""
FEW_PAIRS = 12
"""Pairs that a drift can line up by the order that is drawn, which no standard error shows."""
TOO_LITTLE = "too little a gain"


@dataclass(frozen=True)
class AcceptanceRule:
    """When a candidate counts as no worse.

    Parameters
    ----------
    margin : float, default 0.01
        What the worst starts may cost more than with the MPC on average, as a fraction of the
        MPC's median cost, of its cost of that start, or of what the policy saves on average,
        whichever is most. No single start may cost ten times as much more.
    cvar_alpha : float, default 0.05
        Share of the starts that count as the worst ones. 0 is strict: no single
        start may cost more than the margin, of the median.
    by_region : bool, default True
        Whether single regions are tried where the whole candidate is refused.
    backtrack : bool, default True
        Whether half and a quarter of the way are tried where no region is accepted either, and
        half and a quarter of the correction where a policy loses on new starts.
    significance : float, default 0.05
        Probability that the final trial accepts a policy that is no better on average over all
        starts.
    least_gain : float, default 0.001
        What the final trial must gain on average, as a fraction of the MPC's mean cost, and a
        candidate over what was accepted before: one that surely gains less changes nothing. 0 takes
        any gain, as a strict rule does, ``cvar_alpha=0``; a guard then plays more.
    max_input_step : float, optional
        How far an input may move from one sample to the next, in multiples of the MPC's largest
        step on the known starts, at least 1. The default is no bound.
    excess_room : float, default 0.001
        How much farther than the MPC a policy may exceed a hard bound of the problem, in
        half-widths of theta's box, besides a tenth of the MPC's own excess. It holds for the
        largest excess of an episode and for the sum over its steps, which may be larger by one
        step as well. The costs count what soft bounds cost the MPC.

    Examples
    --------
    >>> from sb3_yann import AcceptanceRule
    >>> AcceptanceRule(margin=0.02, by_region=False).significance
    0.05
    """

    margin: float = 0.01
    cvar_alpha: float = 0.05
    by_region: bool = True
    backtrack: bool = True
    significance: float = 0.05
    least_gain: float = 0.001
    max_input_step: float | None = None
    excess_room: float = EXCESS_ROOM

    def __post_init__(self) -> None:
        check_range("margin", self.margin, 0, np.inf)
        hint = "It is a share of the starts, 0 for the worst one."
        check_range("cvar_alpha", self.cvar_alpha, 0, 1, hint=hint)
        hint = "It is a share of the MPC's mean cost, 0 for any gain."
        check_range("least_gain", self.least_gain, 0, 1, hint=hint)
        hint = "It is in half-widths of theta's box, 0 for the MPC's own excess and a tenth."
        check_range("excess_room", self.excess_room, 0, np.inf, hint=hint)
        if self.max_input_step is not None:
            hint = "It is a multiple of the MPC's largest step, or None."
            check_range("max_input_step", self.max_input_step, 1, np.inf, hint=hint)
        check_bool("by_region", self.by_region)
        check_bool("backtrack", self.backtrack)
        check_range("significance", self.significance, 0, 0.5)

    def tolerance(self, mpc_costs: Array, bounds: BoundNames | None = None) -> Tolerance:
        """Return what starts may cost more, given what they cost with the MPC."""
        typical = float(np.median(np.abs(mpc_costs)))
        names = bounds or BoundNames()
        return Tolerance(self.margin * typical, self.cvar_alpha, typical, self.excess_room, names)

    @property
    def standard_errors(self) -> float:
        """How many standard errors a mean cost must be below the MPC's in the final trial."""
        return float(special.ndtri(1 - self.significance)) if self.cvar_alpha else 0.0


RULE = AcceptanceRule()  # by which policies from a twin, a simulator or a plant are judged


class Verdict(NamedTuple):
    """Whether a policy is no worse, and whether more starts would change that.

    The reason is empty where it is accepted. ``breaks_limit``: it violates a limit of the env, or
    ends sooner, where the policy before does not, or is not finite: then there is no patience.
    ``above_mpc``: its mean cost is, or its excess over a bound. ``is_sure``: its mean cost is
    surely lower, at a level. ``is_hopeless``: more starts would hardly show a gain that counts.
    """

    reason: str = ""
    breaks_limit: bool = False
    above_mpc: bool = False
    is_sure: bool = False
    is_hopeless: bool = False

    @property
    def accepted(self) -> bool:
        """Whether nothing speaks against the policy."""
        return not self.reason


class Scores(NamedTuple):
    """What a policy's episodes cost and break, in the order of their seeds.

    ``costs`` (episodes,) hold the penalty of soft bounds, ``unsafe`` (episodes, 9) is that of
    :func:`unsafe_columns`, ``visits`` (episodes, regions) which regions the episodes come through.
    """

    costs: Array
    unsafe: Array
    visits: NDArray[np.bool_] = np.zeros((0, 0), dtype=bool)

    def at(self, index: Any) -> Scores:
        """Return some of the episodes."""
        return Scores._make(each[index] for each in self)

    def extended_by(self, other: Scores) -> Scores:
        """Return the episodes of both."""
        return Scores._make(map(np.concatenate, zip(self, other, strict=True)))


@dataclass(frozen=True)
class Tolerance:
    """What starts may cost more than with the MPC.

    ``margin`` is in units of cost: what a start may cost more; with a CVaR, what the worst of them
    may on average, the share ``cvar_alpha``. Then a start that costs the MPC more than ``typical``,
    its median cost, may cost more in proportion, and so may all where the policy has ``saved`` more
    than that on average; none may cost ``worst_start`` times as much as the average may. An excess
    over the ``bounds`` may be larger by ``excess_room`` half-widths.
    """

    margin: float
    cvar_alpha: float = 0.0
    typical: float = np.inf
    excess_room: float = EXCESS_ROOM
    bounds: BoundNames = field(default_factory=BoundNames)
    # 10.0: with a CVaR: how many times as much as on average a single start may cost more
    worst_start: float = 10.0
    saved: float = 0.0

    def exceeded(self, policy: Scores, episode: int, mpc: Scores | None = None) -> str:
        """Return which bound an episode exceeds most, a hard one if there is one, and by how much.

        It is empty where none is, or the MPC of these scores exceeds a bound by as much.
        """
        row = policy.unsafe[episode]
        its = -np.inf if mpc is None else mpc.unsafe[episode, ANY_BOUND]
        if row[ANY_BOUND] <= allowed_excess(its, self.excess_room):
            return ""
        return self.bounds.in_words(row[WORST], row[LARGEST_EXCESS] or row[ANY_BOUND])

    def allowed(self, mpc_costs: ArrayLike) -> Array:
        """Return what each start may cost more, rounding at least."""
        margin: Any = self.margin
        if self.cvar_alpha:
            own = np.maximum(np.abs(mpc_costs), self.saved)
            margin = self.margin * np.maximum(1.0, own / self.typical)
        return np.asarray(np.maximum(margin, COST_ROUNDING * np.abs(mpc_costs)))

    def excess(self, mpc_costs: Array, costs: Array) -> Array:
        """Return what each start costs more than the MPC, in units of what it may; inf for NaN."""
        with np.errstate(divide="ignore", invalid="ignore"):
            more = (costs - mpc_costs) / self.allowed(mpc_costs)
        more = np.where(costs <= mpc_costs, np.fmin(more, 0.0), more)  # also without any margin
        return np.asarray(np.nan_to_num(more, nan=np.inf, posinf=np.inf, neginf=-np.inf))

    def is_tail_lost(self, excess: Array) -> bool:
        """Return whether more starts would hardly show that the worst ones may pass.

        If the share that counts as the worst ones exceeds 1, so does their average: as many as
        here would be, in one of ten cases at most, among starts of which fewer do.
        """
        count = np.count_nonzero(excess > 1.0)
        chance = special.bdtrc(count - 1, len(excess), self.cvar_alpha)
        return not self.cvar_alpha or bool(chance <= 0.1)

    def objection(self, excess: Array, standard_errors: float = 0.0) -> str:
        """Return what speaks against an excess over the MPC (starts,), empty for nothing.

        So many ``standard_errors`` of the tail's average count as well.
        """
        worst = int(np.argmax(excess))
        if not excess[worst] > 1.0:
            return ""
        if not self.cvar_alpha or excess[worst] > self.worst_start:
            return f"start {worst}"
        average, error = tail_average(excess, self.cvar_alpha)
        average += standard_errors * error
        if average <= 1.0:
            return ""
        limit = 100 * float(self.allowed(self.typical)) / self.typical
        most = "up to " if standard_errors else ""
        return (
            f"the worst {100 * self.cvar_alpha:g} % of the starts cost {most}{limit * average:.3g} "
            f"% of the median cost more on average, {limit:.3g} % is allowed: start {worst}"
        )


class Difference(NamedTuple):
    """The mean difference of pairs of episodes, and its standard error.

    Of few pairs in turns ``chance`` is how often the order that was drawn for each alone brings a
    mean as low, which is exact under any drift. Of more than `FEW_PAIRS` the error counts a drift.
    """

    mean: float
    error: float
    pairs: int
    chance: float = 0.0

    @classmethod
    def of(cls, differences: Array, in_turns: bool = False) -> Difference:
        """Return that of differences.

        Pairs that were played ``in_turns``, in an order that was drawn for each, may be correlated:
        they are in the order in which they were played, and the error is widened.
        """
        n = len(differences)
        mean = float(differences.mean()) if n else np.nan
        if n < 2:
            return cls(mean, np.inf, n, 0.5 if in_turns else 0.0)
        with np.errstate(invalid="ignore"):  # a cost may be infinite
            error = float(differences.std(ddof=1) / np.sqrt(n))
            left = differences - mean
        if not in_turns:
            return cls(mean, error, n)
        chance = 0.0
        size = float(left @ left)
        if n <= FEW_PAIRS:
            orders = 1 - 2 * (np.arange(2**n)[:, None] >> np.arange(n) & 1)
            as_low = differences.sum() + COST_ROUNDING * np.abs(differences).sum()
            chance = float(np.mean(orders @ differences <= as_low))
        lag = float(np.clip(left[1:] @ left[:-1] / size, 0.0, 0.95)) if size > 0 else 0.0
        widened = np.sqrt((1 + lag) / (1 - lag))  # an autoregression's variance of the mean
        return cls(mean, float(widened * error), n, chance)

    @classmethod
    def relative(cls, more: Array, mpc_costs: Array, in_turns: bool = False) -> Difference:
        """Return that of what starts cost more, in mean costs of the MPC: a ratio of two means.

        To first order its error counts that the MPC's mean is of these starts, too.
        """
        size = np.abs(mpc_costs)
        with np.errstate(invalid="ignore"):  # a cost may be infinite
            mean = max(float(size.mean()), 1e-300)
            return cls.of((more - mean_change(more, mpc_costs) * (size - mean)) / mean, in_turns)

    def room(self, level: float) -> float:
        """Return how far from 0 the mean may be by chance, one-sided; inf for a single pair."""
        if self.pairs < 2:
            return np.inf
        return float(special.stdtrit(self.pairs - 1, 1 - level) * self.error)

    def is_hopeless(self, least_gain: float) -> bool:
        """Return whether more pairs would hardly show that the mean is below minus a gain."""
        return self.mean - self.error > -least_gain / 2

    def is_below_zero(self, level: float) -> bool:
        """Return whether the mean is negative by chance with a probability of ``level`` at most."""
        return self.chance <= level and self.mean + self.room(level) < 0


def level_of_look(significance: float, look: int) -> float:
    """Return the level of the look of a number from 1: all looks together err no more often."""
    return significance / (look * (look + 1))


def looks(first: int, most: int) -> list[int]:
    """Return after how many pairs it is decided whether more are played: twice as many each."""
    counts = [min(first, most)]
    while counts[-1] < most:
        counts.append(min(2 * counts[-1], most))
    return counts


def no_worse(
    policy: Scores,
    accepted: Scores,
    mpc: Scores,
    tolerance: Tolerance,
    *,
    names: Sequence[int] | None = None,
    n_hard: int = 0,
    level: float = 0.05,
    least_gain: float = 0.0,
    tail_errors: float = 0.0,
) -> Verdict:
    """Compare a policy with the accepted one and the MPC, from the same starts.

    Comparisons are written so that a cost that is not a number is refused. ``names``, the seeds,
    are what a reason calls the starts. The first ``n_hard`` of these were chosen since a policy
    lost them: they count in no mean. ``level`` is one-sided, of what is sure. What surely gains
    less than ``least_gain``, a fraction of the MPC's mean cost, is hopeless. So many
    ``tail_errors``, standard errors of the worst starts' average, count as well.
    """
    names = range(len(mpc.costs)) if names is None else names
    less = less_safe(policy.unsafe, accepted.unsafe, tolerance.excess_room)
    breaks = bool(less[:, :INPUT_STEP].any())
    # Neither is exceeded: a tolerance over the accepted policy alone would add up. Of a bound the
    # MPC's excess is: a policy that happens to stay nearer to it does not tighten the limit.
    allowed = np.minimum(accepted.unsafe, mpc.unsafe)
    allowed[:, LARGEST_EXCESS:ANY_BOUND] = mpc.unsafe[:, LARGEST_EXCESS:ANY_BOUND]
    less = less_safe(policy.unsafe, allowed, tolerance.excess_room)
    costs = policy.costs[n_hard:]
    of_mpc = mpc.costs[n_hard:]
    tolerance = replace(tolerance, saved=float(np.mean(of_mpc - costs)) if len(costs) else 0.0)
    excess = tolerance.excess(mpc.costs, policy.costs)
    before = of_mpc if accepted is mpc else accepted.costs[n_hard:]
    above = is_above(costs, of_mpc)
    gain = Difference.of(relative_costs(costs - before, of_mpc))
    is_sure = gain.is_below_zero(level)
    hopeless = gain.is_hopeless(least_gain) and mean_change(costs - before, of_mpc) > -least_gain
    reason = words = ""
    if less.any():
        column = int(np.argmax(less.any(axis=0)))
        which = np.flatnonzero(less[:, column])
        reason = f"{len(which)} of {len(less)} starts with {UNSAFE[column]}, the first is "
        reason += f"start {names[which[0]]}"
        if column == ENDED:
            reason += '; where an end is a success, the env says so by info["is_success"]'
        elif column != INPUT_STEP:
            words = tolerance.exceeded(policy, int(which[0]))
        hopeless = True
    elif costly := tolerance.objection(excess, tail_errors):
        worst = int(np.argmax(excess))
        share = 100 * mean_change(policy.costs[worst] - mpc.costs[worst], of_mpc)
        reason = f"{costly} costs {share:.3g} % of the mean cost more than with the MPC"
        reason = reason.replace(f"start {worst} ", f"start {names[worst]} ")
        words = tolerance.exceeded(policy, worst, mpc)
        hopeless |= not np.isfinite(excess[worst]) or tolerance.is_tail_lost(excess[n_hard:])
    elif above or is_above(costs, before):  # or by what rounding in many acceptances adds up to
        beaten = before is not of_mpc and is_above(costs, before)
        whose, other = ("accepted", before) if beaten else ("MPC", of_mpc)
        # In six digits, or as many more as tell them apart.
        shown = [(f"{costs.mean():.{k}g}", f"{other.mean():.{k}g}") for k in range(6, 18)]
        mean, its = next((pair for pair in shown if pair[0] != pair[1]), shown[0])
        reason = f"mean cost {mean} from {len(costs)} starts, {whose} {its}"
    reason += f": {words}" * bool(words)
    above |= bool(less[:, LARGEST_EXCESS:].any())
    return Verdict(reason, breaks, above, is_sure, hopeless)


@dataclass(frozen=True)
class Starts:
    """Seeded starts, and what came of the MPC there. A policy has lost the first ``n_hard``."""

    seeds: tuple[int, ...]
    mpc: Scores
    tolerance: Tolerance
    n_hard: int = 0

    def with_hard(self, others: Starts, hard: NDArray[np.int64]) -> Starts:
        """Return these starts, with some of others before them."""
        seeds = (*(others.seeds[i] for i in hard), *self.seeds)
        mpc = others.mpc.at(hard).extended_by(self.mpc)
        return replace(self, seeds=seeds, mpc=mpc, n_hard=self.n_hard + len(hard))

    def _excess(self, policy: Scores) -> Array:
        """Return what the first starts cost a policy more, inf where it is less safe."""
        mpc = self.mpc.at(slice(len(policy.costs)))
        less = less_safe(policy.unsafe, mpc.unsafe, self.tolerance.excess_room).any(axis=1)
        return np.where(less, np.inf, self.tolerance.excess(mpc.costs, policy.costs))

    def lost(self, policy: Scores) -> NDArray[np.bool_]:
        """Return which of the first starts a policy loses against the MPC."""
        return np.asarray(self._excess(policy) > 1.0)

    def hardest(self, policy: Scores) -> NDArray[np.int64]:
        """Return the hardest of the first starts that a policy loses, else that cost it more."""
        excess = self._excess(policy)
        count = np.count_nonzero(excess > 1.0) or np.count_nonzero(excess > 0)
        # 10: new starts that join those of every later candidate at a time
        return np.argsort(-excess, kind="stable")[: min(10, count)]


@dataclass
class NewSeeds:
    """Gives seeds of episodes that nothing has seen, from the ``next`` one on."""

    next: int

    def __call__(self, count: int) -> range:
        """Return so many of them."""
        first = self.next
        self.next += count
        return range(first, self.next)


@dataclass
class PairedTrial:
    """Policies beside the MPC from the same starts, in stages, until they decide.

    Every trial of a guard and of `improve` is one. ``play`` returns the scores of a policy, or of
    ``mpc``, from seeds. The MPC plays each start once; where its own cost is no finite number
    nothing can be compared, and the start is left out. After the ``starts`` that it has played
    others follow, of ``new_seeds``; then ``tolerance``, if there is one, says anew what may cost
    more. ``scores`` are those of the policy that is on trial, from the first starts.
    """

    play: Callable[[Any, Sequence[int]], Scores]
    mpc: Any
    starts: Starts
    new_seeds: Callable[[int], Sequence[int]]
    tolerance: Callable[[Array], Tolerance] | None = None

    def __post_init__(self) -> None:
        self.scores = self.starts.mpc.at(slice(0))

    def extend(self, count: int) -> None:
        """Let the MPC play more, until it has played so many starts."""
        missing = count - len(self.starts.seeds)
        if missing <= 0:
            return
        seeds = self.new_seeds(missing)
        mpc = self.play(self.mpc, seeds)
        finite = np.flatnonzero(np.isfinite(mpc.costs))
        if len(finite) == 0 and not self.starts.seeds:
            raise ValueError(
                f"The MPC's own cost is a finite number on none of {missing} new starts of the "
                "simulator, so policies cannot be compared there. Its rewards must be finite."
            )
        known = (*self.starts.seeds, *(seeds[i] for i in finite))
        mpc = self.starts.mpc.extended_by(mpc.at(finite))
        tolerance = self.tolerance(mpc.costs) if self.tolerance else self.starts.tolerance
        self.starts = replace(self.starts, seeds=known, mpc=mpc, tolerance=tolerance)

    def stages(self, policy: Any, counts: Sequence[int]) -> Iterator[int]:
        """Play a policy from ever more starts; yield the number of each look, from 1."""
        self.scores = self.starts.mpc.at(slice(0))
        for look, count in enumerate(counts, start=1):
            self.extend(count)
            seeds = self.starts.seeds[len(self.scores.costs) : count]
            self.scores = self.scores.extended_by(self.play(policy, seeds))
            yield look

    @property
    def mpc_scores(self) -> Scores:
        """Those of the MPC from the starts that the policy has played."""
        return self.starts.mpc.at(slice(len(self.scores.costs)))

    @property
    def relative(self) -> Array:
        """What each start costs more than with the MPC, in its own cost or the typical one."""
        mpc = self.mpc_scores.costs
        return relative_costs(self.scores.costs - mpc, mpc)

    def verdict(
        self,
        level: float,
        accepted: Scores | None = None,
        *,
        least_gain: float = 0.0,
        must_gain: bool = False,
        tail_errors: float = 0.0,
    ) -> Verdict:
        """Return whether the policy is no worse than the MPC, and than what was accepted before.

        With ``must_gain`` a gain must be sure at the ``level`` and ``least_gain`` at least, else
        "no worse" is enough. See :func:`no_worse`.
        """
        mpc = self.mpc_scores
        scores = self.scores
        found = no_worse(
            scores,
            mpc if accepted is None else accepted,
            mpc,
            self.starts.tolerance,
            names=self.starts.seeds,
            n_hard=self.starts.n_hard,
            level=level,
            least_gain=least_gain,
            tail_errors=tail_errors,
        )
        more = scores.costs - mpc.costs
        change = mean_change(more, mpc.costs)
        enough = change <= -least_gain
        if found.reason or not must_gain or (enough and found.is_sure):
            return found
        error = 100 * Difference.of(self.relative).error
        measured = f"{100 * change:+.2g} % (± {error:.1g}) in {len(more)} pairs"
        return found._replace(reason=f"{measured}: {'not sure' if enough else TOO_LITTLE}")


def relative_costs(more: Array, mpc_costs: Array) -> Array:
    """Return what starts cost more, each relative to the MPC's cost of it, or its typical one."""
    own = np.maximum(np.abs(mpc_costs), np.median(np.abs(mpc_costs)))
    return np.asarray(more / np.where(own > 0, own, 1.0))


def mean_change(more: Array, mpc_costs: Array) -> float:
    """Return what starts cost more on average, relative to the MPC's mean: -0.02 is 2 % less."""
    return float(more.mean()) / max(float(np.abs(mpc_costs).mean()), 1e-300)


def tail_average(values: Array, alpha: float) -> tuple[float, float]:
    """Return the average of the worst share of values, and its standard error.

    The conditional value at risk q + E(x - q)+ / alpha at the quantile q, with the deviation of the
    second part (Rockafellar and Uryasev, *Optimization of conditional value-at-risk*, Journal of
    Risk 2, 2000). At least one value counts.
    """
    count = min(max(1.0, alpha * len(values)), float(len(values)))
    ranked = np.sort(values)[::-1]
    level = ranked[int(np.ceil(count)) - 1]
    beyond = np.maximum(ranked - level, 0.0)
    return float(level + beyond.sum() / count), float(beyond.std() * np.sqrt(len(values)) / count)


def is_above(costs: Array, others: Array) -> bool:
    """Return whether the mean of costs is above that of others beyond rounding, or not a number."""
    return not costs.mean() - others.mean() <= COST_ROUNDING * np.abs(others).mean()


def unsafe_columns(
    violations: ArrayLike,
    ended: ArrayLike,
    lost: ArrayLike,
    excess: BoundExcess,
    far: ArrayLike = 0,
    lengths: ArrayLike = 0,
) -> Array:
    """Return what :func:`less_safe` compares, (episodes, 9).

    ``violations`` and ``far`` count steps; ``ended`` is whether the env ends an episode itself, -1
    where its end is a success; ``lost`` whether its cost or an observation is not finite.
    """
    size = np.shape(excess.largest)
    columns = [violations, ended, lost, far, excess.largest, excess.summed, excess.any_bound]
    columns += [-np.asarray(lengths), excess.worst]
    return np.column_stack([np.broadcast_to(each, size).astype(np.float64) for each in columns])


def less_safe(now: Array, before: Array, room: float = EXCESS_ROOM) -> NDArray[np.bool_]:
    """Tell which episodes are less safe than before, and in what (episodes, 6).

    - The largest excess of an episode may be larger by ``room`` half-widths and by ``EXCESS_SHARE``
      of what it was. So may the summed one, and by one step of the largest besides. It counts where
      it is larger on average over all episodes, too.
    - Where the env reported violations before, and the problem's bounds tell their size, a tenth
      more steps of them, or one, count only where they are larger.
    - An episode may be shorter where its end is a success.
    - Of all else nothing may be more.

    Both are columns (episodes, 9) of :func:`unsafe_columns`, of the same starts.
    """
    more = now[:, : len(UNSAFE)] > before[:, : len(UNSAFE)]
    larger = ~(now <= allowed_excess(before, room))
    few = now[:, 0] <= before[:, 0] + np.maximum(1.0, EXCESS_SHARE * before[:, 0])
    known = (before[:, 0] > 0) & (now[:, ANY_BOUND] > 0) & few & ~larger[:, ANY_BOUND]
    more[:, 0] &= ~known
    shorter = (now[:, ENDED] >= 0) & (now[:, MISSING] > before[:, MISSING])
    more[:, ENDED] = shorter | (more[:, ENDED] & (now[:, ENDED] > 0))
    more[:, LARGEST_EXCESS] = larger[:, LARGEST_EXCESS]
    if len(now):
        step = before[:, LARGEST_EXCESS]  # one more of the largest
        summed = now[:, SUMMED_EXCESS]
        its = before[:, SUMMED_EXCESS]
        least = allowed_excess(its.mean(), room) + step.max() / len(now)
        longer = ~(summed <= allowed_excess(its, room) + step)
        more[:, SUMMED_EXCESS] = longer & ~(summed.mean() <= least)
    return np.asarray(more)


def allowed_excess(excess: ArrayLike, room: float = EXCESS_ROOM) -> Array:
    """Return the excess that is no larger than another: it rides the same bound."""
    return np.asarray((1 + EXCESS_SHARE) * np.asarray(excess) + room)
