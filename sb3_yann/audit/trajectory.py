"""Nearly optimal trajectories of many starts at once, with the feedback that keeps a plant on them.

Control-limited differential dynamic programming with Gauss-Newton curvature (Y. Tassa, N. Mansard
and E. Todorov, ICRA 2014). A bound of several inputs that is met once stays active in its step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.audit.plants import Plant, Rows
from sb3_yann.audit.task import Task

Mask = NDArray[np.bool_]
Policy = Callable[[int, Array], Array]  # step and thetas (k, n_theta) -> inputs (k, m)

SIZES = (1.0, 0.5, 0.2, 0.05)
"""Parts of a correction that are tried, the first first."""
SETTLED = 1e-5
"""A start is done when a correction saves less than this part of its cost."""
ROUNDS, RACE = 40, 4
"""Corrections at most; after how many the best of several beginnings goes on."""
SOFT = 1e-2
"""Bounds count so much less at first: stiff ones would end a search where it meets them."""
DAMPED, PATIENCE = 10.0, 5
"""Factor of the damping where no correction helps; how often in a row, at most."""


def roll_out(
    plant: Plant, task: Task, policy: Policy, starts: Array, steps: int, rows: Rows
) -> tuple[Array, Array]:
    """Return thetas (steps + 1, k, n_theta) and inputs (steps, k, m) of a policy within bounds.

    Parameters
    ----------
    plant, task : Plant and Task
        What is tried, and what it is to cost.
    policy : callable
        From the step and thetas (k, n_theta) to inputs (k, m).
    starts : ndarray, shape (k, n_theta)
        Where the runs begin.
    steps : int
        How long they are.
    rows : ndarray of int, shape (k,)
        Numbers of the starts, as the plant knows them.
    """
    thetas = np.empty((steps + 1, *starts.shape))
    inputs = np.empty((steps, len(starts), task.problem.model.n_inputs))
    thetas[0] = starts
    for t in range(steps):
        inputs[t] = np.clip(np.nan_to_num(policy(t, thetas[t])), *task.limits(thetas[t]))
        thetas[t + 1] = plant.step(thetas[t], inputs[t], rows)
    return thetas, inputs


@dataclass(frozen=True)
class Plans:
    """Trajectories and feedback of k starts.

    Attributes
    ----------
    thetas, inputs : ndarray, shapes (T + 1, k, n_theta) and (T, k, m)
    gains : ndarray, shape (T, k, m, n_theta)
    costs : ndarray, shape (k,)
        With what is beyond bounds.
    """

    thetas: Array
    inputs: Array
    gains: Array
    costs: Array

    def of(self, chosen: Rows | Mask) -> Plans:
        """Return some of the starts."""
        return Plans(
            self.thetas[:, chosen],
            self.inputs[:, chosen],
            self.gains[:, chosen],
            self.costs[chosen],
        )


def follow(plans: Plans, t: int, theta: Array) -> Array:
    """Return the inputs (k, m) of plans at a step, from theta (k, n_theta)."""
    away = theta - plans.thetas[t]
    return np.asarray(plans.inputs[t] + (plans.gains[t] @ away[..., None])[..., 0])


def planned(
    plant: Plant, task: Task, policies: list[Policy], starts: Array, steps: int, rows: Rows
) -> Plans:
    """Return the best plan of each start that the policies' trajectories lead to.

    Parameters
    ----------
    plant, task : Plant and Task
        What is tried, and what it is to cost.
    policies : list of callables
        Where the search begins.
    starts : ndarray, shape (k, n_theta)
        Where the plans begin.
    steps : int
        Length T of the plans.
    rows : ndarray of int, shape (k,)
        Numbers of the starts, as the plant knows them.
    """
    found, every = [], np.arange(len(starts))
    soft = dataclasses.replace(task, weight=SOFT * task.weight)
    for policy in policies:
        thetas, inputs = roll_out(plant, task, policy, starts, steps, rows)
        gains = np.zeros((*inputs.shape, starts.shape[1]))
        first = Plans(thetas, inputs, gains, soft.costs(thetas, inputs))
        found.append(improved(plant, soft, first, rows, RACE if len(policies) > 1 else ROUNDS))
    best = np.argmin([each.costs for each in found], axis=0)
    names = "thetas", "inputs", "gains"
    kept = {k: np.stack([getattr(each, k) for each in found], 1)[:, best, every] for k in names}
    costs = np.array([each.costs for each in found])[best, every]
    plans = improved(plant, soft, Plans(**kept, costs=costs), rows, ROUNDS)
    hard = dataclasses.replace(plans, costs=task.costs(plans.thetas, plans.inputs))
    plans = improved(plant, task, hard, rows, ROUNDS)
    # The last search may have been damped, and its feedback with it.
    _, gains = _backward(plant, task, plans, rows, np.zeros(len(rows)))
    return dataclasses.replace(plans, gains=gains)


def improved(plant: Plant, task: Task, plans: Plans, rows: Rows, rounds: int) -> Plans:
    """Return plans that no correction improves, or those after so many rounds.

    Parameters
    ----------
    plant, task : Plant and Task
        What is tried, and what it is to cost.
    plans : Plans
        Where the search begins.
    rows : ndarray of int, shape (k,)
        Numbers of the starts, as the plant knows them.
    rounds : int
        How many corrections there are at most.
    """
    plans = Plans(*(each.copy() for each in vars(plans).values()))
    k = len(rows)
    damping: Array = np.zeros(k)
    active: Rows = np.flatnonzero(np.isfinite(plans.costs))
    if not len(active):
        return plans
    failed: Rows = np.zeros(k, dtype=np.intp)
    for _ in range(rounds):
        old = plans.of(active)
        corrections, gains = _backward(plant, task, old, rows[active], damping[active])
        plans.gains[:, active] = gains
        waiting: Rows = np.arange(len(active))
        for size in SIZES:
            moved = Plans(old.thetas, old.inputs + size * corrections, gains, old.costs)
            now, some = active[waiting], moved.of(waiting)
            given = partial(follow, some), some.thetas[0], len(some.inputs), rows[now]
            thetas, inputs = roll_out(plant, task, *given)
            costs = task.costs(thetas, inputs)
            better = costs < some.costs
            won = now[better]
            plans.thetas[:, won], plans.inputs[:, won] = thetas[:, better], inputs[:, better]
            plans.costs[won] = costs[better]
            waiting = waiting[~better]
            if not len(waiting):
                break
        lost = np.isin(np.arange(len(active)), waiting)
        failed[active] = np.where(lost, failed[active] + 1, 0)
        more = np.maximum(DAMPED * damping[active], 1.0)
        damping[active] = np.where(lost, more, damping[active] / DAMPED)
        little = old.costs - plans.costs[active] <= SETTLED * np.abs(old.costs)
        done = np.where(lost, failed[active] >= PATIENCE, little)
        active = np.asarray(active[~done])
        if not len(active):
            break
    return plans


def _backward(
    plant: Plant, task: Task, plans: Plans, rows: Rows, damping: Array
) -> tuple[Array, Array]:
    """Return corrections (T, k, m) and gains (T, k, m, n_theta)."""
    problem, thetas, inputs = task.problem, plans.thetas, plans.inputs
    size, states = problem.n_theta, problem.layout.state
    A, B = plant.jacobians(thetas[:-1], inputs, rows)
    F = np.concatenate([A, B], axis=-1)
    W = 2 * problem.stage_matrix
    slopes = np.concatenate([thetas[:-1], inputs], axis=-1) @ W
    curved = np.broadcast_to(W, (len(inputs), len(rows), *W.shape))
    if task.doubt is not None:
        slope, more = task.doubt.slopes(thetas[:-1], inputs)
        slopes = slopes + slope
        curved = curved + more
    gradient, curvature = task.penalty(thetas[1:])
    limits = task.limits(thetas[:-1])
    low, high = (each - inputs for each in limits)
    # A bound of the rate moves with the previous input.
    moving = np.stack(
        [limits[0] > problem.deviations.u_min, limits[1] < problem.deviations.u_max], axis=1
    )
    v, V = 2 * thetas[-1] @ task.end, np.tile(2 * task.end, (len(rows), 1, 1))
    corrections, gains = np.empty_like(inputs), np.empty_like(plans.gains)
    damped = damping[:, None, None] * W[size:, size:]
    for t in reversed(range(len(inputs))):
        v[:, states] += gradient[t]
        V[:, states, states] += curvature[t]
        Ft = F[t].swapaxes(1, 2)
        q = slopes[t] + (Ft @ v[..., None])[..., 0]
        H = curved[t] + Ft @ V @ F[t]
        qx, qu = q[:, :size], q[:, size:]
        Hxx, Hux, Huu = H[:, :size, :size], H[:, size:, :size], H[:, size:, size:]
        move = _bounded_step(Huu + damped, qu, low[t], high[t])
        K = _feedback(Huu + damped, Hux, move <= low[t], move >= high[t], moving[t])
        Kt = K.swapaxes(1, 2)
        v = qx + (Kt @ (qu + (Huu @ move[..., None])[..., 0])[..., None])[..., 0]
        v += (Hux.swapaxes(1, 2) @ move[..., None])[..., 0]
        V = Hxx + Kt @ Huu @ K + Kt @ Hux + Hux.swapaxes(1, 2) @ K
        V = (V + V.swapaxes(1, 2)) / 2
        corrections[t], gains[t] = move, K
    return corrections, gains


def _bounded_step(H: Array, g: Array, low: Array, high: Array) -> Array:
    """Return the minimizers (k, m) of ``u'Hu / 2 + g'u`` in a box, for H (k, m, m), g (k, m).

    Projected Newton steps: an input on its bound is held there while the slope presses it on.
    """
    move: Array = np.clip(np.zeros_like(g), low, high)
    for _ in range(2 * g.shape[1] + 1):
        slope = g + (H @ move[..., None])[..., 0]
        held = ((move <= low) & (slope > 0)) | ((move >= high) & (slope < 0))
        step = np.linalg.solve(_reduced(H, held), np.where(held, 0.0, slope)[..., None])[..., 0]
        before, move = move, np.clip(move - step, low, high)
        if np.array_equal(before, move):
            break
    return move


def _feedback(H: Array, G: Array, at_low: Mask, at_high: Mask, moving: Mask) -> Array:
    """Return the gains (k, m, n_theta) of the minimizers in a box whose sides may move.

    Parameters
    ----------
    H, G : ndarray, shapes (k, m, m) and (k, m, n_theta)
        Curvature; how the gradient changes with theta.
    at_low, at_high : ndarray of bool, shape (k, m)
        Inputs on a bound.
    moving : ndarray of bool, shape (2, k, m)
        Whether the lower and the upper bound move with the previous input, theta's last entries.
    """
    held, m = at_low | at_high, H.shape[1]
    fixed: Array = np.zeros_like(G)
    row, j = np.nonzero((at_low & moving[0]) | (at_high & moving[1]))
    fixed[row, j, G.shape[2] - m + j] = 1.0
    right = np.where(held[:, :, None], fixed, -G - H @ fixed)
    return np.asarray(np.linalg.solve(_reduced(H, held), right))


def _reduced(H: Array, held: Mask) -> Array:
    """Return H (k, m, m) with the rows and columns of inputs that are held replaced by ones."""
    free = ~held[:, :, None] & ~held[:, None, :]
    return np.where(free, H, held[:, :, None] * np.eye(H.shape[1]))
