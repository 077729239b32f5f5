"""Laws and networks of a layer as compiled loops, forward and backward."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_yann._numba import Integers, Single, compiled
from sb3_yann._validation import Array
from sb3_yann.control._kernels.law import input_at
from sb3_yann.networks._kernels.mlp import WEIGHTS, network, network_backward, prepared

KEPT = "float32[:, ::1], int64[::1], int64[::1], float32[:, ::1], float32[:, ::1]"
KEPT += ", float32[:, :, ::1]"
"""Types of what a forward pass keeps: x, used, slot, two hidden layers, outputs, see `act`."""


@compiled()
def _locate(
    floats: Array, whole: Integers, theta: Array, p: int, used: Integers, slot: Integers
) -> tuple[Array, int]:
    """Return inputs (batch, m), NaN for theta that is not finite, and how many regions are in use.

    Write which these are, and each row's place among them.
    """
    u, slot_of = np.empty((len(theta), whole[1])), np.full(p, -1)
    slots, region = 0, -1
    for row in range(len(theta)):
        region = input_at(floats, whole, theta, u, row, region)
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


@compiled()
def _confined(theta: Any, box: Any) -> Any:
    """Return the part, from 1 to 0, of a correction that counts at theta (n,).

    ``box`` (2 n + 2,) holds its middle, one over its half-widths, and within how many of these a
    correction counts in full, and beyond how many not.
    """
    n, beyond, full, none = len(theta), 0.0, box[-2], box[-1]
    for j in range(n):
        beyond = max(beyond, abs(theta[j] - box[j]) * box[n + j])
    return np.float32(min(max((none - beyond) / (none - full), 0.0), 1.0))


@compiled()
def act(
    u: Array,
    theta: Array,
    scaling: Array,
    change: Array,
    limit: float,
    ready: Any,
    last: Single,
    pinned: Single,
    actions: Single,
    x: Single,
    used: Integers,
    slot: Integers,
    hidden1: Single,
    hidden2: Single,
    outputs: Single,
) -> None:
    """Write the actions (batch, m), and what :func:`backward` needs, for a law's inputs u.

    Parameters
    ----------
    u, theta : ndarray, shapes (batch, m) and (batch, n)
    scaling : ndarray, shape (3 n + 2 m + 2,)
        One over the half-widths of the box of theta; the middles of the input ranges; one over
        their half-widths; what :func:`_confined` takes, with zeros for half-widths without end.
    change : ndarray, shape (2, m) or (0, m)
        By how much an action may differ from the previous input, the last m entries of theta.
    limit : float
        The network's output is clamped to [-limit, limit].
    ready, last, pinned, used, slot
        As in :func:`network`.
    actions, x, hidden1, hidden2, outputs : ndarray
        What is written; the last one, (5, batch, m), are the networks' outputs, the actions before
        they are clamped, the lower and upper bounds, and the part of the correction that counts.
    """
    (batch, n), m = theta.shape, last.shape[1]
    for row in range(batch):
        for j in range(n):
            x[row, j] = theta[row, j] * scaling[j]
    out, total, bounds, part = outputs[0], outputs[1], outputs[2:4], outputs[4]
    network(x, used, slot, ready, last, pinned, hidden1, hidden2, out)
    bounds[0], bounds[1] = -1, 1
    for row in range(batch):
        part[row] = _confined(theta[row], scaling[n + 2 * m :])
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
            if part[row, k] < 1:  # at the full part a NaN stays what it is
                correction = correction * part[row, k] if part[row, k] > 0 else np.float32(0)
            total[row, k] = _between(law, low, high) + correction
            actions[row, k] = _between(total[row, k], low, high)


_REST = f"float64[:, ::1], float64[::1], float64[:, ::1], float64, {WEIGHTS}, float32[:, ::1]"


@compiled(f"int64(float64[::1], int64[::1], {_REST}, {KEPT})")
def forward(
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
    """Write what :func:`act` does for a packed law; return how much of ``used`` is in use."""
    u, slots = _locate(floats, whole, theta, len(pinned), used, slot)
    ready = prepared(used[:slots], nodes, second, pinned)
    act(
        u, theta, scaling, change, limit, ready, last, pinned, actions,
        x, used[:slots], slot, hidden1, hidden2, outputs,
    )  # fmt: skip
    return slots


@compiled(f"int64(float64[:, ::1], {_REST}, {KEPT})")
def forward_shared(
    u: Array,
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
    """Write what :func:`act` does for inputs u (batch, m) and one network; return 1."""
    used[0], slot[:] = 0, 0
    ready = prepared(used[:1], nodes, second, pinned)
    act(
        u, theta, scaling, change, limit, ready, last, pinned, actions,
        x, used[:1], slot, hidden1, hidden2, outputs,
    )  # fmt: skip
    return 1


@compiled(
    f"void(float32[:, ::1], boolean, float64, {WEIGHTS}, {KEPT}, "
    "float32[:, :, :, ::1], float32[:, :, ::1], float32[:, :, ::1])"
)
def backward(
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
    out, total, bounds, part = outputs[0], outputs[1], outputs[2:4], outputs[4]
    back = gradient * part
    for row in range(len(back)):
        for k in range(back.shape[1]):
            above = total[row, k] >= bounds[1, row, k] or out[row, k] >= limit
            below = total[row, k] <= bounds[0, row, k] or out[row, k] <= -limit
            if (above and back[row, k] < 0) or (below and back[row, k] > 0):
                back[row, k] = 0
    matrices = nodes, second, last, pinned
    found = by_nodes, by_second, by_last
    network_backward(back, x, used, slot, dense, *matrices, hidden1, hidden2, *found)
