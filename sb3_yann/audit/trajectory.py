"""A nearly optimal trajectory: differential dynamic programming on the plant itself.

Y. Tassa, N. Mansard and E. Todorov, *Control-limited differential dynamic programming*, ICRA 2014,
with the curvature of the cost alone. Slopes come from a model, costs from the plant: what is found
has been played there, so a plan's cost can be reached whatever the model is worth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC

SHARES = 1.0, 0.5, 0.2, 0.05
"""Of a step, tried one after the other."""
ENOUGH = 1e-3
"""A gain of a step, relative to the cost, below which a search ends after a few more."""
ITERATIONS, IDLE = 60, 4
STIFFER, SOFTER = 10.0, 0.3


@dataclass(frozen=True)
class Trajectory:
    """One episode.

    Attributes
    ----------
    thetas : ndarray, shape (T + 1, n_theta)
    inputs : ndarray, shape (T, m)
    stage : ndarray, shape (T,), costs
    broken : int, steps that violate a limit
    """

    thetas: Array
    inputs: Array
    stage: Array
    broken: int

    @property
    def cost(self) -> float:
        """Summed stage cost."""
        return float(self.stage.sum())

    def is_better_than(self, other: Trajectory) -> bool:
        """Return whether it costs less, is as long, and is no less safe."""
        alike = len(self.inputs) >= len(other.inputs) and self.broken <= other.broken
        return alike and self.cost < other.cost


Play = Callable[[Callable[[int, Array], Array]], Trajectory]
"""From inputs by step and theta (n_theta,) to the episode that they make."""
Slopes = Callable[[Array, Array], tuple[Array, Array]]
"""From thetas (T, n_theta) and inputs (T, m) to the derivatives (T, n, n) and (T, n, m)."""


def optimize(problem: LinearMPC, play: Play, slopes: Slopes, first: Trajectory) -> Trajectory:
    """Return the best trajectory found from a first one, without preview.

    Parameters
    ----------
    problem : LinearMPC
        Its stage cost is what is minimized, within its bounds of the inputs.
    play : callable
        The plant, always from the same start.
    slopes : callable
        Of a model of it.
    first : Trajectory
        Where the search begins.
    """
    best, stiffness, idle = first, 1e-6, 0
    for _ in range(ITERATIONS):
        T = len(best.inputs)
        k, K = _feedback(problem, best, slopes(best.thetas[:T], best.inputs), stiffness)
        found = None
        for share in SHARES if np.all(np.isfinite(k)) else ():
            tried = play(_policy(problem, best, share * k, K))
            if tried.is_better_than(best):
                found = tried
                break
        if found is None:
            stiffness, idle = STIFFER * stiffness, idle + 1
        else:
            slow = best.cost - found.cost < ENOUGH * abs(best.cost)
            best, stiffness, idle = found, SOFTER * stiffness, idle + 1 if slow else 0
        if idle > IDLE:
            break
    return best


def _policy(
    problem: LinearMPC, about: Trajectory, k: Array, K: Array
) -> Callable[[int, Array], Array]:
    def act(t: int, theta: Array) -> Array:
        if t >= len(k):
            return np.asarray(np.clip(about.inputs[-1], problem.u_min, problem.u_max))
        u = about.inputs[t] + k[t] + K[t] @ (theta - about.thetas[t])
        return np.asarray(np.clip(u, problem.u_min, problem.u_max))

    return act


def _feedback(
    problem: LinearMPC, about: Trajectory, slopes: tuple[Array, Array], stiffness: float
) -> tuple[Array, Array]:
    """Return the changes (T, m) of the inputs and the feedback (T, m, n) about a trajectory.

    Where references or disturbances change, the recursion begins anew with the value of the law:
    nobody knows them before.
    """
    (A, B), n, m = slopes, problem.n_theta, problem.model.n_inputs
    W, P, constant = problem.stage_matrix, undiscounted_value(problem), problem.layout.constant
    T, thetas, inputs = len(about.inputs), about.thetas, about.inputs
    gradient = 2 * np.concatenate([thetas[:T], inputs], axis=1) @ W
    at_bound = 1e-9 * (problem.u_max - problem.u_min)
    low, high = inputs <= problem.u_min + at_bound, inputs >= problem.u_max - at_bound
    k, K = np.zeros((T, m)), np.zeros((T, m, n))
    Vx: Array = np.zeros(n)
    Vxx: Array = np.zeros((n, n))
    moved = np.any(np.diff(thetas[: T + 1, constant], axis=0) != 0, axis=1)
    unit = stiffness * np.diag(1 / problem.u_half**2) * max(abs(about.cost) / T, 1e-300)
    for t in reversed(range(T)):
        if moved[t]:
            known = thetas[t + 1].copy()
            known[constant] = thetas[t, constant]
            Vx, Vxx = 2 * P @ known, 2 * P
        Qx, Qu = gradient[t, :n] + A[t].T @ Vx, gradient[t, n:] + B[t].T @ Vx
        Qxx = 2 * W[:n, :n] + A[t].T @ Vxx @ A[t]
        Qux = 2 * W[n:, :n] + B[t].T @ Vxx @ A[t]
        Quu = 2 * W[n:, n:] + B[t].T @ Vxx @ B[t]
        free = ~((low[t] & (Qu > 0)) | (high[t] & (Qu < 0)))
        if free.any():
            stiff = (Quu + unit)[np.ix_(free, free)]
            solved = np.linalg.solve(stiff, np.column_stack([Qu, Qux])[free])
            k[t, free], K[t, free] = -solved[:, 0], -solved[:, 1:]
        Vx = Qx + K[t].T @ (Quu @ k[t] + Qu) + Qux.T @ k[t]
        Vxx = Qxx + K[t].T @ Quu @ K[t] + K[t].T @ Qux + Qux.T @ K[t]
        Vxx = (Vxx + Vxx.T) / 2
    return k, K


def undiscounted_value(problem: LinearMPC) -> Array:
    """Return the value of the law, discounted a little where there is none without."""
    try:
        return problem.value_matrix(1.0)
    except ValueError:
        return problem.value_matrix(0.99)
