"""How the actions of a YANN layer change with theta, as a compiled loop."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_yann._numba import Single, compiled
from sb3_yann._validation import Array
from sb3_yann.networks._kernels.mlp import slopes_by_x


@compiled()
def add_slopes(
    back: Array,
    theta: Array,
    row: int,
    u: Array,
    of_law: Array,
    scaling: Array,
    change: Array,
    limit: float,
    by_network: Single,
    s: int,
    ready: Any,
    last: Single,
    i: int,
    hidden1: Single,
    hidden2: Single,
    outputs: Single,
    by_theta: Array,
) -> None:
    """Add ``back @ slopes`` of the actions at a row of theta (batch, n) to that of by_theta.

    Law and network do not move on their bounds, and on those of the rate with the previous input.

    Parameters
    ----------
    back : ndarray, shape (m,)
        The gradient by the actions.
    theta, scaling, change, limit, hidden1, hidden2, outputs
        As in `layer_loops.act`, which has written the last three.
    row : int
    u, of_law : ndarray, shapes (m,) and (m, n)
        The law's inputs, and their slopes: zero where they are clipped.
    by_network : ndarray, shape (m,)
        Overwritten.
    s, ready, last, i
        The network, as in :func:`slopes_by_x`.
    by_theta : ndarray, shape (batch, n)
    """
    n, m = theta.shape[1], len(back)
    previous, part, by_part, any_free = n - m, outputs[4, row, 0], 0.0, False
    for k in range(m):
        total, low, high = outputs[1, row, k], outputs[2, row, k], outputs[3, row, k]
        by_network[k] = 0
        if total <= low or total >= high:
            if len(change) and abs(low if total <= low else high) < 1:
                by_theta[row, previous + k] += back[k] * scaling[n + m + k]
            continue
        law = np.float32((u[k] - scaling[n + k]) * scaling[n + m + k])
        if law <= low or law >= high:
            if len(change) and abs(low if law <= low else high) < 1:
                by_theta[row, previous + k] += back[k] * scaling[n + m + k]
        else:
            for j in range(n):
                by_theta[row, j] += back[k] * scaling[n + m + k] * of_law[k, j]
        correction = outputs[0, row, k]
        if abs(correction) < limit:
            by_network[k], any_free = back[k] * part, True
        by_part += back[k] * min(max(correction, -limit), limit)
    if part <= 0:
        return
    if any_free:
        by_x = np.empty(n, np.float32)
        slopes_by_x(by_network, row, s, ready, last, i, hidden1, hidden2, by_x)
        for j in range(n):
            by_theta[row, j] += by_x[j] * scaling[j]
    if part < 1:
        box, largest, of = n + 2 * m, -1.0, 0
        for j in range(n):
            beyond = abs(theta[row, j] - scaling[box + j]) * scaling[box + n + j]
            if beyond > largest:
                largest, of = beyond, j
        sign = 1.0 if theta[row, of] > scaling[box + of] else -1.0
        span = scaling[box + 2 * n + 1] - scaling[box + 2 * n]
        by_theta[row, of] -= by_part * sign * scaling[box + n + of] / span
