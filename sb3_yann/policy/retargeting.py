"""Gives a model another MPC of the same plant, with what a shared network has learnt."""

from __future__ import annotations

import inspect
import warnings
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_yann._validation import check_type
from sb3_yann.control import LinearMPC
from sb3_yann.networks import SharedYannLayer
from sb3_yann.networks.yann import LawLayer
from sb3_yann.policy.policies import StartsAsMPC, require_yann_policy
from sb3_yann.policy.spread import SpreadActor

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
    old = policy.problem
    _require_same_theta(old, mpc)
    names = inspect.signature(type(model).__init__).parameters
    own = {name: getattr(model, name) for name in names if hasattr(model, name)}
    own["policy"] = type(policy)
    own["policy_kwargs"] = {**model.policy_kwargs, "problem": mpc}
    own["env"] = model.get_env() if env is None else env
    found = type(model)(**own)
    lost = _lost(model, policy)
    actor: Any = found.policy.actor
    layer, kept = policy.actor.mu, actor.mu
    if layer.network.is_zero():
        pass
    elif not isinstance(layer, SharedYannLayer) or not isinstance(kept, SharedYannLayer):
        lost.insert(0, "the networks of single regions, which the new law does not have")
    else:
        _hand_over(layer, kept)
    _hand_over_spread(model, policy.actor, found, actor)
    target: Any = found.policy.actor_target
    target.load_state_dict(actor.state_dict())
    if lost:
        warnings.warn(f"What was learnt and is not kept: {'; '.join(lost)}.", stacklevel=2)
    return found


def _require_same_theta(old: LinearMPC, new: LinearMPC) -> None:
    if old.layout != new.layout:
        raise ValueError(
            f"theta of the MPC is {[*new.layout.names]}, that of the model "
            f"{[*old.layout.names]}: a correction needs the same entries. Make a new model."
        )
    was, is_now = (np.concatenate([each.model.x_ss, each.model.u_ss]) for each in (old, new))
    if not np.array_equal(was, is_now):
        raise ValueError(
            f"The operating point of the MPC is {is_now.tolist()}, that of the model "
            f"{was.tolist()}: a correction counts from it. Keep x_ss and u_ss."
        )


def _lost(model: BaseAlgorithm, policy: StartsAsMPC) -> list[str]:
    """Return in words what a new model has not got, of what was learnt."""
    lost = []
    if int(policy.critic_updates):
        lost.append("the critic, which is of the old law and costs")
    buffer: Any = getattr(model, "replay_buffer", None)
    if buffer is not None and buffer.size():
        lost.append("the replay buffer, whose rewards are of before")
    if getattr(model, "guard_state", None) is not None:
        lost.append("the guard's accepted policies")
    return lost


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
