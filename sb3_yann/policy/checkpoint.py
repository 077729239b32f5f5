"""Checkpoints of an actor, its target and its optimizer."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_yann.policy.policies import StartsAsMPC

Tensors = dict[str, th.Tensor]
DIVERGED_SIZE = 1e9
"""Parameters beyond this count as diverged: the actor's sums could overflow."""
OFF = th.tensor(-1.0, dtype=th.float64)
"""The margin of an actor that was stored before there were any."""


@dataclass(frozen=True)
class ActorCheckpoint:
    """All that an actor needs to act and to go on learning, on the CPU: it loads anywhere."""

    actor: Tensors
    target: Tensors
    optimizer: dict[str, Any]

    @classmethod
    def of(cls, policy: StartsAsMPC) -> ActorCheckpoint:
        """Return a copy of the policy's present actor, its target and its optimizer."""
        return cls(
            _copied(policy.actor.state_dict()),
            _copied(policy.actor_target.state_dict()),
            _copied(policy.actor.optimizer.state_dict()),
        )

    @classmethod
    def of_mpc(cls, policy: StartsAsMPC) -> ActorCheckpoint:
        """Return the MPC itself: the policy where it has learnt nothing, else as a new one."""
        if policy.actor.mu.network.is_zero():
            return cls.of(policy)
        actor = _copied(policy.make_actor().state_dict())
        optimizer = {**policy.actor.optimizer.state_dict(), "state": {}}
        return cls(actor, _copied(actor), _copied(optimizer))

    def restore(self, policy: StartsAsMPC) -> None:
        """Restore actor, target and optimizer, bit for bit."""
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

    def has_diverged(self) -> bool:
        """Return whether a trainable parameter is not a finite number, or too large."""
        largest = [each.abs().max() for each in self.networks().values()]
        return not all(bool(each <= DIVERGED_SIZE) for each in largest)  # nor does nan pass

    def has_learned(self) -> bool:
        """Return whether the networks correct the MPC anywhere."""
        for name, value in self.networks().items():
            if not name.endswith(".nodes"):
                if th.any(value[..., -1] != 0):  # biases of later layers
                    return True
                continue
            half = value.shape[1] // 2  # nodes in pairs of opposite sign, and perhaps one more
            pairs = value[:, :half] + value[:, half : 2 * half]
            if th.any(th.cat([pairs, value[:, 2 * half :]], dim=1).sum(dim=1) != 0):
                return True
        return False

    def is_actor_of(self, policy: StartsAsMPC) -> bool:
        """Return whether the policy's actor is still that of the checkpoint, bit for bit."""
        now = {name: value.cpu() for name, value in policy.actor.state_dict().items()}
        alike = all(th.equal(value, now[name]) for name, value in self.actor.items())
        return alike and _have_same_box(self.actor, now)

    def has_networks_of(self, other: ActorCheckpoint) -> bool:
        """Return whether both hold the same networks, whatever their optimizers remember."""
        return not self.changed_regions(other).any()

    def changed_regions(self, other: ActorCheckpoint) -> NDArray[np.bool_]:
        """Return in which regions both may act differently, shape (regions,).

        Where their networks count in different boxes of theta, in all.
        """
        return self.changed_networks(other) | (not self.is_confined_as(other))

    def changed_networks(self, other: ActorCheckpoint) -> NDArray[np.bool_]:
        """Return in which regions the networks of both differ, shape (regions,)."""
        networks = other.networks()
        pairs = ((value, networks[name]) for name, value in self.networks().items())
        different = [(ours != theirs).flatten(1).any(1) for ours, theirs in pairs]
        return np.asarray(th.stack(different).any(0).numpy())

    def is_confined_as(self, other: ActorCheckpoint) -> bool:
        """Return whether the networks of both count in the same box of theta."""
        return _have_same_box(self.actor, other.actor)

    def with_regions(self, other: ActorCheckpoint, regions: Iterable[int]) -> ActorCheckpoint:
        """Return a copy with the networks of some regions, and their moments, from another.

        They count in the same box of theta as before.
        """
        index = th.tensor(sorted(regions), dtype=th.long)
        mixed = copy.deepcopy(self)
        for name in ("actor", "target"):
            ours, theirs = getattr(mixed, name), getattr(other, name)
            for key in self.networks():
                ours[key][index] = theirs[key][index]
        ours = mixed.optimizer["state"]
        for key, state in other.optimizer["state"].items():
            # A parameter without moments has not been stepped yet: they are zero.
            known = ours.setdefault(key, {k: th.zeros_like(v) for k, v in state.items()})
            for entry, value in state.items():
                if value.dim() > 1:
                    known[entry][index] = value[index]
                else:  # the number of steps, or a spread: all regions share it
                    known[entry].copy_(value)
        return mixed

    def part_way(self, other: ActorCheckpoint, share: float) -> ActorCheckpoint:
        """Return a copy whose networks' weights are a share of the way to another's.

        The optimizer is the other's.
        """
        mixed = replace(copy.deepcopy(self), optimizer=copy.deepcopy(other.optimizer))
        for name in ("actor", "target"):
            ours, theirs = getattr(mixed, name), getattr(other, name)
            for key in self.networks():
                ours[key] = th.lerp(ours[key], theirs[key], share)
        return mixed

    def shrunk(self, share: float) -> ActorCheckpoint:
        """Return a copy whose networks add a share of what they add to the MPC's law."""
        mixed = copy.deepcopy(self)
        last = [key for key in self.networks() if ".network.rest." in key][-1]
        for tensors in (mixed.actor, mixed.target):
            tensors[last] = share * tensors[last]
        return mixed


@contextmanager
def all_or_nothing(policy: StartsAsMPC) -> Iterator[None]:
    """Undo what happens to a policy's weights and optimizers, if an error or Ctrl-C cuts it off."""
    whole = whole_policy(policy)
    try:
        yield
    except BaseException:
        restore_whole(policy, whole)
        raise


def whole_policy(policy: StartsAsMPC) -> tuple[Tensors, list[Any]]:
    """Return a copy of a policy's weights, and of its optimizers' states."""
    optimizers = policy.actor.optimizer, policy.critic.optimizer
    weights = {name: each.clone() for name, each in policy.state_dict().items()}
    return weights, [copy.deepcopy(each.state_dict()) for each in optimizers]


def restore_whole(policy: StartsAsMPC, whole: tuple[Tensors, list[Any]]) -> None:
    """Give a policy back what :func:`whole_policy` copied."""
    weights, states = whole
    policy.load_state_dict(weights)
    optimizers = policy.actor.optimizer, policy.critic.optimizer
    for optimizer, state in zip(optimizers, states, strict=True):
        optimizer.load_state_dict(copy.deepcopy(state))


def _have_same_box(ours: Tensors, theirs: Tensors) -> bool:
    """Return whether the networks of two actors count in the same box, and keep as far inside."""
    boxes = (name for name in ours if name.endswith(("confines", "margin")))
    return all(th.equal(ours[name], theirs.get(name, OFF)) for name in boxes)


def _copied(value: Any) -> Any:
    if isinstance(value, th.Tensor):
        return value.detach().to("cpu", copy=True)
    if isinstance(value, dict):
        return {key: _copied(each) for key, each in value.items()}
    return copy.deepcopy(value)
