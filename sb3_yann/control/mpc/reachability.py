"""Whether the steady state that a reference asks for lies within the bounds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array, check_array, to_float
from sb3_yann.control.mpc._arguments import Given
from sb3_yann.control.mpc.problem import MPCProblem

TOLERANCE = 1e-9
"""How far beyond a bound a steady state still counts as within, relative to the bound."""
KINDS = "x", "u", "y", "mixed"


def is_reachable(problem: MPCProblem, r: Given, d: Given) -> NDArray[np.bool_]:
    """Tell whether the steady state lies within the bounds, see :meth:`LinearMPC.is_reachable`."""
    return np.asarray(np.all(margins(problem, r, d) >= 0, axis=-1))


def margins(problem: MPCProblem, r: Given, d: Given) -> Array:
    """Return the room to the upper and lower bounds of x, u, y and mixed ones, negative beyond."""
    constant = _constants(problem, r, d)
    x, u = constant @ problem.steady_states.x.T, constant @ problem.steady_states.u.T
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
    p, n_d = len(problem.tracking.C), problem.model.n_disturbances
    rests = np.split(problem.theta_ss[problem.layout.now], [p])
    parts = []
    for name, value, size, rest in zip("rd", (r, d), (p, n_d), rests, strict=True):
        array = to_float(name, rest if value is None else value)
        shape: tuple[int | str, ...] = ("batch", size) if array.ndim == 2 else (size,)
        parts.append(check_array(name, array, shape) - rest)
    rows = np.broadcast_shapes(parts[0].shape[:-1], parts[1].shape[:-1])
    return np.concatenate([np.broadcast_to(a, (*rows, a.shape[-1])) for a in parts], axis=-1)
