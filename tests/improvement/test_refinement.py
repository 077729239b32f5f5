"""A policy descends on what its own episodes cost in a model: its gradient is that of the costs."""

import numpy as np
import pytest
import torch as th

from improvement_samples import Spring, model_of, quick
from sb3_yann.improvement import imitation, refinement
from sb3_yann.improvement.imitation import Teacher, controller_of, gain_of, policy_of, refine
from sb3_yann.improvement.model import Scenarios, SimulatorModel
from sb3_yann.improvement.simulator import Simulator


@pytest.fixture
def teacher(monkeypatch) -> Teacher:
    quick(monkeypatch)
    simulator = Simulator(model_of().policy.problem, Spring, 0)
    simulator.begin()
    model = SimulatorModel.fit(simulator.problem, simulator.episodes, None, 0)
    rng = np.random.default_rng(0)
    return Teacher(Scenarios.like(model, simulator.episodes[:4], rng), 0)


def moved_layer():
    layer, generator = model_of(networks="shared").policy.actor.mu, th.Generator().manual_seed(0)
    with th.no_grad():
        for weight in layer.network.weights():
            weight.add_(0.02 * th.randn(weight.shape, generator=generator))
    return layer


def test_the_gradient_is_that_of_differences(teacher, monkeypatch) -> None:
    monkeypatch.setattr(refinement, "OUTLIER", np.inf)
    layer, scenarios, weights = moved_layer(), teacher.scenarios, np.array([1.0, 2.0, 0.0, 0.5])

    def played():
        return scenarios.play(controller_of(policy_of(layer, teacher.problem)))

    def cost() -> float:
        found = played()
        return float(np.mean(weights * teacher.task.costs(found.thetas, found.inputs)))

    refinement.descend(layer, scenarios, teacher.task, played(), weights)
    for weight in layer.network.weights():
        step = weight.grad * 0.02 / weight.grad.norm()
        slope = float((weight.grad * step).sum())
        with th.no_grad():
            weight += step
            above = cost()
            weight -= 2 * step
            below = cost()
            weight += step
        assert slope == pytest.approx((above - below) / 2, rel=0.05, abs=1e-6)


def test_descent_ends_with_weights_that_save_more_than_it_began_with(teacher, monkeypatch) -> None:
    monkeypatch.setattr(imitation, "STEPS", 20)
    layer = moved_layer()

    def gain() -> float:
        found = teacher.scenarios.play(controller_of(policy_of(layer, teacher.problem)))
        return gain_of(found.costs, teacher.mpc.costs)

    before = gain()
    saved = refine(layer, teacher)
    assert saved > before + 1e-4
    assert saved == pytest.approx(gain(), abs=1e-9)
    assert not any(w.grad is not None and w.grad.any() for w in layer.network.weights())
