"""The YANN layer on a CPU: compiled, and one operation of torch with its gradient."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th

from sb3_yann._numba import Integers, Single
from sb3_yann._validation import Array
from sb3_yann.networks._kernels.layer_loops import backward, forward, forward_shared
from sb3_yann.networks._kernels.mlp import to_numpy


def layer_on_cpu(
    theta: th.Tensor,
    law: tuple[Array, Integers],
    constants: tuple[Array, Array, float],
    weights: tuple[th.Tensor, ...],
    pinned: Single,
    by_row: bool,
) -> th.Tensor:
    """Return the actions (batch, m) of a YANN layer, with a gradient by its weights.

    Parameters
    ----------
    theta : Tensor, shape (batch, n)
    law : pair of ndarray
        The law, packed.
    constants : tuple
        ``scaling``, ``change`` and ``limit``, as in `layer_loops`.
    weights : tuple of Tensor
        Nodes, second and last.
    pinned : ndarray, shape (p,)
    by_row : bool
        Whether gradients are sparse, with the rows of the regions in use.
    """
    _require_width(theta, int(law[1][0]))
    known = (*law, to_numpy(theta, np.float64), *constants)
    return _run(forward, known, weights, pinned, by_row)


def shared_layer_on_cpu(
    theta: th.Tensor,
    u: Array,
    constants: tuple[Array, Array, float],
    weights: tuple[th.Tensor, ...],
    pinned: Single,
) -> th.Tensor:
    """Return the actions (batch, m) for inputs u (batch, m) of a law, and one network.

    What else it takes is in :func:`layer_on_cpu`.
    """
    _require_width(theta, (len(constants[0]) - 2 - 2 * u.shape[1]) // 3)
    known = (u, to_numpy(theta, np.float64), *constants)
    return _run(forward_shared, known, weights, pinned, by_row=False)


def frozen_layer(floats: Array, whole: Integers, *rest: Any) -> Callable[[Array], Single]:
    """Return a YANN layer, packed, as a function from theta (batch, n) to actions (batch, m)."""

    def act(theta: Array) -> Single:
        rows = _as_rows(theta, int(whole[0]))
        return _actions(forward, [floats, whole, rows, *rest])[0]

    return act


def frozen_shared_layer(law: Callable[[Array], Array], *rest: Any) -> Callable[[Array], Single]:
    """Return what :func:`frozen_layer` does, for inputs of a law and one network."""
    n = rest[3].shape[3] - 1

    def act(theta: Array) -> Single:
        rows = _as_rows(theta, n)
        return _actions(forward_shared, [law(rows), rows, *rest])[0]

    return act


def _as_rows(theta: Array, n: int) -> Array:
    if theta.ndim != 2 or theta.shape[1] != n:  # compiled code does not look
        raise ValueError(f"theta has shape {theta.shape}, expected (batch, {n}).")
    return np.ascontiguousarray(theta, np.float64)


def kept_for_gradient(actions: th.Tensor) -> list[Any]:
    """Return what a forward pass has kept: x, used, slot, two hidden layers, outputs."""
    node: Any = actions.grad_fn
    found: list[Any] = node.kept
    return found


def _require_width(theta: th.Tensor, n: int) -> None:
    if theta.dim() != 2 or theta.shape[1] != n:  # compiled code does not look
        raise ValueError(f"theta has shape {tuple(theta.shape)}, expected (batch, {n}).")


def _run(
    loops: Any,
    known: tuple[Any, ...],
    weights: tuple[th.Tensor, ...],
    pinned: Single,
    by_row: bool,
) -> th.Tensor:
    if th.is_grad_enabled():
        given = loops, known, pinned, by_row
        actions: th.Tensor = _Layer.apply(*given, *weights)  # type: ignore[no-untyped-call]
        return actions
    return th.from_numpy(_actions(loops, [*known, *map(to_numpy, weights), pinned])[0])


def _actions(loops: Any, given: list[Any]) -> tuple[Single, list[Any]]:
    """Return the actions and what :func:`backward` needs, of all that a forward pass takes."""
    (batch, n), second, (p, m, columns) = given[-8].shape, given[-3], given[-2].shape
    used, slot = np.empty(min(batch, p), np.int64), np.empty(batch, np.int64)
    x = np.empty((batch, n), np.float32)
    hidden1 = np.empty((batch, second.shape[2] - 1), np.float32)
    hidden2 = np.empty((batch, columns - 1), np.float32)
    actions, outputs = np.empty((batch, m), np.float32), np.empty((5, batch, m), np.float32)
    written: list[Any] = [actions, x, used, slot, hidden1, hidden2, outputs]
    slots = loops(*given, *written)
    return actions, [x, used[:slots], slot, hidden1, hidden2, outputs]


class _Layer(th.autograd.Function):
    """Differentiable by the weights of the networks, once."""

    @staticmethod
    def forward(
        ctx: Any,
        loops: Any,
        known: tuple[Any, ...],
        pinned: Single,
        by_row: bool,
        *weights: th.Tensor,
    ) -> th.Tensor:
        given = [*known, *map(to_numpy, weights), pinned]
        actions, kept = _actions(loops, given)
        # torch notices weights that change before the backward pass
        ctx.save_for_backward(*weights)
        ctx.given, ctx.kept, ctx.by_row = given[-5:], kept, by_row
        return th.from_numpy(actions)

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[th.Tensor | None, ...]:
        weights, (_, used, *_) = ctx.saved_tensors, ctx.kept
        gradient = to_numpy(gradients[0])
        sizes = [
            (len(used), *weight.shape[1:]) if ctx.by_row else weight.shape for weight in weights
        ]
        arrays = [np.zeros(size, np.float32) for size in sizes]
        backward(gradient, not ctx.by_row, *ctx.given, *ctx.kept, *arrays)
        found = [th.from_numpy(each) for each in arrays]
        if ctx.by_row:
            rows = th.from_numpy(used)[None]
            found = [
                th.sparse_coo_tensor(rows, by_weight, weight.shape, check_invariants=False)
                for by_weight, weight in zip(found, weights, strict=True)
            ]
        return None, None, None, None, *found
