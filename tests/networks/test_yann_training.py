"""Training a YANN layer, region by region, and what torch and Stable-Baselines3 see of it."""

from __future__ import annotations

import numpy as np
import torch as th

from sample_laws import (
    box_points,
    law_of,
    to_action,
)
from sample_layers import EVERY_LAW, INFEASIBLE, region_of, scrambled, train
from sb3_yann.networks import YannLayer
from weights import network_of

# --- training ----------------------------------------------------------------------------------


@EVERY_LAW
def test_only_the_active_regions_get_a_gradient(name: str) -> None:
    law = law_of(name)
    layer = scrambled(YannLayer(law), 0.1)
    theta = box_points(law, 4000)
    active = int(region_of(layer, theta).mode().values)
    theta = theta[region_of(layer, theta) == active]
    (layer(theta) * th.randn(len(theta), law.n_inputs)).sum().backward()
    others = th.arange(law.n_regions) != active
    for parameter in layer.parameters():
        assert parameter.grad is not None
        assert bool(th.any(parameter.grad[active] != 0))
        assert not th.any(parameter.grad[others])


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


# --- what torch and Stable-Baselines3 see --------------------------------------------------------
