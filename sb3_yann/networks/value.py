"""State-action values that are those of the linear plant, exactly, until they are trained."""

from __future__ import annotations

import copy
import operator
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_yann._validation import Array, check_positive
from sb3_yann.networks.zero_output import Activation, ZeroOutputNetwork, register_constants

PredictionModel = Callable[[th.Tensor, th.Tensor], th.Tensor]
"""``(theta, u) -> next theta``: (batch, n), (batch, m) to (batch, n), float64, physical units."""


@dataclass(frozen=True)
class Ranges:
    """What a value is scaled by: the box of theta and the range of the inputs.

    Parameters
    ----------
    theta_half : ndarray, shape (n,)
        Half the width of the box of theta.
    u_min, u_max : ndarray, shape (m,)
        The inputs at action -1 and 1.

    Examples
    --------
    >>> Ranges(np.ones(2), u_min=np.zeros(1), u_max=np.ones(1)).u_half
    array([0.5])
    """

    theta_half: Array
    u_min: Array
    u_max: Array

    @property
    def u_half(self) -> Array:
        """Half the ranges of the inputs, (m,)."""
        return (self.u_max - self.u_min) / 2

    @property
    def u_middle(self) -> Array:
        """The inputs at action 0, (m,)."""
        return (self.u_max + self.u_min) / 2

    def scale(self, size: int) -> Array:
        """Return what networks multiply theta by, (size,): zero for ones that follow it."""
        return np.append(1 / self.theta_half, np.zeros(size - len(self.theta_half)))


def with_one(points: th.Tensor, n: int) -> th.Tensor:
    """Return rows ``[theta, 1, a]`` for rows ``[theta, a]`` with theta (batch, n)."""
    return th.cat([points[:, :n], points.new_ones(len(points), 1), points[:, n:]], dim=1)


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
        register_constants(self, A=A.T, B=B.T)

    def forward(self, theta: th.Tensor, u: th.Tensor) -> th.Tensor:
        """Return the predicted next theta, (batch, n)."""
        return theta @ self.A + u @ self.B


class QuadraticForm(nn.Module):
    """``z -> z' M z``, trainable, for M (k, k) in scaled entries: ``M = D M^ D``.

    ``D = sqrt(|diag M|)`` is constant. The raw entries span many orders of magnitude, and equal
    steps of Adam would flip the smallest ones. ``scale`` (k,) stands for the root of a zero: one
    over the size of an entry of z that costs nothing at first.
    """

    root: th.Tensor

    def __init__(self, M: Array, scale: Array | None = None) -> None:
        super().__init__()
        diagonal = np.abs(np.diag(M))
        one = np.ones_like(diagonal) if scale is None else np.where(scale > 0, scale, 1.0)
        root = np.where(diagonal > 0, np.sqrt(diagonal), one)
        # Float64: along the law the terms of the form cancel, by a factor of up to some hundreds.
        entries = np.array(M / np.outer(root, root), order="C")
        self.entries = nn.Parameter(th.as_tensor(entries, dtype=th.float64))
        self.register_buffer("root", th.as_tensor(root))

    def forward(self, z: th.Tensor) -> th.Tensor:
        """Return the form, shape (batch, 1), for z of shape (batch, k) in float64."""
        weighted = z * self.root
        form: th.Tensor = ((weighted @ self.entries) * weighted).sum(-1, keepdim=True)
        return form


class _StateActionValue(nn.Module):
    """A quadratic form plus a network, of rows ``[theta, a]``; a 1 follows theta in priced ones."""

    to_input: th.Tensor
    middle: th.Tensor
    network_scale: th.Tensor
    n_before_one: int
    quadratic: QuadraticForm
    network: ZeroOutputNetwork

    def weights(self) -> tuple[nn.Parameter, ...]:
        """Return all that is trained: the entries of the form, and the network's weights."""
        modules: Any = self._modules  # an attribute of a module takes a microsecond to find
        return (modules["quadratic"].entries, *modules["network"].weights())

    def _completed(self, theta_and_action: th.Tensor) -> th.Tensor:
        n = self.n_before_one
        return with_one(theta_and_action, n) if n else theta_and_action


