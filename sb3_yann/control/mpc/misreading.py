"""In which other order or units a model predicts steps that it does not predict as they are."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, permutations

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control.linear_system import labels_of
from sb3_yann.control.mpc.linear_mpc import LinearMPC
from sb3_yann.log import UNITS

STEPS_PER_STATE = 10  # steps for each state that must be seen
Reading = tuple[Array, Array]
"""A matrix M (n, n) and an offset v (n,): what is shown as x, in plant units, may mean M x + v."""


def misread_states(problem: LinearMPC, theta: Array, u: Array, following: Array) -> str:
    """Return in which other reading alone the model predicts the steps of an env; empty for none.

    That is another order of the states, deviations from the operating point, or other units. Steps
    are theta (steps, n_theta), inputs (steps, m) and what follows, in deviations.
    """
    known = np.isfinite(theta).all(axis=1) & np.isfinite(following).all(axis=1)
    steps = theta[known], u[known], following[known]
    if np.count_nonzero(known) < STEPS_PER_STATE * problem.model.n_states:
        return ""
    n = problem.model.n_states
    shown = _left_open(problem, (np.eye(n), np.zeros(n)), *steps)
    # The model must leave half of the states' movement in a step open, as they are shown, and
    # hardly any in the order or the units that are meant: no noise and no wrong model does that.
    if not shown > 0.5:
        return ""
    is_clear = False
    best = np.inf, "", ""  # a factor of units may explain more than the order that is told
    for reading, what, cure in _readings(problem):
        left = _left_open(problem, reading, *steps)
        # States in the wrong order drive the plant where no model holds: there it is by far better.
        reorders = not np.array_equal(reading[0], np.eye(n)) and np.isin(reading[0], (0, 1)).all()
        is_clear |= bool(left < 0.05 * (max(1.0, shown) if reorders else 1.0))
        best = min(best, (left, what, cure), key=lambda each: each[0])
    left, what, cure = best
    return is_clear * (
        f"The env seems to show {what}: so the model errs by {100 * left**0.5:.0f} % of "
        f"a step, and by {100 * shown**0.5:.0f} % as it is. {cure}"
    )


def _readings(problem: LinearMPC) -> Iterator[tuple[Reading, str, str]]:
    """Yield what the states that are shown may mean, in words, and what to do."""
    most_reordered = 5  # states of which all orders are tried; of more, two are exchanged
    names = labels_of(problem.model)[0]
    x_ss = problem.model.x_ss
    n = len(names)
    same = np.eye(n)
    # All orders of a few states; of more, two are exchanged.
    orders = [[*each] for each in permutations(range(n))][1:] if n <= most_reordered else []
    if n > most_reordered:
        orders = [[{i: j, j: i}.get(k, k) for k in range(n)] for i, j in combinations(range(n), 2)]
    for order in orders:
        back = np.argsort(order).tolist()
        yield (
            (same[back], np.zeros(n)),
            f"the states in the order {[names[i] for i in order]}, which is not the MPC's, {names}",
            f"Show x[{back}] of what the plant shows, with gymnasium.wrappers."
            "TransformObservation.",
        )
    if np.any(x_ss):
        yield (
            (same, x_ss),
            "deviations from the operating point, and the MPC is in plant units",
            "Show what the plant shows, or leave x_ss and u_ss out of the model.",
        )
    every = [*zip(names, same, strict=True)]
    if n > 1:
        every.append(("all states", np.ones(n)))
    for name, which in every:
        for factor, shift in UNITS:
            what = f"{name} times {factor:.3g}" if factor != 1 else name
            acts = f" It may also be that inputs act {factor:.3g} times as far as in the model."
            scale = np.where(which, 1 / factor, 1.0)
            yield (
                (np.diag(scale), -scale * which * shift),
                f"{what} plus {shift:.5g}" if shift else what,
                "Show it in the model's units, or pass policy_kwargs={'observation': ...}."
                + acts * (shift == 0),
            )


def _left_open(
    problem: LinearMPC, reading: Reading, theta: Array, u: Array, following: Array
) -> float:
    """Return the share of the states' movement that the model leaves open, 1 where none moves."""
    M, v = reading
    states = problem.layout.state
    x_ss = problem.model.x_ss
    at = theta.copy()
    after = following.copy()
    for rows in (at, after):
        rows[:, states] = (rows[:, states] + x_ss) @ M.T + v - x_ss
    error = (after - problem.deviations.predict(at, u))[:, states]
    moved = np.sum((after - at)[:, states] ** 2, axis=0)
    moving = moved > 0
    if not moving.any():
        return 1.0
    return float(np.max(np.sum(error**2, axis=0)[moving] / moved[moving]))
