"""The condensed program of a problem: the predicted states are eliminated by the model."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from scipy import linalg

from sb3_yann._validation import Array
from sb3_yann.control import lqr
from sb3_yann.control.explicit.parametric_qp import ParametricQP
from sb3_yann.control.linear_system import labels_of, labels_of_outputs
from sb3_yann.control.mpc.problem import MPCProblem

GROWTH = 1e3
"""How many times as large the fastest mode may become over the horizon, uncontrolled.

Predictions lose so many digits, and the Hessian twice as many.
"""
OFF = 1e-8
"""How far the law without constraints may be off, in half-widths of the input range."""


class _Prediction:
    """``theta_k = powers[k] theta + forced[k] V`` for k = 0 ... N.

    The input of a block that begins at step s is ``u = K theta_s + v``. ``feedback`` is K
    (m, n_theta). Without any the variables V are the inputs.
    """

    def __init__(self, problem: MPCProblem, feedback: Array | None) -> None:
        A, B = problem.prediction
        n = problem.n_theta
        m = problem.model.n_inputs
        K = np.zeros((m, n)) if feedback is None else feedback
        self.powers: list[Array] = [np.eye(n)]
        self.forced: list[Array] = [np.zeros((n, len(problem.blocks) * m))]
        self.inputs: list[tuple[Array, Array]] = []  # rows of V and theta that make up u_k
        self.previous = problem.layout.previous
        for block, length in enumerate(problem.blocks):
            rows = K @ self.forced[-1]
            rows[:, block * m : (block + 1) * m] += np.eye(m)
            held = rows, K @ self.powers[-1]
            for _ in range(length):
                self.inputs.append(held)
                self.powers.append(A @ self.powers[-1] + B @ held[1])
                self.forced.append(A @ self.forced[-1] + B @ held[0])
        self.starts = np.cumsum((0, *problem.blocks[:-1]))

    def of(self, rows: Array, k: int) -> tuple[Array, Array]:
        """Return what makes up ``rows theta_k``."""
        return rows @ self.forced[k], rows @ self.powers[k]

    def rate(self, k: int) -> tuple[Array, Array]:
        """Return what makes up ``u_k - u_{k-1}``."""
        inputs, start = self.inputs[k]
        return inputs - self.forced[k][self.previous], start - self.powers[k][self.previous]


Limits = tuple[Array, Array, Array, Array]


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
        self, names: Sequence[str], made: tuple[Array, Array], limits: Limits, *softness: Any
    ) -> None:
        """Add rows for ``low <= G U + S theta <= high``, with a name for each.

        Limits are low and high, and how these change with theta.
        """
        upper, lower = ([f"{name} at its {k} bound" for name in names] for k in ("upper", "lower"))
        (G, S) = made
        (low, high, low_moves, high_moves) = limits
        self.add(upper, G, high, high_moves - S, *softness)
        self.add(lower, -G, -low, S - low_moves, *softness)

    def stacked(self) -> tuple[Array, Array, Array, tuple[str, ...]]:
        """Return G, w, S and the names of the rows that bound something."""
        G, w, S = (np.concatenate(each) for each in zip(*self.parts, strict=True))
        bounded = np.isfinite(w)
        names = tuple(name for name, keep in zip(self.names, bounded, strict=True) if keep)
        return G[bounded], w[bounded], S[bounded], names


def condense(problem: MPCProblem) -> tuple[ParametricQP, tuple[str, ...]]:
    """Return the program in ``(u_0, ..., u_{N-1})`` and slacks, and what each row bounds.

    All of it is in deviations. Where the model's modes grow too much over the horizon for float64,
    the variables are ``v_k = u_k - K theta_k`` instead, for a gain K that stabilizes: what is
    predicted then decays. ``feedback`` of the program is that K. The change of variables is exact:
    the law is the same. ValueError if digits are lost all the same: the law without constraints
    must be that of the Riccati recursion, which loses none, to 1e-8 of the input range.
    """
    problem = problem.deviations
    with np.errstate(over="ignore"):
        growth = np.float64(lqr.spectral_radius(problem.model.A)) ** problem.horizon
    plain = _condensed(problem, None) if growth <= GROWTH else None
    if plain is not None and not _error(problem, plain[0]) > OFF / 100:
        return plain
    found = _condensed(problem, _stabilizing_feedback(problem))
    if plain is not None and not _error(problem, plain[0]) > _error(problem, found[0]):
        found = plain
    error = _error(problem, found[0])
    if error > OFF or (plain is None and np.isnan(error)):
        give = "Give" if problem.control_horizon is None else "Leave control_horizon out, or give"
        raise ValueError(
            f"{lqr.long_horizon(problem.model.A, problem.horizon)}, rounding hides the law: "
            f"without constraints it is off by {error:.1e} half-widths of the input range (nan: "
            f"it is not unique), and may be by {OFF:g}. {give} states that grow a weight in Q, "
            "pass a shorter horizon, leave the terminal cost to the Riccati equation, or bring "
            "states, inputs and weights to similar magnitudes."
        )
    return found


def _stabilizing_feedback(problem: MPCProblem) -> Array:
    """Return K (m, n_theta) with ``u = K theta`` a law that brings the model to its steady state.

    It is the gain of the terminal cost where that stabilizes: then the Hessian is as well
    conditioned as a single step's. Else the gain of the problem without a discount, or of unit
    weights, where Q leaves a mode on the unit circle without one. Where no gain stabilizes, as a
    mode grows that no input reaches, it is the one whose loop grows least.
    """
    errors = problem.settled.error_system
    box = problem.theta_half[problem.layout.state]
    model = errors.model
    gamma = problem.gamma
    unit = np.concatenate([box, problem.u_half])[: len(errors.Q)] ** -2.0
    plain = np.diag(unit), np.diag(problem.u_half**-2.0), None
    own = errors.Q, errors.R, errors.cross
    gains = [lqr.gain(model, errors.R, problem.terminal.cost, gamma, errors.cross)]
    for (Q, R, cross), discount in ((own, 1.0), (plain, 1.0), (plain, gamma)):
        if lqr.spectral_radius(model.A - model.B @ gains[-1]) < 1:
            break
        with suppress(ValueError):  # it has no such gain
            P = lqr.riccati(model, Q, R, discount, cross)
            gains.append(lqr.gain(model, R, P, discount, cross))
    gain = min(reversed(gains), key=lambda K: lqr.spectral_radius(model.A - model.B @ K))
    every = np.eye(problem.n_theta)
    return np.asarray((errors.to_input - gain @ errors.to_error) @ every[problem.layout.settles])


def _error(problem: MPCProblem, program: ParametricQP) -> float:
    """Return how far the law without constraints is off in the box of theta, in half-widths of u.

    It is compared with the Riccati recursion. Of a law that asks for many input ranges in its box,
    as many times more is rounding. It is nan where the program has no unique minimum: the laws say
    so.
    """
    errors = problem.settled.error_system
    gamma = problem.gamma
    A = errors.model.A
    B = errors.model.B
    P = problem.terminal.cost
    cross = np.zeros(B.shape) if errors.cross is None else errors.cross
    weight = np.block([[errors.Q, cross], [cross.T, errors.R]])
    count = len(program.c) - program.n_slacks
    m = problem.model.n_inputs
    try:
        for length in reversed(problem.blocks):
            if length > 1:
                gain, P = _held(A, B, weight, P, gamma, length)
                continue
            gain = lqr.gain(errors.model, errors.R, P, gamma, errors.cross)
            # As a sum of squares: of a large terminal cost a difference would leave rounding.
            law = np.vstack([np.eye(len(A)), -gain])
            closed = A - B @ gain
            P = law.T @ weight @ law + gamma * closed.T @ P @ closed
        factor = linalg.cho_factor(program.H[:count, :count])
    except (np.linalg.LinAlgError, ValueError):  # not definite, or numbers that overflow
        return np.nan
    own = -linalg.cho_solve(factor, program.F[:count])[:m]
    if program.feedback is not None:
        own = own + program.feedback
    exact = errors.to_input - gain @ errors.to_error
    own = own @ problem.layout.lift
    unit = problem.settled.theta_half / problem.u_half[:, None]
    largest = max(1.0, float(np.abs(exact * unit).max()))
    return float(np.nan_to_num(np.abs(own - exact) * unit, nan=np.inf).max()) / largest


def _held(
    A: Array, B: Array, weight: Array, P: Array, gamma: float, length: int
) -> tuple[Array, Array]:
    """Return the gain of an input that is held for a block, and the cost with it.

    The stage cost is ``[z; v]' weight [z; v]``, that at the end ``z' P z``.
    """
    n, m = B.shape
    step = np.block([[A, B], [np.zeros((m, n)), np.eye(m)]])
    total = linalg.block_diag(P, np.zeros((m, m)))
    for _ in range(length):
        total = weight + gamma * step.T @ total @ step
    gain = linalg.cho_solve(linalg.cho_factor(total[n:, n:]), total[n:, :n])
    law = np.vstack([np.eye(n), -gain])
    return gain, law.T @ total @ law


def _condensed(problem: MPCProblem, feedback: Array | None) -> tuple[ParametricQP, tuple[str, ...]]:
    """Return the program in ``v = u - feedback theta`` of each block, and what each row bounds."""
    prediction = _Prediction(problem, feedback)
    softness = {"x": problem.soft.x, "y": problem.soft.y, "mixed": problem.mixed.soft}
    slacks = [kind for kind, units in softness.items() if np.any(units)]
    H, F, c = _cost(problem, prediction)
    G, w, S, names = _constraints(problem, prediction, slacks, softness)
    penalty = np.full(len(slacks), problem.soft.penalty)
    H = (H + H.T) / 2
    c = np.concatenate([c, penalty])
    if slacks:
        H = linalg.block_diag(H, np.diag(2 * penalty))
        F = np.vstack([F, np.zeros((len(slacks), problem.n_theta))])
    box = problem.theta_min, problem.theta_max
    bounded = np.isfinite([problem.u_min, problem.u_max]).sum() * len(problem.blocks)
    program = ParametricQP(
        H, F, c, G, w, S, *box, n_slacks=len(slacks), n_input_rows=int(bounded), feedback=feedback
    )
    return program, names


def _cost(problem: MPCProblem, prediction: _Prediction) -> tuple[Array, Array, Array]:
    """Return H, F and c of ``1/2 V'HV + (F theta + c)'V``, whence the factors 2."""
    N = problem.horizon
    gamma = problem.gamma
    steady = problem.steady_states
    layout = problem.layout
    settled = problem.settled
    every = np.eye(problem.n_theta)
    state = every[layout.state]
    to_input = steady.u @ every[layout.now]
    states = state - steady.x @ every[layout.now]
    to_error = settled.error_system.to_error @ every[layout.settles]
    price = problem.price
    size = len(problem.blocks) * problem.model.n_inputs
    H: Array = np.zeros((size, size))
    F: Array = np.zeros((size, problem.n_theta))
    c: Array = np.zeros(size)
    for k in range(N):
        inputs, start = prediction.inputs[k]
        weighted = 2 * gamma**k * inputs.T @ problem.R
        H = H + weighted @ inputs
        F = F + weighted @ (start - to_input @ prediction.powers[k])
    for k in range(1, N + 1):
        weight = gamma**k * (problem.terminal.cost if k == N else problem.Q)
        forced, free = prediction.of(to_error if k == N else states, k)
        weighted = 2 * forced.T @ weight
        H = H + weighted @ forced
        F = F + weighted @ free
    for k in prediction.starts if np.any(problem.rate.R_du) else ():
        inputs, start = prediction.rate(k)
        weighted = 2 * gamma**k * inputs.T @ problem.rate.R_du
        H = H + weighted @ inputs
        F = F + weighted @ start
    for k in range(N) if price.counts else ():
        spent = price.u @ prediction.inputs[k][0] + price.x @ (state @ prediction.forced[k])
        c = c + gamma**k * spent
    return H, F, c


def _constraints(
    problem: MPCProblem, prediction: _Prediction, slacks: list[str], softness: dict[str, Array]
) -> tuple[Array, Array, Array, tuple[str, ...]]:
    N = problem.horizon
    blocks = len(problem.blocks)
    rows = _Rows(slacks)
    called, inputs = labels_of(problem.model)
    limits = {kind: problem.limit_rows(kind) for kind in problem.limits}
    first = zip(*(prediction.inputs[k] for k in prediction.starts), strict=True)
    moved, free = (np.vstack(each) for each in first)
    low, high, low_moves, high_moves = limits["u"]
    of_blocks = np.tile(low, blocks), np.tile(high, blocks)
    moving = np.tile(low_moves, (blocks, 1)), np.tile(high_moves, (blocks, 1))
    rows.add_bounds(inputs * blocks, (moved, free), (*of_blocks, *moving))

    state = np.eye(problem.n_theta)[problem.layout.state]
    for k in range(1, N + 1):
        rows.add_bounds(called, prediction.of(state, k), limits["x"], softness["x"], "x")
    last, upper = problem.terminal.set
    G, S = prediction.of(last, N)
    rows.add("the terminal set", G, upper, -S)
    for k in prediction.starts if problem.layout.n_previous else ():
        rows.add_bounds(
            [f"the rate of {each}" for each in inputs], prediction.rate(k), limits["du"]
        )
    C = problem.outputs.C @ state
    for k in range(1, N + 1) if len(C) else ():
        outputs = labels_of_outputs(problem.outputs.C, problem.model.state_names)
        rows.add_bounds(outputs, prediction.of(C, k), limits["y"], softness["y"], "y")
    mixed = problem.mixed
    for k, used in mixed.at_steps(N) if len(mixed.F) else ():
        G, S = prediction.of((mixed.F @ state)[used], k)
        if k < N:
            inputs_k, start = prediction.inputs[k]
            G = G + mixed.G[used] @ inputs_k
            S = S + mixed.G[used] @ start
        names = [f"mixed[{i}]" for i in np.flatnonzero(used)]
        low, high, low_moves, high_moves = (each[used] for each in limits["mixed"])
        own = low, high, low_moves, high_moves
        rows.add_bounds(names, (G, S), own, softness["mixed"][used], "mixed")
    for kind in slacks:
        none = np.zeros((1, moved.shape[1])), np.zeros(1), np.zeros((1, problem.n_theta))
        rows.add(f"no violation of the soft bounds of {kind}", *none, np.ones(1), kind)
    return rows.stacked()
