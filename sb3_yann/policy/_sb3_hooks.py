"""What a policy does around SB3: ask for its algorithm or env, and step at a rate of its own."""

from __future__ import annotations

import sys
from types import FrameType
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm


def algorithm_under_construction(lr_schedule: Any) -> BaseAlgorithm | None:
    """Return the algorithm that is building a policy, None where nobody is.

    SB3 hands a policy its spaces and its learning rate, but not the discount, which the critic
    needs to be exact; so the whole call stack is asked, whatever decorators and factories are on
    the way. The algorithm is the one whose `_setup_model` is running, or that holds the learning
    rate. Called from a policy's `__init__` only.
    """
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        held = frame.f_locals
        caller = held.get("self")
        if frame.f_code.co_name == "_setup_model" and isinstance(caller, BaseAlgorithm):
            return caller
        for each in held.values():
            if isinstance(each, BaseAlgorithm):
                if getattr(each, "lr_schedule", None) is lr_schedule:
                    return each
        frame = frame.f_back
    return None


def own_policy_kwargs(algorithm: BaseAlgorithm | None) -> dict[str, Any]:
    """Return the keywords that an algorithm saves, to be changed; no longer the user's own dict."""
    if algorithm is None:
        return {}
    algorithm.policy_kwargs = dict(algorithm.policy_kwargs)
    return algorithm.policy_kwargs


def multiply_learning_rate(optimizer: th.optim.Optimizer, factor: float) -> None:
    """Make one step use ``factor`` times the rate that SB3 keeps setting."""
    for group in optimizer.param_groups:
        group["scheduled_lr"] = group["lr"]
        group["lr"] = factor * group["lr"]


def restore_learning_rate(optimizer: th.optim.Optimizer, *_: Any) -> None:
    """Undo :func:`multiply_learning_rate` after the step."""
    for group in optimizer.param_groups:
        group["lr"] = group.pop("scheduled_lr")
