"""The YANN layer on a CPU: compiled, and one operation of torch with its gradient."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_yann._numba import Integers, Single, compiled
from sb3_yann._validation import Array
from sb3_yann.control.law._kernels import input_at
from sb3_yann.networks._kernels.mlp import WEIGHTS, as_array, network, network_backward

_KEPT = "float32[:, ::1], int64[::1], int64[::1], float32[:, ::1], float32[:, ::1]"
_KEPT += ", float32[:, :, ::1]"


@compiled()
def _locate(
    floats: Array, whole: Integers, theta: Array, p: int, used: Integers, slot: Integers
) -> tuple[Array, int]:
    """Return inputs (batch, m), NaN for theta that is not finite, and how many regions are in use.

    Write which these are, and each row's place among them.
    """
    u, slot_of = np.empty((len(theta), whole[1])), np.full(p, -1)
    slots = 0
    for row in range(len(theta)):
        region = input_at(floats, whole, theta, u, row)
        if region < 0:
            u[row], region = np.nan, 0
        if slot_of[region] < 0:
            used[slots], slot_of[region] = region, slots
            slots += 1
        slot[row] = slot_of[region]
    return u, slots


@compiled()
def _between(value: Any, low: Any, high: Any) -> Any:
    """Return a value clamped to bounds; NaN stays what it is."""
    value = high if value > high else value
    return low if value < low else value


@compiled(
    "int64(float64[::1], int64[::1], float64[:, ::1], float64[::1], float64[:, ::1], float64, "
    f"{WEIGHTS}, float32[:, ::1], {_KEPT})"
)
def _forward(
    floats: Array,
    whole: Integers,
    theta: Array,
    scaling: Array,
    change: Array,
    limit: float,
    nodes: Single,
    second: Single,
    last: Single,
    pinned: Single,
    actions: Single,
    x: Single,
    used: Integers,
    slot: Integers,
    hidden1: Single,
    hidden2: Single,
    outputs: Single,
) -> int:
    """Write the actions (batch, m), and what :func:`_backward` needs; return how much of ``used``.

    Parameters
    ----------
    floats, whole : ndarray
        The law, packed.
    theta : ndarray, shape (batch, n)
    scaling : ndarray, shape (n + 2 m,)
        One over the half-widths of the box of theta; the middles of the input ranges; one over
        their half-widths.
    change : ndarray, shape (2, m) or (0, m)
        By how much an action may differ from the previous input, the last m entries of theta.
    limit : float
        The network's output is clamped to [-limit, limit].
    nodes, second, last, pinned
        As in :func:`network`.
    actions, x, used, slot, hidden1, hidden2, outputs : ndarray
        What is written; the last one, (4, batch, m), are the networks' outputs, the actions before
        they are clamped, and the lower and upper bounds.
    """
    (batch, n), m = theta.shape, last.shape[1]
    u, slots = _locate(floats, whole, theta, len(pinned), used, slot)
    for row in range(batch):
        for j in range(n):
            x[row, j] = theta[row, j] * scaling[j]
    out, total, bounds = outputs[0], outputs[1], outputs[2:]
    network(x, used[:slots], slot, nodes, second, last, pinned, hidden1, hidden2, out)
    bounds[0], bounds[1] = -1, 1
    for row in range(batch):
        for k in range(m):
            for side in range(len(change)):
                previous = (theta[row, n - m + k] - scaling[n + k]) * scaling[n + m + k]
                bounds[side, row, k] = min(max(previous + change[side, k], -1.0), 1.0)
            low, high = bounds[0, row, k], bounds[1, row, k]
            law = np.float32((u[row, k] - scaling[n + k]) * scaling[n + m + k])
            correction = out[row, k]
            if limit < np.inf:  # which NaN and infinite weights do not pass either
                correction = np.float32(min(max(correction, -limit), limit))
                correction = correction if out[row, k] == out[row, k] else np.float32(0)
            total[row, k] = _between(law, low, high) + correction
            actions[row, k] = _between(total[row, k], low, high)
    return slots


@compiled(
    f"void(float32[:, ::1], boolean, float64, {WEIGHTS}, {_KEPT}, "
    "float32[:, :, :, ::1], float32[:, :, ::1], float32[:, :, ::1])"
)
def _backward(
    gradient: Single,
    dense: bool,
    limit: float,
    nodes: Single,
    second: Single,
    last: Single,
    pinned: Single,
    x: Single,
    used: Integers,
    slot: Integers,
    hidden1: Single,
    hidden2: Single,
    outputs: Single,
    by_nodes: Single,
    by_second: Single,
    by_last: Single,
) -> None:
    """Write the gradients of a loss by nodes, second and last, see :func:`network_backward`.

    ``gradient`` (batch, m) is that of the loss by the actions. What would push an action, or a
    correction, further beyond its bound is stopped: descent moves against the gradient.
    """
    out, total, bounds, back = outputs[0], outputs[1], outputs[2:], gradient.copy()
    for row in range(len(back)):
        for k in range(back.shape[1]):
            above = total[row, k] >= bounds[1, row, k] or out[row, k] >= limit
            below = total[row, k] <= bounds[0, row, k] or out[row, k] <= -limit
            if (above and back[row, k] < 0) or (below and back[row, k] > 0):
                back[row, k] = 0
    matrices = nodes, second, last, pinned
    found = by_nodes, by_second, by_last
    network_backward(back, x, used, slot, dense, *matrices, hidden1, hidden2, *found)


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
        ``scaling``, ``change`` and ``limit``, see :func:`_forward`.
    weights : tuple of Tensor
        Nodes, second and last.
    pinned : ndarray, shape (p,)
    by_row : bool
        Whether gradients are sparse, with the rows of the regions in use.
    """
    n = law[1][0]
    if theta.dim() != 2 or theta.shape[1] != n:  # compiled code does not look
        raise ValueError(f"theta has shape {tuple(theta.shape)}, expected (batch, {n}).")
    known = (*law, as_array(theta, np.float64), *constants)
    if th.is_grad_enabled():
        actions: th.Tensor = _Layer.apply(known, pinned, by_row, *weights)  # type: ignore[no-untyped-call]
        return actions
    return th.from_numpy(_actions([*known, *map(as_array, weights), pinned])[0])


