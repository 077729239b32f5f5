"""What theta holds, the steady state it asks for, and the coordinates of the error about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from sb3_yann._validation import Array, Bounds, Given, ReadOnlyArrays, check_bounds, is_kept
from sb3_yann.control.model.linear_model import LinearModel


@dataclass(frozen=True)
class ThetaLayout:
    """The layout of ``theta = [x, r, d, bounds, u_prev]`` with the parts that a problem uses.

    With a preview r holds the references of the present sample, then those of the next, and so on.
    So does d; estimated disturbances, which have no preview, come last in it.

    Attributes
    ----------
    n_states, n_references, n_disturbances : int
        Numbers of states x, tracked outputs, and measured or estimated disturbances.
    n_previous : int
        The inputs of the step before, ``u_prev``: all where their rate matters, or none.
    n_estimated : int
        How many of the disturbances are estimated.
    previews : tuple of int
        How many samples ahead references and measured disturbances are known.
    bounds : tuple of str
        The bounds that change at run time.

    Examples
    --------
    >>> ThetaLayout(n_states=1, n_references=1, previews=(1, 0)).names
    ('x[0]', 'r[0]', 'r_1[0]')
    """

    n_states: int
    n_references: int = 0
    n_disturbances: int = 0
    n_previous: int = 0
    n_estimated: int = 0
    previews: tuple[int, int] = (0, 0)
    bounds: tuple[str, ...] = ()

    @cached_property
    def size(self) -> int:
        """Number of entries of theta."""
        return int(self.previous.stop)

    @property
    def has_constants(self) -> bool:
        """Whether theta holds a reference or a disturbance: it has many steady states then."""
        return self.n_references + self.n_disturbances > 0

    @cached_property
    def state(self) -> slice:
        """The entries of x."""
        return slice(0, self.n_states)

    @cached_property
    def reference(self) -> slice:
        """The entries of r, with those of the preview."""
        return _after(self.state, self.n_references * (1 + self.previews[0]))

    @cached_property
    def disturbance(self) -> slice:
        """The entries of d, with those of the preview."""
        return _after(self.reference, self.n_disturbances + self.previews[1] * self._loads)

    @cached_property
    def limits(self) -> slice:
        """The entries of the bounds that change at run time."""
        return _after(self.disturbance, len(self.bounds))

    @cached_property
    def constant(self) -> slice:
        """The entries of r, d and bounds, which an episode prescribes."""
        return slice(self.n_states, self.limits.stop)

    @cached_property
    def previous(self) -> slice:
        """The entries of the previous input."""
        return _after(self.limits, self.n_previous)

    @cached_property
    def now(self) -> NDArray[np.intp]:
        """The entries of r and d of the present sample, (p + d,)."""
        return self.sample(0)

    @cached_property
    def last(self) -> NDArray[np.intp]:
        """The entries of r and d of the last sample that is known, which stay, (p + d,)."""
        return self.sample(max(self.previews))

    @property
    def _loads(self) -> int:
        return self.n_disturbances - self.n_estimated

    @property
    def _known_ahead(self) -> tuple[tuple[int, int, int], ...]:
        """Return the first entry, the number and the preview of references and of loads."""
        first = self.reference.start, self.disturbance.start
        return tuple(zip(first, (self.n_references, self._loads), self.previews, strict=True))

    def sample(self, ahead: int) -> NDArray[np.intp]:
        """Return the entries of r and d so many samples ahead, of the last that are known."""
        parts = [
            np.arange(count) + first + count * min(known, ahead)
            for first, count, known in self._known_ahead
        ]
        until = self.disturbance.stop
        parts.append(np.arange(until - self.n_estimated, until))
        return np.asarray(np.concatenate(parts), np.intp)

    @property
    def settled(self) -> ThetaLayout:
        """The layout without previews."""
        return replace(self, previews=(0, 0))

    @cached_property
    def settles(self) -> NDArray[np.intp]:
        """The entries of theta that make up that of :attr:`settled`, with the last r and d."""
        every = np.arange(self.size)
        rest = self.limits.start
        return np.asarray(np.concatenate([every[self.state], self.last, every[rest:]]), np.intp)

    @cached_property
    def lift(self) -> Array:
        """The map (n_theta, n_settled) to the theta whose r and d do not change."""
        found = np.zeros((self.size, len(self.settles)))
        found[self.settles, np.arange(len(self.settles))] = 1.0
        for first, count, ahead in self._known_ahead:
            stays = found[first + count * ahead : first + count * (ahead + 1)]
            found[first : first + count * ahead] = np.tile(stays, (ahead, 1))
        return found

    @cached_property
    def next(self) -> NDArray[np.intp]:
        """Which entry of theta takes the place of each one sample later (n_theta,)."""
        found = np.arange(self.size)
        for first, count, ahead in self._known_ahead:
            found[first : first + count * ahead] += count
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each entry, such as ``x[0]``, ``r[0]``, ``r_2[0]``, ``d[0]``, ``u_prev[0]``.

        ``r_2`` is the reference two samples ahead.
        """
        return tuple(f"{kind}{f'_{ahead}' * (ahead > 0)}[{i}]" for kind, i, ahead in self.entries)

    @property
    def entries(self) -> list[tuple[str, int, int]]:
        """What each entry is, such as x, r, d, u_max, u_prev; its number; and how far ahead."""
        found = [("x", i, 0) for i in range(self.n_states)]
        for kind, (_, count, known) in zip("rd", self._known_ahead, strict=True):
            found += [(kind, i, k) for k in range(known + 1) for i in range(count)]
        found += [("d", i, 0) for i in range(self._loads, self.n_disturbances)]
        bounds = (name[:-1].split("[") for name in self.bounds)
        found += [(side, int(i), 0) for side, i in bounds]
        return found + [("u_prev", i, 0) for i in range(self.n_previous)]


