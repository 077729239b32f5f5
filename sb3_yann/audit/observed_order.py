"""Whether an env shows the states in the order, from the rest and in the units of the model."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations, permutations

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.model.labels import labels_of

WRONG, RIGHT = 0.5, 0.05
"""Share of the states' movement in a step that the model leaves open: more in the order shown, and
less in another one, or in other units. No noise and no wrong model does that."""
FEWEST = 10
"""Steps for each state that must be seen."""
MOST = 5
"""States of which all orders are tried; of more, two are exchanged."""
UNITS = (
    *((factor, 0.0) for factor in (1000.0, 100.0, 60.0, 10.0, 0.1, 1 / 60, 0.01, 0.001)),
    *((1.0, shift) for shift in (-273.15, 273.15)),
    *((1.8, 32.0), (1 / 1.8, -32 / 1.8)),
)
"""Units that are mistaken for each other: factors, and what is added."""
Reading = Callable[[Array], Array]
"""From what is shown (steps, n), in plant units, to what it may mean."""


def warn_of_order(
    problem: LinearMPC, theta: Array, u: Array, following: Array, stacklevel: int
) -> None:
    """Warn where the model predicts the steps of an env in another reading of its states alone."""
    if words := misread_in_words(problem, theta, u, following):
        warnings.warn(words, stacklevel=stacklevel)


def misread_in_words(problem: LinearMPC, theta: Array, u: Array, following: Array) -> str:
    """Return in which other reading alone the model predicts the steps of an env; empty for none.

    That is another order of the states, deviations from the operating point, or other units.

    Parameters
    ----------
    problem : LinearMPC
        Whose theta the env is to show.
    theta, u, following : ndarray, shapes (steps, n_theta), (steps, m) and (steps, n_theta)
        Steps of the env, in deviations.
    """
    known = np.isfinite(theta).all(axis=1) & np.isfinite(following).all(axis=1)
    steps = theta[known], u[known], following[known]
    if np.count_nonzero(known) < FEWEST * problem.model.n_states:
        return ""
    shown = _left_open(problem, lambda x: x, *steps)
    if not shown > WRONG:
        return ""
    for reading, what, cure in _readings(problem):
        if (left := _left_open(problem, reading, *steps)) < RIGHT:
            return (
                f"The env seems to show {what}: so the model predicts {100 * (1 - left):.0f} % of "
                f"a step, and {100 * max(1 - shown, 0):.0f} % as it is. {cure}"
            )
    return ""


def _readings(problem: LinearMPC) -> Iterator[tuple[Reading, str, str]]:
    """Yield what the states that are shown may mean, in words, and what to do."""
    names, n = labels_of(problem.model)[0], problem.model.n_states
    for order in _orders(n):
        back = np.argsort(order).tolist()
        yield (
            partial(_taken, back),
            f"the states in the order {[names[i] for i in order]}, which is not the MPC's, {names}",
            f"Show x[{back}] of what the plant shows, with gymnasium.wrappers."
            "TransformObservation.",
        )
    if np.any(problem.model.x_ss):
        yield (
            lambda x: x + problem.model.x_ss,
            "deviations from the operating point, and the MPC is in plant units",
            "Show what the plant shows, or leave x_ss and u_ss out of the model.",
        )
    every = [(name, np.arange(n) == i) for i, name in enumerate(names)]
    if n > 1:
        every.append(("all states", np.ones(n, dtype=bool)))
    for name, which in every:
        for factor, shift in UNITS:
            factors, shifts = np.where(which, factor, 1.0), np.where(which, shift, 0.0)
            what = f"{name} times {factor:.3g}" if factor != 1 else name
            acts = f" It may also be that inputs act {factor:.3g} times as far as in the model."
            yield (
                partial(_rescaled, factors, shifts),
                f"{what} plus {shift:.5g}" if shift else what,
                "Show it in the model's units, or pass policy_kwargs={'observation': ...}."
                + acts * (shift == 0),
            )


def _taken(order: list[int], x: Array) -> Array:
    return x[:, order]


def _rescaled(factors: Array, shifts: Array, x: Array) -> Array:
    return np.asarray((x - shifts) / factors)


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
    problem: LinearMPC, reading: Reading, theta: Array, u: Array, following: Array
) -> float:
    """Return the share of the states' movement that the model leaves open, 1 where none moves."""
    at, after, states, x_ss = (
        theta.copy(),
        following.copy(),
        problem.layout.state,
        problem.model.x_ss,
    )
    at[:, states] = reading(theta[:, states] + x_ss) - x_ss
    after[:, states] = reading(following[:, states] + x_ss) - x_ss
    error = (after - problem.deviations.predict(at, u))[:, states]
    moved = np.sum((after - at)[:, states] ** 2, axis=0)
    moving = moved > 0
    if not moving.any():
        return 1.0
    return float(np.max(np.sum(error**2, axis=0)[moving] / moved[moving]))
