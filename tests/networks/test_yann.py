"""The YANN layer: the explicit law, exactly, and a network for each region, which trains."""

from dataclasses import replace

import numpy as np
import pytest
import torch as th

from sample_laws import (
    EVERY_LAW,
    INFEASIBLE,
    box_points,
    facet_points,
    law_of,
    region_of,
    smallest_slack,
    solved,
    to_action,
    train,
)
from sample_problems import strips
from sb3_yann.networks import YannLayer
from weights import last_layer, network_of

# --- the law -----------------------------------------------------------------------------------


def test_stiff_law_keeps_its_digits() -> None:
    # Terms of 1e4 that cancel to an input of the order of 1: float32 would leave errors of 1e-3.
    law = replace(strips(np.array([-2.0, 2.0])), gains=[[[1e4, 1.0]]], offsets=[[-1e4]])
    theta = th.tensor([1.0, 0.0]) + th.tensor([1e-4, 1.0]) * (2 * th.rand(1000, 2) - 1)
    action = YannLayer(law)(theta).detach()
    assert (action - to_action(law, law(theta.numpy()))).abs().max() < 2e-7


@EVERY_LAW
def test_region_on_a_facet_is_that_of_the_law(name: str) -> None:
    law = law_of(name)
    theta = facet_points(law)
    assert len(theta) > 500
    ours = region_of(YannLayer(law), theta)
    theirs = th.as_tensor(law.locate(theta.numpy()))
    assert th.equal(ours, theirs)
    slack = smallest_slack(law, theta)
    chosen = slack[np.arange(len(theta)), ours.numpy()]
    assert np.max(slack.max(axis=1) - chosen) < 1e-12


def test_points_of_a_facet_that_float32_holds_exactly_go_to_the_first_region() -> None:
    law = replace(strips(np.array([-2.0, -0.5, 0.5, 2.0])), disjoint=False)
    theta = th.tensor([[-0.5, 1.0], [0.5, 1.0], [0.5, -1.0], [0.0, 0.0]])
    assert region_of(YannLayer(law), theta).tolist() == [0, 1, 1, 1]
    assert law.locate(theta.numpy()).tolist() == [0, 1, 1, 1]


@pytest.mark.parametrize("side", [-1, 1])
def test_correction_at_its_bound_gets_the_gradient_that_leads_back_and_no_other(side: int) -> None:
    law = law_of("pendulum")
    layer = YannLayer(law, max_correction=0.1, pinned=False)
    with th.no_grad():  # the bias of the output alone: far beyond the bound
        last_layer(layer)[..., -1] = 3.0 * side
    theta = box_points(law, 4000)
    theta = theta[layer.law(theta).abs()[:, 0] < 0.5]
    bias = last_layer(layer)
    for slope, alive in ((side, True), (-side, False)):  # descent goes against the slope
        layer.zero_grad()
        (slope * layer(theta)).sum().backward()
        assert bias.grad is not None
        assert bool(bias.grad[..., -1].any()) is alive


def test_law_without_input_bounds_is_refused() -> None:
    free = replace(solved("two inputs"), horizon=1, u_min=[-1, -np.inf], u_max=1)
    with pytest.raises(ValueError, match=r"u_min = \[-1\.0, -inf\].*Pass u_min and u_max"):
        YannLayer(free.explicit())


@EVERY_LAW
def test_training_one_region_leaves_the_others_bit_for_bit(name: str) -> None:
    law = law_of(name)
    layer = YannLayer(law)
    theta = box_points(law, 4000, stretch=1.5)
    region = region_of(layer, theta)
    trained = region == region.mode().values
    before = layer(theta).detach()
    train(layer, theta[trained], target=0.3)
    after = layer(theta).detach()
    assert th.equal(after[~trained], before[~trained])
    assert not th.equal(after[trained], before[trained])


@INFEASIBLE
@EVERY_LAW
def test_equilibrium_is_where_it_was_after_training(name: str, infeasible: str) -> None:
    law = law_of(name, infeasible)
    layer = YannLayer(law)
    origin = th.zeros(1, law.n_theta)
    at_rest = to_action(law, np.zeros((1, law.n_inputs))).float()
    th.testing.assert_close(layer(origin), at_rest, rtol=0, atol=1e-7)
    before = layer(origin).detach()
    theta = th.cat([box_points(law, 500), 0.01 * box_points(law, 500), origin])
    train(layer, theta, target=0.3, steps=50)
    assert th.equal(layer(origin), before)
    assert (layer(theta) - layer.law(theta)).abs().max() > 0.01  # it has learnt something


def test_region_away_from_the_origin_is_not_pinned() -> None:
    law = law_of("pendulum")
    pinned = network_of(YannLayer(law)).pinned.flatten().bool()
    assert int(pinned.sum()) == 1
    assert bool(pinned[law.locate(np.zeros(2))])
