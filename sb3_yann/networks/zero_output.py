"""Networks whose output is exactly zero at first, for any input, and which train all the same.

Braniff & Tian, Theorems 1 and 2: nodes in pairs of opposite sign, summed before the activation.
Here their weights are added before they meet the input, so that the zero is exact.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_yann._validation import Array, check_int

Activation = Callable[[th.Tensor], th.Tensor]
FEW = 32
"""Stacks of up to this size are multiplied as a whole."""


class Rows:
    """Which layer of a stack each row of a batch goes through; None is for a stack of one.

    Few layers are multiplied as a whole, with one-hot vectors; of many each row gathers its own.
    """

    def __init__(self, index: th.Tensor | None, n_stacked: int, dtype: th.dtype) -> None:
        self.index = index
        self.one_hot: th.Tensor | None = None
        if index is not None and n_stacked <= FEW:
            layers = th.arange(n_stacked, device=index.device)
            self.one_hot = (index[:, None] == layers).to(dtype)

    def affine(self, weight: th.Tensor, bias: th.Tensor, x: th.Tensor) -> th.Tensor:
        """Return ``W x + b`` (batch, out) for weights (stack, out, in) and biases (stack, out)."""
        if self.index is None:
            return th.addmm(bias, x, weight[0].T)
        if self.one_hot is not None:
            own = (self.one_hot[:, :, None] * x[:, None]).flatten(1)
            return th.addmm(self.one_hot @ bias, own, weight.transpose(1, 2).flatten(0, 1))
        weight = weight.index_select(0, self.index)
        # Forward and backward, a fifth of the time of einsum, which multiplies matrix by matrix.
        return (weight * x[:, None]).sum(-1) + bias.index_select(0, self.index)

    def each(self, function: Callable[..., th.Tensor], *tables: th.Tensor) -> th.Tensor:
        """Return a function of each row's entries of tables (stack, k), shape (batch, k)."""
        if self.index is None:
            return function(*tables)
        if self.one_hot is not None:
            return self.one_hot @ function(*tables)
        return function(*(table.index_select(0, self.index) for table in tables))


def register_constants(module: nn.Module, **values: Array) -> None:
    """Give a module buffers: optimizers and SB3's target updates leave them alone."""
    for name, value in values.items():
        module.register_buffer(name, th.as_tensor(np.array(value, order="C"), dtype=th.float64))


def _alive_at_zero(activation: Activation, x: th.Tensor) -> th.Tensor:
    return th.where(x == 0, x, activation(x))


class ZeroOutputNetwork(nn.Module):
    """A stack of networks with one or two hidden layers, exactly zero at first, and trainable.

    The first axis of every parameter is the stack. Where ``pinned``, every layer is
    ``s(W x + b) - s(b)``: the output at x = 0 stays zero, training cannot shift the equilibrium.

    Parameters
    ----------
    in_features, out_features : int
    hidden : sequence of int
        Widths of the one or two hidden layers, odd or even.
    activation : callable, default torch.tanh
        Any s with s(0) = 0. Where torch has no slope at 0, as for ReLU, the slope there is 1:
        every unit starts at 0 and would never leave it.
    pinned : Tensor of bool, shape (n_stacked,), optional
        Networks whose output at 0 stays 0; the number of entries is the size of the stack. The
        default is one network that is not pinned.

    Examples
    --------
    >>> network = ZeroOutputNetwork(3, 1, hidden=(8, 8))
    >>> network(th.ones(2, 3)).tolist(), sum(each.numel() for each in network.parameters())
    ([[0.0], [0.0]], 145)
    """

    pinned: th.Tensor

    def __init__(
        self,
        in_features: int,
        out_features: int,
        hidden: tuple[int, ...] = (16, 16),
        *,
        activation: Activation = th.tanh,
        pinned: th.Tensor | None = None,
    ) -> None:
        super().__init__()
        if np.ndim(hidden) != 1 or len(hidden) not in (1, 2):
            raise ValueError(f"hidden = {hidden!r} must name one or two widths, such as (16, 16).")
        hidden = tuple(check_int("hidden", each) for each in hidden)
        with th.enable_grad():
            zero = th.zeros((), requires_grad=True)
            at_zero = activation(zero)
            (slope,) = th.autograd.grad(at_zero, zero)
        if at_zero != 0:
            raise ValueError(
                f"activation(0) = {at_zero:g}, but a zero output needs activation(0) = 0. "
                "Use e.g. torch.tanh or torch.relu."
            )
        if slope == 0:
            activation = partial(_alive_at_zero, activation)
        pinned = th.zeros(1, dtype=th.bool) if pinned is None else pinned
        self.activation = activation
        inputs = (in_features, *hidden)
        outputs = (*hidden, out_features)
        sizes = zip(outputs, inputs, strict=True)
        first, *rest = (th.empty(len(pinned), m, n + 1).uniform_(-0.01, 0.01) for m, n in sizes)
        for each in rest:
            each[..., -1] = 0  # Theorem 2: the biases of later layers start at zero
        self.first = nn.ParameterDict({"nodes": th.stack([first, -first], 1)})
        self.rest = nn.ModuleList(nn.ParameterDict({"weight": each}) for each in rest)
        self.register_buffer("pinned", pinned.float()[:, None])
        names_of_tanh = (th.tanh, nn.functional.tanh)
        is_tanh = isinstance(activation, nn.Tanh) or activation in names_of_tanh
        self.has_loops = len(hidden) == 2 and is_tanh

    def matrices(self) -> list[th.Tensor]:
        """Return each layer's weights and, as the last column, biases: (n_stacked, out, n + 1).

        The first layer's nodes come in pairs, whose sum is zero at first.
        """
        nodes, *rest = self.weights()
        return [nodes.sum(1), *rest]

    def weights(self) -> tuple[nn.Parameter, ...]:
        """Return the parameters, layer by layer."""
        # From the modules' own tables: an attribute of a module takes a microsecond to find.
        modules: Any = self._modules
        rest = modules["rest"]._modules.values()
        nodes = modules["first"]._parameters["nodes"]
        return (nodes, *[each._parameters["weight"] for each in rest])

    @property
    def compiles(self) -> bool:
        """Whether there is compiled code for such networks where they are now."""
        # Tracing would take its result for a constant; autocast needs torch's own operations.
        tracing = th.jit.is_tracing()  # type: ignore[attr-defined, no-untyped-call]
        if tracing or th.compiler.is_compiling() or th.is_autocast_enabled("cpu"):
            return False
        return self.has_loops and all(w.dtype == th.float32 and w.is_cpu for w in self.weights())

    @property
    def pinned_array(self) -> NDArray[np.float32]:
        """Which networks are pinned, (n_stacked,), for compiled code."""
        pinned: Any = self._buffers["pinned"]
        array: NDArray[np.float32] = pinned.numpy()[:, 0]
        return array

    @th.no_grad()
    def is_zero(self) -> bool:
        """Return whether nothing has been learnt: the output is zero whatever the input is."""
        first, *rest = self.matrices()
        return not any(bool(each.any()) for each in (first, *(weight[..., -1] for weight in rest)))

    def forward(self, x: th.Tensor, index: th.Tensor | None = None) -> th.Tensor:
        """Return (batch, out_features) for x (batch, in_features).

        ``index`` (batch,) names the network of the stack for each row, None where there is one.
        """
        if len(self.pinned) == 1:
            index = None
        elif index is None:
            stack = f"there are {len(self.pinned)} networks in the stack"
            raise ValueError(f"index is None, but {stack}: pass that of each row of x.")
        rows = Rows(index, len(self.pinned), x.dtype)
        pinned = rows.each(lambda pinned: pinned, self.pinned)
        at_zero = (x == 0).all(-1, keepdim=True) & (pinned > 0)
        *hidden, last = self.matrices()
        for matrix in hidden:
            bias = matrix[..., -1]
            x = self.activation(rows.affine(matrix[..., :-1], bias, x)) - rows.each(
                lambda bias, pinned: pinned * self.activation(bias), bias, self.pinned
            )
        output: th.Tensor = rows.affine(last[..., :-1], (1 - self.pinned) * last[..., -1], x)
        # Many kernels round s differently at the end of a row of memory: s(b) - s(b) is not 0.
        return output.masked_fill(at_zero, 0.0)


