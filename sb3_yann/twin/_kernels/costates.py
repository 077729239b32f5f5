"""The costates along runs of a layer in a twin with polynomial residuals, compiled."""

from __future__ import annotations

import numpy as np

from sb3_yann._numba import Integers, Single, compiled
from sb3_yann._validation import Array
from sb3_yann.control._kernels.law import slopes_at
from sb3_yann.networks._kernels.stack import WEIGHTS, prepared
from sb3_yann.networks._kernels.yann_layer import KEPT, add_slopes
from sb3_yann.twin._kernels.step import ROWS, TWIN, monomials

_POLICY = f"float64[::1], int64[::1], float64[::1], float64[:, ::1], float64, {WEIGHTS}"


@compiled(f"void({_POLICY}, float64[::1], {TWIN}, int64[::1], {KEPT}, {ROWS}, {ROWS})")
def costates(
    floats: Array,
    whole: Integers,
    scaling: Array,
    change: Array,
    limit: float,
    nodes: Single,
    second: Single,
    last: Single,
    pinned: Single,
    half: Array,
    linear: Array,
    columns: Integers,
    box: Array,
    parents: Integers,
    variables: Integers,
    weights: Array,
    regions: Integers,
    x: Single,
    used: Integers,
    slot: Integers,
    hidden1: Single,
    hidden2: Single,
    outputs: Single,
    thetas: Array,
    inputs: Array,
    by_theta: Array,
    by_input: Array,
) -> None:
    """Add to the slopes of each step's own cost those of the costs to come, along runs of a layer.

    Step follows upon step: ``thetas`` and ``inputs`` have steps times batch rows. ``half`` (m,) are
    the half-widths of the input ranges. Of the law there are the ``regions`` in use, of the layer
    what its forward pass has kept. ``by_theta``, which has those of the end besides, and
    ``by_input`` are overwritten from the end to the beginning.
    """
    n, m, k, size = thetas.shape[1], inputs.shape[1], len(columns), len(parents)
    batch = len(by_theta) - len(thetas)
    values, worth = np.empty(weights.shape[1]), np.empty(k + size)
    ready, by_network = prepared(used, nodes, second, pinned), np.empty(m, np.float32)
    u, slopes, back = np.empty(m), np.empty((m, n)), np.empty(m)
    for row in range(len(thetas) - 1, -1, -1):
        after, member = row + batch, row % batch * len(weights) // batch
        for j in range(n):
            for i in range(n):
                by_theta[row, i] += by_theta[after, j] * linear[j, i]
            for i in range(m):
                by_input[row, i] += by_theta[after, j] * linear[j, n + i]
        # What a monomial is worth passes to its parent and to its variable.
        monomials(thetas, inputs, row, columns, box, parents, variables, values)
        for i in range(k + size):
            worth[i] = 0.0
            for j in range(weights.shape[2]):
                worth[i] += weights[member, i, j] * by_theta[after, j]
        for i in range(size - 1, -1, -1):
            worth[parents[i]] += worth[k + i] * values[variables[i]]
            worth[variables[i]] += worth[k + i] * values[parents[i]]
        for j in range(k):
            of = columns[j]
            at = thetas[row, of] if of < n else inputs[row, of - n]
            if box[0, j] < at < box[1, j]:
                if of < n:
                    by_theta[row, of] += worth[j] / box[2, j]
                else:
                    by_input[row, of - n] += worth[j] / box[2, j]
        for i in range(m):
            back[i] = by_input[row, i] * half[i]
        slopes_at(floats, whole, regions[row], thetas, u, slopes, row)
        add_slopes(
            back, thetas, row, u, slopes, scaling, change, limit, by_network, slot[row],
            ready, last, used[slot[row]], hidden1, hidden2, outputs, by_theta,
        )  # fmt: skip
