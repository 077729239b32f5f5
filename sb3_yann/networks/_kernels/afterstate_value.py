"""The afterstate value on a CPU: compiled, and one operation of torch with its gradient."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_yann._numba import compiled
from sb3_yann._validation import Array, Single
from sb3_yann.networks._kernels.stack import (
    at_zero,
    first_layers,
    hidden_layer,
    tanh,
    to_numpy,
    transposed,
)

_LINEAR = "float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1]"
_NODES = "float32[:, :, :, ::1], float32[::1]"
_QUADRATICS = "float64[:, ::1], float64[:, ::1], float32[:, ::1], float32[:, ::1]"


@compiled()
def _matrices(weights: Single, pinned: Single) -> tuple[Single, Single]:
    """Return the layers of a stack of one, inputs before outputs, and what they put out at zero."""
    used = np.zeros(1, np.int64)
    matrices = transposed(weights, used)
    return matrices, at_zero(matrices, used, pinned)


@compiled(f"void(float64[:, ::1], {_LINEAR}, {_NODES}, float64[::1], {_QUADRATICS})", fastmath=True)
def _forms(
    points: Array,
    W: Array,
    AB: Array,
    M: Array,
    scaling: Array,
    nodes: Single,
    pinned: Single,
    total: Array,
    y: Array,
    z: Array,
    x: Single,
    hidden: Single,
) -> None:
    """Write ``y'W y + z'M z`` (batch,), y, z, the network's input, and its first hidden layer.

    Parameters
    ----------
    points : ndarray, shape (batch, n + m)
        Rows ``[theta, a]``; y is the same with inputs for actions, and ``z = AB y``.
    scaling : ndarray, shape (n + 2 m,)
        Factors of z for the network; half the ranges of the inputs; their middles.
    total, y, z, x, hidden : ndarray
        What is written; total and z are zero before.
    """
    batch = len(points)
    n = len(M)
    m = len(W) - len(M)
    matrices, zero = _matrices(first_layers(nodes, np.zeros(1, np.int64)), pinned)
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
            for j in range(n + m):
                z[row, i] += AB[i, j] * y[row, j]
            x[row, i] = z[row, i] * scaling[i]
        for i in range(n):
            product = 0.0
            for j in range(n):
                product += M[i, j] * z[row, j]
            total[row] += z[row, i] * product
        hidden_layer(x, row, matrices, 0, zero, hidden)


@compiled(
    "void(float64[::1], float32[:, ::1], float32[:, :, ::1], float32[:, :, ::1], float32[::1], "
    "float64, float32[:, ::1])",
    fastmath=True,
)
def _output(
    total: Array,
    hidden: Single,
    second: Single,
    last: Single,
    pinned: Single,
    factor: float,
    q: Single,
) -> None:
    """Write ``q = -(total + factor network)`` (batch, 1).

    ``hidden`` (batch, h2) comes as the product of the second layer's weights and becomes what that
    layer puts out. second and last are (1, h2, h1 + 1) and (1, 1, h2 + 1).
    """
    batch, h = hidden.shape
    matrices, zeros = _matrices(second, pinned)
    bias = matrices[0, -1]
    zero = zeros[0]
    for row in range(batch):
        for a in range(h):
            hidden[row, a] = tanh(hidden[row, a] + bias[a]) - zero[a]
        learnt = (np.float32(1) - pinned[0]) * last[0, 0, h]
        for a in range(h):
            learnt += last[0, 0, a] * hidden[row, a]
        q[row, 0] = -(total[row] + factor * learnt)


@compiled(
    "void(float32[:, ::1], float64, float32[:, ::1], float32[:, :, ::1], float32[:, :, ::1], "
    "float32[::1], float32[:, ::1], float32[::1], float32[:, :, ::1])",
    fastmath=True,
)
def _output_backward(
    gradient: Single,
    factor: float,
    hidden: Single,
    second: Single,
    last: Single,
    pinned: Single,
    through: Single,
    by_bias: Single,
    by_last: Single,
) -> None:
    """Write the gradients by the second layer's products (batch, h2), its bias, and last.

    ``gradient`` (batch, 1) is that of a loss by what :func:`_output` wrote. The last two are zero
    before.
    """
    batch, h = hidden.shape
    one = np.float32(1)
    all_back = np.float32(0)
    zero = _matrices(second, pinned)[1][0]
    for row in range(batch):
        back = np.float32(-factor * gradient[row, 0])
        all_back += back
        for a in range(h):
            by_last[0, 0, a] += back * hidden[row, a]
            out = hidden[row, a] + zero[a]
            back_a = back * last[0, 0, a]
            through[row, a] = back_a * (one - out * out)
            by_bias[a] += through[row, a] - pinned[0] * back_a * (one - zero[a] * zero[a])
    by_last[0, 0, h] = (one - pinned[0]) * all_back


@compiled(
    f"void(float32[:, ::1], float32[:, ::1], boolean, boolean, {_QUADRATICS}, {_LINEAR}, {_NODES}, "
    "float32[:, :, :, ::1], float64[:, ::1], float64[:, ::1])",
    fastmath=True,
)
def _forms_backward(
    gradient: Single,
    back: Single,
    of_points: bool,
    of_weights: bool,
    y: Array,
    z: Array,
    x: Single,
    hidden: Single,
    W: Array,
    AB: Array,
    M: Array,
    scaling: Array,
    nodes: Single,
    pinned: Single,
    by_nodes: Single,
    by_points: Array,
    by_M: Array,
) -> None:
    """Write the gradients by nodes, points (batch, n + m) and M (n, n), which are zero before.

    ``back`` (batch, h1) is the gradient by the first hidden layer. Those by points, or by nodes
    and M, are zeros unless they are asked for.
    """
    batch = len(y)
    n = len(M)
    m = len(W) - len(M)
    h = nodes.shape[2]
    one = np.float32(1)
    matrices, zeros = _matrices(first_layers(nodes, np.zeros(1, np.int64)), pinned)
    matrix = matrices[0]
    zero = zeros[0]
    by_matrix = np.zeros((n + 1, h), np.float32)
    through = np.empty(h, np.float32)
    for row in range(batch):
        for a in range(h):
            out = hidden[row, a] + zero[a]
            through[a] = back[row, a] * (one - out * out)
            by_matrix[n, a] += through[a] - pinned[0] * back[row, a] * (one - zero[a] * zero[a])
        g = -float(gradient[row, 0])
        if of_weights:
            for j in range(n):
                for a in range(h):
                    by_matrix[j, a] += through[a] * x[row, j]
                for i in range(n):
                    by_M[i, j] += g * z[row, i] * z[row, j]
        if not of_points:
            continue
        for i in range(n + m):
            for j in range(n + m):
                by_points[row, i] += g * (W[i, j] + W[j, i]) * y[row, j]
        for i in range(n):
            by_x = np.float32(0)
            for a in range(h):
                by_x += through[a] * matrix[i, a]
            by_z = by_x * scaling[i]
            for j in range(n):
                by_z += g * (M[i, j] + M[j, i]) * z[row, j]
            for j in range(n + m):
                by_points[row, j] += by_z * AB[i, j]
        for j in range(n, n + m):
            by_points[row, j] *= scaling[j]
    for node in range(2):  # they enter the same sum
        for a in range(h):
            for j in range(n + 1):
                by_nodes[0, node, a, j] = by_matrix[j, a]


ValueConstants = tuple[Array, Array, Array, Array, Single, float]


def value_on_cpu(
    points: th.Tensor, weights: tuple[th.Tensor, ...], constants: ValueConstants
) -> th.Tensor:
    """Return an afterstate value (batch, 1), with a gradient by points (batch, n + m) and weights.

    Weights are entries of the quadratic form; nodes, second and last of the network. Constants are
    W, [A B], the scale of the form, the scaling of :func:`_forms`, pinned, the network's factor.
    """
    size = len(constants[0])
    if points.dim() != 2 or points.shape[1] != size:  # compiled code does not look
        raise ValueError(f"points have shape {tuple(points.shape)}, expected (batch, {size}).")
    if th.is_grad_enabled():
        q: th.Tensor = _Value.apply(constants, points, *weights)  # type: ignore[no-untyped-call]
        return q
    return th.from_numpy(_Pass(constants, points, weights).q)


class _Pass:
    """A forward pass, and what its backward pass needs. Torch multiplies the second layer."""

    def __init__(
        self, constants: ValueConstants, points: th.Tensor, weights: tuple[th.Tensor, ...]
    ) -> None:
        self.weights = weights
        entries, nodes, second, last = to_numpy(weights[0], np.float64), *map(to_numpy, weights[1:])
        W, AB, self.roots, scaling, pinned, self.factor = constants
        self.first: tuple[Any, ...] = (W, AB, entries * self.roots, scaling, nodes, pinned)
        array = to_numpy(points, np.float64)
        (batch, size) = array.shape
        n = len(entries)
        h = nodes.shape[2]
        total = np.zeros(batch)
        y = np.empty((batch, size))
        z = np.zeros((batch, n))
        x = np.empty((batch, n), np.float32)
        hidden = np.empty((batch, h), np.float32)
        self.forms: tuple[Any, ...] = (y, z, x, hidden)
        _forms(array, *self.first, total, *self.forms)
        self.matrix = th.from_numpy(second)[0, :, :-1]
        product = th.mm(th.from_numpy(hidden), self.matrix.T)
        self.hidden = product.numpy()
        self.layers = (second, last, pinned)
        self.q: Single = np.empty((batch, 1), np.float32)
        _output(total, self.hidden, *self.layers, self.factor, self.q)

    def backward(
        self, gradient: Single, of_points: bool, of_weights: bool
    ) -> tuple[th.Tensor | None, ...]:
        """Return the gradients by the points and the weights, as far as they are asked for."""
        last = self.layers[1]
        hidden = self.hidden
        through = np.empty_like(hidden)
        by_bias = np.zeros(hidden.shape[1], np.float32)
        by_last = np.zeros(last.shape, np.float32)
        _output_backward(gradient, self.factor, hidden, *self.layers, through, by_bias, by_last)
        product = th.from_numpy(through)
        back = th.mm(product, self.matrix)
        y = self.forms[0]
        M = self.first[2]
        nodes = self.first[4]
        by_nodes = np.zeros_like(nodes)
        found = np.zeros_like(y)
        by_M = np.zeros_like(M)
        given = (*self.forms, *self.first, by_nodes, found, by_M)
        _forms_backward(gradient, back.numpy(), of_points, of_weights, *given)
        by_points = th.from_numpy(found) if of_points else None
        if not of_weights:
            return by_points, None, None, None, None
        by_second = th.empty_like(self.weights[2])
        th.mm(product.T, th.from_numpy(self.forms[-1]), out=by_second[0, :, :-1])
        by_second[0, :, -1] = th.from_numpy(by_bias)
        by_entries = th.from_numpy(by_M * self.roots)
        return by_points, by_entries, th.from_numpy(by_nodes), by_second, th.from_numpy(by_last)


class _Value(th.autograd.Function):
    """Differentiable by points and weights, once."""

    @staticmethod
    def forward(
        ctx: Any, constants: ValueConstants, points: th.Tensor, *weights: th.Tensor
    ) -> th.Tensor:
        # torch notices weights that change before the backward pass
        ctx.save_for_backward(*weights)
        ctx.done = _Pass(constants, points, weights)
        ctx.dtype = points.dtype
        return th.from_numpy(ctx.done.q)

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[th.Tensor | None, ...]:
        _ = ctx.saved_tensors
        gradient = to_numpy(gradients[0])
        _, of_points, *of_weights = ctx.needs_input_grad
        by_points, *by_weights = ctx.done.backward(gradient, of_points, any(of_weights))
        return None, by_points if by_points is None else by_points.to(ctx.dtype), *by_weights
