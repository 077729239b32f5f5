"""Checkpoints of an actor, and what a model of another MPC takes over from it."""

from __future__ import annotations

import copy
import hashlib
import inspect
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from sb3_yann._validation import check_type, warn
from sb3_yann.control import LinearMPC
from sb3_yann.networks import SharedYannLayer
from sb3_yann.networks.yann import LawLayer
from sb3_yann.policy.exploring import SpreadActor
from sb3_yann.policy.policies import StartsAsMPC, require_yann_policy

Tensors = dict[str, th.Tensor]


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
        # 1e9: parameters beyond this count as diverged: the actor's sums could overflow.
        small = [bool((each.abs() <= 1e9).all()) for each in self.networks().values()]
        return not all(small)  # nor does nan pass

    def has_learned(self) -> bool:
        """Return whether the networks correct the MPC anywhere."""
        return any(
            # Pairs of opposite sign, and biases of later layers.
            bool((value.sum(1) if name.endswith(".nodes") else value[..., -1]).any())
            for name, value in self.networks().items()
        )

    def is_actor_of(self, policy: StartsAsMPC) -> bool:
        """Return whether the policy's actor is still that of the checkpoint, bit for bit."""
        now = {name: value.cpu() for name, value in policy.actor.state_dict().items()}
        alike = all(th.equal(value, now[name]) for name, value in self.actor.items())
        return alike and _have_same_box(self.actor, now)

    def has_networks_of(self, other: ActorCheckpoint) -> bool:
        """Return whether both hold the same networks, whatever their optimizers remember."""
        return not self.changed_regions(other).any()

    def changed_regions(self, other: ActorCheckpoint) -> NDArray[np.bool_]:
        """Return in which regions (regions,) both may act differently: all, in different boxes."""
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
        """Return a copy, box and all, with another's networks of some regions and their moments."""
        index = th.tensor(sorted(regions), dtype=th.long)
        mixed = copy.deepcopy(self)
        for ours, theirs in ((mixed.actor, other.actor), (mixed.target, other.target)):
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
        """Return a copy with weights a share of the way to another's, and the other's optimizer."""
        mixed = replace(copy.deepcopy(self), optimizer=copy.deepcopy(other.optimizer))
        for ours, theirs in ((mixed.actor, other.actor), (mixed.target, other.target)):
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
    weights = {name: each.clone() for name, each in policy.state_dict().items()}
    networks = policy.actor, policy.critic
    return weights, [copy.deepcopy(each.optimizer.state_dict()) for each in networks]


def restore_whole(policy: StartsAsMPC, whole: tuple[Tensors, list[Any]]) -> None:
    """Give a policy back what :func:`whole_policy` copied."""
    weights, states = whole
    policy.load_state_dict(weights)
    for network, state in zip((policy.actor, policy.critic), states, strict=True):
        network.optimizer.load_state_dict(copy.deepcopy(state))


def _have_same_box(ours: Tensors, theirs: Tensors) -> bool:
    """Return whether the networks of two actors count in the same box, and keep as far inside."""
    boxes = (name for name in ours if name.endswith(("confines", "margin")))
    return all(th.equal(ours[name], theirs[name]) for name in boxes)


def _copied(value: Any) -> Any:
    if isinstance(value, th.Tensor):
        return value.detach().to("cpu", copy=True)
    if isinstance(value, dict):
        return {key: _copied(each) for key, each in value.items()}
    return copy.deepcopy(value)


Model = TypeVar("Model", bound=BaseAlgorithm)