class QuadraticStateActionValue(_StateActionValue):
    """``Q(theta, a) = -[theta; u]' M [theta; u] + network``: u now, the law ever after.

    The critic of Braniff & Tian, Section 4.2. ``u`` is the input in physical units for an action
    ``a`` in [-1, 1]. Only exploration shows this network how Q depends on a.

    Parameters
    ----------
    M : ndarray, shape (n + m, n + m)
        From :meth:`LinearMPC.state_action_terms`. With a row and a column more, it is the form of
        ``[theta; 1; u]``.
    ranges : Ranges
    hidden : tuple of int, default (64, 64)
    activation : callable, default torch.tanh
    pinned : bool, default True
        Whether the network's output at the equilibrium stays zero for good.
    n_outputs : int, default 1
        Columns of Q: quantiles of the return, all of them the same at first.

    Examples
    --------
    >>> ranges = Ranges(np.ones(2), u_min=-np.ones(1), u_max=np.ones(1))
    >>> q = QuadraticStateActionValue(np.eye(3), ranges)
    >>> q(th.tensor([[1.0, 2.0, 1.0]])).item()
    -6.0
    """

    def __init__(
        self,
        M: Array,
        ranges: Ranges,
        hidden: tuple[int, ...] = (64, 64),
        activation: Activation = th.tanh,
        pinned: bool = True,
        n_outputs: int = 1,
    ) -> None:
        super().__init__()
        m = len(ranges.u_min)
        n = len(M) - m
        scale = np.concatenate([ranges.scale(n), 1 / ranges.u_half])
        self.quadratic = QuadraticForm(M, scale)
        self.n_before_one = len(ranges.theta_half) if n > len(ranges.theta_half) else 0
        register_constants(
            self,
            to_input=np.concatenate([np.ones(n), ranges.u_half]),
            middle=np.concatenate([np.zeros(n), ranges.u_middle]),
            network_scale=scale,
        )
        kept = th.tensor([pinned])
        self.network = ZeroOutputNetwork(
            n + m, n_outputs, hidden, activation=activation, pinned=kept
        )

    def forward(self, theta_and_action: th.Tensor) -> th.Tensor:
        """Return Q, shape (batch, 1), for rows ``[theta, a]`` of shape (batch, n + m)."""
        z = self._completed(theta_and_action) * self.to_input + self.middle
        learnt = self.network((z * self.network_scale).float())
        q: th.Tensor = learnt - self.quadratic(z).float()
        return q


