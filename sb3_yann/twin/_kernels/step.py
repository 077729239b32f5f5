"""Steps of a twin with polynomial residuals, compiled.

It goes in as arrays:

- ``linear`` (n, n + m): the prediction matrices side by side;
- ``columns`` (k,): where in ``[theta, u]`` the features are that a residual is fed;
- ``box`` (3, k): their least and largest values, and what they are scaled by;
- ``parents``, ``variables``: monomial k + i is monomial ``parents[i]`` times a feature;
- ``weights`` (members, monomials, states): of each, and of the constant one if there is one.
"""

from __future__ import annotations

import numpy as np

from sb3_yann._numba import Integers, compiled
from sb3_yann._validation import Array

TWIN = "float64[:, ::1], int64[::1], float64[:, ::1], int64[::1], int64[::1], float64[:, :, ::1]"
ROWS = "float64[:, ::1], float64[:, ::1]"


@compiled()
def monomials(
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


@compiled(f"void({TWIN}, {ROWS}, float64[:, ::1])")
def step(
    linear: Array,
    columns: Integers,
    box: Array,
    parents: Integers,
    variables: Integers,
    weights: Array,
    theta: Array,
    u: Array,
    after: Array,
) -> None:
    """Write what comes of each row of theta and u; the first rows are those of the first member."""
    batch, n = theta.shape
    values = np.empty(weights.shape[1])
    for row in range(batch):
        member = row * len(weights) // batch
        monomials(theta, u, row, columns, box, parents, variables, values)
        for j in range(n):
            total = 0.0
            for i in range(n):
                total += linear[j, i] * theta[row, i]
            for i in range(u.shape[1]):
                total += linear[j, n + i] * u[row, i]
            after[row, j] = total
        for i in range(len(values)):
            for j in range(weights.shape[2]):
                after[row, j] += weights[member, i, j] * values[i]
