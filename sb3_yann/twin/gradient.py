"""The gradient of a policy's cost in a twin, by the actor's parameters.

Backpropagation through time with the costate: the actions are computed forward without torch's
graph, the costate runs backward through the twin's and the actor's Jacobians, and one backward pass
of the actor over all steps at once takes what the costate makes of each action.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch as th

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.mpc.bound_excess import Bounds, bound_excess
from sb3_yann.networks.yann import LawLayer
from sb3_yann.twin.dynamics import Dynamics
from sb3_yann.twin.row_layout import RowLayout


@dataclass(frozen=True)
class Objective:
    """What is minimized: stage costs, the value at the end, and a penalty beyond limits.

    Bounds of the problem's outputs are limits as well; soft bounds cost what they cost the MPC.

    Attributes
    ----------
    problem : LinearMPC
    value : ndarray, shape (n_theta, n_theta)
        ``theta' value theta`` is the cost of what comes after the last step.
    low, high : ndarray, shape (n,)
        Limits of the states, infinite where there are none.
    penalty : float
        Cost of a step one half-width beyond.
    """

    problem: LinearMPC
    value: Array
    low: Array
    high: Array
    penalty: float

    @cached_property
    def bounds(self) -> Bounds:
        """Those of the problem."""
        return Bounds.of(self.problem)

    def slopes(self, rows: Array, inputs: Array, row: RowLayout) -> tuple[Array, Array]:
        """Return the derivatives of the cost of runs by their rows and by the inputs.

        Parameters
        ----------
        rows : ndarray, shape (steps + 1, ..., size)
            Of the runs.
        inputs : ndarray, shape (steps, ..., m)
            What acted.
        row : RowLayout
            What a row holds.
        """
        W, size = self.problem.stage_matrix, self.problem.n_theta
        thetas, by_rows = row.shown(rows), np.zeros(rows.shape)
        both = 2 * np.concatenate([thetas[:-1], inputs], axis=-1) @ W
        by_rows[:-1, ..., :size], by_u = both[..., :size], both[..., size:].copy()
        by_rows[-1, ..., :size] = 2 * thetas[-1] @ self.value
        by_rows[:-1, ..., row.state] += 2 * self.penalty * self._beyond(rows[:-1, ..., row.state])
        by_rows[1:, ..., row.state] += self._slopes_of_bounds(thetas[1:])
        return by_rows, by_u

    def _slopes_of_bounds(self, thetas: Array) -> Array:
        """Return the derivatives by the states of what soft bounds and those of outputs cost."""
        bounds, over = self.bounds, self.bounds.beyond(thetas)
        soft, is_output = bounds.softness > 0, ~bounds.of_states
        by_bound = np.where(is_output & ~soft, 2 * self.penalty * over, 0.0) / bounds.half
        for part in (soft & ~is_output, soft & is_output):  # each shares a slack
            unit = np.where(part, bounds.softness, np.inf) / bounds.half
            s = np.abs(over) / unit
            most = (s == s.max(axis=-1, keepdims=True, initial=0.0)) & (s > 0)
            slope = (self.problem.soft.penalty or 0.0) * (1 + 2 * s) / (unit * bounds.half)
            by_bound = by_bound + np.where(most, np.sign(over) * slope, 0.0)
        return np.asarray(by_bound @ bounds.C)

    def _beyond(self, x: Array) -> Array:
        half = self.problem.theta_half[self.problem.layout.state]
        over = np.maximum(x - self.high, 0.0) - np.maximum(self.low - x, 0.0)
        return np.asarray(over / half**2)

    def costs(self, rows: Array, inputs: Array) -> Array:
        """Return the costs of runs with those of soft bounds, without the penalty."""
        thetas = rows[..., : self.problem.n_theta]
        end = thetas[-1]
        stage = self.problem.deviations.stage_cost(thetas[:-1], inputs).sum(axis=0)
        soft = bound_excess(self.problem, thetas, inputs).penalty
        return np.asarray(stage + soft + np.sum((end @ self.value) * end, axis=-1))


def actor(layer: LawLayer, problem: LinearMPC) -> Callable[[Array], Array]:
    """Return an actor of now as a function from theta (rows, n_theta) to inputs (rows, m)."""
    middle, half = (problem.deviations.u_max + problem.deviations.u_min) / 2, problem.u_half
    act = layer.frozen()
    return lambda theta: np.asarray(middle + half * act(theta))


def accumulate_gradient(
    layer: LawLayer,
    dynamics: Dynamics,
    objective: Objective,
    starts: Array,
    steps: int,
    reference: tuple[Array, Array, Array] | None = None,
) -> None:
    """Add to the parameters' ``grad`` the gradient of the mean cost of runs from some starts.

    Parameters
    ----------
    layer : LawLayer
        On the CPU.
    dynamics : Dynamics
        The twin's.
    objective : Objective
        What is minimized.
    starts : ndarray, shape (members, batch, size)
        Where the runs begin.
    steps : int
        Length T of the runs.
    reference : three of ndarray, shape (members, batch), optional
        Costs that no run should exceed; how much each counts below them, and above.
    """
    problem, row = objective.problem, dynamics.row
    thetas, inputs = dynamics.roll_out(actor(layer, problem), starts, steps)
    by_theta, by_u = objective.slopes(thetas, inputs, row)
    costs = objective.costs(thetas, inputs)
    weights = np.ones_like(costs)
    if reference is not None:
        weights = np.where(costs > reference[0], reference[2], reference[1])
    flat = row.shown(thetas[:-1]).reshape(-1, problem.n_theta)
    actions = layer(th.as_tensor(flat))
    if layer.packed is not None and dynamics.packed is not None and row.observer is None:
        _compiled_costates(layer, dynamics, actions, flat, inputs, by_theta, by_u)
    else:
        _costates(layer, dynamics, thetas, inputs, by_theta, by_u)
    upstream = (by_u * weights[..., None] * problem.u_half / weights.size).reshape(len(flat), -1)
    actions.backward(th.as_tensor(upstream).to(actions))


def _compiled_costates(
    layer: LawLayer,
    dynamics: Dynamics,
    actions: th.Tensor,
    flat: Array,
    inputs: Array,
    by_theta: Array,
    by_u: Array,
) -> None:
    """Do what :func:`_costates` does, for thetas that are ``flat`` and the layer's actions there.

    Parameters
    ----------
    layer, dynamics
        With arrays for compiled code.
    actions : Tensor, shape (rows, m)
        With its gradient, for which it keeps what the layer has come by.
    flat : ndarray, shape (rows, n_theta)
        Without those at the end.
    inputs, by_theta, by_u
        As in :func:`_costates`.
    """
    from sb3_yann.networks._kernels.yann_layer import kept_for_gradient  # which load numba
    from sb3_yann.twin._kernels.costates import costates

    law, problem = layer.explicit_law, dynamics.problem
    half = np.array(problem.u_half)  # a loaded problem holds it read-only
    policy: Any = (*layer.packed, half)  # type: ignore[misc]
    twin: Any = (*dynamics.packed, law.locate(np.where(np.isfinite(flat), flat, 0.0)))  # type: ignore[misc, union-attr]
    rows = (each.reshape(-1, each.shape[-1]) for each in (flat, inputs, by_theta, by_u))
    costates(*policy, *twin, *kept_for_gradient(actions), *rows)


def _costates(
    layer: LawLayer,
    dynamics: Dynamics,
    thetas: Array,
    inputs: Array,
    by_theta: Array,
    by_u: Array,
) -> None:
    """Add to the slopes of each step's own cost those of the costs to come, along runs.

    Parameters
    ----------
    layer, dynamics, thetas, inputs
        As in :func:`accumulate_gradient`, and what :meth:`Dynamics.roll_out` makes of them.
    by_theta, by_u : ndarray, shapes (steps + 1, members, batch, size) and (steps, ..., m)
        Overwritten from the end to the beginning.
    """
    problem, steps = dynamics.problem, len(inputs)
    A, B = dynamics.jacobians(*_by_member(thetas[:-1], inputs))
    A, B = (
        np.moveaxis(each.reshape(len(each), steps, -1, *each.shape[2:]), 0, 1) for each in (A, B)
    )
    shown = dynamics.row.shown(thetas[:-1])
    slopes = _slopes_of_actor(layer, shown.reshape(-1, problem.n_theta))
    K = problem.u_half[:, None] * slopes.reshape(*inputs.shape, problem.n_theta)
    for t in reversed(range(steps)):
        row = by_theta[t + 1][..., None, :]
        by_u[t] += (row @ B[t])[..., 0, :]
        by_theta[t] += (row @ A[t])[..., 0, :]
        by_theta[t, ..., : problem.n_theta] += (by_u[t][..., None, :] @ K[t])[..., 0, :]


def _by_member(thetas: Array, inputs: Array) -> tuple[Array, Array]:
    """Return (T, members, batch, ...) as (members, T batch, ...)."""
    first, second = (np.moveaxis(each, 1, 0) for each in (thetas, inputs))
    return (
        first.reshape(len(first), -1, thetas.shape[-1]),
        second.reshape(len(second), -1, inputs.shape[-1]),
    )


def _slopes_of_actor(layer: LawLayer, theta: Array) -> Array:
    """Return the derivatives (rows, m, n_theta) of the actions in [-1, 1] by theta.

    Those of the law and of the network, each zero where it lies on its bound. On a bound of the
    rate an action moves with the previous input. (The layer's own gradient leads inside from its
    bounds, which is for training and not for this.)
    """
    at, of_law = th.as_tensor(theta), layer.slopes_of_law(theta)
    of_network = _slopes_of_network(layer, at, layer.regions(at))
    with th.no_grad():
        by_law, actions = layer.law(at).double().numpy(), layer(at).double().numpy()
        bounds = [each.double().numpy() for each in layer.reachable(at)] if layer.rated else []
    low, high = bounds or (np.full_like(actions, -1.0), np.full_like(actions, 1.0))
    of_law = _moved_by_bounds(layer, of_law, by_law, low, high)
    return _moved_by_bounds(layer, of_law + of_network, actions, low, high)


def _slopes_of_network(layer: LawLayer, at: th.Tensor, region: Any) -> Array:
    z = (at / layer.theta_half).to(layer.theta_half).requires_grad_()
    correction = layer.network(z, th.as_tensor(region))
    m = correction.shape[1]
    rows = [
        th.autograd.grad(correction[:, k].sum(), z, retain_graph=k + 1 < m)[0] / layer.theta_half
        for k in range(m)
    ]
    slopes = th.stack(rows, dim=1).double().numpy()
    added = correction.detach().double().numpy()
    if layer.reach is not None:
        slopes[np.abs(added) >= layer.reach] = 0.0
        added = np.clip(added, -layer.reach, layer.reach)
    points = at.double().clone().requires_grad_()
    part = layer.confined(points)
    (of_part,) = th.autograd.grad(part.sum(), points)
    slopes *= part.detach().double().numpy()[:, :, None]
    return np.asarray(slopes + added[:, :, None] * of_part.numpy()[:, None])


def _moved_by_bounds(
    layer: LawLayer, slopes: Array, values: Array, low: Array, high: Array
) -> Array:
    """Return the slopes of what lies on a bound: zero, or those of the bound of the rate.

    Parameters
    ----------
    layer : LawLayer
        Which knows whether there are bounds of the rate.
    slopes : ndarray, shape (rows, m, n_theta)
        Of the values.
    values, low, high : ndarray, shape (rows, m)
        In [-1, 1].
    """
    slopes, held = slopes.copy(), (values <= low) | (values >= high)
    slopes[held] = 0.0
    if layer.rated:
        row, k = np.nonzero(held & (np.abs(values) < 1))
        m, size = values.shape[1], slopes.shape[2]
        slopes[row, k, size - m + k] = 1 / layer.half_range.numpy()[k]
    return slopes
