"""Why a candidate is refused: in paired episodes of a simulator, or on a plant alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

from sb3_yann._validation import Array

OUTLIER = 1e-3
"""Probability that one episode of a policy like the accepted one is taken for far outside."""
MOST = 10.0
"""With a tail: how many times as much as its average one start may cost more."""
UNSAFE = (
    "violations",
    "an episode that the env terminates",
    "a cost or an observation that is no finite number",
    "an input that moves too far in one step",
)


@dataclass(frozen=True)
class Tolerance:
    """What starts may cost more than with the MPC.

    Attributes
    ----------
    margin : float
        In units of cost: what a start may cost more. With a ``tail``, what the worst of them may on
        average.
    tail : float, share of all starts that the average is over; 0 is the worst single start
        With a tail, a start that costs the MPC more than ``typical`` may cost more in proportion,
        and no start may cost more than ``MOST`` times as much as the average may.
    typical : float, the MPC's median cost
    """

    margin: float
    tail: float = 0.0
    typical: float = np.inf

    def excess(self, mpc_costs: Array, costs: Array) -> Array:
        """Return what each start costs more than with the MPC, in units of what it may.

        A cost that is not a number is inf.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            more = (costs - mpc_costs) / self.allowed(mpc_costs)
        more = np.where(costs <= mpc_costs, np.fmin(more, 0.0), more)  # also without any margin
        return np.asarray(np.nan_to_num(more, nan=np.inf, posinf=np.inf, neginf=-np.inf))

    def allowed(self, mpc_costs: Array) -> Array:
        """Return what each start may cost more."""
        if not self.tail:
            return np.full(len(mpc_costs), self.margin)
        return np.asarray(self.margin * np.maximum(1.0, np.abs(mpc_costs) / self.typical))

    def objection(self, excess: Array, n_starts: int | None = None, sure: float = 0.0) -> str:
        """Return what speaks against such an excess over the MPC, empty where nothing does.

        Parameters
        ----------
        excess : ndarray, shape (starts,)
            As :meth:`excess` returns it.
        n_starts : int, optional
            Number of starts of which these are the worst ones. The default is all of them.
        sure : float, default 0
            How many standard errors of the tail's average count as well.
        """
        worst = int(np.argmax(excess))
        if not excess[worst] > 1.0:
            return ""
        if not self.tail or excess[worst] > MOST:
            return f"start {worst}"
        average, error = tail_average(excess, self.tail, n_starts or len(excess))
        if average + sure * error <= 1.0:
            return ""
        return f"the worst {100 * self.tail:g} % of the starts cost too much, start {worst}"


def tail_average(excess: Array, tail: float, n_starts: int) -> tuple[float, float]:
    """Return the average of the worst share of values, and its standard error.

    The conditional value at risk q + E(x - q)+ / tail at the quantile q, with the deviation of the
    second part (Rockafellar and Uryasev, *Optimization of conditional value-at-risk*, Journal of
    Risk 2, 2000). At least one value counts.

    Parameters
    ----------
    excess : ndarray, shape (values,)
        The worst ones of ``n_starts``.
    tail : float
        The share.
    n_starts : int
        So many values there are.
    """
    count = min(max(1.0, tail * n_starts), float(len(excess)))
    ranked = np.sort(excess)[::-1]
    level = ranked[int(np.ceil(count)) - 1]
    beyond = np.maximum(ranked - level, 0.0)
    mean = beyond.sum() / count
    deviation = np.sqrt(max(0.0, np.sum(beyond**2) / n_starts - (beyond.sum() / n_starts) ** 2))
    return float(level + mean), float(deviation * np.sqrt(n_starts) / count)


