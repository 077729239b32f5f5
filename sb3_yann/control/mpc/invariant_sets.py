"""Terminal cost and set, and sets in which hard bounds are kept for ever, by any inputs too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_yann._validation import Array, ReadOnlyArrays, check_array
from sb3_yann.control import lqr
from sb3_yann.control.mpc.groups import Terminal
from sb3_yann.control.mpc.problem import MPCProblem
from sb3_yann.control.polyhedra import bounded_region, farthest_points

MAX_FACETS = 200
MAX_STEPS = 500
Facets = tuple[Array, Array]  # half-spaces F theta <= g


def completed(problem: MPCProblem) -> Terminal:
    """Return the terminal cost and set of a problem, solved where they are left to it.

    The set is in the units of the problem.
    """
    size = problem.n_theta
    cost: Any = problem.terminal.cost
    half_spaces: Any = problem.terminal.set
    if isinstance(half_spaces, tuple) and half_spaces[0].shape[1] != size:
        check_array("Terminal.set F", half_spaces[0], ("rows", problem.model.n_states))
    errors = problem.settled.error_system
    if cost is None:
        try:
            cost = lqr.riccati(errors.model, errors.Q, errors.R, problem.gamma, errors.cross)
        except ValueError:
            _require_weighted_inputs(problem)
            raise
    else:
        check_array("Terminal.cost", cost, errors.Q.shape)
    _require_weighted_inputs(problem, cost)
    if isinstance(half_spaces, str):
        F, g = invariant_set(problem.deviations.settled, cost)
        F = F @ np.eye(problem.n_theta)[problem.layout.settles]
        half_spaces = F, g + F @ problem.theta_ss
    F, g = half_spaces or (np.zeros((0, size)), np.zeros(0))
    found = Terminal(cost, (np.pad(F, ((0, 0), (0, size - F.shape[1]))), g))
    was_asked = isinstance(problem.terminal.set, str)
    vars(found)["is_invariant"] = was_asked or problem.terminal.is_invariant
    return found


def _require_weighted_inputs(problem: MPCProblem, cost: Array | None = None) -> None:
    """Raise where an input costs nothing: not itself, not by its rate, not by what it moves."""
    errors = problem.settled.error_system
    if np.linalg.eigvalsh(problem.R)[0] > 0:
        return  # where rounding hides it, the laws say so
    B = errors.model.B
    weight = errors.R if cost is None else errors.R + problem.gamma * B.T @ cost @ B
    sizes = np.linalg.eigvalsh(weight * np.outer(problem.u_half, problem.u_half))
    if sizes[0] > 1e-13 * max(sizes[-1], np.finfo(float).tiny):
        return
    raise ValueError(
        "R must be positive definite, its smallest eigenvalue is "
        f"{np.linalg.eigvalsh(problem.R)[0]:g}, where an input costs nothing else: neither its "
        "rate nor a state that it moves has a weight. Give every input a positive weight, in R or "
        "in RateLimits(R_du=...)."
    )


def invariant_set(problem: MPCProblem, cost: Array) -> Facets:
    """Return F (rows, n_theta) and g (rows,): the maximal output admissible set F theta <= g.

    The problem comes without previews.

    From a theta in it the law ``v = -K z``, with K the gain of the terminal cost, keeps all hard
    bounds of x, u, y and the rate for ever on the model, with r and d constant. The boxes of r, d
    and ``u_prev``, and ten times that of the states, are taken for granted. Steady states lie
    inside by one percent: the number of steps is finite (Gilbert & Tan, Linear systems with state
    and control constraints, IEEE Trans. Autom. Control 36 (1991), Section V). ValueError if the
    gain does not stabilize the model, the origin is not inside all bounds, or 500 steps or 200 rows
    are not enough.
    """
    errors = problem.error_system
    K = lqr.gain(errors.model, errors.R, cost, problem.gamma, errors.cross)
    radius = lqr.spectral_radius(errors.model.A - errors.model.B @ K)
    if radius >= 1:
        raise ValueError(
            "Terminal(set='invariant') needs a terminal gain that stabilizes the model, but the "
            f"spectral radius of A - BK is {radius:.6g}. Use gamma=1, or the default terminal cost."
        )
    gain = errors.to_input - K @ errors.to_error
    half = problem.theta_half
    rows, bounds = hard_rows(problem)
    rows = rows @ np.vstack([np.eye(problem.n_theta), gain])
    rest = problem.theta_rest  # which the law keeps: all of it counts from there
    bounds = bounds - rows @ rest
    A, B = problem.prediction
    rows = rows * half
    closed = (A + B @ gain) * half / half[:, None]
    parts = problem.layout
    own = problem.steady_states
    at_rest = np.zeros_like(A)  # the map from theta to the theta at rest under the same r and d
    at_rest[parts.state, parts.now] = own.x
    at_rest[parts.constant, parts.constant] = np.eye(parts.constant.stop - parts.constant.start)
    at_rest[parts.previous, parts.now] = own.u[: parts.n_previous]
    steady = rows @ (at_rest / half[:, None] * half)
    if np.any(bounds <= 0):
        raise ValueError(
            "Terminal(set='invariant') needs an operating point with room to every bound, but "
            "it lies on or beyond a hard one. Move the bounds or the operating point."
        )
    wide, ends = _around(problem, half, 1e3)
    box = wide, ends - wide @ (rest / half)
    moving = np.any(np.abs(steady) > 1e-12, axis=1)
    # Steady states must lie inside the bounds by 1 % of them.
    inside = steady[moving], 0.99 * bounds[moving]
    found = _reduced(_joined((rows, bounds), inside), box)
    later = rows
    for step in range(MAX_STEPS):  # until the bounds of a later step say nothing new
        assert found is not None  # the origin lies inside of all
        if step and len(found[1]) > MAX_FACETS:
            raise ValueError(
                f"The invariant terminal set has more than {MAX_FACETS} half-spaces. Give the "
                "state more weight, sample more slowly, or pass a terminal set of your own."
            )
        later = later @ closed
        new = _exceeded(found, (later, bounds), box) > 1e-9 * np.linalg.norm(later, axis=1)
        if not np.any(new):
            F, g = found
            return F / half, g + F @ (rest / half)
        found = _reduced(_joined(found, (later[new], bounds[new])), box)
    raise ValueError(
        f"The invariant terminal set is not determined after {MAX_STEPS} steps: the closed loop "
        "of the terminal gain is too slow. Give the state more weight, or sample more slowly."
    )


def hard_rows(
    problem: MPCProblem, kinds: tuple[str, ...] = ("u", "x", "y", "du", "mixed")
) -> Facets:
    """Return the hard bounds of these kinds: rows (k, n_theta + m) of [theta; u], and their ends.

    They are of one sample. Bounds that change at run time are entries of theta.
    """
    theta = np.eye(problem.n_theta, problem.n_theta + problem.model.n_inputs)
    rows = [theta[:0]]
    ends = [np.zeros(0)]
    for kind in kinds:
        if kind in problem.bounded:
            value, softness, _ = problem.bounded[kind]
            hard = softness == 0
            low, high, L, H = problem.limit_rows(kind)
            rows += [(value - H @ theta)[hard], (L @ theta - value)[hard]]
            ends += [high[hard], -low[hard]]
    found = np.concatenate(rows)
    bounds = np.concatenate(ends)
    bounded = np.isfinite(bounds)
    return found[bounded], bounds[bounded]


ZERO_LENGTH = 1e-9
"""A column or a radius, in half-widths, that counts as zero."""


@dataclass(frozen=True, eq=False)
class KeptSet(ReadOnlyArrays):
    """Half-spaces ``F theta <= g`` in deviations: in all of them hard bounds can be kept.

    There are none for a problem whose hard bounds are those of inputs alone. Slacks are in
    half-widths: a state that is off by as much moves them by no more than 1. Of rows ``[a, b, c]``
    of ``ahead``, where ``a theta + b u <= c`` the predicted next theta lies in the set, and mixed
    bounds and those that change at run time hold. From each theta in it some inputs within bounds
    keep the bounds for so many ``steps``, or ``for_ever``.
    """

    F: Array
    g: Array
    ahead: Array
    steps: int
    for_ever: bool


def kept_set(problem: MPCProblem, most_steps: int = 100, most_rows: int = 60) -> KeptSet:
    """Return the largest set in which inputs within bounds keep the hard bounds for ever.

    Preimages are intersected until nothing changes by more than 1e-7 half-widths (Blanchini, Set
    invariance in control, Automatica 35 (1999)), with references and disturbances constant. With a
    terminal set, they are as many as the horizon is long: the set in which the MPC has a solution.
    Inputs need bounds. Where ``most_steps`` or ``most_rows`` are not enough the last set is taken,
    which looks fewer steps ahead.
    """
    problem = problem.deviations
    half = problem.theta_half
    u_half = problem.u_half
    A, B = problem.prediction
    own = A * half / half[:, None]
    forced = B * u_half / half[:, None]
    n = len(half)
    unit = np.concatenate([half, u_half])
    box = _around(problem, half)

    def hard(*kinds: str) -> Facets:  # whatever units a row is in
        rows, limits = hard_rows(problem, kinds)
        size = np.abs(rows * unit).sum(1)
        size = np.where(size > 0, size, 1.0)
        return rows * unit / size[:, None], limits / size

    inputs = hard("u", "du", "mixed")
    values, limits = hard("x", "y", "mixed")
    of_states = np.all(np.abs(values[:, n:]) <= ZERO_LENGTH, axis=1)
    bounds = values[of_states, :n], limits[of_states]

    def before(rows: Facets, room: float = 0.0) -> Facets | None:
        F, g = rows
        return _without_inputs((np.hstack([F @ own, F @ forced]), g - room), inputs, box)

    last, upper = problem.terminal.set
    end = _reduced(_joined(bounds, (last * half, upper)), box)
    steps = 0
    found = bounds if end is None else end
    settled = False
    nothing = end is None or not np.any(np.abs(values[:, problem.layout.state]) > ZERO_LENGTH)
    ends = not nothing and not _implies(bounds, (last * half, upper), box)
    if ends:  # a terminal set that inputs cannot stay in promises nothing
        stays = before(found)
        ends = stays is not None and _implies(found, stays, box)
    most_steps = 0 if nothing else problem.horizon if ends else most_steps
    while steps < most_steps and not settled:
        # What the MPC does not plan itself needs room: an unstable plant leaves an edge at once.
        # Inputs that the MPC does not plan leave 1e-5 half-widths from one step to the next.
        earlier = before(found, 1e-5 if not ends and steps >= problem.horizon else 0.0)
        earlier = None if earlier is None else _reduced(_joined(bounds, earlier), box)
        if earlier is None or len(earlier[1]) > most_rows:
            break
        settled = not ends and _implies(found, earlier, box)
        found = earlier
        steps += 1
    F, g = found
    size = np.abs(F[:, problem.layout.state]).sum(1)
    size = np.where(size > 0, size, 1.0)
    F = F / size[:, None] / half
    g = g / size
    # Inputs and rates within fixed bounds, and inputs within those of theta, are clipped anyway.
    rate_moves = any(name.startswith("du") for name in problem.layout.bounds)
    now = np.column_stack(hard("du", "mixed") if rate_moves else hard("mixed"))
    now[:, :-1] /= unit
    rows = np.vstack([np.hstack([F @ A, F @ B, g[:, None]]), now])
    return KeptSet(F, g, rows, steps, settled or (ends and steps == problem.horizon))


def _around(problem: MPCProblem, half: Array, unbounded: float = 1.0) -> Facets:
    """Return the box of theta, ten times as large in the states, in half-widths."""
    low = problem.theta_min / half
    high = problem.theta_max / half
    low = np.where(np.isfinite(low), low, -unbounded)
    high = np.where(np.isfinite(high), high, unbounded)
    far = np.ones(len(half))
    far[problem.layout.state] = 10
    middle = (low + high) / 2
    reach = far * (high - low) / 2
    eye = np.eye(len(half))
    return np.vstack([eye, -eye]), np.concatenate([middle + reach, reach - middle])


def _joined(*parts: Facets) -> Facets:
    return np.vstack([F for F, _ in parts]), np.concatenate([g for _, g in parts])


def _without_inputs(ahead: Facets, inputs: Facets, box: Facets, most: int = 3000) -> Facets | None:
    """Return for which theta some u fulfils the rows of [theta, u]; None where that is too large.

    It is the elimination of Fourier and Motzkin.
    """
    F, g = _joined(ahead, inputs)
    n = box[0].shape[1]
    while F.shape[1] > n:
        last = F[:, -1]
        above = last > ZERO_LENGTH
        below = last < -ZERO_LENGTH
        if above.sum() * below.sum() > most:
            return None
        up = F[above] / last[above, None]
        down = F[below] / last[below, None]
        pairs = (up[:, None] - down[None]).reshape(-1, F.shape[1])
        ends = ((g[above] / last[above])[:, None] - (g[below] / last[below])[None]).ravel()
        free = ~(above | below)
        F, g = _joined((pairs, ends), (F[free], g[free]))
        F = F[:, :-1]
        wide = np.zeros((len(box[1]), F.shape[1]))
        wide[:, :n] = box[0]
        found = _reduced((F, g), (wide, box[1]))
        if found is None:
            return None
        F, g = found
    return F, g


def _reduced(rows: Facets, box: Facets) -> Facets | None:
    """Return the rows that say something new within a box; None where no theta fulfils them."""
    F, g = rows
    if not len(g):
        return rows
    length = np.linalg.norm(F, axis=1)
    some = length > ZERO_LENGTH
    if np.any(g[~some] < -ZERO_LENGTH):
        return None
    F = F[some] / length[some, None]
    g = g[some] / length[some]
    order = np.argsort(g, kind="stable")  # of parallel rows the first, which is the nearest
    _, first = np.unique(np.round(F[order], 9), axis=0, return_index=True)
    kept = order[np.sort(first)]
    F = F[kept]
    g = g[kept]
    A, b = _joined((F, g), box)
    _, radius, facets, _ = bounded_region(A, b, ZERO_LENGTH)
    if radius <= ZERO_LENGTH:
        return None
    facets = facets[facets < len(g)]
    return F[facets], g[facets]


def _implies(found: Facets, wanted: Facets, box: Facets) -> bool:
    """Tell whether all theta of one set lie in another, to some room."""
    return not len(wanted[1]) or bool(np.all(_exceeded(found, wanted, box) <= 1e-7))


def _exceeded(found: Facets, wanted: Facets, box: Facets) -> Array:
    """Return by how much the theta of a set exceed some half-spaces at most, negative inside."""
    A, b = _joined(found, box)
    inside, _, _, _ = bounded_region(A, b, np.inf)
    ends = farthest_points(A, b, inside, wanted[0])
    return np.asarray(np.sum(ends * wanted[0], axis=1) - wanted[1])