def _actions(given: list[Any]) -> tuple[Single, list[Any]]:
    """Return the actions and what :func:`_backward` needs, of all that :func:`_forward` takes."""
    (batch, n), second, (p, m, columns) = given[2].shape, given[7], given[8].shape
    used, slot = np.empty(min(batch, p), np.int64), np.empty(batch, np.int64)
    x = np.empty((batch, n), np.float32)
    hidden1 = np.empty((batch, second.shape[2] - 1), np.float32)
    hidden2 = np.empty((batch, columns - 1), np.float32)
    actions, outputs = np.empty((batch, m), np.float32), np.empty((4, batch, m), np.float32)
    written: list[Any] = [actions, x, used, slot, hidden1, hidden2, outputs]
    slots = _forward(*given, *written)
    return actions, [x, used[:slots], slot, hidden1, hidden2, outputs]


class _Layer(th.autograd.Function):
    """Differentiable by the weights of the networks, once."""

    @staticmethod
    def forward(
        ctx: Any, known: tuple[Any, ...], pinned: Single, by_row: bool, *weights: th.Tensor
    ) -> th.Tensor:
        given = [*known, *map(as_array, weights), pinned]
        actions, kept = _actions(given)
        # torch notices weights that change before the backward pass
        ctx.save_for_backward(*weights)
        ctx.given, ctx.kept, ctx.by_row = given[5:], kept, by_row
        return th.from_numpy(actions)

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[th.Tensor | None, ...]:
        weights, (_, used, *_) = ctx.saved_tensors, ctx.kept
        gradient = as_array(gradients[0])
        sizes = [
            (len(used), *weight.shape[1:]) if ctx.by_row else weight.shape for weight in weights
        ]
        arrays = [np.zeros(size, np.float32) for size in sizes]
        _backward(gradient, not ctx.by_row, *ctx.given, *ctx.kept, *arrays)
        found = [th.from_numpy(each) for each in arrays]
        if ctx.by_row:
            rows = th.from_numpy(used)[None]
            found = [
                th.sparse_coo_tensor(rows, by_weight, weight.shape, check_invariants=False)
                for by_weight, weight in zip(found, weights, strict=True)
            ]
        return None, None, None, *found
