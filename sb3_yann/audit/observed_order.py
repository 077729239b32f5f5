"""Whether an env shows the states in the order that the model has."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from itertools import combinations, permutations

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.model.labels import labels_of

WRONG, RIGHT = 0.5, 0.05
"""Share of the states' movement in a step that the model leaves open: more in the order shown, and
less in another one. No noise and no wrong model does that."""
FEWEST = 10
"""Steps for each state that must be seen."""
MOST = 5
"""States of which all orders are tried; of more, two are exchanged."""


def warn_of_order(
    problem: LinearMPC, theta: Array, u: Array, following: Array, stacklevel: int
) -> None:
    """Warn where the model predicts the steps of an env in another order of its states alone.

    Parameters
    ----------
    problem : LinearMPC
        Whose theta the env is to show.
    theta, u, following : ndarray, shapes (steps, n_theta), (steps, m) and (steps, n_theta)
        Steps of the env.
    stacklevel : int
        Of the warning.
    """
    known = np.isfinite(theta).all(axis=1) & np.isfinite(following).all(axis=1)
    steps = theta[known], u[known], following[known]
    n = problem.model.n_states
    if np.count_nonzero(known) < FEWEST * n:
        return
    shown = _left_open(problem, list(range(n)), *steps)
    if not shown > WRONG:
        return
    for order in _orders(n):
        if (left := _left_open(problem, order, *steps)) < RIGHT:
            names = [labels_of(problem.model)[0][i] for i in order]
            back = np.argsort(order).tolist()
            warnings.warn(
                f"The env seems to show the states in the order {names}: so the model predicts "
                f"{100 * (1 - left):.0f} % of a step, and {100 * max(1 - shown, 0):.0f} % in the "
                f"order of the MPC, {labels_of(problem.model)[0]}. Show x[{back}] of what the "
                "plant shows, with gymnasium.wrappers.TransformObservation.",
                stacklevel=stacklevel,
            )
            return


def _orders(n: int) -> Iterator[list[int]]:
    """Yield other orders: what each entry that is shown may be."""
    if n <= MOST:
        yield from (list(each) for each in [*permutations(range(n))][1:])
        return
    for i, j in combinations(range(n), 2):
        order = list(range(n))
        order[i], order[j] = j, i
        yield order


def _left_open(
    problem: LinearMPC, order: list[int], theta: Array, u: Array, following: Array
) -> float:
    """Return the share of the states' movement that the model leaves open, 1 where none moves."""
    at, after, states = theta.copy(), following.copy(), problem.layout.state
    at[:, order], after[:, order] = theta[:, states], following[:, states]
    error = (after - problem.deviations.predict(at, u))[:, states]
    moved = np.sum((after - at)[:, states] ** 2, axis=0)
    moving = moved > 0
    if not moving.any():
        return 1.0
    return float(np.max(np.sum(error**2, axis=0)[moving] / moved[moving]))