@dataclass(frozen=True)
class PairedEpisodes:
    """Episodes from the same starts, under the MPC and under the accepted policy.

    Attributes
    ----------
    mpc_costs, costs : ndarray, shape (episodes,), those of the MPC and of the accepted policy
    unsafe : ndarray of int, shape (episodes, 4), the accepted policy's
        The columns, named in ``UNSAFE``, are compared one by one: an episode cut short has fewer
        steps to violate in.
    tolerance : Tolerance, what starts may cost more than with the MPC
    n_starts : int, optional, the number of starts that these are the worst ones of
    """

    mpc_costs: Array
    costs: Array
    unsafe: NDArray[np.int64]
    tolerance: Tolerance
    n_starts: int | None = None

    def lost(self, costs: Array) -> NDArray[np.bool_]:
        """Return which starts cost more than with the MPC by more than they may."""
        return np.asarray(self.tolerance.excess(self.mpc_costs, costs) > 1.0)

    def loses_to_the_mpc(self, costs: Array) -> bool:
        """Return whether the mean cost is above the MPC's."""
        return not costs.mean() <= self.mpc_costs.mean()

    def objection(self, costs: Array, unsafe: NDArray[np.int64]) -> str:
        """Return why a policy with these episodes is refused, empty where it is not.

        Comparisons are written so that a cost that is not a number is refused.
        """
        for what, now, before in zip(UNSAFE, unsafe.T, self.unsafe.T, strict=True):
            more = np.flatnonzero(now > before)
            if len(more):
                return f"{len(more)} starts with {what}, the first is number {more[0]}"
        relative = self.tolerance.excess(self.mpc_costs, costs)
        why = self.tolerance.objection(relative, self.n_starts)
        if why:
            worst = np.argmax(relative)
            return f"{why} costs {costs[worst] - self.mpc_costs[worst]:.4g} more than with the MPC"
        if not costs.mean() <= self.costs.mean():
            mean, accepted = told_apart(costs.mean(), self.costs.mean())
            return f"mean cost {mean}, accepted {accepted}"
        return ""


def told_apart(one: float, other: float) -> tuple[str, str]:
    """Return two numbers in six digits, or in as many more as tell them apart."""
    shown = [(f"{one:.{digits}g}", f"{other:.{digits}g}") for digits in range(6, 18)]
    return next((pair for pair in shown if pair[0] != pair[1]), shown[0])


Logged = tuple[Array, Array]
"""The thetas (T + 1, n_theta) and the inputs (T, m) of an episode."""


@dataclass(frozen=True)
class PlantEpisodes:
    """Training episodes of one policy.

    Attributes
    ----------
    costs, predicted : ndarray, shape (episodes,)
        What each cost, and what it should cost from its start, whoever plays: the covariate.
    log : tuple of pairs of ndarray, shapes (T + 1, n_theta) and (T, m)
        Thetas and inputs of each; empty where they are not known.
    """

    costs: Array
    predicted: Array
    log: tuple[Logged, ...] = ()

    def __add__(self, other: PlantEpisodes) -> PlantEpisodes:
        """Return the episodes of both, which one policy has played."""
        return PlantEpisodes(
            np.concatenate([self.costs, other.costs]),
            np.concatenate([self.predicted, other.predicted]),
            self.log + other.log,
        )


@dataclass(frozen=True)
class ErrorBudget:
    """How much of the probability of an error each test of a run may use.

    The tests of a run share ``significance``: number i has ``1 / (i (i + 1))`` of it, which adds up
    to 1, and a test that passes hands its size on to the next one. So a run passes a policy that is
    no better with probability ``significance`` at most, however many tests it makes, whenever it
    stops, and however the tests depend on each other (online fallback: Tian and Ramdas, *Online
    control of the familywise error rate*, Statistical Methods in Medical Research, 2021).

    Attributes
    ----------
    tests : int, so many have been made
    handed_on : float, the size of the last one if it passed, else 0

    Examples
    --------
    >>> budget = ErrorBudget()
    >>> [round(budget.size(0.05), 4), round(budget.after(0.025, passed=False).size(0.05), 4)]
    [0.025, 0.0083]
    """

    tests: int = 0
    handed_on: float = 0.0

    def size(self, significance: float) -> float:
        """Return the size of the next test."""
        return significance / ((self.tests + 1) * (self.tests + 2)) + self.handed_on

    def after(self, size: float, passed: bool) -> ErrorBudget:
        """Return what is left after a test of that size."""
        return ErrorBudget(self.tests + 1, size if passed else 0.0)


def is_promising(candidate: PlantEpisodes, accepted: PlantEpisodes, size: float) -> bool:
    """Return whether a test of that size would pass if both played all their episodes once more."""
    return analyze_covariance(candidate + candidate, accepted + accepted)[1] < size


