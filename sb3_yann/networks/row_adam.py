"""Adam for tables of networks: a step moves only those with a gradient."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch as th


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
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Do one step for the rows that have a gradient."""
        loss = None
        if closure is not None:
            with th.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._step(parameter, *_rows(parameter.grad), group)
        return loss

    def _step(
        self, parameter: th.Tensor, rows: th.Tensor, gradient: th.Tensor, group: dict[str, Any]
    ) -> None:
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


def _rows(gradient: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Return which rows have a gradient, and it."""
    if gradient.is_sparse:
        gradient = gradient.coalesce()
        return gradient.indices()[0], gradient.values()
    rows = gradient.flatten(1).any(1).nonzero()[:, 0]
    return rows, gradient[rows]
