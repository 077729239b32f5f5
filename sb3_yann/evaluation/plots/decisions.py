"""The learning curve under a guard: every candidate, what became of it, and why the cost falls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._drawing import COLORS, as_figure, axes_or_new, legend_beside
from sb3_yann._validation import Array, to_float

if TYPE_CHECKING:
    from matplotlib.axes import Axes

KINDS = (
    ("accepted", "accepted", "o", COLORS[2]),
    ("accepted in part", "accepted in part", "^", COLORS[4]),
    ("refused", "refused, plays on", "x", COLORS[3]),
    ("restored", "refused, policy restored", "X", COLORS[1]),
)
BEYOND = 2.0
"""Candidates that lie farther out, in widths of what was accepted, are drawn at the edge."""


class DecisionLike(Protocol):
    """What is drawn of a guard's :class:`Decision`."""

    @property
    def episode(self) -> int:
        """Training episodes until then."""

    @property
    def verdict(self) -> str:
        """What became of the candidate."""

    @property
    def restored(self) -> bool:
        """Whether the accepted policy was restored."""

    @property
    def candidate_cost(self) -> float:
        """Mean cost of the candidate."""

    @property
    def accepted_cost(self) -> float:
        """Mean cost of what is accepted."""

    @property
    def mpc_cost(self) -> float:
        """Mean cost of the MPC."""


def plot_decisions(
    decisions: Sequence[DecisionLike],
    axes: Axes | None = None,
    *,
    training_costs: ArrayLike | None = None,
) -> Axes:
    """Draw each candidate's mean cost by the verdict on it, the accepted policy's and the MPC's.

    A candidate far beyond the accepted policies, or without a cost, is drawn at the edge.

    Parameters
    ----------
    decisions : sequence of Decision
        As in ``guard.decisions``; of none a note says so.
    axes : matplotlib Axes, optional
        Where to draw; a new figure's by default.
    training_costs : array_like, shape (episodes,), optional
        Costs of the training episodes themselves, drawn behind.

    Examples
    --------
    >>> from sb3_yann import Decision
    >>> first = Decision(9, 1, "accepted", "", False, 3.0, 3.0, 4.0, -0.5, (), 1.0)
    >>> plot_decisions([first]).get_xlabel()
    'training episodes'
    """
    axes = axes_or_new(axes, 8.0, 3.8)
    axes.set(xlabel="training episodes", ylabel="mean cost")
    if not decisions:
        axes.text(0.5, 0.5, "no candidate was tried", ha="center", transform=axes.transAxes)
        return axes
    episodes = np.array([each.episode for each in decisions])
    costs, accepted, mpc = (
        np.array([getattr(each, name) for each in decisions], np.float64)
        for name in ("candidate_cost", "accepted_cost", "mpc_cost")
    )
    bottom, top = _range(costs, accepted, mpc)
    if training_costs is not None:
        played = to_float("training_costs", training_costs)
        axes.plot(1 + np.arange(len(played)), played, ".", color="0.7", label="training episode")
    axes.step(episodes, accepted, where="post", color=COLORS[0], label="accepted policy")
    axes.plot(episodes, mpc, color="black", linestyle="--", linewidth=1.2, label="MPC")
    kinds = [_kind(each) for each in decisions]
    for kind, label, marker, color in KINDS:
        own = np.array([each == kind for each in kinds])
        if own.any():
            shown = np.clip(np.nan_to_num(costs[own], nan=np.inf), bottom, top)
            axes.plot(
                episodes[own], shown, marker, color=color, markersize=6, label=label, clip_on=False
            )
    if beyond := int(np.sum(~((costs >= bottom) & (costs <= top)))):
        axes.plot([], [], " ", label=f"({beyond} beyond the scale,\ndrawn at its edge)")
    axes.set_ylim(bottom, top)
    axes.locator_params(axis="x", integer=True)
    axes.grid(alpha=0.3)
    legend_beside(axes)
    return axes


def _kind(decision: DecisionLike) -> str:
    if decision.verdict != "rejected":
        return decision.verdict
    return "restored" if decision.restored else "refused"


def _range(costs: Array, accepted: Array, mpc: Array) -> tuple[float, float]:
    """Return the range that shows what was accepted, and the candidates not far beyond."""
    known = np.concatenate([accepted, mpc])
    known = known[np.isfinite(known)]
    if not known.size:
        known = costs[np.isfinite(costs)] if np.isfinite(costs).any() else np.zeros(1)
    low, high = float(known.min()), float(known.max())
    width = max(high - low, 0.02 * max(abs(low), abs(high)), 1e-12)
    near = costs[(costs >= low - BEYOND * width) & (costs <= high + BEYOND * width)]
    low, high = min([low, *near]), max([high, *near])
    room = 0.08 * max(high - low, width)
    return low - room, high + room


decisions_figure = as_figure(plot_decisions)
