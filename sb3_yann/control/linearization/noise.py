"""The noise of a deterministic function: what an adaptive integrator leaves in its results."""

from __future__ import annotations

from collections.abc import Callable
from math import factorial

import numpy as np

from sb3_yann._validation import Array

SPACINGS = (1e-3, 1e-4, 1e-5)
"""Distances of the points at which noise is measured, relative to the scale."""
POINTS, ORDER = 10, 6
"""Points on a line, and the order of the differences that leave nothing of a smooth function."""
UNLIKE = 4.0  # ratio of what two spacings show from which it is a kink rather than noise
MOST = 1e-3  # largest noise, relative to the scale, that differences can cope with


def noise_of(f: Callable[[Array], Array], point: Array, scale: Array) -> Array:
    """Return the standard deviation of each value's noise, zeros where there is a kink instead.

    High differences of a smooth function vanish. What they show is noise where it does not shrink
    with the spacing: Hamming's table, as in Moré & Wild (2011), *SIAM J. Sci. Comput.* 33.

    Parameters
    ----------
    f : callable
        Takes an array of shape (c,), returns one of shape (r,).
    point, scale : ndarray, shape (c,)
        Where noise is measured, and the range of each coordinate.

    Examples
    --------
    >>> rounded = noise_of(lambda z: np.round(np.sin(z), 6), np.ones(1), np.ones(1))
    >>> bool(1e-7 < rounded[0] < 1e-6)
    True
    """
    direction = scale * np.random.default_rng(0).choice([-1.0, 1.0], point.size)
    offsets = np.arange(POINTS) - (POINTS - 1) / 2
    shrink = factorial(ORDER) ** 2 / factorial(2 * ORDER)
    levels = []
    for spacing in SPACINGS:
        values = np.array([f(point + spacing * k * direction) for k in offsets])
        table = np.diff(values, ORDER, axis=0)
        levels.append(np.sqrt(shrink * np.mean(table**2, axis=0)))
    found = np.array(levels)
    if not np.all(np.isfinite(found)):
        return np.zeros(found.shape[1])
    largest = np.max(found, axis=0)
    # A kink fades with the spacing. At the shortest, noise may be smooth, as of step sizes chosen.
    steady = largest <= UNLIKE * np.maximum(np.median(found, axis=0), np.finfo(float).tiny)
    return np.where(steady, largest, 0.0)
