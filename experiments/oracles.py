"""What could be gained where the plant shows outputs? `python -m experiments.oracles column ph`.

Plans of the true plant from its true state, which know nothing of set-points to come: one for each
set-point, played with the case's own estimator, whose costs are those of `experiments.outputs`. The
column's plans know the feed rate from the fourth minute on, when an output first shows it: before,
they take its mean. The pH's know the buffer from the start.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable

import numpy as np
from scipy.optimize import lsq_linear, minimize

from experiments.outputs import LEARNERS, Column, Learner
from sb3_yann._validation import Array

TESTS = range(2000, 2050)
FORESEEN = 60  # minutes after the episode that a plan of the column counts
SHOWN = 4  # minutes after which an output of the column shows the feed rate


class ColumnPlans:
    """Exact plans of the column: its states, and the estimates in its costs, are linear in u."""

    def __init__(self, case: Learner, steps: int) -> None:
        self.case = case
        self.mpc = case.mpc
        self.rest: Array = np.tile(Column.u_rest, (steps, 1))
        weights, vectors = np.linalg.eigh(self.mpc.error_system.Q)
        self.to_cost = np.sqrt(np.maximum(weights, 0.0))[:, None] * vectors.T
        self.to_input_cost = np.linalg.cholesky(self.mpc.error_system.R).T
        start = np.zeros(2), 0.0, np.zeros((steps, 2))
        zero = self.residuals(*start, self.rest)
        self.slopes = np.zeros((*zero.shape, steps, 2))
        for j in range(2):
            pushed = self.rest.copy()
            pushed[0, j] += 1
            moved = self.residuals(*start, pushed) - zero
            for k in range(steps):
                self.slopes[k:, :, k, j] = moved[: steps - k]

    def residuals(self, parts: Array, feed: float, r: Array, inputs: Array) -> Array:
        """Return what a step costs as sums of squares (T, .), within no bounds of the inputs."""
        env = Column(self.case.mpc.model.shown)
        env.action_space.low[:] = -np.inf
        env.action_space.high[:] = np.inf
        env.reset(seed=0)
        env.parts[:, 0] = parts
        env.step_of_feed = feed
        estimator = copy.deepcopy(self.case.estimator)
        assert estimator is not None
        model = self.mpc.model
        layout = self.mpc.layout
        C = model.shown
        y = env.show() - C @ model.x_ss
        x_hat, d_hat = estimator.reset(y)
        theta = np.zeros((len(inputs), self.mpc.n_theta))
        theta[:, layout.reference] = r - self.mpc.theta_ss[layout.reference]
        for k, u in enumerate(inputs):
            theta[k, layout.state] = x_hat + np.linalg.pinv(C) @ (y - C @ x_hat)
            theta[k, layout.disturbance] = d_hat
            y = env.step(u)[0] - C @ model.x_ss
            x_hat, d_hat = estimator.update(y, u - model.u_ss)
        errors = self.mpc.error_system
        v = inputs - model.u_ss - theta @ errors.to_input.T
        return np.hstack([theta @ errors.to_error.T @ self.to_cost.T, v @ self.to_input_cost.T])

    def planned(self, parts: Array, feed: float, r: Array, done: Array) -> Array:
        """Return all inputs, of which the first are ``done``."""
        k = len(done)
        begun = np.vstack([done, self.rest[k:]])
        left = self.residuals(parts, feed, np.tile(r, (len(begun), 1)), begun)[k:].ravel()
        half = self.mpc.u_half[0]
        slopes = self.slopes[k:, :, k:].reshape(len(left), -1)
        found = lsq_linear(slopes, -left, (-half, half), tol=1e-10)
        return np.vstack([done, begun[k:] + found.x.reshape(-1, 2)])


def of_column(case: Learner, seeds: range) -> list[Array]:
    """Return the inputs of the episodes."""
    found = []
    plans = ColumnPlans(case, 120 + FORESEEN)
    for seed in seeds:
        env = case.make()
        env.reset(seed=seed)
        parts = env.unwrapped.parts[:, 0].copy()
        feed = env.unwrapped.step_of_feed
        first, second = set_points(case, seed)
        inputs = plans.planned(parts, 0.0, first, plans.rest[:0])[:SHOWN]
        inputs = plans.planned(parts, feed, first, inputs)[:60]
        found.append(plans.planned(parts, feed, second, inputs)[:120])
    return found


def of_ph(case: Learner, seeds: range) -> list[Array]:
    """Return the inputs of the episodes, found from those of the MPC."""
    found = []
    for seed in seeds:
        env = case.make()
        env.reset(seed=seed)
        x = env.unwrapped.state.copy()
        advance = env.unwrapped.plant.advance
        _, _, played, thetas = case.play(case.mpc.law().plant_input, seed)
        inputs: list[Array] = []
        for k in (0, 30):
            for u in searched(case, advance, x, thetas[k], played[k : k + 30, 0]):
                x = advance(x, u)
                inputs.append(u)
        found.append(np.array(inputs))
    return found


def searched(
    case: Learner, advance: Callable[[Array, Array], Array], x: Array, theta: Array, first: Array
) -> Array:
    """Return inputs (T, 1) from a state on that cost least, found from others (T,)."""
    mpc = case.mpc
    low = float(mpc.u_min[0])
    width = float(mpc.u_max[0]) - low

    def cost(v: Array) -> float:
        at = theta.astype(np.float64)
        now = x
        total = 0.0
        for u in low + width * v[:, None]:
            at[mpc.layout.state] = now[:1]
            total += float(mpc.stage_cost(at, u))
            now = advance(now, u)
        return total

    bounds = [(0.0, 1.0)] * len(first)
    best = minimize(cost, (first - low) / width, bounds=bounds, options={"maxiter": 25})
    return np.asarray(low + width * best.x[:, None])


def set_points(case: Learner, seed: int) -> tuple[Array, Array]:
    """Return the two set-points of an episode of the column."""
    thetas = case.play(lambda theta: case.mpc.model.u_ss, seed)[3]
    part = case.mpc.layout.reference
    return thetas[0, part], thetas[60, part]


def main(names: list[str]) -> None:
    """Print what plans gain."""
    for name in names:
        case = LEARNERS[name]()
        law = case.mpc.law()
        mpc = np.array([case.play(law.plant_input, seed)[0] for seed in TESTS])
        plans = {"column": of_column, "ph": of_ph}[name](case, TESTS)
        costs = []
        for seed, inputs in zip(TESTS, plans, strict=True):
            steps = iter(inputs)
            costs.append(case.play(lambda _, steps=steps: next(steps), seed)[0])
        more = (np.array(costs) - mpc) / mpc.mean()
        print(f"{name}: {100 * more.mean():+.1f} %, worst start {100 * more.max():+.1f} %")


if __name__ == "__main__":
    main(sys.argv[1:])
