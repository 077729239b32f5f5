"""Runs of a policy in a twin with polynomial residuals, and the costate along them, compiled.

A policy goes in as its packed law, then what `layer_loops.act` takes, then the middles and the
half-widths of the input ranges (2, m). Without networks, ``len(pinned) == 0``, it is the law. The
twin goes in as arrays:

- ``linear`` (n, n + m): the prediction matrices side by side;
- ``columns`` (k,): where in ``[theta, u]`` the features are that a residual is fed;
- ``box`` (3, k): their least and largest values, and what they are scaled by;
- ``parents``, ``variables``: monomial k + i is monomial ``parents[i]`` times a feature;
- ``weights`` (members, monomials, states): of each, and of the constant one if there is one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_yann._numba import Integers, Single, compiled
from sb3_yann._validation import Array
from sb3_yann.control.law._kernels import input_at, slopes_at
from sb3_yann.networks._kernels.layer_loops import act
from sb3_yann.networks._kernels.mlp import WEIGHTS, prepared
from sb3_yann.networks._kernels.slopes import add_slopes

_POLICY = f"float64[::1], int64[::1], float64[::1], float64[:, ::1], float64, {WEIGHTS}"
_POLICY += ", float64[:, ::1]"
_TWIN = "float64[:, ::1], int64[::1], float64[:, ::1], int64[::1], int64[::1], float64[:, :, ::1]"
_RUNS = "float64[:, :, ::1], float64[:, :, ::1]"


@compiled()
def _empty(theta: Array, second: Single, last: Single) -> Any:
    """Return what `act` writes to, without the slots: actions, x, two hidden layers, outputs."""
    (batch, n), (_, m, columns) = theta.shape, last.shape
    hidden1 = np.empty((batch, second.shape[2] - 1), np.float32)
    hidden2 = np.empty((batch, columns - 1), np.float32)
    actions, x = np.empty((batch, m), np.float32), np.empty((batch, n), np.float32)
    return actions, x, hidden1, hidden2, np.empty((5, batch, m), np.float32)


@compiled()
def _monomials(
    theta: Array,
    u: Array,
    row: int,
    columns: Integers,
    box: Array,
    parents: Integers,
    variables: Integers,
    values: Array,
) -> None:
    """Write the monomials at a row of theta and u, the k scaled features first."""
    n, k = theta.shape[1], len(columns)
    for j in range(k):
        of = columns[j]
        value = theta[row, of] if of < n else u[row, of - n]
        value = box[0, j] if value < box[0, j] else value  # NaN stays what it is
        values[j] = (box[1, j] if value > box[1, j] else value) / box[2, j]
    for i in range(len(parents)):
        values[k + i] = values[parents[i]] * values[variables[i]]
    if len(values) > k + len(parents):
        values[k + len(parents)] = 1.0


@compiled(f"void({_POLICY}, {_TWIN}, {_RUNS})")
def roll_out(
    floats: Array,
    whole: Integers,
    scaling: Array,
    change: Array,
    limit: float,
    nodes: Single,
    second: Single,
    last: Single,
    pinned: Single,
    span: Array,
    linear: Array,
    columns: Integers,
    box: Array,
    parents: Integers,
    variables: Integers,
    weights: Array,
    thetas: Array,
    inputs: Array,
) -> None:
    """Write thetas (steps + 1, rows, n) from the first ones on, and inputs (steps, rows, m).

    The rows are shared out among the members, the first ones go to the first.
    """
    _, batch, n = thetas.shape
    m, each, p = inputs.shape[2], batch // len(weights), len(pinned)
    values = np.empty(weights.shape[1])
    actions, x, hidden1, hidden2, outputs = _empty(thetas[0], second, last)
    used, slot = np.arange(p), np.zeros(batch, np.int64)
    ready, regions = prepared(used, nodes, second, pinned), np.full(batch, -1)
    for t in range(len(inputs)):
        theta, u, after = thetas[t], inputs[t], thetas[t + 1]
        for row in range(batch):
            regions[row] = input_at(floats, whole, theta, u, row, regions[row])
            if regions[row] < 0:
                u[row] = np.nan
            slot[row] = max(regions[row], 0) if p > 1 else 0
        if p:
            act(
                u, theta, scaling, change, limit, ready, last, pinned, actions,
                x, used, slot, hidden1, hidden2, outputs,
            )  # fmt: skip
            for row in range(batch):
                for k in range(m):
                    u[row, k] = span[0, k] + span[1, k] * actions[row, k]
        for row in range(batch):
            _monomials(theta, u, row, columns, box, parents, variables, values)
            for j in range(n):
                total = 0.0
                for i in range(n):
                    total += linear[j, i] * theta[row, i]
                for i in range(m):
                    total += linear[j, n + i] * u[row, i]
                after[row, j] = total
            own = weights[row // each]
            for i in range(len(values)):
                for j in range(own.shape[1]):
                    after[row, j] += own[i, j] * values[i]


@compiled(f"void({_POLICY}, {_TWIN}, {_RUNS}, {_RUNS})")
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
    span: Array,
    linear: Array,
    columns: Integers,
    box: Array,
    parents: Integers,
    variables: Integers,
    weights: Array,
    thetas: Array,
    inputs: Array,
    by_theta: Array,
    by_input: Array,
) -> None:
    """Add to the slopes of each step's own cost those of the costs to come, along runs of a layer.

    ``by_theta`` (steps + 1, rows, n), with those of the end, and ``by_input`` (steps, rows, m) are
    overwritten, from the end to the beginning.
    """
    _, batch, n = thetas.shape
    m, each, p = inputs.shape[2], batch // len(weights), len(pinned)
    k, size = len(columns), len(parents)
    values, worth = np.empty(weights.shape[1]), np.empty(k + size)
    actions, x, hidden1, hidden2, outputs = _empty(thetas[0], second, last)
    used, slot = np.arange(p), np.zeros(batch, np.int64)
    ready, regions = prepared(used, nodes, second, pinned), np.full(batch, -1)
    u, slopes, back = np.empty((batch, m)), np.empty((batch, m, n)), np.empty(m)
    by_network = np.empty(m, np.float32)
    for t in range(len(inputs) - 1, -1, -1):
        theta, of_u, after = thetas[t], by_input[t], by_theta[t + 1]
        for row in range(batch):
            regions[row] = input_at(floats, whole, theta, u, row, regions[row])
            slopes_at(floats, whole, theta, slopes[row], row, regions[row])
            slot[row] = max(regions[row], 0) if p > 1 else 0
        act(
            u, theta, scaling, change, limit, ready, last, pinned, actions,
            x, used, slot, hidden1, hidden2, outputs,
        )  # fmt: skip
        for row in range(batch):
            for i in range(n):
                for j in range(n):
                    by_theta[t, row, i] += after[row, j] * linear[j, i]
            for i in range(m):
                for j in range(n):
                    of_u[row, i] += after[row, j] * linear[j, n + i]
            # What a monomial is worth passes to its parent and to its variable.
            _monomials(theta, inputs[t], row, columns, box, parents, variables, values)
            own = weights[row // each]
            for i in range(k + size):
                worth[i] = 0.0
                for j in range(own.shape[1]):
                    worth[i] += own[i, j] * after[row, j]
            for i in range(size - 1, -1, -1):
                above = worth[k + i]
                worth[parents[i]] += above * values[variables[i]]
                worth[variables[i]] += above * values[parents[i]]
            for j in range(k):
                of = columns[j]
                at = theta[row, of] if of < n else inputs[t, row, of - n]
                if box[0, j] < at < box[1, j]:
                    if of < n:
                        by_theta[t, row, of] += worth[j] / box[2, j]
                    else:
                        of_u[row, of - n] += worth[j] / box[2, j]
            for i in range(m):
                back[i] = of_u[row, i] * span[1, i]
            add_slopes(
                back, theta, row, u, slopes[row], scaling, change, limit, by_network, slot[row],
                ready, last, slot[row], hidden1, hidden2, outputs, by_theta[t],
            )  # fmt: skip
