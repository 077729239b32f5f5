"""Whether parameters are those of a policy with the same problem, before they are loaded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch as th
from torch import nn

from sb3_yann.networks import AfterstateValue, QuadraticStateActionValue, SharedYannLayer
from sb3_yann.networks.law_layer import LawLayer
from sb3_yann.policy._features import AffineFeatures

FIXED = LawLayer, AfterstateValue, QuadraticStateActionValue, AffineFeatures
"""Modules whose buffers follow from the problem, or from the map to its theta."""
FREE = {"confines", "value_scale"}
"""Buffers of theirs that follow from what was learnt."""
RECENT = {"samples"}
"""Those that earlier saves do not have."""
OF_ORDER_ONE = {"offsets", "resting", "half_space_b", "change"}
"""Those that are in units of a range: zeros among them are not exact."""
ROUNDING, SMALLEST = 1e-6, 1e-9
"""A law that another machine has solved differs by less, of each number and of the largest."""


class OtherProblemError(ValueError, RuntimeError):
    """Parameters are those of another problem than the policy's.

    torch says what does not fit by a RuntimeError, and `DDPG.load` hands on no other.
    """


def require_own_problem(module: nn.Module, state: Mapping[str, Any], strict: bool) -> None:
    """Raise unless what follows from the problem is in a state_dict as it is in the module.

    Parameters
    ----------
    module : Module
        A policy or an actor.
    state : mapping
        What is to be loaded into it.
    strict : bool
        Whether nothing may be missing.
    """
    for name, part in module.named_modules():
        if isinstance(part, FIXED):
            prefix = f"{name}." if name else ""
            if difference := _difference(part, prefix, state, strict):
                raise OtherProblemError(
                    "The parameters are those of a policy with another problem, observation or "
                    f"networks: {difference}. Load that model as a whole, DDPG.load(path), or load "
                    "them into a model that was made with the problem that they were trained with."
                )


def _difference(part: nn.Module, prefix: str, state: Mapping[str, Any], strict: bool) -> str:
    """Return in words what of a state_dict is not a module's own; nothing where all of it is."""
    own = {name: each for name, each in part.named_buffers(recurse=False) if name not in FREE}
    given = {key[len(prefix) :] for key in state if key.startswith(prefix)}
    given = {name for name in given if "." not in name} - FREE
    if strict and (missing := sorted(own.keys() - given - RECENT)):
        return f"there is no {prefix}{missing[0]}"
    if strict and (unknown := sorted(given - own.keys())):
        return f"there is {prefix}{unknown[0]}, which this policy does not have"
    for name in sorted(own.keys() & given):
        value, wanted = state[f"{prefix}{name}"], own[name]
        if value.shape != wanted.shape:
            return f"{prefix}{name} has shape {tuple(value.shape)}, expected {tuple(wanted.shape)}"
        if not th.equal(value.to(wanted), wanted) and not _agree(part, name, value, wanted):
            return f"{prefix}{name} holds other numbers"
    return ""


def _agree(part: nn.Module, name: str, value: th.Tensor, wanted: th.Tensor) -> bool:
    """Return whether numbers are the same but for the rounding of another machine."""
    if isinstance(part, SharedYannLayer) and name == "samples":
        return part.answers_as(value, ROUNDING)
    ours, theirs = wanted.double().cpu(), value.double().cpu()
    size = _largest(ours)
    if name in OF_ORDER_ONE:
        size = max(size, 1.0)
    if name == "middle":  # of the inputs, often zero: in their ranges
        ranges = "half_range" if isinstance(part, LawLayer) else "to_input"
        size = max(size, _largest(part.get_buffer(ranges)))
    return th.allclose(theirs, ours, rtol=ROUNDING, atol=SMALLEST * size)


def _largest(numbers: th.Tensor) -> float:
    return float(numbers[numbers.isfinite()].abs().max()) if numbers.numel() else 0.0
