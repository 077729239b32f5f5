"""The YANN layers on a CPU: compiled loops, and one operation of torch with its gradient."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch as th

from sb3_yann._numba import Integers, compiled
from sb3_yann._validation import Array, Single
from sb3_yann.control._kernels.law import input_at
from sb3_yann.networks._kernels.stack import (
    WEIGHT_TYPES,
    network,
    network_backward,
    prepared,
    to_numpy,
)
from sb3_yann.units import KEPT_ROUNDING

KEPT_TYPES = (
    "float32[:, ::1], int64[::1], int64[::1], float32[:, ::1], float32[:, ::1], float32[:, :, ::1]"
)
"""Types of what a forward pass keeps: x, used, slot, two hidden layers, outputs, see `forward`."""
Constants = tuple[Array, Array, Array, float]
"""``scaling``, ``change``, ``kept`` and ``limit``, as in `forward`."""
PackedLaw = tuple[Array, Integers, Array, Array]
"""A packed law, room for its inputs, and theta; or two empty arrays, the inputs of any law, and
theta: what is asked for lies within its range."""


@compiled()
def _locate(
    floats: Array, whole: Integers, theta: Array, p: int, used: Integers, slot: Integers, u: Array
) -> int:
    """Write inputs (batch, m), NaN for theta that is not finite; return how many regions are used.

    Write which these are, and each row's place among them.
    """
    slot_of = np.full(p, -1)
    slots = 0
    region = -1
    for row in range(len(theta)):
        region = input_at(floats, whole, theta, u, row, region)
        if region < 0:
            u[row] = np.nan
            region = 0
        if slot_of[region] < 0:
            used[slots] = region
            slot_of[region] = slots
            slots += 1
        slot[row] = slot_of[region]
    return slots


@compiled()
def _between(value: Any, low: Any, high: Any) -> Any:
    """Return a value clamped to bounds; NaN stays what it is."""
    value = high if value > high else value
    return low if value < low else value


@compiled()
def _confined(theta: Any, box: Any) -> Any:
    """Return the part, from 1 to 0, of a correction that counts at theta (n,).

    ``box`` (2 n + 2,) holds its middle, one over its half-widths, and within how many of these a
    correction counts in full, and beyond how many not.
    """
    n = len(theta)
    beyond = 0.0
    for j in range(n):
        beyond = max(beyond, abs(theta[j] - box[j]) * box[n + j])
    return np.float32(min(max((box[-1] - beyond) / (box[-1] - box[-2]), 0.0), 1.0))


@compiled()
def _worst(theta: Array, row: int, law: Any, actions: Any, kept: Array) -> tuple[int, float, float]:
    """Return the row of kept that actions are furthest beyond, -1 for none, and by how much.

    Last comes the share of the way from the law that goes no further beyond any.
    """
    n = theta.shape[1]
    m = len(law)
    worst = -1
    most = 0.0
    share = 1.0
    for i in range(len(kept)):
        push = 0.0
        slack = kept[i, n + m]
        for j in range(n):
            slack -= kept[i, j] * theta[row, j]
        for k in range(m):
            push += kept[i, n + k] * (actions[row, k] - law[k])
            slack -= kept[i, n + k] * law[k]
        room = max(slack - kept[i, n + m + 1], 0.0)
        share = min(share, (room + KEPT_ROUNDING) / max(push, KEPT_ROUNDING))
        beyond = push - min(slack, room)
        if beyond > most:
            worst = i
            most = beyond
    return worst, most, share


@compiled(
    f"int64(float64[::1], int64[::1], float64[:, ::1], float64[:, ::1], float64[::1], "
    f"float64[:, ::1], float64[:, ::1], float64, {WEIGHT_TYPES}, float32[:, ::1], {KEPT_TYPES})"
)
def forward(
    floats: Array,
    whole: Integers,
    u: Array,
    theta: Array,
    scaling: Array,
    change: Array,
    kept: Array,
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
    """Write the actions and what :func:`backward` needs; return how much of ``used`` is in use.

    Parameters
    ----------
    floats, whole : ndarray
        A packed law; empty where u holds the inputs of a law and there is one network.
    u, theta : ndarray, shapes (batch, m) and (batch, n)
    scaling : ndarray, shape (3 n + 2 m + 2,)
        One over the half-widths of the box of theta; the middles of the input ranges; one over
        their half-widths; what :func:`_confined` takes, with zeros for half-widths without end.
    change : ndarray, shape (2, m), (4, m) or (0, m)
        By how much an action may differ from the previous input, the last m entries of theta. Then
        which entries are bounds of the inputs, -1 for none; they are reached as fast as that.
    kept : ndarray, shape (q, n + m + 2)
        Rows ``[a, b, c, margin]``, b of length 1. Where networks add something, actions move onto
        the row ``a theta + b action <= c - margin`` that they are furthest beyond; where the law is
        beyond it by itself, onto c. They then move towards the law's, until no row is broken
        further than the law breaks it.
    limit : float
        The network's output is clamped to [-limit, limit].
    nodes, second, last, pinned : ndarray
        The networks, as in `stack.network`.
    actions, x, used, slot, hidden1, hidden2, outputs : ndarray
        What is written; the last one, (6, batch, m), are the networks' outputs, the actions before
        they are clamped, the lower and upper bounds, the part of the correction that counts, and
        the row of kept that holds the actions, -1 for none.
    """
    slots = 1
    if len(whole):
        slots = _locate(floats, whole, theta, len(pinned), used, slot, u)
    else:
        used[0] = 0
        slot[:] = 0
    used = used[:slots]
    ready = prepared(used, nodes, second, pinned)
    batch, n = theta.shape
    m = last.shape[1]
    for row in range(batch):
        for j in range(n):
            x[row, j] = theta[row, j] * scaling[j]
    out = outputs[0]
    total = outputs[1]
    bounds = outputs[2:4]
    part = outputs[4]
    holds = outputs[5]
    laws = np.empty(m, np.float32)
    network(x, used, slot, ready, last, pinned, hidden1, hidden2, out)
    bounds[0] = -1
    bounds[1] = 1
    for row in range(batch):
        part[row] = _confined(theta[row], scaling[n + 2 * m :])
        for k in range(m):
            for side in range(len(change) - 2):
                at = int(change[side + 2, k])
                if at >= 0:
                    shown = (theta[row, at] - scaling[n + k]) * scaling[n + m + k]
                    bounds[side, row, k] = min(max(shown, -1.0), 1.0)
            bounds[1, row, k] = max(bounds[0, row, k], bounds[1, row, k])
            if len(change):
                previous = (theta[row, n - m + k] - scaling[n + k]) * scaling[n + m + k]
                slowest = min(max(previous + change[0, k], -1.0), 1.0)
                fastest = min(max(previous + change[1, k], -1.0), 1.0)
                for side in range(2):
                    bounds[side, row, k] = min(max(bounds[side, row, k], slowest), fastest)
            low = bounds[0, row, k]
            high = bounds[1, row, k]
            law = np.float32((u[row, k] - scaling[n + k]) * scaling[n + m + k])
            correction = out[row, k]
            if limit < np.inf:  # which NaN and infinite weights do not pass either
                correction = np.float32(min(max(correction, -limit), limit))
                correction = correction if out[row, k] == out[row, k] else np.float32(0)
            if part[row, k] < 1:  # at the full part a NaN stays what it is
                correction = correction * part[row, k] if part[row, k] > 0 else np.float32(0)
            laws[k] = _between(law, low, high)
            total[row, k] = laws[k] + correction
            actions[row, k] = _between(total[row, k], low, high)
        worst = -1
        most = 0.0
        for k in range(m if len(kept) else 0):
            if total[row, k] != laws[k]:
                worst, most, _ = _worst(theta, row, laws, actions, kept)
                break
        holds[row] = worst
        if worst < 0:
            continue
        for k in range(m):
            moved = actions[row, k] - most * kept[worst, n + k]
            moved = np.float32(_between(moved, laws[k] - limit, laws[k] + limit))
            actions[row, k] = _between(moved, bounds[0, row, k], bounds[1, row, k])
        _, _, share = _worst(theta, row, laws, actions, kept)
        for k in range(m if share < 1 else 0):
            moved = np.float32(laws[k] + share * (actions[row, k] - laws[k]))
            actions[row, k] = _between(moved, bounds[0, row, k], bounds[1, row, k])
    return slots


@compiled(
    f"void(float32[:, ::1], boolean, float64[:, ::1], float64, {WEIGHT_TYPES}, {KEPT_TYPES}, "
    "float32[:, :, :, ::1], float32[:, :, ::1], float32[:, :, ::1])"
)
def backward(
    gradient: Single,
    dense: bool,
    kept: Array,
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
    correction, further beyond its bound is stopped: descent moves against the gradient. All else
    passes, however far a row of ``kept`` has moved the action.
    """
    out = outputs[0]
    total = outputs[1]
    bounds = outputs[2:4]
    back = gradient * outputs[4]
    n = x.shape[1]
    for row in range(len(back)):
        holds = int(outputs[5, row, 0])
        along = 0.0
        for k in range(back.shape[1] if holds >= 0 else 0):
            along += kept[holds, n + k] * back[row, k]
        for k in range(back.shape[1] if along < 0 else 0):
            back[row, k] -= along * kept[holds, n + k]
        for k in range(back.shape[1]):
            above = total[row, k] >= bounds[1, row, k] or out[row, k] >= limit
            below = total[row, k] <= bounds[0, row, k] or out[row, k] <= -limit
            if (above and back[row, k] < 0) or (below and back[row, k] > 0):
                back[row, k] = 0
    network_backward(
        back, x, used, slot, dense, True, nodes, second, last, pinned,
        hidden1, hidden2, by_nodes, by_second, by_last,
    )  # fmt: skip


