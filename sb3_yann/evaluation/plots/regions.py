"""The regions of an MPC's explicit law, by law or by what acts in the plan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._drawing import as_figure
from sb3_yann._validation import Array, check_choice
from sb3_yann.control import LinearMPC
from sb3_yann.control.explicit.solve import ProgramUnits
from sb3_yann.control.law import plot as law_plot
from sb3_yann.control.mpc.condensing import condense
from sb3_yann.evaluation.plots._sources import Quantity, entry_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ACTIVE = 1e-7
"""Slack of a unit row, in half-widths, below which it acts."""


def plot_regions(
    problem: LinearMPC,
    axes: Axes | None = None,
    *,
    entries: Sequence[Quantity] = (0, 1),
    at: ArrayLike | None = None,
    by: str = "law",
) -> Axes:
    """Draw the regions of the explicit law in the plane of two entries of theta.

    Parameters
    ----------
    problem : LinearMPC
        The one that has the law.
    axes : matplotlib Axes, optional
        Where to draw; a new figure's by default.
    entries : pair of int or str, default (0, 1)
        The coordinates to the right and up: indices, or names as in ``problem.labels()``.
    at : array_like, shape (n_theta,), optional
        The other entries, as the plant shows them; the operating point by default.
    by : {"law", "constraint"}, default "law"
        What a color stands for: which inputs are constant in the region, or which constraints act
        in its optimal plan.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> axes = plot_regions(problems.cstr(), entries=("C_B", "T"), by="constraint")
    >>> axes.get_xlabel()
    'C_B (mol/L)'
    """
    check_choice("by", by, ("law", "constraint"))
    chosen = [entry_of(problem, each) for each in entries]
    name = ActiveConstraints(problem) if by == "constraint" else None
    labels = problem.labels(units=True)
    return law_plot.plot_regions(
        problem.explicit(), axes, entries=chosen, at=at, labels=labels, name=name
    )


class ActiveConstraints:
    """Names what acts in the optimal plan at a theta, whatever the region."""

    def __init__(self, problem: LinearMPC) -> None:
        program, self.names = condense(problem)
        self.units = ProgramUnits(program, problem.deviations.u_min, problem.deviations.u_max)

    def at(self, theta: Array) -> list[str] | None:
        """Return the constraints that act at theta (n_theta,), None where no plan is feasible."""
        scaled, z = self.units.scaled, (theta - self.units.center) / self.units.half
        U = scaled.solve(z)
        if U is None:
            return None
        slack = scaled.w + scaled.S @ z - scaled.G @ U
        return [*dict.fromkeys(self.names[i] for i in np.flatnonzero(slack < ACTIVE))]

    def __call__(self, region: int, theta: Array) -> str:
        """Return them in words."""
        return ", ".join(self.at(theta) or ()) or "no constraint acts"


regions_figure = as_figure(plot_regions)
