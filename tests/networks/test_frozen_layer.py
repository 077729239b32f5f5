"""A layer's compiled copy acts as the layer."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_yann.networks import SharedYannLayer, YannLayer
from twin_samples import problem


@pytest.mark.parametrize("kind", [YannLayer, SharedYannLayer])
def test_a_frozen_layer_acts_as_the_layer_and_refuses_another_width(kind: Any) -> None:
    layer = kind(problem().explicit(), (8, 8), max_correction=0.3)
    with th.no_grad():
        for each in layer.network.weights():
            each.add_(0.3 * th.randn(each.shape, generator=th.Generator().manual_seed(0)))
    layer.confine(0.3 * problem().theta_min, 0.4 * problem().theta_max)
    theta = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    theta[7] = np.inf
    with th.no_grad():
        np.testing.assert_array_equal(layer.frozen()(theta), layer(th.as_tensor(theta)).numpy())
    with pytest.raises(ValueError, match=r"theta has shape \(4, 3\), expected \(batch, 2\)"):
        layer.frozen()(np.zeros((4, 3)))
