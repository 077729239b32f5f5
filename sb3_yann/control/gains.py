"""What a held input does to the states in the end: gains, or slopes where a pole is 1."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from sb3_yann._validation import Array, ReadOnlyArrays

NORMAL = 1.96  # standard deviations on either side that hold 95 %
WIDE = 0.5  # half-width from which an interval says only that the pole is not known
ON_CIRCLE = 1e-6  # distance of a pole's magnitude from 1 below which it neither grows nor decays
SURE_ERRORS = 5.0
"""Standard errors from 1 beyond which a pole does not integrate: those of an integrator are not
normal (Dickey & Fuller, 1979, J. Am. Stat. Assoc. 74), nor are gains of a pole nearby."""
CURVED = "Curvature: "  # begins notes on it
UNTOLD = "Standard errors and intervals do not tell that."  # ends notes on what they leave out


@dataclass(frozen=True, eq=False)
class Gains(ReadOnlyArrays):
    """What states do in the end while one input is held at one unit more than at rest.

    Attributes
    ----------
    values, errors : ndarray, shapes (n, m)
        Of the model as it is, with their standard errors, zeros where nothing is known.
    degrees : ndarray of int, shape (n, m)
        0: the value is a steady-state gain. 1: the state integrates, by so much in a sample.
        2: what it moves in a sample grows by so much in each.
    integrators : int
        Poles that are 1, or cannot surely be told from it: those nearest to 1.
    beside, beside_errors : ndarray, shapes (n, m)
        Gains of what other poles do, which are all where an integrator is a load that no input
        moves. Of a state that integrates, gains of a pole that is not 1.
    """

    values: Array
    errors: Array
    degrees: NDArray[np.int64]
    integrators: int
    beside: Array
    beside_errors: Array

    @classmethod
    def of(cls, A: Array, B: Array, integrators: int = -1, errors: Iterable[Array] = ()) -> Gains:
        """Return the gains beside so many integrators, -1: counted; errors are of `responses`."""
        integrators = count_integrators(A) if integrators < 0 else integrators
        found = responses(A, B, integrators)
        found[2] *= integrators > 1
        widths = np.array([*errors] or np.zeros(found.shape))
        P = np.abs(projector(A, integrators))
        # Rounding of a slope is 1e-7 of its parts.
        parts = np.abs(found[1:3]) - 1e-7 * np.array([P @ np.abs(B), np.abs(A) @ P @ np.abs(B)])
        # 3.0: standard errors from which a state is said to go on and on
        moves_on, speeds_up = parts > 3.0 * widths[1:3]
        # 100: samples in which the motion of one must grow by as much as it is, else it is a rate
        speeds_up &= 100 * parts[1] > parts[0]
        # What one input moves on and on, another may move on too: its interval tells.
        moves_on |= np.any(moves_on | speeds_up, axis=1, keepdims=True) & (widths[1] > 0)
        degrees = np.where(speeds_up, 2, moves_on.astype(int))
        pick = np.expand_dims(degrees, 0)
        values, own = (np.take_along_axis(each, pick, 0)[0] for each in (found, widths))
        # Of an input that moves one state on and on, the others' gains are beside that pole.
        away = np.sort(np.abs(np.linalg.eigvals(A) - 1))[:integrators]
        # 0.05: distance of a pole from 1 within which a state goes on and on: for 20 samples
        rests = (degrees == 0) & np.any(degrees, axis=0) & np.all(away < 0.05)
        values = np.where(rests, found[3], values)
        own = np.where(rests, widths[3], own)
        beside = (np.where(degrees, each[0], each[3]) for each in (found, widths))
        return cls(values, own, degrees, integrators, *beside)


def projector(A: Array, integrators: int) -> Array:
    """Return the spectral projector (n, n) of so many poles, those nearest to 1.

    Poles that repeat are taken together: with so many of them, or more.
    """
    n = len(A)
    if not integrators:
        return np.zeros((n, n))
    away = np.sort(np.abs(np.linalg.eigvals(A) - 1))
    # 1e-5: how far apart rounding shows poles that repeat
    while integrators < n and away[integrators] - away[integrators - 1] < 1e-5:
        integrators += 1
    if integrators == n:
        return np.eye(n)
    end = (away[integrators - 1] + away[integrators]) / 2

    def near(pole: complex) -> bool:
        return bool(abs(pole - 1) < end)

    T, Q, count = linalg.schur(A, "complex", sort=near)
    beside = linalg.solve_sylvester(T[:count, :count], -T[count:, count:], T[:count, count:])
    left = Q[:, :count].conj().T + beside @ Q[:, count:].conj().T
    return np.real(Q[:, :count] @ left)


def settled(A: Array, P: Array) -> Array:
    """Return the inverse of ``I - A`` beside a spectral projector, on which it is zero."""
    one = np.eye(len(A))
    return np.asarray(np.linalg.solve(one - A + P, one - P))


def responses(A: Array, B: Array, integrators: int) -> Array:
    """Return steady-state gains, slopes of integrators, their growth, and the gains without them.

    Shape (4, n, m). A pole that is 1 has no part in the first.
    """
    P = projector(A, integrators)
    ones = int(np.sum(np.abs(np.linalg.eigvals(A) - 1) < ON_CIRCLE))
    own = settled(A, projector(A, ones))
    return np.array([own @ B, P @ B, (A @ P - P) @ B, settled(A, P) @ B])


def count_integrators(A: Array, deviation: Callable[[Array], float] = lambda R: 0.0) -> int:
    """Return how many poles are 1, or cannot surely be told from it.

    ``deviation(R)`` is the standard deviation of ``trace(R dA)``. With the inverse R of ``I - A``
    that is the relative one of ``det(I - A)``: poles that repeat do not spoil it. Of a pole's share
    in R it is its own: poles that are farther away do not count with it.
    """
    values = np.linalg.eigvals(A)
    values = values[np.argsort(np.abs(values - 1), kind="stable")]
    near = int(np.sum(np.abs(values - 1) < WIDE))
    known = projector(A, near)
    count = 0
    while count < near:
        reached = projector(A, count + (2 if values[count].imag else 1))
        if abs(values[count] - 1) > ON_CIRCLE:
            before = projector(A, count)
            R = settled(A, before)
            own = reached - before
            if not min(deviation(R @ known), deviation(R @ own)) * SURE_ERRORS > 1:
                break
        count = round(np.trace(reached))
    return count
