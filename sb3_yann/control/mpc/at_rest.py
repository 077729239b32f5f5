"""At rest: whether bounds allow a steady state, and the value of the law near it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from sb3_yann._validation import Array, check_array, to_float
from sb3_yann.control import lqr
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc.arguments import Given
from sb3_yann.control.mpc.problem import MPCProblem
from sb3_yann.control.online import Law

TOLERANCE = 1e-9
"""How far beyond a bound a steady state still counts as within, relative to the bound."""
KINDS = "x", "u", "y", "mixed"


def is_reachable(problem: MPCProblem, r: Given, d: Given) -> NDArray[np.bool_]:
    """Tell whether the steady state lies within the bounds, see :meth:`LinearMPC.is_reachable`."""
    return np.asarray(np.all(margins(problem, r, d) >= 0, axis=-1))


def margins(problem: MPCProblem, r: Given, d: Given) -> Array:
    """Return the room to the upper and lower bounds of x, u, y and mixed ones, negative beyond."""
    constant = _constants(problem, r, d)
    x = constant @ problem.steady_states.x.T
    u = constant @ problem.steady_states.u.T
    own = problem.deviations
    mixed = x @ own.mixed.F.T + u @ own.mixed.G.T
    value = np.concatenate([x, u, x @ own.outputs.C.T, mixed], axis=-1)
    low, high = (np.concatenate([own.limits[kind][k] for kind in KINDS]) for k in (0, 1))
    room = np.concatenate([high - value, value - low], axis=-1)
    bound = np.abs(np.concatenate([high, low]))
    return np.asarray(room + TOLERANCE * np.where(np.isfinite(bound), bound, 0.0))


def steady_state(problem: MPCProblem, r: Given, d: Given) -> tuple[Array, Array]:
    """Return x_s and u_s, see :meth:`LinearMPC.steady_state`."""
    constant = _constants(problem, r, d)
    if constant.ndim != 1:
        raise ValueError(
            f"r and d make {len(constant)} points, and steady_state takes one: r (p,) and d (d,)."
        )
    room = margins(problem, r, d)
    x = problem.units.to_plant(problem.steady_states.x @ constant)
    u = problem.units.input_to_plant(problem.steady_states.u @ constant)
    if np.any(room < 0):
        sizes = {kind: len(problem.limits[kind][0]) for kind in KINDS}
        names = [(name, f"[{i}]") for name, size in sizes.items() for i in range(size)]
        sides = [
            f"{a}{i} {side} {a}_{end}{i}"
            for side, end in ((">", "max"), ("<", "min"))
            for a, i in names
        ]
        broken = ", ".join(side for side, left in zip(sides, room, strict=True) if left < 0)
        p = len(problem.tracking.C)
        shown = constant + problem.theta_ss[problem.layout.now]
        raise ValueError(
            f"The reference r = {shown[:p].tolist()} with d = {shown[p:].tolist()} is not "
            f"reachable: its steady state is x_s = {x.tolist()}, u_s = {u.tolist()}, and {broken}. "
            "Ask is_reachable(r, d) first, or choose a reference nearer to the operating point."
        )
    return x, u


def _constants(problem: MPCProblem, r: Given, d: Given) -> Array:
    """Return [r; d] in deviations, of shape (p + d,) or (batch, p + d)."""
    p = len(problem.tracking.C)
    n_d = problem.model.n_disturbances
    rests = np.split(problem.theta_ss[problem.layout.now], [p])
    parts = []
    for name, value, size, rest in zip("rd", (r, d), (p, n_d), rests, strict=True):
        array = to_float(name, rest if value is None else value)
        shape: tuple[int | str, ...] = ("batch", size) if array.ndim == 2 else (size,)
        parts.append(check_array(name, array, shape) - rest)
    rows = np.broadcast_shapes(parts[0].shape[:-1], parts[1].shape[:-1])
    return np.concatenate([np.broadcast_to(a, (*rows, a.shape[-1])) for a in parts], axis=-1)


REST_STEPS = 100_000
"""After so many a law that does not rest is given up."""


class Value(NamedTuple):
    """``theta' P theta + slope' theta + constant``, of theta in deviations."""

    P: Array
    slope: Array
    constant: float

    def at(self, theta: Array) -> Array:
        """Return it at theta (..., n_theta)."""
        return np.asarray(np.sum((theta @ self.P + self.slope) * theta, axis=-1) + self.constant)

    @property
    def form(self) -> Array:
        """The matrix of the same as a form of ``[theta; 1]``."""
        half = self.slope[:, None] / 2
        return np.block([[self.P, half], [half.T, np.full((1, 1), self.constant)]])


def value(problem: MPCProblem, law: Law, gamma: float) -> Value:
    """Return what :meth:`LinearMPC.value_terms` does; without a price it is solved for in z."""
    if problem.price.counts:
        return _priced_value(problem, law, gamma)
    errors = problem.error_system
    K = gain_at_rest(problem, law)
    P = lqr.policy_value(errors.model, errors.Q, errors.R, K, gamma, errors.cross)
    P = np.asarray(errors.to_error.T @ P @ errors.to_error)
    return Value(P, np.zeros(len(P)), 0.0)


def state_action_value(problem: MPCProblem, law: Law, gamma: float) -> Value:
    """Return the same of ``[theta; u]``: the cost of u now, the law ever after."""
    after = value(problem, law, gamma)
    AB = np.hstack(problem.prediction)
    return Value(
        np.asarray(problem.stage_matrix + gamma * AB.T @ after.P @ AB),
        problem.stage_slope + gamma * AB.T @ after.slope,
        problem.price.constant + gamma * after.constant,
    )


def _priced_value(problem: MPCProblem, law: Law, gamma: float) -> Value:
    """Return the value of the affine law at the point where the model rests under it.

    That point is reached from the operating point, with r and d at zero.
    """
    if gamma >= 1:
        raise ValueError(
            "With a price the law pays at rest too: its cost for good is infinite without a "
            "discount. Pass a gamma below 1."
        )
    A, B = problem.prediction
    theta = problem.theta_rest
    for _ in range(REST_STEPS):
        u = law(theta)
        before = theta
        theta = A @ theta + B @ u
        if np.all(np.abs(theta - before) <= 1e-13 * problem.theta_half):
            break
    else:
        raise ValueError(
            f"The law comes to no rest in {REST_STEPS} steps from the operating point, so that "
            "no quadratic form is its value there. Lengthen the horizon, or give states and "
            "inputs weights."
        )
    K = law.gain(theta)
    held = law(theta) - K @ theta
    # On [theta; 1]: a price is a quadratic form of it.
    n = problem.n_theta
    one = np.ones((1, 1))
    stage = Value(problem.stage_matrix, problem.stage_slope, problem.price.constant).form
    play = np.block([[np.eye(n), np.zeros((n, 1))], [K, held[:, None]], [np.zeros((1, n)), one]])
    closed = linalg.block_diag(A + B @ K, one)
    closed[:n, n] = B @ held
    own = play.T @ stage @ play
    still = np.zeros((n + 1, 1))
    model = LinearModel(closed, still, problem.model.dt)
    P = lqr.policy_value(model, own, one, still.T, gamma)
    return Value(P[:n, :n], 2 * P[:n, n], float(P[n, n]))


def gain_at_rest(problem: MPCProblem, law: Law) -> Array:
    """Return K (m, n_z) with ``v = -K z`` near rest, where the law must rest."""
    errors = problem.error_system
    rest = problem.theta_rest
    unit = 2 * problem.u_half
    if not law.in_domain(rest) or np.any(np.abs(law(rest)) > 1e-9 * unit):
        raise ValueError(
            "The law does not rest at the origin: theta = 0 must be feasible with u = 0. "
            "Choose an operating point inside the bounds, and boxes of parameters that hold 0."
        )
    gains = law.gain(rest)
    K = -gains @ errors.to_theta
    box = np.maximum(np.abs(problem.theta_min), np.abs(problem.theta_max))
    if np.any(np.abs(gains - (errors.to_input - K @ errors.to_error)) @ box > 1e-6 * unit):
        raise ValueError(
            "The law does not rest at the steady states near theta = 0: a constraint acts there. "
            "Choose an operating point inside the bounds."
        )
    return K
