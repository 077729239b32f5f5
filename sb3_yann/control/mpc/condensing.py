"""The condensed program of a problem: the predicted states are eliminated by the model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import linalg

from sb3_yann._validation import Array
from sb3_yann.control.explicit.parametric_qp import ParametricQP
from sb3_yann.control.model.labels import labels_of
from sb3_yann.control.mpc._arguments import Bounds
from sb3_yann.control.mpc.problem import MPCProblem


class _Prediction:
    """``theta_k = powers[k] theta + forced[k] U`` for k = 0 ... N."""

    def __init__(self, problem: MPCProblem) -> None:
        A, B = problem.prediction
        n, m, N = problem.n_theta, problem.model.n_inputs, problem.horizon
        self.powers: list[Array] = [np.eye(n)]
        self.forced: list[Array] = [np.zeros((n, N * m))]
        for k in range(N):
            self.powers.append(A @ self.powers[-1])
            reach = A @ self.forced[-1]
            reach[:, k * m : (k + 1) * m] += B
            self.forced.append(reach)

    def rate(self, problem: MPCProblem, k: int) -> tuple[Array, Array]:
        """Return rows (m, N m) and (m, n_theta) for ``u_k - u_{k-1} = rows U + rows theta``."""
        m, N = problem.model.n_inputs, problem.horizon
        inputs, start = np.zeros((m, N * m)), np.zeros((m, problem.n_theta))
        inputs[:, k * m : (k + 1) * m] = np.eye(m)
        before = inputs[:, (k - 1) * m : k * m] if k > 0 else start[:, problem.layout.previous]
        before[:] = -np.eye(m)
        return inputs, start


class _Rows:
    """Collects constraints ``G U - unit slack <= w + S theta`` with a name for each."""

    def __init__(self, slacks: Sequence[str]) -> None:
        self.slacks = list(slacks)
        self.parts: list[tuple[Array, Array, Array]] = []
        self.names: list[str] = []

    def add(
        self,
        names: str | Sequence[str],
        G: Array,
        w: Array,
        S: Array,
        softness: Array | None = None,
        kind: str = "",
    ) -> None:
        """Add rows, of one name or with a name for each."""
        soft = np.zeros((len(w), len(self.slacks)))
        if kind in self.slacks and softness is not None:
            soft[:, self.slacks.index(kind)] = -softness
        self.parts.append((np.hstack([G, soft]), w, S))
        self.names += [names] * len(w) if isinstance(names, str) else names

    def add_bounds(
        self, names: Sequence[str], G: Array, bounds: Bounds, S: Array, *softness: Any
    ) -> None:
        """Add rows for ``low <= G U + S theta <= high``, with a name for each."""
        upper, lower = ([f"{name} at its {k} bound" for name in names] for k in ("upper", "lower"))
        self.add(upper, G, bounds[1], -S, *softness)
        self.add(lower, -G, -bounds[0], S, *softness)

    def stacked(self) -> tuple[Array, Array, Array, tuple[str, ...]]:
        """Return G, w, S and the names of the rows that bound something."""
        G, w, S = (np.concatenate(each) for each in zip(*self.parts, strict=True))
        bounded = np.isfinite(w)
        names = tuple(name for name, keep in zip(self.names, bounded, strict=True) if keep)
        return G[bounded], w[bounded], S[bounded], names


def condense(problem: MPCProblem) -> tuple[ParametricQP, tuple[str, ...]]:
    """Return the program in ``(u_0, ..., u_{N-1})`` and slacks, and what each row bounds."""
    prediction = _Prediction(problem)
    slacks = [kind for kind in "xy" if np.any(getattr(problem.soft, kind))]
    H, F = _cost(problem, prediction)
    G, w, S, names = _constraints(problem, prediction, slacks)
    penalty, H = np.full(len(slacks), problem.soft.penalty), (H + H.T) / 2
    c = np.concatenate([np.zeros(len(H)), penalty])
    if slacks:
        H = linalg.block_diag(H, np.diag(2 * penalty))
        F = np.vstack([F, np.zeros((len(slacks), problem.n_theta))])
    box = problem.theta_min, problem.theta_max
    return ParametricQP(H, F, c, G, w, S, *box, n_slacks=len(slacks)), names


def _cost(problem: MPCProblem, prediction: _Prediction) -> tuple[Array, Array]:
    """Return H and F of ``1/2 U'HU + (F theta)'U``, whence the factors 2."""
    N, gamma, errors = problem.horizon, problem.gamma, problem.error_system
    to_error, states = errors.to_error, errors.to_error[: problem.model.n_states]
    H: Array = np.asarray(2 * np.kron(np.diag(gamma ** np.arange(N)), problem.R), np.float64)
    F: Array = -H @ np.tile(errors.to_input, (N, 1))
    for k in range(1, N + 1):
        coordinates = to_error if k == N else states
        weight = gamma**k * (problem.terminal.cost if k == N else problem.Q)
        forced, free = coordinates @ prediction.forced[k], coordinates @ prediction.powers[k]
        weighted = 2 * forced.T @ weight
        H, F = H + weighted @ forced, F + weighted @ free
    if np.any(problem.rate.R_du):
        for k in range(N):
            inputs, start = prediction.rate(problem, k)
            weighted = 2 * gamma**k * inputs.T @ problem.rate.R_du
            H, F = H + weighted @ inputs, F + weighted @ start
    return H, F


def _constraints(
    problem: MPCProblem, prediction: _Prediction, slacks: list[str]
) -> tuple[Array, Array, Array, tuple[str, ...]]:
    n, m, N = problem.n_theta, problem.model.n_inputs, problem.horizon
    free, rows = np.zeros((N * m, n)), _Rows(slacks)
    called, inputs = labels_of(problem.model)
    limits = np.tile(problem.u_min, N), np.tile(problem.u_max, N)
    rows.add_bounds(inputs * N, np.eye(N * m), limits, free)

    states, rate = slice(0, problem.model.n_states), problem.rate
    x = problem.x_min, problem.x_max
    for k in range(1, N + 1):
        forced, powers = prediction.forced[k][states], prediction.powers[k][states]
        rows.add_bounds(called, forced, x, powers, problem.soft.x, "x")
    last, upper = problem.terminal.set
    rows.add("the terminal set", last @ prediction.forced[N], upper, -last @ prediction.powers[N])
    for k in range(N) if problem.layout.n_previous else ():
        change, start = prediction.rate(problem, k)
        rates = [f"the rate of {each}" for each in inputs]
        rows.add_bounds(rates, change, (rate.du_min, rate.du_max), start)
    C, y = problem.outputs.C, (problem.outputs.y_min, problem.outputs.y_max)
    for k in range(1, N + 1) if len(C) else ():
        forced, powers = prediction.forced[k][states], prediction.powers[k][states]
        outputs = [f"y[{i}]" for i in range(len(C))]
        rows.add_bounds(outputs, C @ forced, y, C @ powers, problem.soft.y, "y")
    for kind in slacks:
        none = np.zeros((1, N * m)), np.zeros(1), np.zeros((1, n))
        rows.add(f"no violation of the soft bounds of {kind}", *none, np.ones(1), kind)
    return rows.stacked()
