"""Why a candidate is refused: paired episodes of a simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.compare import EXCESS_ROOM, SUCCESS, UNSAFE, less_safe

ROUNDING = 1e-6
"""Of a mean cost: what float32 actions and batches of other sizes make of one policy's."""
MOST = 10.0
"""With a tail: how many times as much as its average one start may cost more."""


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
    excess_room : float, half-widths by which an excess over bounds may be larger
    """

    margin: float
    tail: float = 0.0
    typical: float = np.inf
    excess_room: float = EXCESS_ROOM

    def excess(self, mpc_costs: Array, costs: Array) -> Array:
        """Return what each start costs more than with the MPC, in units of what it may.

        A cost that is not a number is inf.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            more = (costs - mpc_costs) / self.allowed(mpc_costs)
        more = np.where(costs <= mpc_costs, np.fmin(more, 0.0), more)  # also without any margin
        return np.asarray(np.nan_to_num(more, nan=np.inf, posinf=np.inf, neginf=-np.inf))

    def allowed(self, mpc_costs: Array) -> Array:
        """Return what each start may cost more, rounding at least."""
        rounding = ROUNDING * np.abs(mpc_costs)
        if not self.tail:
            return np.maximum(self.margin, rounding)
        return np.maximum(self.margin * np.maximum(1.0, np.abs(mpc_costs) / self.typical), rounding)

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
    unsafe : ndarray, shape (episodes, 7), the accepted policy's
        As :func:`~sb3_yann.compare.unsafe_columns` returns it.
    tolerance : Tolerance, what starts may cost more than with the MPC
    n_starts : int, optional, the number of starts that these are the worst ones of
    """

    mpc_costs: Array
    costs: Array
    unsafe: Array
    tolerance: Tolerance
    n_starts: int | None = None

    def lost(self, costs: Array) -> NDArray[np.bool_]:
        """Return which starts cost more than with the MPC by more than they may."""
        return np.asarray(self.tolerance.excess(self.mpc_costs, costs) > 1.0)

    def loses_to_the_mpc(self, costs: Array) -> bool:
        """Return whether the mean cost is above the MPC's."""
        return is_above(costs, self.mpc_costs)

    def objection(self, costs: Array, unsafe: Array) -> str:
        """Return why a policy with these episodes is refused, empty where it is not.

        Comparisons are written so that a cost that is not a number is refused.
        """
        for what, column in zip(
            UNSAFE, less_safe(unsafe, self.unsafe, self.tolerance.excess_room).T, strict=True
        ):
            more = np.flatnonzero(column)
            if len(more):
                told = f"{len(more)} starts with {what}, the first is number {more[0]}"
                return f"{told}; {SUCCESS}" if what == UNSAFE[1] else told
        relative = self.tolerance.excess(self.mpc_costs, costs)
        why = self.tolerance.objection(relative, self.n_starts)
        if why:
            worst = np.argmax(relative)
            return f"{why} costs {costs[worst] - self.mpc_costs[worst]:.4g} more than with the MPC"
        if is_above(costs, self.costs):
            mean, accepted = told_apart(costs.mean(), self.costs.mean())
            return f"mean cost {mean}, accepted {accepted}"
        if self.loses_to_the_mpc(costs):  # by as much as rounding in many acceptances adds up to
            mean, mpc = told_apart(costs.mean(), self.mpc_costs.mean())
            return f"mean cost {mean}, MPC {mpc}"
        return ""


def is_above(costs: Array, others: Array, error: float = 0.0) -> bool:
    """Return whether the mean of costs, and an error, is above that of others beyond rounding.

    A mean that is not a number is.
    """
    return not costs.mean() + error - others.mean() <= ROUNDING * np.abs(others).mean()


def told_apart(one: float, other: float) -> tuple[str, str]:
    """Return two numbers in six digits, or in as many more as tell them apart."""
    shown = [(f"{one:.{digits}g}", f"{other:.{digits}g}") for digits in range(6, 18)]
    return next((pair for pair in shown if pair[0] != pair[1]), shown[0])
