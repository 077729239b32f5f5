"""YANN layers with random weights, and a few steps of training."""

import pytest
import torch as th

from sample_laws import (
    PROBLEMS,
)
from sb3_yann.networks import YannLayer

EVERY_LAW = pytest.mark.parametrize("name", PROBLEMS)
INFEASIBLE = pytest.mark.parametrize("infeasible", ["nearest_region", "zero_input"])


def scrambled(layer: YannLayer, size: float = 1.0) -> YannLayer:
    """The layer with random weights, as after much training."""
    for parameter in layer.parameters():
        th.nn.init.normal_(parameter, std=size)
    return layer


def region_of(layer: YannLayer, theta: th.Tensor) -> th.Tensor:
    return layer.locate(theta)[0]


def train(layer: YannLayer, theta: th.Tensor, target: float, steps: int = 20) -> None:
    optimizer = th.optim.Adam(layer.parameters(), 1e-2)
    for _ in range(steps):
        optimizer.zero_grad()
        (layer(theta) - target).square().mean().backward()
        optimizer.step()


def by_loops_and_by_torch(layer: YannLayer, theta: th.Tensor) -> th.Tensor:
    """Assert that compiled loops and torch give the same actions and gradients; return actions."""
    found = []
    for compiles in (True, False):
        layer.network.has_loops = compiles
        layer.zero_grad()
        actions = layer(theta)
        (actions - 0.3).square().sum().backward()
        found.append([actions, *[each.grad.clone() for each in layer.network.weights()]])
    for ours, theirs in zip(*found, strict=True):
        th.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)
    return found[0][0]
