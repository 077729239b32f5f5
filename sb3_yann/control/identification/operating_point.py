"""The steady state of an identified plant, as far as the data determine it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control.identification.least_squares import Regression

FAR = 5.0  # spreads from the mean of the data beyond which a model is extrapolated
SURE = 5.0
"""Standard errors above which a direction does not integrate: those of an integrator are not normal
(Dickey & Fuller, 1979, J. Am. Stat. Assoc. 74)."""


def operating_point(
    found: Regression,
    sizes: tuple[int, int, int],
    given: Sequence[Array | None],
    delays: Sequence[int] = (),
) -> Array:
    """Return the steady state, inputs and disturbances (n+m+d,) of the fitted plant.

    Parameters
    ----------
    found, sizes : Regression, and (n, m, d)
        The fit.
    given : sequence of ndarray, shapes (n,), (m,) and (d,)
        What is known of the point, None where nothing is.
    delays : sequence of int, length m
        So many of the last states are each input on its way: at rest these are the inputs, however
        far from the data.
    """
    n, m, _ = sizes
    means = zip(given, np.split(found.center, [n, n + m]), strict=True)
    start = np.concatenate([mean if value is None else value for value, mean in means])
    # The state gives way, or the inputs where the state is given; nothing where both are.
    if given[0] is not None and given[1] is not None:
        return start
    scale = np.where(found.spread > 0, found.spread, 1.0)
    moves = (found.coefficients - np.eye(n, scale.size)) * scale / scale[:n, None]
    doubt = found.standard_errors * scale / scale[:n, None]
    drift = (found.predict(start[None])[0] - start[:n]) / scale[:n]
    states, inputs = slice(0, n), slice(n, n + m)
    if given[0] is not None:
        start[inputs] += scale[inputs] * _way(moves[:, inputs], drift, doubt[:, inputs])
        return start
    if given[1] is None:  # only the inputs can hold an integrator
        left, _, _, known = _directions(moves[:, states], doubt[:, states])
        free = left[:, ~known].T
        errors = np.sqrt(free**2 @ doubt[:, inputs] ** 2)
        way = _way(free @ moves[:, inputs], free @ drift, errors)
        start[inputs] += scale[inputs] * way
        drift = drift + moves[:, inputs] @ way
    if any(delays):
        states = slice(0, n - sum(delays))
        start[states.stop : n] = np.repeat(start[inputs], delays)
        drift = ((found.predict(start[None])[0] - start[:n]) / scale[:n])[states]
        moves, doubt = moves[states], doubt[states]
    start[states] += scale[states] * _way(moves[:, states], drift, doubt[:, states])
    return start


def _directions(moves: Array, doubt: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return the singular value decomposition, and which directions differ from an integrator."""
    left, sizes, right = np.linalg.svd(moves, full_matrices=False)
    errors = np.sqrt(np.sum((left.T**2 @ doubt**2) * right**2, axis=1))
    return left, sizes, right, (sizes > SURE * errors) & (sizes > 1e-9)


def _way(moves: Array, drift: Array, doubt: Array) -> Array:
    """Return the step to the steady state along the directions that the data determine."""
    left, sizes, right, known = _directions(moves, doubt)
    steps = -(left.T @ drift) / np.where(known, sizes, 1.0)
    return np.asarray(right.T @ np.where(known & (np.abs(steps) <= FAR), steps, 0.0))
