"""What pictures are drawn from: entries of theta by name, and the inputs of a law or policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.model.labels import labels_of

Quantity = int | str


def entry_of(problem: LinearMPC, quantity: Quantity, inputs: bool = False) -> int:
    """Return the entry of ``[theta, u]`` that a name or an index stands for; ValueError for none.

    Inputs follow theta, and count only where they are asked for.
    """
    names = [*problem.labels(), *(labels_of(problem.model)[1] if inputs else ())]
    if isinstance(quantity, str) and quantity in names:
        return names.index(quantity)
    if isinstance(quantity, int | np.integer) and 0 <= quantity < len(names):
        return int(quantity)
    raise ValueError(f"{quantity!r} is no entry: expected one of {names}, or its index.")


def inputs_of(problem: LinearMPC, policy: Any, theta: Array) -> Array:
    """Return the inputs (batch, m), in deviations, of a law or a policy at theta (batch, n_theta).

    Parameters
    ----------
    problem : LinearMPC
        With the range of the inputs.
    policy : callable, model or YannPolicy
        A law takes theta. Of a model, or its policy, the actor's layer does.
    theta : ndarray, shape (batch, n_theta)
        In deviations.
    """
    actor = getattr(getattr(policy, "policy", policy), "actor", None)
    if actor is None:
        return np.asarray(policy(theta), np.float64).reshape(len(theta), -1)
    device = next(actor.mu.buffers()).device
    with th.no_grad():
        scaled = actor.mu(th.as_tensor(theta, device=device)).double().cpu().numpy()
    return np.asarray(
        (problem.deviations.u_max + problem.deviations.u_min) / 2 + problem.u_half * scaled
    )
