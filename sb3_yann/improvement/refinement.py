"""Descent on what a policy's own episodes cost in a model, by their exact derivatives."""

from __future__ import annotations

import numpy as np
import torch as th

from sb3_yann._validation import Array
from sb3_yann.improvement.model import Imagined, Scenarios
from sb3_yann.networks.yann import LawLayer
from sb3_yann.plan import Task

OUTLIER = 3.0  # times the median size of all scenarios' gradients that one may have


def descend(
    layer: LawLayer, scenarios: Scenarios, task: Task, played: Imagined, weights: Array
) -> None:
    """Give a layer's weights the gradient of its episodes' costs.

    The costs are those of the task, times ``weights`` (k,). The chain rule goes backward through
    the model, the law and the networks (P. Werbos, *Backpropagation through time*, Proc. IEEE
    78(10), 1990). A scenario whose gradient is far longer than most, as of a loop that diverges,
    is shortened.

    Parameters
    ----------
    layer : LawLayer
        The policy that was played.
    scenarios : Scenarios
        Where it was.
    task : Task
        What counts.
    played : Imagined
        What came of it.
    weights : ndarray, shape (k,)
        Of the scenarios.
    """
    problem = task.problem
    thetas, inputs = played.thetas, played.inputs
    (steps, k, m), size = inputs.shape, problem.n_theta
    at = th.as_tensor(thetas[:-1].reshape(-1, size)).requires_grad_()
    out = layer(at)
    slopes = [th.autograd.grad(out[:, j].sum(), at, retain_graph=True)[0] for j in range(m)]
    policy = th.stack(slopes, 1).numpy().reshape(steps, k, m, size) * problem.u_half[:, None]
    low, high = problem.deviations.u_min, problem.deviations.u_max
    policy = policy * ((inputs > low) & (inputs < high))[..., None]
    with np.errstate(all="ignore"):
        gradient = _of_inputs(scenarios, task, played, policy) * weights[:, None]
        length = np.sqrt(np.sum(gradient**2, axis=(0, 2)))
        known = np.isfinite(length) & np.isfinite(played.costs)
        most = OUTLIER * np.median(length[known]) if known.any() else 0.0
        share = np.where(known, np.minimum(1.0, most / np.maximum(length, 1e-300)), 0.0)
    gradient = np.where(known[:, None], gradient * share[:, None], 0.0) * problem.u_half / k
    out.backward(th.as_tensor(gradient.reshape(-1, m)).to(out))


def _of_inputs(scenarios: Scenarios, task: Task, played: Imagined, policy: Array) -> Array:
    """Return the gradient (T, k, m) by the inputs, for the policy's slopes (T, k, m, n_theta)."""
    problem, row = task.problem, scenarios.model.dynamics.row
    rows, inputs, thetas = played.rows, played.inputs, played.thetas
    size, states = problem.n_theta, problem.layout.state
    A, B = scenarios.plant.slopes(rows[:-1], inputs, np.arange(len(scenarios)))
    stage = 2 * np.concatenate([thetas[:-1], inputs], axis=-1) @ problem.stage_matrix
    if task.doubt is not None:
        stage = stage + task.doubt.slopes(thetas[:-1], inputs)[0]
    outside = task.penalty(thetas[1:])[0]
    found, after = np.empty_like(inputs), np.zeros(rows.shape[1:])
    after[:, :size] = 2 * thetas[-1] @ task.end
    for t in reversed(range(len(inputs))):
        after[:, states] += outside[t]
        found[t] = stage[t, :, size:] + np.einsum("krm,kr->km", B[t], after)
        after = np.einsum("krq,kr->kq", A[t], after)
        after[:, :size] += stage[t, :, :size] + np.einsum("kmq,km->kq", policy[t], found[t])
        after[:, row.given] = 0.0  # these are given anew at each step
    return found