class AfterstateValue(_StateActionValue):
    """``Q(theta, a) = -(theta'Q theta + u'Ru + gamma V(f(theta, u)))``, V quadratic plus network.

    With the linear model for f, it starts as :class:`QuadraticStateActionValue`, to rounding. Only
    V is learnt, at predicted next states: stage cost and model say how Q depends on the action.

    Parameters
    ----------
    W : ndarray, shape (n + m, n + m)
        The stage cost is ``[theta; u]' W [theta; u]``.
    P : ndarray, shape (n, n)
        V is ``theta' P theta`` at first. With a row and a column more, W and P are forms of
        ``[theta; 1; u]`` and ``[theta; 1]``: costs have linear terms.
    model : callable
        ``(theta, u) -> next theta``, of float64 tensors in physical units. A module is copied,
        moved and saved with this one, but not trained.
    gamma : float
    ranges, hidden, activation, pinned, n_outputs
        As in :class:`QuadraticStateActionValue`.
    scale : float, optional
        The network's output is multiplied by it: its units are those of the cost-to-go. The default
        is 1, until :attr:`value_scale` is set.

    Examples
    --------
    >>> ranges = Ranges(np.ones(1), u_min=-np.ones(1), u_max=np.ones(1))
    >>> stays = LinearPrediction(np.eye(1), np.zeros((1, 1)))
    >>> q = AfterstateValue(np.eye(2), np.eye(1), stays, gamma=0.5, ranges=ranges)
    >>> q(th.tensor([[2.0, 1.0]])).item()  # -(2 * 2 + 1 * 1 + 0.5 * 2 * 2)
    -7.0
    """

    value_scale: th.Tensor
    W: th.Tensor

    def __init__(
        self,
        W: Array,
        P: Array,
        model: PredictionModel,
        gamma: float,
        ranges: Ranges,
        hidden: tuple[int, ...] = (64, 64),
        activation: Activation = th.tanh,
        pinned: bool = True,
        scale: float | None = None,
        n_outputs: int = 1,
    ) -> None:
        super().__init__()
        known = 0.0 if scale is None else check_positive("scale", scale)  # 0: not known yet
        import_module("sb3_yann.networks._kernels.afterstate_value")  # see YannLayer
        n = len(ranges.theta_half)
        m = len(ranges.u_min)
        self.model = untrained(model) if isinstance(model, nn.Module) else model
        require_prediction(self.model, n, m)
        self.n_before_one = n if len(P) > n else 0
        self.gamma = gamma
        self.quadratic = QuadraticForm(P, ranges.scale(len(P)))
        register_constants(
            self,
            W=W,
            to_input=ranges.u_half,
            middle=ranges.u_middle,
            network_scale=ranges.scale(len(P)),
            value_scale=np.array(known),
        )
        kept = th.tensor([pinned])
        self.n_outputs = n_outputs
        self.network = ZeroOutputNetwork(
            len(P), n_outputs, hidden, activation=activation, pinned=kept
        )
        self._constants: tuple[Array, ...] = ()
        self._constants_of: tuple[list[Any], tuple[th.Tensor, ...]] = ([], ())

    @property
    def scale(self) -> float:
        """Factor of the network's output, 1 where it is not known yet."""
        buffers: Any = self._buffers
        return float(buffers["value_scale"].item()) or 1.0

    @property
    def compiles(self) -> bool:
        """Whether there is compiled code for such a value where it is now."""
        modules: Any = self._modules
        largest = 48  # parameters and inputs; beyond, BLAS is faster than loops
        linear = isinstance(modules.get("model"), LinearPrediction)
        weight: Any = self._buffers["W"]
        double = weight.dtype == modules["quadratic"].entries.dtype == th.float64
        fits = linear and double and len(weight) <= largest and self.n_outputs == 1
        return fits and modules["network"].compiles

    @property
    def constants(self) -> tuple[Array, ...]:
        """W, the model's [A B], the scale of the quadratic form, and others, for compiled code."""
        modules: Any = self._modules
        own: Any = self._buffers
        model = modules["model"]._buffers
        quadratic = modules["quadratic"]._buffers
        used = (
            own["W"], model["A"], model["B"], quadratic["root"],
            own["network_scale"], own["to_input"], own["middle"],
        )  # fmt: skip
        now = [self.gamma, *[each._version for each in used]]
        then, known = self._constants_of
        if then != now or not all(map(operator.is_, used, known)):
            W, A, B, root, *scaling = (each.numpy() for each in used)
            AB = np.vstack([A, B]).T
            if n := self.n_before_one:  # the 1 stays
                AB = np.insert(AB, n, 0.0, axis=1)
                AB = np.vstack([AB, np.eye(1, AB.shape[1], n)])
            self._constants = (
                W.copy(),
                np.ascontiguousarray(AB),
                np.outer(root, root) * self.gamma,
                np.concatenate(scaling),
            )
            self._constants_of = now, used
        return self._constants

    def forward(self, theta_and_action: th.Tensor) -> th.Tensor:
        """Return Q, shape (batch, 1), for rows ``[theta, a]`` of shape (batch, n + m)."""
        theta_and_action = self._completed(theta_and_action)
        if self.compiles and theta_and_action.device.type == "cpu":
            from sb3_yann.networks._kernels.afterstate_value import value_on_cpu  # compiled once

            network: Any = self._modules["network"]  # an attribute of a module takes a microsecond
            known = (*self.constants, network.pinned_array, self.gamma * self.scale)
            return value_on_cpu(theta_and_action, self.weights(), known)
        theta, u = self._theta_and_input(theta_and_action)
        following = self.model(theta[:, : self.n_before_one or None], u)
        return -(self._stage_cost(theta, u) + self.gamma * self.value(following)).float()

    @th.no_grad()
    def mean_stage_cost(self, theta_and_action: th.Tensor) -> float:
        """Return the mean of the stage cost's absolute values, over rows ``[theta, a]``."""
        points = self._completed(theta_and_action)
        return float(self._stage_cost(*self._theta_and_input(points)).abs().mean())

    def _theta_and_input(self, theta_and_action: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        theta, action = th.tensor_split(theta_and_action.double(), [len(self.network_scale)], 1)
        return theta, action * self.to_input + self.middle

    def _stage_cost(self, theta: th.Tensor, u: th.Tensor) -> th.Tensor:
        z = th.cat([theta, u], 1)
        return ((z @ self.W) * z).sum(-1, keepdim=True)

    def value(self, theta: th.Tensor) -> th.Tensor:
        """Return V, the discounted cost to go in float64, shape (batch, 1), for (batch, n)."""
        if theta.shape[1] == self.n_before_one:
            theta = with_one(theta, self.n_before_one)
        learnt: th.Tensor = self.network((theta * self.network_scale).float())
        total: th.Tensor = self.quadratic(theta) + self.scale * learnt.double()
        return total


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
    model = copy.deepcopy(model).double().cpu()
    for module in model.modules():
        for name, parameter in [*module.named_parameters(recurse=False)]:
            delattr(module, name)
            module.register_buffer(name, parameter.detach())
    return model