def excess_of_an_outlier(
    candidate: PlantEpisodes, accepted: PlantEpisodes, margin: float = 0.0
) -> float:
    """Return by how much one of the candidate's episodes costs more than the accepted policy's.

    0 where none is beyond the upper prediction limit, of size ``OUTLIER`` for all of them, of the
    least-squares line of the accepted costs on the predicted ones (e.g. Montgomery, chapter 10), by
    more than a margin: the line may leave next to no scatter.
    """
    covariate = _varies(accepted.predicted) and bool(np.all(np.isfinite(candidate.predicted)))
    X, new = (
        np.column_stack([np.ones(len(each.costs)), each.predicted][: 1 + covariate])
        for each in (accepted, candidate)
    )
    freedom = len(X) - X.shape[1]
    coefficients, *_ = np.linalg.lstsq(X, accepted.costs, rcond=None)
    scatter = np.sqrt(np.sum((accepted.costs - X @ coefficients) ** 2) / freedom)
    leverage = np.einsum("ij,jk,ik->i", new, np.linalg.pinv(X.T @ X), new)
    excess = candidate.costs - new @ coefficients
    limit = stats.t.isf(OUTLIER / len(new), freedom) * scatter * np.sqrt(1 + leverage)
    beyond = excess > limit + margin + 1e-9 * np.abs(accepted.costs).max()
    return float(np.max(excess, where=beyond, initial=0.0))


def _varies(predicted: Array) -> bool:
    finite = bool(np.all(np.isfinite(predicted)))
    return finite and bool(np.ptp(predicted) > 1e-9 * np.abs(predicted).max())


def analyze_covariance(candidate: PlantEpisodes, accepted: PlantEpisodes) -> tuple[float, float]:
    """Return how much more the candidate costs from the same starts, and the one-sided p-value.

    Ordinary least squares of the cost on the cost that was predicted and on which policy played;
    Welch's t test of the policy's coefficient (Welch, *Biometrika* 34, 1947, with Satterthwaite's
    degrees of freedom). A prediction for the accepted policy fits the candidate less well, so each
    policy has a variance of its own. The test assumes independent episodes and residuals that are
    nearly normal. Where nothing can be told: nan and p = 1.
    """
    costs = np.concatenate([candidate.costs, accepted.costs])
    predicted = np.concatenate([candidate.predicted, accepted.predicted])
    if not np.all(np.isfinite(costs)):
        return np.nan, 1.0
    covariate, count = _varies(predicted), len(candidate.costs)
    if min(count, len(accepted.costs)) < 2:
        raise ValueError(f"{len(costs)} episodes are too few to compare two policies.")
    # Deviations from each policy's own means tell the slope; the means tell the difference.
    y, difference = _within(costs, count)
    is_candidate = np.arange(len(costs)) < count
    weights = np.where(is_candidate, 1 / count, -1 / len(accepted.costs))
    if covariate:
        x, apart = _within(predicted, count)
        spread = float(x @ x)
        if spread <= 1e-12 * np.sum((predicted - predicted.mean()) ** 2):
            return np.nan, 1.0  # the starts alone tell the two policies' episodes apart
        slope = float(x @ y) / spread
        difference -= slope * apart
        weights = weights - apart * x / spread
        y = y - slope * x
    if abs(difference) <= 1e-12 * np.abs(costs).max():
        return 0.0, 1.0  # rounding: "no difference" is no improvement
    each = np.array([is_candidate, ~is_candidate])
    freedom = each.sum(1) - 1 - covariate / 2  # the slope takes half a degree of each
    variances = (each @ weights**2) * (each @ y**2) / freedom
    variance = variances.sum()
    if not variance > 0:  # without any scatter the sign alone decides
        return difference, float(difference > 0)
    joint = variance**2 / np.sum(variances**2 / freedom)
    return difference, float(special.stdtr(joint, difference / np.sqrt(variance)))


def _within(values: Array, count: int) -> tuple[Array, float]:
    """Return the deviations from each policy's mean, and how far apart the two means are."""
    new, old = values[:count], values[count:]
    parts = new - new.mean(), old - old.mean()
    return np.concatenate(parts), float(new.mean() - old.mean())
