"""The invariant terminal set: where the terminal gain keeps every hard constraint for ever."""

from __future__ import annotations

import numpy as np
from scipy import optimize

from sb3_yann._validation import Array
from sb3_yann.control import lqr
from sb3_yann.control.mpc.problem import MPCProblem

MARGIN = 0.01
"""How far inside the bounds steady states must lie, relative to the bounds."""
MAX_ROWS, MAX_STEPS = 200, 500
Rows = tuple[Array, Array]  # half-spaces F theta <= g


def invariant_set(problem: MPCProblem, cost: Array) -> Rows:
    """Return F (rows, n_theta) and g (rows,): the maximal output admissible set F theta <= g.

    The problem comes without previews.

    From a theta in it the law ``v = -K z``, with K the gain of the terminal cost, keeps all hard
    bounds of x, u, y and the rate for ever on the model, with r and d constant. The boxes of r, d
    and ``u_prev`` are taken for granted, that of the states is no bound. Steady states lie inside
    by one percent: the number of steps is finite (Gilbert & Tan, Linear systems with state and
    control constraints, IEEE Trans. Autom. Control 36 (1991), Section V).

    Raises
    ------
    ValueError
        If the gain does not stabilize the model, the origin is not inside all bounds, or 500 steps
        or 200 rows are not enough.
    """
    errors, parts = problem.error_system, problem.layout
    K = lqr.gain(errors.model, errors.R, cost, problem.gamma, errors.cross)
    radius = lqr.spectral_radius(errors.model.A - errors.model.B @ K)
    if radius >= 1:
        raise ValueError(
            "Terminal(set='invariant') needs a terminal gain that stabilizes the model, but the "
            f"spectral radius of A - BK is {radius:.6g}. Use gamma=1, or the default terminal cost."
        )
    gain, half = errors.to_input - K @ errors.to_error, problem.theta_half
    rows, bounds = hard_rows(problem)
    rows = rows @ np.vstack([np.eye(problem.n_theta), gain])
    rest = problem.theta_rest  # which the law keeps: all of it counts from there
    bounds = bounds - rows @ rest
    A, B = problem.prediction
    rows, closed = rows * half, (A + B @ gain) * half / half[:, None]
    steady = rows @ _steady_projection(problem, half)
    if np.any(bounds <= 0):
        raise ValueError(
            "Terminal(set='invariant') needs an operating point with room to every bound, but "
            "it lies on or beyond a hard one. Move the bounds or the operating point."
        )
    granted = _granted(problem, half)
    found = _remove_redundant((rows, bounds), granted)
    if parts.constant.start < parts.constant.stop:
        moving = np.any(np.abs(steady) > 1e-12, axis=1)
        inside = (steady[moving], (1 - MARGIN) * bounds[moving])
        found = np.vstack([found[0], inside[0]]), np.concatenate([found[1], inside[1]])
    found = _until_nothing_new((rows, bounds), closed, found, granted)
    F, g = _remove_redundant(found, granted)
    return F / half, g + F @ (rest / half)


def _until_nothing_new(ahead: Rows, closed: Array, found: Rows, granted: Rows) -> Rows:
    """Add the bounds of later steps until those of one step say nothing new."""
    (F, g), (later, bounds) = found, ahead
    for _ in range(MAX_STEPS):
        later = later @ closed
        A, b = np.vstack([F, granted[0]]), np.concatenate([g, granted[1]])
        new = [i for i, row in enumerate(later) if not _is_redundant(row, float(bounds[i]), A, b)]
        if not new:
            return F, g
        F, g = np.vstack([F, later[new]]), np.concatenate([g, bounds[new]])
        if len(g) > MAX_ROWS:
            raise ValueError(
                f"The invariant terminal set has more than {MAX_ROWS} half-spaces. Give the "
                "state more weight, sample more slowly, or pass a terminal set of your own."
            )
    raise ValueError(
        f"The invariant terminal set is not determined after {MAX_STEPS} steps: the closed loop "
        "of the terminal gain is too slow. Give the state more weight, or sample more slowly."
    )


def hard_rows(problem: MPCProblem, kinds: tuple[str, ...] = ("u", "x", "y", "du", "mixed")) -> Rows:
    """Return the hard bounds of these kinds: rows (k, n_theta + m) of [theta; u], and their ends.

    They are of one sample. Bounds that change at run time are entries of theta.
    """
    n, m = problem.n_theta, problem.model.n_inputs
    theta, u = np.split(np.eye(n + m), [n])
    x, mixed = theta[problem.layout.state], problem.mixed
    values = {"u": u, "x": x, "y": problem.outputs.C @ x, "mixed": mixed.F @ x + mixed.G @ u}
    if problem.layout.n_previous:
        values["du"] = u - theta[problem.layout.previous]
    softness = {"x": problem.soft.x, "y": problem.soft.y, "mixed": mixed.soft}
    rows, ends = [np.zeros((0, n + m))], [np.zeros(0)]
    for kind in kinds:
        if kind in values:
            value = values[kind]
            hard = softness.get(kind, np.zeros(len(value))) == 0
            low, high, L, H = problem.limit_rows(kind)
            rows += [(value - H @ theta)[hard], (L @ theta - value)[hard]]
            ends += [high[hard], -low[hard]]
    found, bounds = np.concatenate(rows), np.concatenate(ends)
    bounded = np.isfinite(bounds)
    return found[bounded], bounds[bounded]


def _steady_projection(problem: MPCProblem, half: Array) -> Array:
    """Return the map from theta to the theta at rest under the same r and d, in units of half."""
    parts, steady = problem.layout, problem.steady_states
    at_rest = np.zeros((problem.n_theta, problem.n_theta))
    at_rest[parts.state, parts.now] = steady.x
    at_rest[parts.constant, parts.constant] = np.eye(parts.constant.stop - parts.constant.start)
    at_rest[parts.previous, parts.now] = steady.u[: parts.n_previous]
    return np.asarray(at_rest / half[:, None] * half)


def _granted(problem: MPCProblem, half: Array) -> Rows:
    """Return the half-spaces that every predicted theta satisfies anyway."""
    first = problem.layout.constant.start
    rows = np.vstack([np.eye(problem.n_theta)[first:], -np.eye(problem.n_theta)[first:]])
    rest = problem.theta_rest[first:]
    bounds = np.concatenate([problem.theta_max[first:] - rest, rest - problem.theta_min[first:]])
    bounds = bounds / np.tile(half[first:], 2)
    bounded = np.isfinite(bounds)
    return rows[bounded], bounds[bounded]


def _remove_redundant(found: Rows, granted: Rows) -> Rows:
    """Return the half-spaces that the others and the granted ones do not imply."""
    (rows, bounds), kept = found, list(range(len(found[1])))
    for i in range(len(bounds)):
        others = [j for j in kept if j != i]
        A = np.vstack([rows[others], granted[0]])
        b = np.concatenate([bounds[others], granted[1]])
        if _is_redundant(rows[i], float(bounds[i]), A, b):
            kept = others
    return rows[kept], bounds[kept]


def _is_redundant(row: Array, bound: float, A: Array, b: Array) -> bool:
    """Tell whether ``row theta <= bound`` follows from ``A theta <= b`` (a linear program)."""
    length = float(np.linalg.norm(row))
    if length < 1e-12:
        return True
    row, bound = row / length, bound / length
    # The row itself, one further out, keeps the program bounded.
    A, b = np.vstack([A, row]), np.append(b, bound + 1)
    best = optimize.linprog(-row, A_ub=A, b_ub=b, bounds=[(None, None)] * len(row))
    return bool(best.status == 0 and -best.fun <= bound + 1e-9)
