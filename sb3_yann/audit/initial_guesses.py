"""Where searches for plans begin: what they lead to depends on it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.audit.plants import Plant, Rows
from sb3_yann.audit.task import Task
from sb3_yann.audit.trajectory import Policy, roll_out
from sb3_yann.control import LinearMPC, lqr
from sb3_yann.twin.dynamics import law_of

BURSTS = 25
"""Some searches begin with all inputs on a bound, for this part of the episode."""
WEIGHTS = 0.1, 10.0
"""Factors of weights of the MPC, for laws that are tried instead of it."""

Law = Callable[[Array], Array]


def initial_guesses(
    plant: Plant, task: Task, starts: Array, steps: int, rows: Rows
) -> list[Policy]:
    """Return the policies whose trajectories plans may begin with; the first one is the MPC.

    Two have inputs on their bounds for a while, then the MPC. The last one is, for each start, the
    cheapest of these and of unconstrained laws with other weights, after such a push or without: an
    MPC that leaves a pendulum hanging shows no plan that it can swing. There is none where the MPC
    is as cheap.

    Parameters
    ----------
    plant, task : Plant and Task
        What is tried, and what it is to cost.
    starts : ndarray, shape (k, n_theta)
        Where the plans begin.
    steps : int
        Their length.
    rows : ndarray of int, shape (k,)
        Numbers of the starts, as the plant knows them.
    """
    problem, until = task.problem, steps // BURSTS
    none = partial(_pushed, problem.deviations.u_min, 0)
    pushes = [
        none,
        *(partial(_pushed, u, until) for u in (problem.deviations.u_min, problem.deviations.u_max)),
    ]
    first = [push(law_of(problem)) for push in pushes]

    def played(policy: Policy) -> tuple[Array, Array]:
        thetas, inputs = roll_out(plant, task, policy, starts, steps, rows)
        return task.costs(thetas, inputs), inputs

    least, best = played(first[0])
    cheaper: NDArray[np.bool_] = np.zeros(len(starts), dtype=bool)
    others = [push(partial(_linear, K)) for K in _gains(problem) for push in pushes]
    for policy in (*first[1:], *others):
        costs, inputs = played(policy)
        won = costs < least
        best[:, won], least, cheaper = inputs[:, won], np.minimum(costs, least), cheaper | won
    return [*first, lambda t, theta: best[t]] if cheaper.any() else first


def _pushed(u: Array, until: int, law: Law) -> Policy:
    """Return a policy with inputs u (m,) for some steps, those of a law after them."""
    return lambda t, theta: np.tile(u, (len(theta), 1)) if t < until else law(theta)


def _linear(K: Array, theta: Array) -> Array:
    return theta @ K.T


def _gains(problem: LinearMPC) -> Iterator[Array]:
    """Yield gains (m, n_theta) of unconstrained laws: with another weight of one error, or all."""
    errors, size = problem.error_system, len(problem.error_system.Q)
    for chosen in (*np.eye(size, dtype=bool), np.ones(size, dtype=bool)):
        for factor in WEIGHTS:
            scale = np.where(chosen, np.sqrt(factor), 1.0)
            Q = scale[:, None] * errors.Q * scale
            cross = None if errors.cross is None else scale[:, None] * errors.cross
            if np.array_equal(Q, errors.Q):
                continue
            try:
                P = lqr.riccati(errors.model, Q, errors.R, problem.gamma, cross)
            except ValueError:  # no stabilizing solution with these weights
                continue
            K = lqr.gain(errors.model, errors.R, P, problem.gamma, cross)
            yield errors.to_input - K @ errors.to_error
