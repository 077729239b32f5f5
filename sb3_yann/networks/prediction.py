"""The prediction in a critic: the linear model, or a differentiable one of the user's."""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch as th
from torch import nn

from sb3_yann._validation import Array

PredictionModel = Callable[[th.Tensor, th.Tensor], th.Tensor]
"""``(theta, u) -> next theta``: (batch, n), (batch, m) to (batch, n), float64, physical units."""


class LinearPrediction(nn.Module):
    """``(theta, u) -> A theta + B u``, from :attr:`LinearMPC.prediction`.

    Examples
    --------
    >>> import numpy as np
    >>> predict = LinearPrediction(np.eye(1), np.ones((1, 1)))
    >>> predict(th.ones(1, 1).double(), th.ones(1, 1).double()).tolist()
    [[2.0]]
    """

    A: th.Tensor
    B: th.Tensor

    def __init__(self, A: Array, B: Array) -> None:
        super().__init__()
        self.register_buffer("A", th.as_tensor(A.T.copy()))
        self.register_buffer("B", th.as_tensor(B.T.copy()))

    def forward(self, theta: th.Tensor, u: th.Tensor) -> th.Tensor:
        """Return the predicted next theta, (batch, n)."""
        return theta @ self.A + u @ self.B


def require_prediction(model: PredictionModel, n: int, m: int) -> None:
    """Raise unless the model returns a next theta for each row that depends on u."""
    batch = n + m + 1  # no other size of the problem, so that a mistaken axis shows
    theta = th.zeros(batch, n, dtype=th.float64)
    u = th.zeros(batch, m, dtype=th.float64, requires_grad=True)
    with th.enable_grad():
        predicted = model(theta, u)
    if not isinstance(predicted, th.Tensor) or predicted.shape != theta.shape:
        shape = getattr(predicted, "shape", type(predicted).__name__)
        raise ValueError(
            f"The prediction model returned {shape} for theta ({batch}, {n}) and u ({batch}, {m}); "
            f"it must return the next theta, shape ({batch}, {n})."
        )
    if not bool(th.isfinite(predicted).all()):
        raise ValueError(f"The prediction model returned {predicted[0].tolist()} for zeros.")
    if not predicted.requires_grad:
        raise ValueError(
            "The prediction has no gradient with respect to u, by which the actor learns: compute "
            "it by operations of torch on u itself, without detach or numpy."
        )


def untrained(model: nn.Module) -> nn.Module:
    """Return a copy with buffers for parameters: no optimizer or target update moves those."""
    model = copy.deepcopy(model).double()
    for module in model.modules():
        for name, parameter in [*module.named_parameters(recurse=False)]:
            delattr(module, name)
            module.register_buffer(name, parameter.detach())
    return model
