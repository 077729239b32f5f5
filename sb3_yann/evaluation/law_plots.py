"""Pictures of laws and policies over theta: regions, surfaces, and which regions are used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann._drawing import COLORS, as_figure, axes_or_new, new_figure
from sb3_yann._validation import Array, check_array, check_choice
from sb3_yann.control import LinearMPC, PiecewiseAffine
from sb3_yann.control.explicit.solve import ProgramUnits
from sb3_yann.control.law_plot import plot_law
from sb3_yann.control.model.labels import labels_of, with_units
from sb3_yann.control.mpc.condensing import condense
from sb3_yann.rollout import Trajectories

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Quantity = int | str
Frame = tuple[ArrayLike, ArrayLike]
MAX_REGIONS = 30  # in a picture of visits: those visited most


def entry_of(problem: LinearMPC, quantity: Quantity, inputs: bool = False) -> int:
    """Return the entry of theta that a name or an index stands for; ValueError for none.

    With ``inputs`` it is an entry of ``[theta, u]``.
    """
    names = [*problem.labels(), *(labels_of(problem.model)[1] if inputs else ())]
    if isinstance(quantity, str) and quantity in names:
        return names.index(quantity)
    if isinstance(quantity, int | np.integer) and 0 <= quantity < len(names):
        return int(quantity)
    raise ValueError(f"{quantity!r} is no entry: expected one of {names}, or its index.")


def inputs_of(problem: LinearMPC, policy: Any, theta: Array) -> Array:
    """Return the inputs (batch, m), in deviations, at theta (batch, n_theta), in deviations.

    ``policy`` is a law, which takes theta, or a model or YannPolicy, whose actor's layer does.
    """
    actor = getattr(getattr(policy, "policy", policy), "actor", None)
    if actor is None:
        return np.asarray(policy(theta), np.float64).reshape(len(theta), -1)
    import torch as th

    device, bounds = next(actor.mu.buffers()).device, problem.deviations
    with th.no_grad():
        scaled = actor.mu(th.as_tensor(theta, device=device)).double().cpu().numpy()
    return np.asarray((bounds.u_max + bounds.u_min) / 2 + problem.u_half * scaled)


# ---- Regions ----


class ActiveConstraints:
    """Names the constraints that are active in the optimal plan at a theta."""

    def __init__(self, problem: LinearMPC) -> None:
        program, self.names = condense(problem)
        self.units = ProgramUnits(program, problem.deviations.u_min, problem.deviations.u_max)

    def at(self, theta: Array) -> list[str] | None:
        """Return the active constraints at theta (n_theta,), None where no plan is feasible."""
        scaled, z = self.units.scaled, (theta - self.units.center) / self.units.half
        U = scaled.solve(z)
        if U is None:
            return None
        slack = scaled.w + scaled.S @ z - scaled.G @ U  # of unit rows, in half-widths
        return [*dict.fromkeys(self.names[i] for i in np.flatnonzero(slack < 1e-7))]

    def __call__(self, region: int, theta: Array) -> str:
        """Return them as one text."""
        return ", ".join(self.at(theta) or ()) or "no constraint acts"


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
        The other entries, in plant units; the operating point by default.
    by : {"law", "constraint"}, default "law"
        What a color stands for: which inputs are constant in the region, or which constraints are
        active in its optimal plan.

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
    return plot_law(problem.explicit(), axes, entries=chosen, at=at, labels=labels, name=name)


regions_figure = as_figure(plot_regions)


# ---- Surfaces ----


class _Surface:
    """An input over a grid of two entries of theta, in plant units, to be drawn.

    Parameters are those of :func:`plot_surface`.
    """

    def __init__(
        self,
        problem: LinearMPC,
        entries: Sequence[Quantity],
        at: ArrayLike | None,
        output: int,
        frame: Frame | None,
    ) -> None:
        chosen = [entry_of(problem, each) for each in entries]
        if len(chosen) != 2 or chosen[0] == chosen[1]:
            raise ValueError(f"entries = {[*entries]} must be two different entries of theta.")
        if not 0 <= output < problem.model.n_inputs:
            raise ValueError(
                f"output = {output} must be an input, from 0 to {problem.model.n_inputs - 1}."
            )
        low, high = problem.theta_min[chosen], problem.theta_max[chosen]
        if frame is not None:
            low, high = (check_array("frame", each, (2,)) for each in frame)
        if not np.all(np.isfinite([low, high])) or np.any(low >= high):
            names = [problem.labels()[i] for i in chosen]
            raise ValueError(
                f"There is no frame to draw {names} in: the box goes from {low.tolist()} to "
                f"{high.tolist()}. Pass frame=(lower left, upper right)."
            )
        fixed = problem.theta_ss if at is None else check_array("at", at, (problem.n_theta,))
        law = problem.law()
        points = 121 if isinstance(law, PiecewiseAffine) else 41  # a program for each of them
        self.grid = [np.linspace(a, b, points) for a, b in zip(low, high, strict=True)]
        shown = np.tile(fixed, (points**2, 1))
        shown[:, chosen] = np.stack(np.meshgrid(*self.grid), axis=-1).reshape(-1, 2)
        self.theta = problem.units.to_deviations(shown)
        self.inside = law.in_domain(self.theta).astype(float).reshape(points, points)
        self.labels = [problem.labels(units=True)[i] for i in chosen]
        self.problem, self.output = problem, output
        self.name = with_units(problem.model)[1][output]

    def values(self, policy: Any) -> Array:
        """Return the input of a policy on the grid."""
        u = self.problem.units.input_to_plant(inputs_of(self.problem, policy, self.theta))
        return np.reshape(u[:, self.output], self.inside.shape)

    def draw(self, axes: Axes, u: Array, scale: tuple[float, float]) -> Any:
        """Draw values in colors of a scale, and the border of where the MPC has a solution."""
        low, high = scale
        mesh = axes.pcolormesh(*self.grid, u, cmap="cividis", vmin=low, vmax=high, rasterized=True)
        if not self.inside.all():
            axes.contour(*self.grid, self.inside, levels=[0.5], colors="black", linewidths=1.0)
        axes.set(xlabel=self.labels[0], ylabel=self.labels[1])
        return mesh

    def draw_change(self, axes: Axes, change: Array) -> None:
        """Draw a difference in colors that are symmetric about zero; rounding is pale."""
        rounding = 1e-4 * float(self.problem.u_half[self.output])
        size = max(float(np.abs(change).max()), rounding)
        mesh = self.draw(axes, change, (-size, size))
        mesh.set_cmap("PuOr")
        axes.figure.colorbar(mesh, ax=axes, label=f"change of {self.name}")


def plot_surface(
    problem: LinearMPC,
    policy: Any,
    axes: Axes | None = None,
    *,
    entries: Sequence[Quantity] = (0, 1),
    at: ArrayLike | None = None,
    output: int = 0,
    minus: Any = None,
    frame: Frame | None = None,
) -> Axes:
    """Draw an input, in plant units, over two entries of theta.

    A line surrounds where the MPC has a solution, if that is not everywhere.

    Parameters
    ----------
    problem : LinearMPC
        With the box of theta, names and units.
    policy : callable, model or YannPolicy
        A law takes theta (batch, n_theta) in deviations.
    axes : matplotlib Axes, optional
        Where to draw; a new figure's by default.
    entries : pair of int or str, default (0, 1)
        The coordinates to the right and up: indices, or names as in ``problem.labels()``.
    at : array_like, shape (n_theta,), optional
        The other entries, in plant units; the operating point by default.
    output : int, default 0
        Which input.
    minus : callable, model or YannPolicy, optional
        What to subtract: then the difference is drawn, in colors that are symmetric about zero.
    frame : pair of array_like, shape (2,), optional
        The lower left and the upper right corner, in plant units; by default the box of theta.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> mpc = problems.clipped_pendulum()
    >>> axes = plot_surface(mpc, mpc.explicit())
    >>> float(abs(axes.collections[0].get_array()).max())
    2.0
    """
    surface = _Surface(problem, entries, at, output, frame)
    u, axes = surface.values(policy), axes_or_new(axes, 5.4, 4.2)
    if minus is not None:
        surface.draw_change(axes, u - surface.values(minus))
        return axes
    mesh = surface.draw(axes, u, (u.min(), u.max()))
    axes.figure.colorbar(mesh, ax=axes, label=surface.name)
    return axes


def surfaces_figure(
    problem: LinearMPC,
    before: Any,
    after: Any,
    *,
    entries: Sequence[Quantity] = (0, 1),
    at: ArrayLike | None = None,
    output: int = 0,
    frame: Frame | None = None,
) -> Figure:
    """Return a figure of the control surface before, after, and of their difference.

    Parameters
    ----------
    problem : LinearMPC
        With the box of theta, names and units.
    before, after : callable, model or YannPolicy
        As of :func:`plot_surface`; the first two panels share their colors.
    entries, at, output, frame
        As there.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> mpc = problems.clipped_pendulum()
    >>> figure = surfaces_figure(mpc, mpc.explicit(), lambda theta: 0 * theta[:, :1])
    >>> [panel.get_title() for panel in figure.axes[:3]]
    ['before', 'after', 'after - before']
    """
    figure = new_figure(10.2, 3.2)
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    surface = _Surface(problem, entries, at, output, frame)
    first, second = surface.values(before), surface.values(after)
    scale = min(first.min(), second.min()), max(first.max(), second.max())
    surface.draw(panels[0], first, scale)
    mesh = surface.draw(panels[1], second, scale)
    figure.colorbar(mesh, ax=[*panels[:2]], label=surface.name)
    surface.draw_change(panels[2], second - first)
    for panel, title in zip(panels, ("before", "after", "after - before"), strict=True):
        panel.set_title(title)
        panel.label_outer()
    return figure


# ---- Which regions are used ----


@dataclass(frozen=True)
class RegionUse:
    """The regions that episodes visit, those visited most first.

    Attributes
    ----------
    regions : ndarray of int, shape (k,)
    share : ndarray, shape (k,)
        Of all steps.
    mean, largest : ndarray, shape (k,)
        Distance of the policy's input from the MPC's, in half-widths of the input range, of the
        input that is farthest.

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
    def of(cls, problem: LinearMPC, policy: Any, episodes: Trajectories) -> RegionUse:
        """Return it of a law, model or policy; the observations of the episodes are theta."""
        law = problem.explicit()
        theta = np.concatenate([each[:-1] for each in episodes.observations])
        theta = problem.units.to_deviations(theta[np.isfinite(theta).all(axis=1)])
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
    axes, share = axes_or_new(axes, 6.4, 2.6), 100 * use.share[:MAX_REGIONS]
    axes.bar(range(len(share)), share, color=COLORS[5])
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
    axes, largest = axes_or_new(axes, 6.4, 2.6), 100 * use.largest[:MAX_REGIONS]
    places = range(len(largest))
    axes.bar(places, 100 * use.mean[:MAX_REGIONS], color=COLORS[0], label="mean")
    axes.plot(places, largest, "v", color=COLORS[1], markersize=5, label="largest")
    axes.set(ylabel="distance from the MPC\n(% of half the range)")
    axes.set_ylim(0, max(axes.get_ylim()[1], 0.01))  # rounding is not drawn large
    axes.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0)
    return _with_regions(use, axes)


def use_figure(problem: LinearMPC, policy: Any, episodes: Trajectories) -> Figure:
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
    names = [str(each) for each in use.regions[:MAX_REGIONS]]
    axes.set_xticks(range(len(names)), names, rotation=90 if len(names) > 15 else 0)
    left_out = len(use.regions) - len(names)
    more = f" ({left_out} more, visited less, are left out)" if left_out else ""
    axes.set_xlabel(f"region{more}")
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)
    return axes
