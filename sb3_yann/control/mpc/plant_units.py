"""Whether an env takes inputs and shows states as deviations, as absolute values, or otherwise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann._validation import Array, ReadOnlyArrays, half_widths
from sb3_yann.control.mpc.problem import MPCProblem

NEAR = 0.5
"""An absolute state is at most so far from the operating point, relative to its size."""
MOST = 0.9  # share of the rows that must speak for it


@dataclass(frozen=True, eq=False)
class InputUnits(ReadOnlyArrays):
    """How an env takes the inputs of a problem: ``action = scale * u + shift``.

    Attributes
    ----------
    kind : {"deviation", "absolute", "normalized"}
    scale, shift : ndarray, shape (m,)
    """

    kind: str
    scale: Array
    shift: Array

    @classmethod
    def of(cls, problem: MPCProblem, low: NDArray[Any], high: NDArray[Any]) -> InputUnits | None:
        """Return what bounds of the env's actions say; None where they fit nothing.

        They may be rounded to their own type. Where ``u_ss`` is zero, absolute inputs are
        deviations.

        Parameters
        ----------
        problem : LinearMPC
            With the bounds of the inputs, in deviations.
        low, high : ndarray, shape (m,)
            The env's.
        """
        return cls.between(problem.u_min, problem.u_max, problem.model.u_ss, low, high)

    @classmethod
    def between(
        cls, u_min: Array, u_max: Array, u_ss: Array, low: NDArray[Any], high: NDArray[Any]
    ) -> InputUnits | None:
        """Return the same as :meth:`of`.

        Parameters
        ----------
        u_min, u_max, u_ss : ndarray, shape (m,)
            Bounds in deviations, and what these count from.
        low, high : ndarray, shape (m,)
            The env's.
        """
        u_half = half_widths(u_min, u_max)
        bounds, one = np.array([u_min, u_max]), np.ones_like(u_ss)
        given = np.array([low, high], np.float64)
        if given.shape != bounds.shape:
            return None
        kinds = {"deviation": (one, 0 * one), "absolute": (one, u_ss)}
        if np.all(np.isfinite(bounds)):
            kinds["normalized"] = (1 / u_half, -(u_max + u_min) / 2 / u_half)
        finite = np.where(np.isfinite(bounds), np.abs(bounds), 0).max(0)
        size = np.where(np.isfinite(u_half), u_half, finite)
        digits = np.finfo(low.dtype).eps if np.issubdtype(low.dtype, np.floating) else 0.0
        for kind, (scale, shift) in kinds.items():
            wanted, room = scale * bounds + shift, 2e-6 * scale * size + digits * np.abs(given)
            # Not np.isclose: that of numpy 1 takes no room for each entry where some are infinite.
            either = np.isfinite(given) & np.isfinite(wanted)
            apart = np.abs(np.where(either, given, 0) - np.where(either, wanted, 0))
            if np.all(np.where(either, apart <= room, given == wanted)):
                return cls(kind, scale, shift)
        return None

    def action(self, u: ArrayLike) -> Array:
        """Return the env's action for an input in deviations, (m,) or (batch, m)."""
        return np.asarray(self.scale * np.asarray(u, np.float64) + self.shift)

    def input(self, action: ArrayLike) -> Array:
        """Return the input in deviations for an action of the env, (m,) or (batch, m)."""
        return np.asarray((np.asarray(action, np.float64) - self.shift) / self.scale)


def misread_state(problem: MPCProblem, theta: Array, sign: int = 1) -> int | None:
    """Return a state that theta holds as an absolute value, None where it does not seem so.

    Nearly all rows lie outside the box of the law, and inside with the operating point taken off.

    Parameters
    ----------
    problem : LinearMPC
        Its theta counts from the model's operating point.
    theta : ndarray, shape (steps, n_theta)
        As the law got it.
    sign : {1, -1}, default 1
        -1 asks whether the operating point was taken off what were deviations.
    """
    point, states = sign * problem.model.x_ss, problem.layout.state
    if not len(theta) or not np.any(point):
        return None
    low, high = problem.theta_min[states], problem.theta_max[states]
    reach = problem.theta_half[states]
    x = theta[:, states]
    room = 1e-6 * reach
    shown, meant = (
        np.all((low - room <= each) & (each <= high + room), axis=1) for each in (x, x - point)
    )
    if np.mean(~shown) < MOST or np.mean(meant) < MOST:
        return None
    # By how much farther from zero each state is, in half-widths, where it is clearly so.
    farther = np.mean((NEAR * np.abs(x) - np.abs(x - point)) / reach, axis=0)
    worst = int(np.argmax(farther))
    return worst if farther[worst] > 0 else None
