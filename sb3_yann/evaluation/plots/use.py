"""Which regions closed loops come through, and how far a policy leaves the MPC in each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann._drawing import COLORS, axes_or_new, new_figure
from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.evaluation.episodes import Episodes
from sb3_yann.evaluation.plots._sources import inputs_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEAST = 0.01
"""Percent that the axis of distances reaches at least: rounding is not drawn large."""
MOST = 30
"""Regions in a picture: those visited most."""


@dataclass(frozen=True)
class RegionUse:
    """The regions that episodes come through, those visited most first.

    Attributes
    ----------
    regions : ndarray of int, shape (k,)
    share : ndarray, shape (k,)
        Of all steps.
    mean, largest : ndarray, shape (k,)
        Distance of the policy's input from the MPC's, in half-widths of the input range, of that
        input which is farthest.

    Examples
    --------
    >>> from sb3_yann.evaluation import evaluate
    >>> from sb3_yann_envs import problems
    >>> mpc = problems.cstr()
    >>> played = evaluate(mpc.explicit(), "CSTR-v0", [0])
    >>> use = RegionUse.of(mpc, mpc.explicit(), played)
    >>> round(float(use.share.sum()), 9), float(use.largest.max())
    (1.0, 0.0)
    """

    regions: NDArray[np.int64]
    share: Array
    mean: Array
    largest: Array

    @classmethod
    def of(cls, problem: LinearMPC, policy: Any, episodes: Episodes) -> RegionUse:
        """Return it of a law, model or policy; the observations of the episodes are theta."""
        law = problem.explicit()
        theta = np.concatenate([each[:-1] for each in episodes.observations])
        theta = theta[np.isfinite(theta).all(axis=1)]
        apart = np.abs(inputs_of(problem, policy, theta) - law(theta)) / problem.u_half
        distance, region = apart.max(axis=1), law.locate(theta)
        found, where, visits = np.unique(region, return_inverse=True, return_counts=True)
        largest = np.zeros(len(found))
        np.maximum.at(largest, where, distance)
        mean = np.bincount(where, weights=distance) / visits
        order = np.argsort(-visits, kind="stable")
        return cls(found[order], visits[order] / len(theta), mean[order], largest[order])


def plot_visits(use: RegionUse, axes: Axes | None = None) -> Axes:
    """Draw the share of the steps in each region, of those visited most.

    Examples
    --------
    >>> use = RegionUse(np.array([3, 1]), np.array([0.8, 0.2]), np.zeros(2), np.zeros(2))
    >>> [float(bar.get_height()) for bar in plot_visits(use).patches]
    [80.0, 20.0]
    """
    axes = axes_or_new(axes, 6.4, 2.6)
    axes.bar(range(len(use.share[:MOST])), 100 * use.share[:MOST], color=COLORS[5])
    axes.set(ylabel="steps there (%)")
    return _with_regions(use, axes)


def plot_changes(use: RegionUse, axes: Axes | None = None) -> Axes:
    """Draw the mean and largest distance from the MPC in each region, of those visited most.

    Examples
    --------
    >>> use = RegionUse(np.array([3]), np.ones(1), np.array([0.1]), np.array([0.2]))
    >>> plot_changes(use).lines[0].get_ydata().tolist()
    [20.0]
    """
    axes = axes_or_new(axes, 6.4, 2.6)
    places = range(len(use.share[:MOST]))
    axes.bar(places, 100 * use.mean[:MOST], color=COLORS[0], label="mean")
    axes.plot(places, 100 * use.largest[:MOST], "v", color=COLORS[1], markersize=5, label="largest")
    axes.set(ylabel="distance from the MPC\n(% of half the range)")
    axes.set_ylim(0, max(axes.get_ylim()[1], LEAST))
    axes.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0)
    return _with_regions(use, axes)


def use_figure(problem: LinearMPC, policy: Any, episodes: Episodes) -> Figure:
    """Return a figure of :func:`plot_visits` above :func:`plot_changes`.

    Examples
    --------
    >>> from sb3_yann.evaluation import evaluate
    >>> from sb3_yann_envs import problems
    >>> mpc = problems.cstr()
    >>> played = evaluate(mpc.explicit(), "CSTR-v0", [0])
    >>> len(use_figure(mpc, mpc.explicit(), played).axes)
    2
    """
    figure, use = new_figure(6.8, 4.8), RegionUse.of(problem, policy, episodes)
    above, below = figure.subplots(2, 1, sharex=True)
    plot_visits(use, above).set_xlabel("")
    plot_changes(use, below)
    return figure


def _with_regions(use: RegionUse, axes: Axes) -> Axes:
    names = [str(each) for each in use.regions[:MOST]]
    axes.set_xticks(range(len(names)), names, rotation=90 if len(names) > 15 else 0)
    left_out = len(use.regions) - len(names)
    more = f" ({left_out} more, visited less, are left out)" if left_out else ""
    axes.set_xlabel(f"region{more}")
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)
    return axes
