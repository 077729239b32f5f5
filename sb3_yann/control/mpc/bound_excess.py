"""By how much trajectories exceed the bounds of their problem: the only place that says so."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann._validation import Array, Mask, finite_sizes
from sb3_yann.control.mpc.linear_mpc import LinearMPC
from sb3_yann.units import FLOAT32_ROUNDING


@dataclass(frozen=True)
class Bounds:
    """Bounds ``low <= C x <= high`` of states and outputs, one of which is finite at least.

    ``half`` (k,) are half-widths of theta's box, or of the outputs in it; where a state's box has
    an open side, the size of its bound. ``softness`` (k,) is the violation that counts as one unit,
    0 where a bound is hard. ``used`` (n + q,) tells which states and outputs these are,
    ``of_states`` (k,) which are states. ``moving`` bounds are those of `MPCProblem.limit_rows`.
    """

    C: Array
    low: Array
    high: Array
    half: Array
    softness: Array
    of_states: NDArray[np.bool_]
    used: NDArray[np.bool_]
    moving: tuple[Array, ...]

    @classmethod
    def of(cls, problem: LinearMPC, low: ArrayLike = -np.inf, high: ArrayLike = np.inf) -> Bounds:
        """Return those of a problem, and of its states (n,) besides, in deviations."""
        problem = problem.deviations
        outputs = problem.outputs
        n = problem.model.n_states
        size = (problem.theta_max - problem.theta_min)[:n] / 2
        # Without a box the size of a bound is the unit: one that is fixed would be hidden.
        box = problem.theta_min[:n], problem.theta_max[:n]
        ends = finite_sizes(problem.x_min, problem.x_max, *box)
        size = np.where(np.isfinite(size) & (size > 0), size, np.where(ends > 0, ends, 1.0))
        C = np.vstack([np.eye(len(size)), outputs.C])
        lowest = np.concatenate([np.maximum(problem.x_min, low), outputs.y_min])
        highest = np.concatenate([np.minimum(problem.x_max, high), outputs.y_max])
        half = np.concatenate([size, np.abs(outputs.C) @ size])
        softness = np.concatenate([problem.soft.x, problem.soft.y])
        used = np.isfinite(lowest) | np.isfinite(highest)
        moving = zip(problem.limit_rows("x"), problem.limit_rows("y"), strict=True)
        return cls(
            C=C[used],
            low=lowest[used],
            high=highest[used],
            half=half[used],
            softness=softness[used],
            of_states=(np.arange(len(used)) < n)[used],
            used=used,
            moving=tuple(np.concatenate(both)[used] for both in moving),
        )

    def beyond(self, thetas: Array, room: float = 0.0) -> Array:
        """Return by how much bounds that are moved out by some room are exceeded (..., k).

        Room and result are in half-widths; below a lower bound it is negative.
        """
        y = thetas[..., : self.C.shape[1]] @ self.C.T
        low = self.low
        high = self.high
        own_low, own_high, L, H = self.moving
        if np.any(L) or np.any(H):
            low = np.maximum(low, own_low + thetas @ L.T)
            high = np.minimum(high, own_high + thetas @ H.T)
        return _beyond(y, low, high, self.half, room)


def mixed_half(problem: LinearMPC) -> Array:
    """Return what the rows (k,) of MixedBounds come to in half-widths of states and inputs."""
    mixed = problem.mixed
    size = problem.theta_half[problem.layout.state]
    return np.asarray(np.abs(mixed.F) @ size + np.abs(mixed.G) @ problem.u_half)


def mixed_beyond(problem: LinearMPC, thetas: Array, inputs: Array, room: float = 0.0) -> Array:
    """Return by how much MixedBounds that are moved out by some room are exceeded (..., k).

    As `Bounds.beyond`, at thetas (..., n_theta) and inputs (..., m) of the same samples.
    """
    mixed = problem.mixed
    half = mixed_half(problem)
    low, high = problem.limits_at("mixed", thetas)
    made = thetas[..., problem.layout.state] @ mixed.F.T + inputs @ mixed.G.T
    return _beyond(made, low, high, half, room)


def _beyond(values: Array, low: Array, high: Array, half: Array, room: float) -> Array:
    above = np.maximum((values - high) / half - room, 0)
    return np.asarray(above - np.maximum((low - values) / half - room, 0))


class BoundNames(NamedTuple):
    """What the bounds of a problem are called: of `Bounds`, of inputs, of rates, and mixed ones."""

    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    half: tuple[float, ...] = ()
    soft: tuple[bool, ...] = ()

    @classmethod
    def of(cls, problem: LinearMPC) -> BoundNames:
        """Return those of a problem."""
        bounds = Bounds.of(problem)
        of = problem.bounded
        units = dict(zip((*of["x"].names, *of["u"].names), problem.model.units, strict=False))
        names = np.array([*of["x"].names, *of["y"].names], object)[bounds.used].tolist()
        inputs = of["u"].names
        changing = inputs if problem.layout.n_previous else []
        measured = [*names, *inputs, *changing, *of["mixed"].names]
        changes = [f"the change of {each} in a step" for each in changing]
        rates = problem.u_half[: len(changing)]
        half = np.concatenate([bounds.half, problem.u_half, rates, mixed_half(problem)])
        hard = np.zeros(len(inputs) + len(changing))
        soft = np.concatenate([bounds.softness, hard, problem.mixed.soft]) > 0
        return cls(
            (*names, *inputs, *changes, *of["mixed"].names),
            tuple(units.get(each, "") for each in measured),
            tuple(half.tolist()),
            tuple(soft.tolist()),
        )

    def in_words(self, worst: float, largest: float) -> str:
        """Return which bound is exceeded most, and by how much in its unit; empty for none."""
        if not (0 <= worst < len(self.names) and largest > 0):
            return ""
        k = int(worst)
        by = f"{largest * self.half[k]:.3g} {self.units[k]}".strip()
        return f"{self.names[k]} exceeds its {'soft ' if self.soft[k] else ''}bound by {by}"


class BoundExcess(NamedTuple):
    """By how much trajectories exceed the bounds of their problem, one number for each.

    ``largest`` and ``summed`` are of the hard bounds, in half-widths: at the worst step, and over
    steps and bounds. ``any_bound`` is the largest of hard and soft ones. ``penalty`` is what soft
    bounds cost over the steps: ``penalty (s + s^2)`` of the largest violation s of the states'
    bounds at a step, and of the outputs'. ``worst`` is the number of the bound that ``largest`` is
    of, as in `BoundNames`; without any, of the soft one that ``any_bound`` is of, else -1.
    """

    largest: Array
    summed: Array
    any_bound: Array
    penalty: Array
    worst: Array = np.array(-1.0)


def bound_excess(
    problem: LinearMPC,
    thetas: Array,
    inputs: Array,
    taken: ArrayLike = True,
    bounds: Bounds | None = None,
) -> BoundExcess:
    """Return by how much trajectories exceed the bounds of their problem, those of rates too.

    What is not finite exceeds by inf. The state that a trajectory begins in is nobody's doing.
    Thetas (T + 1, ..., n_theta) and inputs (T, ..., m) are deviations; ``taken`` (T, ...) are the
    steps that count. A wrapper that asks at every step has the ``bounds`` of the problem at hand.

    Examples
    --------
    >>> from sb3_yann import LinearModel, LinearMPC
    >>> cart = LinearModel([[1, 1], [0, 1]], [[0], [1]], dt=1.0)
    >>> mpc = LinearMPC(cart, Q=[[1, 0], [0, 1]], R=[[1]], horizon=2, x_min=-5, x_max=5, u_max=1)
    >>> float(bound_excess(mpc, np.array([[4.0, 2], [6.0, 2]]), np.zeros((1, 1))).largest)
    0.2
    """
    problem = problem.deviations
    bounds = Bounds.of(problem) if bounds is None else bounds
    with np.errstate(invalid="ignore", over="ignore"):
        parts = [np.abs(bounds.beyond(thetas[1:]))]
        groups = [("u", inputs, problem.u_half)]
        if problem.layout.n_previous:
            moved = inputs - thetas[:-1][..., problem.layout.previous]
            groups.append(("du", moved, problem.u_half))
        for kind, values, half in groups:
            low, high = problem.limits_at(kind, thetas[:-1])
            parts.append(np.maximum(values - high, low - values) / half)
        parts.append(np.abs(mixed_beyond(problem, thetas[:-1], inputs)))
        over = np.concatenate(parts, axis=-1)
    counts = ~(over <= FLOAT32_ROUNDING) & np.asarray(taken)[..., None]
    nothing = np.zeros(thetas.shape[1:-1])
    if not counts.any():  # mostly
        return BoundExcess(nothing, nothing, nothing, nothing, nothing - 1)
    over = np.where(counts, np.where(np.isnan(over), np.inf, over), 0.0)
    mixed = problem.mixed.soft
    of_inputs = over.shape[-1] - len(bounds.half) - len(mixed)
    softness = np.concatenate([bounds.softness, np.zeros(of_inputs), mixed])
    half = np.concatenate([bounds.half, np.ones(of_inputs), mixed_half(problem)])
    slacks = np.concatenate([~bounds.of_states, np.full(of_inputs, -1), np.full(len(mixed), 2)])
    hard = softness <= 0
    penalty = nothing
    for slack in range(3):  # of states, of outputs, of mixed bounds
        soft = (slacks == slack) & ~hard
        if np.any(soft):
            s = np.max(over[..., soft] * (half[soft] / softness[soft]), axis=-1)
            penalty = penalty + problem.soft.penalty * np.sum(s + s**2, axis=0)
    of_any = np.max(over, axis=0)
    of_hard = np.where(hard, of_any, 0.0)
    largest = of_hard.max(axis=-1)
    any_bound = of_any.max(axis=-1)
    worst = np.argmax(np.where(largest[..., None] > 0, of_hard, of_any), axis=-1)
    return BoundExcess(
        largest=largest,
        summed=np.sum(over[..., hard], axis=(0, -1)),
        any_bound=any_bound,
        penalty=penalty,
        worst=np.where(any_bound > 0, worst, -1.0),
    )


def costs_of(
    problem: LinearMPC, thetas: Array, inputs: Array, taken: Mask | bool = True
) -> tuple[Array, BoundExcess]:
    """Return what trajectories cost (...), with the penalty of soft bounds, and their excess."""
    excess = bound_excess(problem, thetas, inputs, taken)
    stage = problem.deviations.stage_cost(thetas[:-1], inputs)
    return np.sum(stage, axis=0, where=taken) + excess.penalty, excess


def excess_of_episodes(problem: LinearMPC, episodes: Iterable[tuple[Array, Array]]) -> BoundExcess:
    """Return the same of thetas (T + 1, n_theta) and inputs (T, m) of episodes, one for each."""
    found = [bound_excess(problem, thetas, inputs) for thetas, inputs in episodes]
    return BoundExcess(*np.array(found, dtype=np.float64).reshape(-1, 5).T)
