"""Whether bounds, or what an env shows, are deviations where a problem is in plant units."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann._validation import Array
from sb3_yann.control.model.labels import labels_of
from sb3_yann.control.model.linear_model import LinearModel

if TYPE_CHECKING:
    from sb3_yann.control.mpc.problem import MPCProblem

Mask = NDArray[np.bool_]


class Range(NamedTuple):
    """Bounds of a problem, and the operating point between them.

    Attributes
    ----------
    name : {"x", "theta", "u", "r", "y", "d"}
    low, high, point : ndarray, shape (k,)
    """

    name: str
    low: Array
    high: Array
    point: Array

    @property
    def leave_out_rest(self) -> Mask:
        """Which leave out the operating point."""
        return np.asarray((self.low > self.point) | (self.high < self.point))

    @property
    def are_deviations(self) -> Mask:
        """Which leave out the operating point, and hold 0."""
        return np.asarray(self.leave_out_rest & (self.low < 0) & (self.high > 0))


def warn_of_misread_bounds(
    model: LinearModel, ranges: Sequence[Range], has_constants: bool
) -> None:
    """Warn of bounds that seem to be deviations, or in which the law cannot rest.

    Parameters
    ----------
    model : LinearModel
        Which names the states.
    ranges : sequence of Range
        Those of a problem: x, theta of the states, u, and others.
    has_constants : bool
        Whether references or disturbances are other places to rest at.
    """
    for each in ranges:
        for i in np.flatnonzero(each.are_deviations)[:1]:
            name, low, high, point = each.name, each.low[i], each.high[i], each.point[i]
            warnings.warn(
                f"{name}_min = {low:g} and {name}_max = {high:g} of entry {i} leave out the "
                f"operating point, {point:g}, and hold 0. Bounds are what the plant shows. If "
                f"these are deviations, pass {name}_min = {low + point:g} and {name}_max = "
                f"{high + point:g}, or leave x_ss and u_ss out of the model.",
                stacklevel=3,
            )
            return
    if has_constants:
        return
    x, theta, u = ranges[:3]
    has_point = bool(np.any(x.point) or np.any(u.point))
    cure = "If these are what the plant takes, give the model its x_ss and u_ss."
    if has_point:
        cure = "Linearize where the inputs keep their bounds, or correct u_ss of the model."
    for i in np.flatnonzero(u.leave_out_rest):
        warnings.warn(
            f"u_min = {u.low[i]:g} and u_max = {u.high[i]:g} leave out u[{i}] = {u.point[i]:g}, "
            f"the operating point: the law cannot rest there. {cure}",
            stacklevel=3,
        )
    for i in np.flatnonzero(has_point & (x.leave_out_rest | theta.leave_out_rest)):
        of = x if x.leave_out_rest[i] else theta
        warnings.warn(
            f"{labels_of(model)[0][i]} = {x.point[i]:g}, the operating point, lies outside its "
            f"bounds, {of.low[i]:g} to {of.high[i]:g}: the law cannot rest there. Look at the "
            "order of the states.",
            stacklevel=3,
        )


def misread_entry(problem: MPCProblem, shown: ArrayLike) -> int | None:
    """Return an entry of theta that is shown as a deviation, None where it does not seem so.

    Nearly all rows lie outside the box of the law, and inside with the operating point put on.

    Parameters
    ----------
    problem : LinearMPC
        Whose theta it should be.
    shown : ndarray, shape (steps, n_theta)
        What an env shows, in plant units or not.
    """
    rows, point = np.asarray(shown, np.float64), problem.theta_ss
    if not len(rows) or not np.any(point):
        return None
    low, high, reach = problem.theta_min, problem.theta_max, problem.theta_half
    room = 1e-6 * reach
    most = 0.9  # share of the rows that must speak for it
    is_in, would_be_in = (
        (low - room <= each) & (each <= high + room) for each in (rows, rows + point)
    )
    states = problem.layout.state
    out = np.mean(~is_in[:, states].all(axis=1)) >= most
    if out and np.mean(would_be_in[:, states].all(axis=1)) >= most:
        # By how much nearer to zero than to the operating point, in half-widths: clearly so.
        nearer = np.abs(rows - point) / 2 - np.abs(rows)
        nearer = np.mean(nearer[:, states] / reach[states], axis=0)
        worst = int(np.argmax(nearer))
        if nearer[worst] > 0:
            return worst
    is_misread = (np.mean(~is_in, axis=0) >= most) & (np.mean(would_be_in, axis=0) >= most)
    constants = np.flatnonzero(is_misread & (point != 0))
    found = [
        int(i) for i in constants if problem.model.n_states <= i < problem.layout.previous.start
    ]
    return found[0] if found else None


def misread_in_words(problem: MPCProblem, shown: ArrayLike) -> str:
    """Return what `misread_entry` finds, empty where that is nothing."""
    i = misread_entry(problem, shown)
    if i is None:
        return ""
    value = np.asarray(shown, np.float64)[0, i]
    return (
        f"{problem.labels()[i]} = {value:.6g} is shown, and the operating point is "
        f"{problem.theta_ss[i]:.6g}: this is a deviation, and the problem is in plant units. Show "
        "what the plant shows, or leave x_ss and u_ss out of the model."
    )