class RowAdam(th.optim.Optimizer):
    """Adam (Kingma & Ba, 2015) that treats every row of a parameter as a parameter of its own.

    A row is a network's share in a stack of networks. Without a gradient it does not move, not even
    by momentum: regions without data keep their law. Sparse gradients cost what their rows cost. In
    a dense gradient, a row of zeros is none.

    Parameters
    ----------
    params : iterable of Tensor or dict
    lr : float, default 1e-3
    betas : tuple of float, default (0.9, 0.999)
    eps : float, default 1e-8

    Examples
    --------
    >>> table = th.nn.Parameter(th.zeros(2, 3))
    >>> optimizer = RowAdam([table], lr=0.1)
    >>> table[1].sum().backward()
    >>> optimizer.step()
    >>> [round(each, 3) for each in table[:, 0].tolist()]
    [0.0, -0.1]
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        if not (lr >= 0 and eps >= 0 and all(0 <= beta < 1 for beta in betas)):
            raise ValueError(
                f"lr = {lr!r} and eps = {eps!r} must be at least 0, and betas = {betas!r} from 0 "
                "to below 1."
            )
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

    @th.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """Do one step for the rows that have a gradient."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if (gradient := parameter.grad) is not None:
                    by_row = gradient if gradient.is_sparse else gradient.to_sparse(1)
                    self._step(parameter, by_row.coalesce(), group)

    def _step(self, parameter: th.Tensor, by_row: th.Tensor, group: dict[str, Any]) -> None:
        rows = by_row.indices()[0]
        gradient = by_row.values()
        state = self.state[parameter]
        if "steps" not in state:  # nothing yet, or what an Adam left
            taken = float(state.pop("step", 0.0))
            state["steps"] = th.full((len(parameter),), taken, device=parameter.device)
            for name in ("exp_avg", "exp_avg_sq"):
                state.setdefault(name, th.zeros_like(parameter))
        beta1, beta2 = group["betas"]
        step = state["steps"][rows] + 1
        mean = state["exp_avg"][rows].lerp_(gradient, 1 - beta1)
        square = state["exp_avg_sq"][rows].mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
        for name, value in (("steps", step), ("exp_avg", mean), ("exp_avg_sq", square)):
            state[name][rows] = value
        step = step.view(-1, *[1] * (parameter.dim() - 1))
        size = (square / (1 - beta2**step)).sqrt_().add_(group["eps"])
        change = mean.div_(size).mul_(group["lr"] / (1 - beta1**step))
        parameter.index_add_(0, rows, change, alpha=-1)
