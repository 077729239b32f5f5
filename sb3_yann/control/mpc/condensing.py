"""The condensed program of a problem: the predicted states are eliminated by the model."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from scipy import linalg

from sb3_yann._validation import Array
from sb3_yann.control import lqr
from sb3_yann.control.explicit.parametric_qp import ParametricQP
from sb3_yann.control.mpc.problem import MPCProblem

OFF = 1e-8
"""How far the law without constraints may be off, in half-widths of the input range."""


class _Prediction:
    """``[theta_k; u_k] = forced V + free theta`` for k = 0 ... N, where no input is at the end.

    The input of a block that begins at step s is ``u = K theta_s + v``. ``feedback`` is K
    (m, n_theta). Without any the variables V are the inputs.
    """

    def __init__(self, problem: MPCProblem, feedback: Array | None) -> None:
        A, B = problem.prediction
        n, m = B.shape
        K = np.zeros((m, n)) if feedback is None else feedback
        forced: Array = np.zeros((n, len(problem.blocks) * m))
        free: Array = np.eye(n)
        self.steps: list[tuple[Array, Array]] = []
        for block, length in enumerate(problem.blocks):
            held = K @ forced
            held[:, block * m : (block + 1) * m] += np.eye(m)
            start = K @ free
            for _ in range(length):
                self.steps.append((np.vstack([forced, held]), np.vstack([free, start])))
                forced = A @ forced + B @ held
                free = A @ free + B @ start
        self.steps.append((np.vstack([forced, 0 * held]), np.vstack([free, 0 * start])))
        self.starts = np.cumsum((0, *problem.blocks[:-1]))

    def of(self, rows: Array, k: int) -> tuple[Array, Array]:
        """Return what makes up ``rows [theta_k; u_k]``."""
        used = np.any(rows, axis=0)
        forced, free = self.steps[k]
        return rows[:, used] @ forced[used], rows[:, used] @ free[used]


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
    # Predictions lose three digits where the fastest uncontrolled mode grows a thousandfold over
    # the horizon, and the Hessian twice as many.
    plain = _condensed(problem, None) if growth <= 1e3 else None
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
    n, m = errors.model.B.shape
    step = np.block([[errors.model.A, errors.model.B], [np.zeros((m, n)), np.eye(m)]])
    P = problem.terminal.cost
    cross = np.zeros((n, m)) if errors.cross is None else errors.cross
    weight = np.block([[errors.Q, cross], [cross.T, errors.R]])
    count = len(program.c) - program.n_slacks
    try:
        for length in reversed(problem.blocks):
            gain, P = _held(step, weight, P, gamma, length)
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


def _held(step: Array, weight: Array, P: Array, gamma: float, length: int) -> tuple[Array, Array]:
    """Return the gain of an input that is held for a block, and the cost with it.

    ``[z; v]`` takes a ``step`` and costs ``[z; v]' weight [z; v]``, at the end ``z' P z``.
    """
    n = len(P)
    total = weight + gamma * step[:n].T @ P @ step[:n]
    for _ in range(length - 1):
        total = weight + gamma * step.T @ total @ step
    gain = linalg.cho_solve(linalg.cho_factor(total[n:, n:]), total[n:, :n])
    # As a sum of squares: of a large terminal cost a difference would leave rounding.
    law = np.vstack([np.eye(n), -gain])
    cost = np.zeros((n, n))
    for k in range(length):
        cost = cost + gamma**k * law.T @ weight @ law
        law = step @ law
    return gain, cost + gamma**length * law[:n].T @ P @ law[:n]


def _condensed(problem: MPCProblem, feedback: Array | None) -> tuple[ParametricQP, tuple[str, ...]]:
    """Return the program in ``v = u - feedback theta`` of each block, and what each row bounds."""
    prediction = _Prediction(problem, feedback)
    slacks = [kind for kind in ("x", "y", "mixed") if np.any(problem.bounded[kind].softness)]
    H, F, c = _cost(problem, prediction)
    G, w, S, names = _constraints(problem, prediction, slacks)
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
    steady = problem.steady_states
    layout = problem.layout
    settled = problem.settled
    theta, u = np.split(np.eye(problem.n_theta + problem.model.n_inputs), [problem.n_theta])
    now = theta[layout.now]
    terms = [(u - steady.u @ now, problem.R, k) for k in range(N)]
    terms += [(theta[layout.state] - steady.x @ now, problem.Q, k) for k in range(1, N)]
    at_end = settled.error_system.to_error @ theta[layout.settles]
    terms.append((at_end, problem.terminal.cost, N))
    if np.any(problem.rate.R_du):
        terms += [(problem.bounded["du"].rows, problem.rate.R_du, k) for k in prediction.starts]
    size = len(problem.blocks) * len(u)
    H: Array = np.zeros((size, size))
    F: Array = np.zeros((size, problem.n_theta))
    c: Array = np.zeros(size)
    for rows, weight, k in terms:
        forced, free = prediction.of(rows, k)
        weighted = 2 * forced.T @ (problem.gamma**k * weight)
        H = H + weighted @ forced
        F = F + weighted @ free
    for k in range(N) if problem.price.counts else ():
        c = c + problem.gamma**k * prediction.of(problem.stage_slope[None], k)[0][0]
    return H, F, c


def _constraints(
    problem: MPCProblem, prediction: _Prediction, slacks: list[str]
) -> tuple[Array, Array, Array, tuple[str, ...]]:
    """Return ``G V - unit slack <= w + S theta``, and what each row bounds."""
    N = problem.horizon
    limits = {kind: problem.limit_rows(kind) for kind in problem.limits}
    parts: list[tuple[Array, Array, Array]] = []
    names: list[str] = []

    def add(kind: str, *steps: int, used: Any = slice(None)) -> None:
        """Add the upper bounds of a kind at some steps, then the lower ones."""
        rows, softness, called = problem.bounded[kind]
        made = [prediction.of(rows[used], k) for k in steps]
        G, S = (np.concatenate(each) for each in zip(*made, strict=True))
        low, high, L, H = (np.concatenate([each[used]] * len(steps)) for each in limits[kind])
        soft = np.tile(softness[used], len(steps))[:, None] * [kind == each for each in slacks]
        # 0 - soft, for -soft would hold negative zeros.
        parts.append((np.hstack([G, 0 - soft]), high, H - S))
        parts.append((np.hstack([-G, 0 - soft]), -low, S - L))
        chosen = np.tile(np.array(called, object)[used], len(steps))
        names.extend(f"{name} at its {k} bound" for k in ("upper", "lower") for name in chosen)

    add("u", *prediction.starts)
    for k in range(1, N + 1):
        add("x", k)
    last, upper = problem.terminal.set
    inputs = problem.model.n_inputs
    G, S = prediction.of(np.pad(last, ((0, 0), (0, inputs))), N)
    parts.append((np.pad(G, ((0, 0), (0, len(slacks)))), upper, -S))
    names += ["the terminal set"] * len(upper)
    for k in prediction.starts if problem.layout.n_previous else ():
        add("du", k)
    for k in range(1, N + 1) if len(problem.outputs.C) else ():
        add("y", k)
    acting = np.any(problem.mixed.G, axis=1)
    # At first the state is given, and in the end no input acts.
    used = {0: acting, N: ~acting}
    for k in range(N + 1) if len(acting) else ():
        add("mixed", k, used=used.get(k, slice(None)))
    none = np.zeros((len(slacks), G.shape[1])), np.zeros((len(slacks), problem.n_theta))
    parts.append((np.hstack([none[0], 0 - np.eye(len(slacks))]), np.zeros(len(slacks)), none[1]))
    names += [f"no violation of the soft bounds of {kind}" for kind in slacks]
    G, w, S = (np.concatenate(each) for each in zip(*parts, strict=True))
    bounded = np.isfinite(w)
    kept = tuple(names[i] for i in np.flatnonzero(bounded))
    return G[bounded], w[bounded], S[bounded], kept