def layer_on_cpu(
    pack: Callable[[Array], PackedLaw],
    theta: th.Tensor | Array,
    constants: Constants,
    weights: tuple[th.Tensor, ...],
    pinned: Single,
    by_row: bool,
) -> th.Tensor:
    """Return the actions (batch, m) of a layer, with a gradient by its weights.

    ``pack`` makes of theta (batch, n) what :func:`forward` takes of the law. Weights are nodes,
    second and last. ``by_row`` gradients are sparse, with the rows of the regions in use.
    """
    known = (*pack(_rows(theta, weights[0])), *constants)
    if th.is_grad_enabled():
        actions: th.Tensor = _Layer.apply(known, pinned, by_row, *weights)  # type: ignore[no-untyped-call]
        return actions
    return th.from_numpy(_actions([*known, *map(to_numpy, weights), pinned])[0])


def frozen_layer(
    pack: Callable[[Array], PackedLaw],
    constants: Constants,
    weights: tuple[th.Tensor, ...],
    pinned: Single,
) -> Callable[[Array], Single]:
    """Return a layer of now as a function from theta (batch, n) to actions (batch, m)."""
    rest = (*constants, *map(to_numpy, weights), pinned)
    return lambda theta: _actions([*pack(_rows(theta, weights[0])), *rest])[0]