def _after(part: slice, size: int) -> slice:
    return slice(part.stop, part.stop + size)


def theta_box(
    layout: ThetaLayout, given: tuple[Given, Given], states: Bounds, others: Sequence[Bounds]
) -> Bounds:
    """Return the box of theta.

    ``given`` are theta_min and theta_max, a number or (n,) for the states; ``states`` (n,) stand in
    for them. ``others`` are the boxes of r and d without their previews, of bounds and of the
    previous input.
    """
    n = layout.n_states
    parts = []
    for value, fallback in zip(given, states, strict=True):
        part: Any = fallback if value is None else value
        # `dataclasses.replace` passes the stored box, which is read-only, and means the states.
        parts.append(part[:n] if is_kept(part) else part)
    pieces = [check_bounds("theta", parts[0], parts[1], n), *others]
    settled = np.argmax(layout.lift, axis=1)
    low, high = (np.concatenate(side)[settled] for side in zip(*pieces, strict=True))
    return check_bounds("theta", low, high, layout.size)


@dataclass(frozen=True, eq=False)
class SteadyStates(ReadOnlyArrays):
    """``x_s = x [r; d]`` and ``u_s = u [r; d]``, of shapes (n, p + d) and (m, p + d)."""

    x: Array
    u: Array


def steady_states(
    model: LinearModel, C: Array, Q: Array, R: Array, x_unit: Array, u_unit: Array
) -> SteadyStates:
    """Return the map from reference and disturbance to the steady state with ``C x_s = r``.

    It solves ``(A - I) x_s + B u_s = -E d`` and ``C x_s = r``. Of several solutions it is the one
    with the smallest ``x_s'Q x_s + u_s'R u_s``, then that of minimum norm in the units given
    (Rawlings, Mayne & Diehl, Model Predictive Control, Section 1.5). ``x_unit`` (n,) and ``u_unit``
    (m,) are typical sizes: ranks and norms do not depend on the units of the plant. ValueError if
    some reference or disturbance has no steady state, whatever the bounds.
    """
    n, m = model.B.shape
    unit = np.concatenate([x_unit, u_unit])
    equations = np.block([[model.A - np.eye(n), model.B], [C, np.zeros((len(C), m))]]) * unit
    row_unit = np.linalg.norm(equations, axis=1)
    row_unit[:n] = np.maximum(row_unit[:n], x_unit)  # an integrator's row may be all rounding
    row_unit[row_unit == 0] = 1.0
    equations = equations / row_unit[:, None]
    right = linalg.block_diag(np.zeros((n, 0)), np.eye(len(C)))
    right = np.hstack([right, np.vstack([-model.E, np.zeros((len(C), model.n_disturbances))])])
    right = right / row_unit[:, None]

    solution = np.linalg.pinv(equations, rcond=1e-10) @ right
    size = np.maximum(np.abs(right).max(axis=0, initial=0.0), np.finfo(float).tiny)
    missed = np.abs(equations @ solution - right).max(axis=0, initial=0.0) > 1e-8 * size
    if np.any(missed):
        p = len(C)
        known = [*(f"r[{i}]" for i in range(p)), *model.disturbance_labels]
        which = [known[i] for i in np.flatnonzero(missed)]
        rank = int(np.linalg.matrix_rank(equations, tol=1e-10))
        raise ValueError(
            f"There is no steady state for {', '.join(which)}: [[A - I, B], [C, 0]] has rank "
            f"{rank}, not {n + p}. Track fewer outputs, or other ones: at most as many as inputs "
            f"({m}) can be tracked, each moved by an input at steady state."
        )

    free = linalg.null_space(equations, rcond=1e-10)
    weight = linalg.block_diag(Q, R) * np.outer(unit, unit)
    curvature = free.T @ weight @ free
    # What costs nothing leaves the squares of rounding, 1e-32 of the weights: no curvature.
    rounding = 1e-24 * np.abs(weight).max() / max(np.abs(curvature).max(initial=0.0), 1e-300)
    inverse = np.linalg.pinv(curvature, rcond=max(1e-12, rounding), hermitian=True)
    solution = solution - free @ inverse @ (free.T @ weight @ solution)
    solution = solution * unit[:, None]
    return SteadyStates(solution[:n], solution[n:])


