"""Where the weights are that an actor or a critic learns: tests ask here, and nowhere else."""

from typing import Any

import numpy as np
import torch as th

from sb3_yann.networks import ZeroOutputNetwork

LARGEST = float(np.finfo(np.float32).max)


def network_of(owner: Any) -> ZeroOutputNetwork:
    """Return the network of an algorithm, a policy, an actor, a layer, a value, or itself."""
    for name in ("policy", "actor", "mu", "network"):
        owner = getattr(owner, name, owner)
    return owner


def is_learnt(name: str) -> bool:
    """Return whether a name of a state_dict is that of a weight, not of the law."""
    return ".network." in name


def is_mpc(owner: Any) -> bool:
    """Return whether the networks are zero for any input: the actor is the MPC."""
    return network_of(owner).is_zero()


@th.no_grad()
def shake(owner: Any, size: float, seed: int = 0) -> None:
    """Add noise of this size to all parameters."""
    generator = th.Generator().manual_seed(seed)
    for each in owner.parameters():
        each += size * th.randn(each.shape, generator=generator, dtype=each.dtype)


@th.no_grad()
def redrawn(owner: Any, size: float, seed: int, poison: float | None = None) -> Any:
    """Give the networks weights of this size, and some that are ``poison``."""
    rng = np.random.default_rng(seed)
    for weight in network_of(owner).parameters():
        drawn = np.clip(size * rng.normal(size=weight.shape), -LARGEST, LARGEST)
        if poison is not None:
            drawn[rng.random(weight.shape) < 0.1] = poison
        weight.copy_(th.as_tensor(drawn, dtype=th.float32))
    return owner


def first_layer(owner: Any) -> th.nn.Parameter:
    """Return weights and, as the last column, biases: (n_regions, n_nodes, out, in + 1)."""
    return network_of(owner).first.nodes


def later_layers(owner: Any) -> th.nn.ModuleList:
    """Return the layers after the first, as modules with a ``weight``."""
    return network_of(owner).rest


def later_layer(owner: Any, number: int) -> th.nn.Parameter:
    """Return weights and, as the last column, biases: (n_regions, out, in + 1)."""
    return later_layers(owner)[number].weight


def last_layer(owner: Any) -> th.nn.Parameter:
    """Return weights and, as the last column, biases: (n_regions, m, in + 1)."""
    return later_layer(owner, -1)


def unpin(owner: Any) -> None:
    """Let every region move its output at the origin."""
    network_of(owner).pinned.zero_()
