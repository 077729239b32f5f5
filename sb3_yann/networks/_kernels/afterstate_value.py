"""The afterstate value on a CPU: compiled, and one operation of torch with its gradient."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_yann._numba import compiled
from sb3_yann._validation import Array, Single
from sb3_yann.networks._kernels.stack import (
    WEIGHT_TYPES,
    network,
    network_backward,
    prepared,
    to_numpy,
)

_GIVEN = f"float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1], float64, {WEIGHT_TYPES}"
_KEPT = "float64[:, ::1], float64[:, ::1], " + ", ".join(3 * ["float32[:, ::1]"])


@compiled(f"void(float64[:, ::1], {_GIVEN}, {_KEPT}, float32[:, ::1])", fastmath=True)
def _forward(
    points: Array,
    W: Array,
    AB: Array,
    M: Array,
    scaling: Array,
    factor: float,
    nodes: Single,
    second: Single,
    last: Single,
    pinned: Single,
    y: Array,
    z: Array,
    x: Single,
    hidden1: Single,
    hidden2: Single,
    q: Single,
) -> None:
    """Write ``q = -(y'W y + z'M z + factor network)`` (batch, 1), and what :func:`_backward` needs.

    Parameters
    ----------
    points : ndarray, shape (batch, n + m)
        Rows ``[theta, a]``; y is the same with inputs for actions, and ``z = AB y``.
    W, AB, M : ndarray, shapes (n + m, n + m), (n, n + m) and (n, n)
    scaling : ndarray, shape (n + 2 m,)
        Factors of z for the network; half the ranges of the inputs; their middles.
    nodes, second, last, pinned : ndarray
        The network, as in `stack.network`.
    y, z, x, hidden1, hidden2, q : ndarray
        What is written; x is the network's input.
    """
    batch = len(points)
    n = len(M)
    m = len(W) - len(M)
    total = np.zeros(batch)
    for row in range(batch):
        for j in range(n):
            y[row, j] = points[row, j]
        for j in range(n, n + m):
            y[row, j] = points[row, j] * scaling[j] + scaling[j + m]
        for i in range(n + m):
            product = 0.0
            for j in range(n + m):
                product += W[i, j] * y[row, j]
            total[row] += y[row, i] * product
        for i in range(n):
            z[row, i] = 0
            for j in range(n + m):
                z[row, i] += AB[i, j] * y[row, j]
            x[row, i] = z[row, i] * scaling[i]
        for i in range(n):
            product = 0.0
            for j in range(n):
                product += M[i, j] * z[row, j]
            total[row] += z[row, i] * product
    used = np.zeros(1, np.int64)
    ready = prepared(used, nodes, second, pinned)
    slot = np.zeros(batch, np.int64)
    network(x, used, slot, ready, last, pinned, hidden1, hidden2, q)
    for row in range(batch):
        q[row, 0] = -(total[row] + factor * q[row, 0])


@compiled(
    f"void(float32[:, ::1], boolean, boolean, {_GIVEN}, {_KEPT}, float64[:, ::1], float64[:, ::1], "
    "float32[:, :, :, ::1], float32[:, :, ::1], float32[:, :, ::1])",
    fastmath=True,
)
def _backward(
    gradient: Single,
    of_points: bool,
    of_weights: bool,
    W: Array,
    AB: Array,
    M: Array,
    scaling: Array,
    factor: float,
    nodes: Single,
    second: Single,
    last: Single,
    pinned: Single,
    y: Array,
    z: Array,
    x: Single,
    hidden1: Single,
    hidden2: Single,
    by_points: Array,
    by_M: Array,
    by_nodes: Single,
    by_second: Single,
    by_last: Single,
) -> None:
    """Write the gradients of a loss by points, M and weights, as far as they are asked for.

    They are zero before. ``gradient`` (batch, 1) is that of the loss by q.
    """
    batch = len(y)
    n = len(M)
    m = len(W) - len(M)
    back = np.empty((batch, 1), np.float32)
    for row in range(batch):
        back[row, 0] = -factor * gradient[row, 0]
    used = np.zeros(1, np.int64)
    slot = np.zeros(batch, np.int64)
    by_x = network_backward(
        back, x, used, slot, True, of_weights, nodes, second, last, pinned,
        hidden1, hidden2, by_nodes, by_second, by_last,
    )  # fmt: skip
    for row in range(batch):
        g = -float(gradient[row, 0])
        for j in range(n if of_weights else 0):
            for i in range(n):
                by_M[i, j] += g * z[row, i] * z[row, j]
        if not of_points:
            continue
        for i in range(n + m):
            for j in range(n + m):
                by_points[row, i] += g * (W[i, j] + W[j, i]) * y[row, j]
        for i in range(n):
            by_z = by_x[row, i] * scaling[i]
            for j in range(n):
                by_z += g * (M[i, j] + M[j, i]) * z[row, j]
            for j in range(n + m):
                by_points[row, j] += by_z * AB[i, j]
        for j in range(n, n + m):
            by_points[row, j] *= scaling[j]


ValueConstants = tuple[Array, Array, Array, Array, Single, float]


def value_on_cpu(
    points: th.Tensor, weights: tuple[th.Tensor, ...], constants: ValueConstants
) -> th.Tensor:
    """Return an afterstate value (batch, 1), with a gradient by points (batch, n + m) and weights.

    Weights are entries of the quadratic form; nodes, second and last of the network. Constants are
    W, [A B], the scale of the form, the scaling of :func:`_forward`, pinned, the network's factor.
    """
    size = len(constants[0])
    if points.dim() != 2 or points.shape[1] != size:  # compiled code does not look
        raise ValueError(f"points have shape {tuple(points.shape)}, expected (batch, {size}).")
    if th.is_grad_enabled():
        q: th.Tensor = _Value.apply(constants, points, *weights)  # type: ignore[no-untyped-call]
        return q
    return th.from_numpy(_pass(constants, points, weights)[0])


def _pass(
    constants: ValueConstants, points: th.Tensor, weights: tuple[th.Tensor, ...]
) -> tuple[Single, list[Any]]:
    """Return q (batch, 1), and what :func:`_backward` takes of the pass."""
    W, AB, roots, scaling, pinned, factor = constants
    entries, nodes, second, last = to_numpy(weights[0], np.float64), *map(to_numpy, weights[1:])
    array = to_numpy(points, np.float64)
    batch = len(array)
    y = np.empty_like(array)
    z = np.empty((batch, len(entries)))
    x, hidden1, hidden2, q = (
        np.empty((batch, k), np.float32) for k in (len(entries), nodes.shape[2], second.shape[1], 1)
    )
    M = entries * roots
    kept: list[Any] = [W, AB, M, scaling, factor, nodes, second, last, pinned]
    kept += [y, z, x, hidden1, hidden2]
    _forward(*[array, *kept, q])
    return q, kept


class _Value(th.autograd.Function):
    """Differentiable by points and weights, once."""

    @staticmethod
    def forward(
        ctx: Any, constants: ValueConstants, points: th.Tensor, *weights: th.Tensor
    ) -> th.Tensor:
        # torch notices weights that change before the backward pass
        ctx.save_for_backward(*weights)
        q, ctx.kept = _pass(constants, points, weights)
        ctx.roots = constants[2]
        ctx.dtype = points.dtype
        return th.from_numpy(q)

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[th.Tensor | None, ...]:
        _ = ctx.saved_tensors
        _, of_points, *of_weights = ctx.needs_input_grad
        _, _, M, _, _, *networks = ctx.kept
        # Points, M, nodes, second and last.
        found = [np.zeros_like(each) for each in (ctx.kept[9], M, *networks[:3])]
        _backward(to_numpy(gradients[0]), of_points, any(of_weights), *ctx.kept, *found)
        points, by_M, *by_weights = map(th.from_numpy, found)
        by_points = points.to(ctx.dtype) if of_points else None
        if not any(of_weights):
            return None, by_points, None, None, None, None
        return None, by_points, by_M * th.from_numpy(ctx.roots), *by_weights