@dataclass(frozen=True, eq=False)
class ErrorSystem(ReadOnlyArrays):
    """The problem in ``z = to_error theta`` and ``v = u - to_input theta``: ``z+ = A z + B v``.

    z is ``x - x_s``, followed by ``u_prev - u_s`` where the rate has a weight, and by what r and d
    of a preview differ from the last of them, whose steady state x_s and u_s are. The constant r
    and d, modes on the unit circle that no Riccati equation without discount allows, are gone.
    ``to_theta`` (n_theta, n_z) leads to a theta with this z, whose last r and d are zero. The stage
    cost is ``z'Qz + 2 z' cross v + v'Rv``, and ``[theta; u]' stage_matrix [theta; u]`` too.
    """

    model: LinearModel
    to_error: Array
    to_input: Array
    to_theta: Array
    Q: Array
    R: Array
    cross: Array | None
    stage_matrix: Array


def error_system(
    model: LinearModel,
    layout: ThetaLayout,
    steady: SteadyStates,
    prediction: tuple[Array, Array],
    weights: tuple[Array, Array, Array],
) -> ErrorSystem:
    """Return the coordinates of a problem with weights Q (n, n), R (m, m) and R_du (m, m).

    The stage cost is ``e'Qe + v'Rv + (u - u_prev)'R_du(u - u_prev)``, with ``e = x - x_s`` and
    ``v = u - u_s`` of the present r and d.
    """
    n, m = model.B.shape
    every = np.eye(layout.size)
    x = every[layout.state]
    previous = every[layout.previous]
    is_rated = bool(np.any(weights[2]))
    from_now = np.block([[x - steady.x @ every[layout.now], np.zeros((n, m))],
                         [-steady.u @ every[layout.now], np.eye(m)]])  # fmt: skip
    if is_rated:
        from_now = np.vstack([from_now, np.hstack([-previous, np.eye(m)])])
    W = from_now.T @ linalg.block_diag(*weights[: 2 + is_rated]) @ from_now

    to_input = steady.u @ every[layout.last]
    changes = np.flatnonzero(layout.next != np.arange(layout.size))
    final = layout.lift @ every[layout.settles]  # all r and d are the last ones
    to_error = [x - steady.x @ every[layout.last]]
    to_theta = [x]
    if is_rated:
        to_error.append(previous - to_input)
        to_theta.append(previous)
    to_error.append((every - final)[changes])
    to_theta.append(every[changes])
    E = np.vstack(to_error)
    T = np.vstack(to_theta).T
    A, B = prediction
    cross = T.T @ W[: layout.size, layout.size :]
    return ErrorSystem(
        model=LinearModel(E @ A @ T, E @ B, model.dt),
        to_error=E,
        to_input=to_input,
        to_theta=T,
        Q=T.T @ W[: layout.size, : layout.size] @ T,
        R=W[layout.size :, layout.size :],
        cross=cross if np.any(cross) else None,
        stage_matrix=W,
    )