def retarget(model: Model, mpc: LinearMPC, env: Any = None) -> Model:
    """Return a new model whose policy is another MPC plus the correction that was learnt.

    The MPC may have other weights, bounds or a longer horizon, with the same theta. A shared
    network adds to its law what it added to the other one, in units of the inputs; SAC, TQC and PPO
    keep their spread as well, and SAC and TQC the weight of the entropy. The critic is the new
    law's, an :class:`ImprovementGuard` begins anew, and the model that was given stays as it is.
    Whether the correction is still worth having is for a guard or `improve` to say.

    Parameters
    ----------
    model : DDPG, TD3, SAC, TQC or PPO
        With a YANN policy.
    mpc : LinearMPC
        With the same entries of theta and the same operating point.
    env : gymnasium.Env or VecEnv, optional
        Where it goes on; by default that of the model. A `StageCost` in it should be of the new
        MPC.

    Warns
    -----
    UserWarning
        Which names what was learnt and cannot be kept.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from stable_baselines3 import DDPG
    >>> model = DDPG("YannPolicy", "CSTR-v0", policy_kwargs={"networks": "shared"}, device="cpu")
    >>> problem = model.policy.problem
    >>> other = retarget(model, replace(problem, R=4 * problem.R))
    >>> bool((other.policy.problem.R == 4 * problem.R).all())
    True
    """
    check_type("model", model, BaseAlgorithm, "a model with a YannPolicy")
    policy = require_yann_policy(model.policy, "retarget")
    check_type("mpc", mpc, LinearMPC, "a LinearMPC")
    _require_same_theta(policy.problem, mpc)
    names = inspect.signature(type(model).__init__).parameters
    own = {name: getattr(model, name) for name in names if hasattr(model, name)}
    own["policy"] = type(policy)
    own["policy_kwargs"] = {**model.policy_kwargs, "problem": mpc}
    own["env"] = model.get_env() if env is None else env
    found = type(model)(**own)
    buffer: Any = getattr(model, "replay_buffer", None)
    learnt = {
        "the critic, which is of the old law and costs": int(policy.critic_updates) > 0,
        "the replay buffer, whose rewards are of before": buffer is not None and buffer.size() > 0,
        "the guard's accepted policies": getattr(model, "guard_state", None) is not None,
    }
    lost = [what for what, is_there in learnt.items() if is_there]
    actor: Any = found.policy.actor
    layer = policy.actor.mu
    if not layer.network.is_zero():
        if isinstance(layer, SharedYannLayer) and isinstance(actor.mu, SharedYannLayer):
            _hand_over(layer, actor.mu)
        else:
            lost.insert(0, "the networks of single regions, which the new law does not have")
    _hand_over_spread(model, policy.actor, found, actor)
    target: Any = found.policy.actor_target
    target.load_state_dict(actor.state_dict())
    if lost:
        warn(f"What was learnt and is not kept: {'; '.join(lost)}.")
    return found


def _require_same_theta(old: LinearMPC, new: LinearMPC) -> None:
    if old.layout != new.layout:
        raise ValueError(
            f"theta of the MPC is {[*new.layout.names]}, that of the model "
            f"{[*old.layout.names]}: a correction needs the same entries. Make a new model."
        )
    if not np.array_equal(old.tracking.C, new.tracking.C):
        raise ValueError(
            f"The MPC tracks the outputs {new.tracking.C.tolist()} x, the model "
            f"{old.tracking.C.tolist()} x: a correction needs the same set-points."
        )
    was, is_now = (np.concatenate([each.theta_ss, each.model.u_ss]) for each in (old, new))
    if not np.array_equal(was, is_now):
        raise ValueError(
            f"The operating point of the MPC is {is_now.tolist()}, that of the model "
            f"{was.tolist()}: a correction counts from it. Keep x_ss, u_ss and d_ss."
        )


@th.no_grad()
def _hand_over_spread(old: Any, old_actor: Any, new: Any, new_actor: Any) -> None:
    """Give a model the spread of another one's actions, in units of the inputs, and its weight."""
    if isinstance(old_actor, SpreadActor):
        laws = old_actor.mu.base_law, new_actor.mu.base_law
        ranges = [each.u_max - each.u_min for each in laws]
        log_std = old_actor.log_std
        new_actor.log_std.copy_(log_std + th.as_tensor(np.log(ranges[0] / ranges[1])).to(log_std))
    if getattr(old, "log_ent_coef", None) is not None:
        new.log_ent_coef.copy_(old.log_ent_coef)


@th.no_grad()
def _hand_over(old: LawLayer, new: LawLayer) -> None:
    """Give a layer the correction of another one, as a function of theta, in units of the inputs.

    Networks take theta in half-widths of its box, and put out half-ranges of the inputs.
    """
    ratio = new.theta_half.double() / old.theta_half.double()
    first, *rest = (each.detach().clone() for each in old.network.weights())
    nodes = first.double()
    nodes[..., :-1] *= ratio
    ranges = [each.base_law.u_max - each.base_law.u_min for each in (old, new)]
    rest[-1] *= th.as_tensor(ranges[0] / ranges[1])[:, None].to(rest[-1])
    for weight, value in zip(new.network.weights(), (nodes, *rest), strict=True):
        weight.copy_(value)
    new.confines.copy_(old.confines)
    new._keep_constants()


def fingerprint(module: nn.Module) -> str:
    """Return the SHA-256 of a module's tensors, whatever their order and device."""
    found = hashlib.sha256()
    for name, each in sorted(module.state_dict().items()):
        found.update(name.encode())
        found.update(np.ascontiguousarray(each.cpu().numpy()).tobytes())
    return found.hexdigest()


def is_confirmed(model: Any) -> bool:
    """Return whether a guard, `improve` or a commissioning has accepted the policy as it is."""
    policy = model.policy
    state = getattr(model, "guard_state", None)
    if state is not None and state.accepted.is_actor_of(policy):
        return True
    improved = [each for each in getattr(model, "improvements", ()) if each.accepted]
    commissioned = getattr(model, "commissioned", None)
    records = improved[-1:] + [commissioned] * (commissioned is not None and commissioned.accepted)
    now = fingerprint(policy.actor)
    return any(each.policy == now for each in records)
