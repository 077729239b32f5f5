"""Plans are optimal, within bounds, from every start of a batch."""

import dataclasses

import numpy as np
import pytest

from sb3_yann import LinearCost, LinearModel, LinearMPC, MixedBounds, RateLimits, Terminal, Tracking
from sb3_yann.plan import WEIGHT, Task, planned, value_at_end

STEPS = 30


class Exact:
    """The prediction model as the plant."""

    turn = None

    def __init__(self, mpc: LinearMPC) -> None:
        self.mpc = mpc

    def step(self, theta, u, rows):
        return self.mpc.predict(theta, u)

    def jacobians(self, theta, u, rows):
        return tuple(np.tile(M, (*theta.shape[:2], 1, 1)) for M in self.mpc.prediction)


def cart(**changes) -> LinearMPC:
    bounds = {"u_min": -1, "u_max": 1, "x_min": [-4, -0.5], "x_max": [4, 0.5]}
    model = LinearModel([[1, 1], [0, 1]], [[0.5], [1]], 1.0)
    weights = {"R": [[0.1]], "horizon": 12}
    return LinearMPC(model, Q=np.diag([1, 0.01]), **{**weights, **bounds, **changes})


def plan(mpc: LinearMPC, starts: np.ndarray, unit: float = 1.0):
    if not len(mpc.mixed.F):
        mpc.explicit()  # some take more effort than "auto" spends
    free = np.full(mpc.model.n_states, np.inf)
    end = value_at_end(mpc)
    task = Task(mpc, -free, free, end.P, WEIGHT * unit, end_slope=end.slope)
    rows = np.arange(len(starts))
    return planned(
        Exact(mpc), task, [lambda _, x: np.zeros((len(x), len(mpc.R)))], starts, STEPS, rows
    )


@pytest.mark.parametrize("rate", [None, RateLimits(-0.3, 0.3)])
def test_a_plan_costs_what_a_long_horizon_costs_and_keeps_bounds(rate) -> None:
    mpc = cart(rate=rate)
    starts = np.zeros((3, mpc.n_theta))
    starts[:, :2] = [3.0, 0.2], [-2.0, 0.0], [0.1, 0.1]
    found = plan(mpc, starts)
    assert np.abs(found.thetas[1:, :, 1]).max() <= 0.5 and np.abs(found.inputs).max() <= 1
    assert np.abs(found.thetas[..., 1]).max() > 0.49  # the bound is felt
    if rate is not None:
        moved = np.diff(found.inputs, axis=0, prepend=0.0)
        assert 0.299 < np.abs(moved).max() <= 0.3 + 1e-9
    reached, expected = costs(mpc, starts, found)
    assert np.all(reached <= 1.005 * expected)


def costs(mpc: LinearMPC, starts: np.ndarray, found) -> tuple[np.ndarray, np.ndarray]:
    """Return what the plans cost, and what the law costs from the same starts."""
    played = [mpc.simulate(start, STEPS) for start in starts]
    expected = [mpc.stage_cost(thetas[:-1], inputs).sum() for thetas, inputs in played]
    return mpc.stage_cost(found.thetas[:-1], found.inputs).sum(axis=0), np.array(expected)


def test_two_inputs_of_which_one_is_on_its_bound() -> None:
    model = LinearModel([[0.95, 0.1], [0.0, 0.9]], [[0.2, 0.1], [0.0, 0.3]], 1.0)
    bounds = {"u_min": [-0.1, -2], "u_max": [0.1, 2], "theta_min": -5, "theta_max": 5}
    mpc = LinearMPC(model, Q=np.eye(2), R=0.1 * np.eye(2), horizon=20, **bounds)
    starts = np.array([[3.0, -2.0], [-4.0, 1.0]])
    found = plan(mpc, starts)
    assert np.isclose(np.abs(found.inputs[..., 0]).max(), 0.1) and np.all(found.gains[0, :, 0] == 0)
    reached, expected = costs(mpc, starts, found)
    np.testing.assert_allclose(reached, expected, rtol=1e-3)


@pytest.mark.parametrize("rows", [{"G": [[1, 1]]}, {"F": [[0, -0.5]], "G": [[1, 1]]}])
def test_bounds_of_combinations_are_kept_at_no_more_than_the_cost_of_a_long_horizon(rows) -> None:
    model = LinearModel([[1.0, 0.1], [0.0, 0.9]], [[0.2, 0.1], [0.1, 0.3]], 1.0)
    box = {"u_min": -1, "u_max": 1, "theta_min": -5, "theta_max": 5}
    mixed = MixedBounds(**rows, low=-0.7, high=0.7)
    mpc = LinearMPC(model, Q=np.eye(2), R=0.1 * np.eye(2), horizon=20, mixed=mixed, **box)
    mpc.law("online")
    starts = np.array([[3.0, -2.0], [-4.0, 1.0]])
    found = plan(mpc, starts, unit=float(mpc.stage_cost(starts, np.zeros((2, 2))).mean()))
    made = found.thetas[:-1] @ mixed.sized(2, 2).F.T + found.inputs @ mixed.G.T
    assert 0.69 < np.abs(made).max() <= 0.7
    reached, expected = costs(mpc, starts, found)
    assert np.all(reached <= 1.005 * expected)


def test_a_price_is_planned_with() -> None:
    mpc = cart(price=LinearCost(x=[0.2, 0.1], u=0.05), horizon=3)
    start = np.array([0.3, 0.1])
    found = plan(mpc, start[None])
    end = value_at_end(mpc)

    def cost(inputs: np.ndarray) -> float:
        thetas = [start]
        for u in inputs:
            thetas.append(mpc.predict(thetas[-1], u))
        return float(mpc.stage_cost(np.array(thetas[:-1]), inputs).sum() + end.at(thetas[-1]))

    best = found.inputs[:, 0]
    for k in (0, 5, STEPS - 1):
        moved = 1e-3 * np.eye(STEPS)[:, [k]]
        slope = (cost(best + moved) - cost(best - moved)) / 2e-3
        assert abs(slope) < 1e-4
    assert cost(best) < cost(mpc.simulate(start, STEPS)[1])


def test_a_reference_is_reached() -> None:
    mpc = cart(tracking=Tracking([0], -2, 2), horizon=3)
    mpc = dataclasses.replace(mpc, terminal=Terminal())
    found = plan(mpc, np.array([[0.0, 0.0, 1.5]]))
    np.testing.assert_allclose(found.thetas[-1, 0], [1.5, 0.0, 1.5], atol=1e-3)
