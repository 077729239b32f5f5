"""The gradient through twin and actor is that of the cost."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th

from sb3_yann.networks import YannLayer
from sb3_yann.twin.gradient import (
    Objective,
    _slopes_of_actor,
    accumulate_gradient,
    actor,
)
from twin_samples import observed, rated, twin


@pytest.mark.parametrize("make", [twin, rated, observed])
def test_it_is_the_directional_derivative_of_the_mean_cost(make) -> None:
    found = make()
    mpc, law = found.problem, found.problem.explicit()
    rate = (mpc.rate.du_min, mpc.rate.du_max) if mpc.has_rate_bounds else None
    layer = YannLayer(law, rate=rate).double()
    generator = th.Generator().manual_seed(0)
    weights = list(layer.network.weights())
    with th.no_grad():
        for each in weights:
            each.add_(0.02 * th.randn(each.shape, generator=generator))
    # Away from bounds: the actor's own gradient leads inside from there, the true one is zero.
    starts = 0.1 * found.starts.draw(15, np.random.default_rng(1)).reshape(5, 3, -1)
    nowhere = np.full(mpc.model.n_states, np.inf)
    objective = Objective(mpc, np.eye(mpc.n_theta), -nowhere, nowhere, 0.0)
    accumulate_gradient(layer, found.dynamics, objective, starts, 12)
    rolled = found.dynamics.roll_out(actor(layer, mpc), starts, 12)
    assert np.abs(rolled[1]).max() < 1
    direction = [th.randn(each.shape, generator=generator, dtype=th.float64) for each in weights]
    slope = sum(float((g.grad * d).sum()) for g, d in zip(weights, direction, strict=True))

    def cost(step: float) -> float:
        with th.no_grad():
            for each, d in zip(weights, direction, strict=True):
                each.add_(step * d)
        rolled = found.dynamics.roll_out(actor(layer, mpc), starts, 12)
        with th.no_grad():
            for each, d in zip(weights, direction, strict=True):
                each.sub_(step * d)
        return float(objective.costs(*rolled).mean())

    difference = (cost(1e-5) - cost(-1e-5)) / 2e-5
    assert slope == pytest.approx(difference, rel=1e-3)


def test_a_limit_pushes_back_and_runs_above_a_reference_count_more() -> None:
    found = twin()
    mpc, layer = found.problem, YannLayer(found.problem.explicit())
    starts = found.starts.draw(10, np.random.default_rng(1)).reshape(5, 2, -1)

    def gradient(low, reference=None) -> np.ndarray:
        layer.zero_grad()
        objective = Objective(mpc, np.eye(2), np.full(2, low), np.full(2, np.inf), 100.0)
        accumulate_gradient(layer, found.dynamics, objective, starts, 20, reference)
        return np.concatenate([each.grad.numpy().ravel() for each in layer.network.weights()])

    assert not np.allclose(gradient(-np.inf), gradient(0.5))
    ones = np.ones((5, 2))
    np.testing.assert_allclose(
        gradient(-np.inf, (0 * ones, ones, 3 * ones)), 3 * gradient(-np.inf), rtol=1e-4, atol=1e-6
    )


@pytest.mark.parametrize("options", [{}, {"max_correction": 0.02}])
@pytest.mark.parametrize("make", [twin, rated])
@pytest.mark.parametrize("confined", [False, True])
def test_the_actor_s_slopes_are_those_of_differences_on_bounds_as_well(
    make, options, confined
) -> None:
    problem_ = make().problem
    rate = None
    if problem_.has_rate_bounds:
        rate = problem_.rate.du_min, problem_.rate.du_max
    layer = YannLayer(problem_.explicit(), rate=rate, **options).double()
    generator = th.Generator().manual_seed(0)
    with th.no_grad():
        for each in layer.network.weights():
            each.add_(0.3 * th.randn(each.shape, generator=generator))
    low, high = problem_.theta_min, problem_.theta_max
    if confined:
        layer.confine(0.2 * low, 0.4 * high)
    theta = 0.5 * np.random.default_rng(0).uniform(low, high, (400, problem_.n_theta))
    found, step = _slopes_of_actor(layer, theta), 1e-6

    def actions(at: np.ndarray) -> np.ndarray:
        with th.no_grad():
            return layer(th.as_tensor(at).requires_grad_()).numpy()  # in float64

    for j in range(problem_.n_theta):
        e = step * np.eye(problem_.n_theta)[j]
        slope = (actions(theta + e) - actions(theta - e)) / (2 * step)
        wrong = np.abs(slope - found[..., j]) > 1e-4 * (1 + np.abs(slope))
        assert np.mean(wrong) < 0.01  # of 400 points a few lie on a facet


@pytest.mark.parametrize("make", [twin, rated, observed])
def test_the_slopes_of_an_objective_are_those_of_its_costs_and_its_penalty(make) -> None:
    found, rng = make(), np.random.default_rng(0)
    mpc, row = found.problem, found.dynamics.row
    n, half = mpc.model.n_states, mpc.theta_half[: mpc.model.n_states]
    root = rng.normal(size=(mpc.n_theta, mpc.n_theta))
    low, high = -0.3 * half, 0.4 * half
    objective = Objective(mpc, root @ root.T, low, high, 7.0)
    rows = 0.8 * rng.uniform(-1, 1, (4, 2, 3, row.size)) * half[0]
    inputs = rng.uniform(mpc.u_min, mpc.u_max, (3, 2, 3, mpc.model.n_inputs))

    def total(rows: np.ndarray, inputs: np.ndarray) -> float:
        thetas, x = rows[..., : mpc.n_theta], rows[:-1, ..., row.state]
        stage = mpc.stage_cost(thetas[:-1], inputs).sum(axis=0)
        end = np.einsum("...i,ij,...j", thetas[-1], root @ root.T, thetas[-1])
        np.testing.assert_allclose(objective.costs(rows, inputs), stage + end)
        over = np.maximum(x - high, 0) + np.maximum(low - x, 0)
        return float((stage + end).sum() + 7.0 * np.sum((over / half) ** 2))

    by_rows, by_u = objective.slopes(rows, inputs, row)
    for of, slopes in ((rows, by_rows), (inputs, by_u)):
        direction = rng.normal(size=of.shape)
        ends = []
        for sign in (1, -1):
            moved = of + sign * 1e-6 * direction
            ends.append(total(*((moved, inputs) if of is rows else (rows, moved))))
        slope = (ends[0] - ends[1]) / 2e-6
        assert slope == pytest.approx(float(np.sum(slopes * direction)), rel=1e-6)
    assert n == 2 and np.any(rows[:-1, ..., row.state] > high)


def test_runs_below_a_reference_count_with_one_weight_and_those_above_with_the_other() -> None:
    found = twin()
    mpc, layer, nowhere = found.problem, YannLayer(found.problem.explicit()), np.full(2, np.inf)
    objective = Objective(mpc, np.eye(2), -nowhere, nowhere, 0.0)
    starts = np.random.default_rng(0).uniform(-1, 1, (5, 2, 2))

    def gradient(starts, reference=None) -> np.ndarray:
        layer.zero_grad()
        accumulate_gradient(layer, found.dynamics, objective, starts, 10, reference)
        return np.concatenate([each.grad.numpy().ravel() for each in layer.network.weights()])

    rows = found.dynamics.roll_out(actor(layer, mpc), starts, 10)
    costs = objective.costs(*rows)
    middle = np.broadcast_to(np.array([1.0, -1.0]), costs.shape)  # the second run is above its own
    parts = [gradient(starts[:, [k]]) for k in range(2)]
    mixed = gradient(starts, (costs + middle, np.full((5, 2), 2.0), np.full((5, 2), 5.0)))
    np.testing.assert_allclose(mixed, (2 * parts[0] + 5 * parts[1]) / 2, rtol=1e-3, atol=1e-5)
