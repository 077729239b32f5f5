"""Copies of an actor, its target and its optimizer, and putting them back, whole or in part."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_yann.policy.policies import YannPolicy

Tensors = dict[str, th.Tensor]


@dataclass(frozen=True)
class ActorCheckpoint:
    """What makes an actor and its learning go on as if nothing had happened since.

    It lies in the main memory, so that a model saved on one device loads on another.
    """

    actor: Tensors
    target: Tensors
    optimizer: dict[str, Any]

    @classmethod
    def of(cls, policy: YannPolicy) -> ActorCheckpoint:
        """Return a copy of the policy's present actor, its target and its optimizer."""
        return cls(
            _copied(policy.actor.state_dict()),
            _copied(policy.actor_target.state_dict()),
            _copied(policy.actor.optimizer.state_dict()),
        )

    @classmethod
    def of_parts(cls, actor: Tensors, optimizer: dict[str, Any]) -> ActorCheckpoint:
        """Return a copy of an actor that is its own target, and of an optimizer."""
        return cls(_copied(actor), _copied(actor), _copied(optimizer))

    def restore(self, policy: YannPolicy) -> None:
        """Put them back, bit for bit."""
        policy.actor.load_state_dict(self.actor)
        policy.actor_target.load_state_dict(self.target)
        policy.actor.optimizer.load_state_dict(copy.deepcopy(self.optimizer))

    @property
    def size(self) -> int:
        """Bytes of the actor, its target and two moments of each trained parameter."""
        stored = [*self.actor.values(), *self.target.values(), *2 * [*self.networks().values()]]
        return sum(each.numel() * each.element_size() for each in stored)

    def networks(self) -> Tensors:
        """Return the actor's trainable parameters; the first axis of each is the region."""
        return {
            name: value
            for name, value in self.actor.items()
            if ".network." in name and not name.endswith("pinned")
        }

    def with_regions(self, other: ActorCheckpoint, regions: Iterable[int]) -> ActorCheckpoint:
        """Return a copy that has the networks of some regions, with their moments, from other."""
        index = th.tensor(sorted(regions), dtype=th.long)
        mixed = copy.deepcopy(self)
        for name in ("actor", "target"):
            ours, theirs = getattr(mixed, name), getattr(other, name)
            for key in self.networks():
                _copy_rows(ours[key], theirs[key], index)
        ours, theirs = mixed.optimizer["state"], other.optimizer["state"]
        for key, state in theirs.items():
            # A parameter without moments has not been stepped yet: they are zero.
            known = ours.setdefault(key, {k: th.zeros_like(v) for k, v in state.items()})
            for entry, value in state.items():
                if value.dim() > 0:
                    _copy_rows(known[entry], value, index)
                else:  # the number of steps, which all regions share
                    known[entry].copy_(value)
        return mixed


def _copied(value: Any) -> Any:
    if isinstance(value, th.Tensor):
        return value.detach().to("cpu", copy=True)
    if isinstance(value, dict):
        return {key: _copied(each) for key, each in value.items()}
    return copy.deepcopy(value)


def _copy_rows(ours: th.Tensor, theirs: th.Tensor, index: th.Tensor) -> None:
    ours[index] = theirs[index]


def same(checkpoint: ActorCheckpoint, policy: YannPolicy) -> bool:
    """Return whether the policy's actor is still that of the checkpoint, bit for bit."""
    now = policy.actor.state_dict()
    return all(th.equal(value, now[name].cpu()) for name, value in checkpoint.actor.items())


def same_networks(one: ActorCheckpoint, other: ActorCheckpoint) -> bool:
    """Return whether both hold the same actor, whatever its optimizer remembers."""
    networks = other.networks()
    return all(th.equal(value, networks[name]) for name, value in one.networks().items())


def changed(before: ActorCheckpoint, after: ActorCheckpoint) -> NDArray[np.bool_]:
    """Return in which regions the network is another one, shape (regions,)."""
    networks = after.networks()
    different = [
        (value != networks[name]).flatten(1).any(1) for name, value in before.networks().items()
    ]
    return np.asarray(th.stack(different).any(0).numpy())