@compiled(
    "void(float32[:, ::1], float32[:, ::1], int64[::1], float32[:, :, ::1], int64[::1], float64)"
)
def _adam(
    weights: Single,
    gradients: Single,
    used: Integers,
    moments: Single,
    taken: Integers,
    rate: float,
) -> None:
    """Take a step of Adam for the rows in use of weights (p, size), as `RowAdam` does.

    ``moments`` (2, p, size) are the averages of a row's gradients and of their squares, ``taken``
    (p,) how many steps it has done with this one.
    """
    first = np.float32(0.9)
    second = np.float32(0.999)
    for s in range(len(used)):
        i = used[s]
        size = np.float32(rate / (1 - 0.9 ** taken[i]))
        scale = np.float32(1 / (1 - 0.999 ** taken[i]))
        for j in range(weights.shape[1]):
            g = gradients[s, j]
            mean = g + first * (moments[0, i, j] - g)
            square = g * g + second * (moments[1, i, j] - g * g)
            moments[0, i, j] = mean
            moments[1, i, j] = square
            weights[i, j] -= size * mean / (np.sqrt(square * scale) + np.float32(1e-8))


def descend(
    pack: Callable[[Array], PackedLaw],
    theta: th.Tensor,
    wanted: Single,
    largest: float,
    steps: Iterable[tuple[Integers, float]],
    constants: Constants,
    weights: tuple[th.Tensor, ...],
    pinned: Single,
) -> None:
    """Take steps of Adam with a layer, see `LawLayer.descend`; its law is found once."""
    floats, whole, inputs, points = pack(_rows(theta, weights[0]))
    arrays = [to_numpy(each) for each in weights]  # the same memory
    flat = [each.reshape(len(each), -1) for each in arrays]
    moments = [np.zeros((2, *each.shape), np.float32) for each in flat]
    taken = np.zeros(len(pinned), np.int64)
    for rows, rate in steps:
        given: list[Any] = [floats, whole, inputs[rows], points[rows], *constants, *arrays, pinned]
        actions, kept = _actions(given)
        used = kept[1]
        slopes: Any = np.clip(actions - wanted[rows], -largest, largest) / np.float32(len(rows))
        gradients = [np.zeros((len(used), *each.shape[1:]), np.float32) for each in arrays]
        backward(slopes, False, *given[-6:], *kept, *gradients)
        taken[used] += 1
        for own, by, average in zip(flat, gradients, moments, strict=True):
            _adam(own, by.reshape(len(by), -1), used, average, taken, rate)


