"""Stacks of zero-output networks on a CPU, forward and backward, as compiled loops.

One call each way, without torch's overhead; only the networks in use are read or written.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_yann._numba import Integers, compiled
from sb3_yann._validation import Single

WEIGHT_TYPES = "float32[:, :, :, ::1], float32[:, :, ::1], float32[:, :, ::1], float32[::1]"
"""Types of nodes, second, last and pinned, see :func:`network`."""


def to_numpy(tensor: th.Tensor, dtype: Any = np.float32) -> NDArray[Any]:
    """Return what compiled code takes for a tensor, without its gradient: the same memory if so."""
    known = tensor.float() if tensor.dtype == th.bfloat16 else tensor  # which numpy does not have
    return np.ascontiguousarray(known.numpy(force=True), dtype)


@compiled()  # not a fast one: s(b) - s(b) must be zero wherever the two are computed
def tanh(x: Any) -> Any:
    """Return tanh in float32 to two units in the last place: exact at 0, odd, 1 beyond 10.

    With t = tanh(x / 2) from the eighth convergent of Lambert's continued fraction
    ``t = h / (1 + h^2 / (3 + h^2 / (5 + ...)))`` at h = x / 2, it is ``2 t / (1 + t^2)``.
    """
    one = np.float32(1)
    five = np.float32(5)
    h = np.float32(0.5) * x
    h = five if h > five else h  # NaN stays what it is
    h = -five if h < -five else h
    y = h * h
    above = ((np.float32(36) * y + np.float32(6930)) * y + np.float32(270270)) * y
    below = ((y + np.float32(630)) * y + np.float32(51975)) * y + np.float32(945945)
    t = h * (above + np.float32(2027025)) / (below * y + np.float32(2027025))
    return (t + t) / (one + t * t)


@compiled()
def first_layers(nodes: Single, used: Integers) -> Single:
    """Return the sums of the pairs of nodes, (slots, h1, n + 1)."""
    rows, columns = nodes.shape[2:]
    sums = np.empty((len(used), rows, columns), np.float32)
    # Entry by entry: arrays that are added as a whole take numba five times as long to compile.
    for s in range(len(used)):
        own = nodes[used[s]]
        for a in range(rows):
            for j in range(columns):
                sums[s, a, j] = own[0, a, j] + own[1, a, j]
    return sums


@compiled()
def transposed(matrices: Single, used: Integers) -> Single:
    """Return the matrices in use with inputs before outputs, (slots, inputs, outputs)."""
    _, rows, columns = matrices.shape
    out = np.empty((len(used), columns, rows), np.float32)
    for s in range(len(used)):
        for a in range(rows):
            for j in range(columns):
                out[s, j, a] = matrices[used[s], a, j]
    return out


@compiled()
def at_zero(matrices: Single, used: Integers, pinned: Single) -> Single:
    """Return what a hidden layer puts out at zero where it is pinned, else 0: (slots, outputs).

    ``matrices`` (slots, inputs + 1, outputs) hold the biases in their last rows.
    """
    out = np.zeros((len(used), matrices.shape[2]), np.float32)
    for s in range(len(used)):
        if pinned[used[s]] > 0:
            for a in range(matrices.shape[2]):
                out[s, a] = tanh(matrices[s, -1, a])
    return out


@compiled(fastmath=True)
def hidden_layer(x: Single, row: int, matrices: Single, s: int, zero: Single, out: Single) -> None:
    """Write ``s(W x + b) - s(b)`` to a row of out, for that of x.

    The matrix, (inputs + 1, outputs), and s(b) are number s of several: slices would be slow.
    """
    inputs = matrices.shape[1] - 1
    outputs = matrices.shape[2]
    for a in range(outputs):
        out[row, a] = matrices[s, inputs, a]
    for j in range(inputs):
        for a in range(outputs):
            out[row, a] += matrices[s, j, a] * x[row, j]
    for a in range(outputs):
        out[row, a] = tanh(out[row, a]) - zero[s, a]


@compiled()
def _block_of(size: int) -> int:
    """Return how many rows a product with a matrix of so many entries takes at once.

    Threads of BLAS wait for one another: where other processes have the cores, ten times as long.
    Large matrices are worth it.
    """
    block = 128  # rows of a product of narrow matrices: as a whole it takes BLAS twice as long
    # 262_144: multiplications of a product that OpenBLAS does not share out among threads
    few = 262_144 // size
    return few if block // 4 <= few < block else block


@compiled()
def _product(rows: Single, matrix: Single, out: Single) -> None:
    """Write the products of rows, (batch, k), and a matrix, (k, outputs)."""
    block = _block_of(matrix.size)
    for at in range(0, len(rows), block):
        np.dot(rows[at : at + block], matrix, out[at : at + block])


@compiled()
def _layer_of_all(x: Single, matrix: Single, zero: Single, out: Single) -> None:
    """Write what :func:`hidden_layer` does for all rows of x, which go through one matrix."""
    _product(x, np.ascontiguousarray(matrix[:-1].T).T, out)  # BLAS is faster so
    for row in range(len(out)):
        for a in range(out.shape[1]):
            out[row, a] = tanh(out[row, a] + matrix[-1, a]) - zero[a]


@compiled()
def prepared(used: Integers, nodes: Single, second: Single, pinned: Single) -> Any:
    """Return the two hidden layers of the networks in use, transposed, and what each is at zero."""
    matrices1 = transposed(first_layers(nodes, used), np.arange(len(used)))
    matrices2 = transposed(second, used)
    return matrices1, matrices2, at_zero(matrices1, used, pinned), at_zero(matrices2, used, pinned)


@compiled(fastmath=True)
def network(
    x: Single,
    used: Integers,
    slot: Integers,
    ready: Any,
    last: Single,
    pinned: Single,
    hidden1: Single,
    hidden2: Single,
    out: Single,
) -> None:
    """Write the networks' output (batch, m), and their hidden layers, (batch, h1) and (batch, h2).

    Parameters
    ----------
    x : ndarray, shape (batch, n)
    used : ndarray of int, shape (slots,)
        The networks in use.
    slot : ndarray of int, shape (batch,)
        Where in ``used`` each row's network is.
    ready : tuple of ndarray
        From :func:`prepared`, for pairs of nodes (p, 2, h1, n + 1) and second layers (p, h2, h1 +
        1).
    last : ndarray, shape (p, m, h2 + 1)
    pinned : ndarray, shape (p,)
        1 where the network stays zero at the origin, else 0.
    hidden1, hidden2, out : ndarray
        What is written.
    """
    batch = len(x)
    m = last.shape[1]
    h2 = last.shape[2] - 1
    matrices1, matrices2, zero1, zero2 = ready
    alone = len(pinned) == 1
    if alone:  # two thirds of the time that row by row takes
        _layer_of_all(x, matrices1[0], zero1[0], hidden1)
        _layer_of_all(hidden1, matrices2[0], zero2[0], hidden2)
    for row in range(batch):
        s = slot[row]
        i = used[s]
        if not alone:
            hidden_layer(x, row, matrices1, s, zero1, hidden1)
            hidden_layer(hidden1, row, matrices2, s, zero2, hidden2)
        for k in range(m):
            total = (np.float32(1) - pinned[i]) * last[i, k, h2]
            for j in range(h2):
                total += last[i, k, j] * hidden2[row, j]
            out[row, k] = total


@compiled(fastmath=True)
def _hidden_backward(
    back: Single,
    x: Single,
    out: Single,
    row: int,
    zero: Single,
    pinned: float,
    s: int,
    matrices: Single,
    i: int,
    by_matrices: Single,
    at: int,
    by_x: Single,
) -> None:
    """Add the gradient by a matrix (outputs, inputs + 1), and write that by a row of x.

    ``back`` (batch, outputs) is the gradient by what :func:`hidden_layer` wrote to ``out``; the
    matrix is number i of ``matrices``, its gradient number ``at`` of ``by_matrices``.
    """
    one = np.float32(1)
    inputs = x.shape[1]
    for j in range(inputs):
        by_x[row, j] = 0
    for a in range(out.shape[1]):  # of tanh(z + b) - tanh(b): by z, and less that of tanh(b), by b
        b = zero[s, a]
        through = back[row, a] * (one - (out[row, a] + b) * (out[row, a] + b))
        for j in range(inputs):
            by_x[row, j] += through * matrices[i, a, j]
            by_matrices[at, a, j] += through * x[row, j]
        by_matrices[at, a, inputs] += through - pinned * back[row, a] * (one - b * b)


@compiled(fastmath=True)
def _all_backward(
    back: Single, x: Single, out: Single, zero: Single, pinned: float, asked: bool, by: Single
) -> Single:
    """Write the gradient by a matrix as :func:`_hidden_backward` does, that all rows go through.

    It is zero before, and stays so unless it is asked for. Return that by what is in tanh, (batch,
    outputs).
    """
    one = np.float32(1)
    inputs = x.shape[1]
    through = np.empty(out.shape, np.float32)
    by_bias = np.zeros(out.shape[1], np.float32)
    for row in range(len(out)):
        for a in range(out.shape[1]):
            b = zero[a]
            through[row, a] = back[row, a] * (one - (out[row, a] + b) * (out[row, a] + b))
            by_bias[a] += through[row, a] - pinned * back[row, a] * (one - b * b)
    by[:, inputs] = by_bias
    block = _block_of(inputs * out.shape[1])
    for at in range(0, len(x) if asked else 0, block):
        by[:, :inputs] += np.dot(through[at : at + block].T, x[at : at + block])
    return through


@compiled(fastmath=True)
def network_backward(
    back: Single,
    x: Single,
    used: Integers,
    slot: Integers,
    dense: bool,
    asked: bool,
    nodes: Single,
    second: Single,
    last: Single,
    pinned: Single,
    hidden1: Single,
    hidden2: Single,
    by_nodes: Single,
    by_second: Single,
    by_last: Single,
) -> Single:
    """Write the gradients by nodes, second and last; the last two are zero before.

    Of all networks if ``dense``, else of those in use alone, in the order of ``used``. ``back``
    (batch, m) is the gradient by the output; the others are as in :func:`network`. Those of a
    network that is alone may not be ``asked`` for. Return its gradient by x, (batch, n).
    """
    batch, n = x.shape
    m = last.shape[1]
    h1 = second.shape[2] - 1
    h2 = last.shape[2] - 1
    rows = len(pinned) if dense else len(used)
    by_first = np.zeros((rows, h1, n + 1), np.float32)
    by_x = np.empty((batch, n), np.float32)
    by_1 = np.empty((batch, h1), np.float32)
    by_2 = np.zeros((batch, h2), np.float32)
    first = first_layers(nodes, used)
    matrices1, matrices2, zero1, zero2 = prepared(used, nodes, second, pinned)
    for row in range(batch):
        s = slot[row]
        i = used[s]
        at = i if dense else s
        for c in range(m):
            g = back[row, c]
            for j in range(h2):
                by_2[row, j] += g * last[i, c, j]
                by_last[at, c, j] += g * hidden2[row, j]
            by_last[at, c, h2] += g * (np.float32(1) - pinned[i])
        own = pinned[i]
        if len(pinned) == 1:
            continue
        _hidden_backward(by_2, hidden1, hidden2, row, zero2, own, s, second, i, by_second, at, by_1)
        _hidden_backward(by_1, x, hidden1, row, zero1, own, s, first, s, by_first, at, by_x)
    if len(pinned) == 1:
        own = pinned[0]
        through = _all_backward(by_2, hidden1, hidden2, zero2[0], own, asked, by_second[0])
        _product(through, matrices2[0, :-1].T, by_1)
        through = _all_backward(by_1, x, hidden1, zero1[0], own, asked, by_first[0])
        _product(through, matrices1[0, :-1].T, by_x)
    for s in range(by_first.shape[0]):
        for node in range(2):  # they enter the same sum
            for a in range(by_first.shape[1]):
                for j in range(by_first.shape[2]):
                    by_nodes[s, node, a, j] = by_first[s, a, j]
    return by_x
