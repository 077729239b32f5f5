"""Curvature: what squares and products of states and inputs explain of a linear fit's residuals."""

from __future__ import annotations

import numpy as np
from scipy.special import fdtrc

from sb3_yann._validation import Array
from sb3_yann.control.identification.least_squares import Regression
from sb3_yann.control.identification.logs import Episode

ROWS = 4  # steps for each feature, at least: with fewer the features fit anything
MOST = 12  # main components, at most: a long log with many states must not take minutes
SHARE, CHANCE = 0.1, 1e-3
"""Least share of the residuals' variance, and its significance, from which curvature is named."""


def features(regressors: Array) -> Array:
    """Return squares, products and cubes (k, q) of the main components of regressors (k, p).

    There are as many components as the number of rows allows. The regressors are centered.
    """
    k, p = regressors.shape
    spread = np.sqrt(np.mean(regressors**2, axis=0))
    z = regressors / np.where(spread > 0, spread, 1.0)
    room, kept = k // ROWS - p - 1, 0
    while kept < min(p, MOST) and (kept + 1) * (kept + 4) / 2 <= room:
        kept += 1
    if not kept:
        return np.zeros((k, 0))
    left, sizes, _ = np.linalg.svd(z, full_matrices=False)
    main = left[:, :kept][:, sizes[:kept] > 1e-6 * sizes[0]] * np.sqrt(k)
    first, second = np.triu_indices(main.shape[1])
    return np.hstack([main[:, first] * main[:, second], main**3])


def bent(found: Regression, episodes: list[Episode]) -> tuple[Array, Array]:
    """Return the share (n,) of each residual's variance that curvature explains, and what is left.

    The shares are corrected for the number of features, and zero where chance explains them. What
    is left has the shape (steps, n).
    """
    now = np.concatenate([episode.regressors for episode in episodes]) - found.center
    reached = np.concatenate([episode.states[1:] for episode in episodes])
    residuals = reached - found.predict(now + found.center)
    known, added = np.column_stack([np.ones(len(now)), now]), features(now)
    before = without(known, residuals)
    after = without(np.column_stack([known, added]), residuals)
    q, free = added.shape[1], len(now) - known.shape[1] - added.shape[1]
    size, rest = np.sum(before**2, axis=0), np.sum(after**2, axis=0)
    real = size > 1e-20 * np.sum(reached**2, axis=0)
    if not q or free < 1 or not np.any(real):
        return np.zeros(len(size)), residuals
    size, rest = np.where(real, size, 1.0), np.where(real, rest, 1.0)
    share = 1 - (rest / free) / (size / (free + q))
    ratio = ((size - rest) / q) / np.maximum(rest / free, np.finfo(float).tiny)
    sure = real & (np.asarray(fdtrc(q, free, ratio)) < CHANCE)
    return np.asarray(np.where(sure & (share > SHARE), share, 0.0)), after


def without(basis: Array, values: Array) -> Array:
    """Return what a least-squares fit by the basis leaves of the values."""
    scale = np.linalg.norm(basis, axis=0)
    left, sizes, _ = np.linalg.svd(basis / np.where(scale > 0, scale, 1.0), full_matrices=False)
    left = left[:, sizes > 1e-10 * sizes[0]]
    return np.asarray(values - left @ (left.T @ values))