def _rows(theta: Any, nodes: Any) -> Array:
    """Return theta (batch, n) for compiled code, which does not look at shapes."""
    n = nodes.shape[3] - 1
    if theta.ndim != 2 or theta.shape[1] != n:
        raise ValueError(f"theta has shape {tuple(theta.shape)}, expected (batch, {n}).")
    if isinstance(theta, th.Tensor):
        return to_numpy(theta, np.float64)
    return np.ascontiguousarray(theta, np.float64)


def _actions(given: list[Any]) -> tuple[Single, list[Any]]:
    """Return the actions and what :func:`backward` needs, of all that :func:`forward` takes."""
    batch, n = given[3].shape
    second = given[-3]
    p, m, columns = given[-2].shape
    actions = np.empty((batch, m), np.float32)
    x = np.empty((batch, n), np.float32)
    used = np.empty(max(min(batch, p), 1), np.int64)
    slot = np.empty(batch, np.int64)
    hidden1 = np.empty((batch, second.shape[2] - 1), np.float32)
    hidden2 = np.empty((batch, columns - 1), np.float32)
    outputs = np.empty((6, batch, m), np.float32)
    arrays = [*given, actions, x, used, slot, hidden1, hidden2, outputs]
    slots = forward(*arrays)
    return actions, [x, used[:slots], slot, hidden1, hidden2, outputs]


class _Layer(th.autograd.Function):
    """Differentiable by the weights of the networks, once."""

    @staticmethod
    def forward(
        ctx: Any, known: tuple[Any, ...], pinned: Single, by_row: bool, *weights: th.Tensor
    ) -> th.Tensor:
        given = [*known, *map(to_numpy, weights), pinned]
        actions, kept = _actions(given)
        # torch notices weights that change before the backward pass
        ctx.save_for_backward(*weights)
        ctx.given = given[-6:]
        ctx.kept = kept
        ctx.by_row = by_row
        return th.from_numpy(actions)

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[th.Tensor | None, ...]:
        weights = ctx.saved_tensors
        used = ctx.kept[1]
        sizes = [
            (len(used), *weight.shape[1:]) if ctx.by_row else weight.shape for weight in weights
        ]
        arrays = [np.zeros(size, np.float32) for size in sizes]
        backward(to_numpy(gradients[0]), not ctx.by_row, *ctx.given, *ctx.kept, *arrays)
        found = [th.from_numpy(each) for each in arrays]
        if ctx.by_row:
            rows = th.from_numpy(used)[None]
            found = [
                th.sparse_coo_tensor(rows, by_weight, weight.shape, check_invariants=False)
                for by_weight, weight in zip(found, weights, strict=True)
            ]
        return None, None, None, *found
