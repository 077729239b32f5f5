"""What a twin steps: theta, and behind it the memory of an observer of the disturbance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import DisturbanceObserver, LinearMPC

ROUNDED = 1e-6
"""So near to its bound, relative to their distance, an estimate may lie beyond it."""
SINGULAR = 1e10
"""Condition number from which on a matrix is not inverted."""


@dataclass(frozen=True)
class RowLayout:
    """What a row of a twin holds: theta, and behind it what the law does not see.

    Without an observer a row is theta. With one the x and d of theta are *estimates*: behind theta
    stand the plant's own state (n,) and the estimate of d (d,) before it is clipped to its bounds.
    The plant does not know d. The observer steps its estimate from what it measures:
    ``z+ = (I - L C) (A z + B u) + L C x+`` with ``z = [x_hat; d_hat]``.

    Attributes
    ----------
    problem : LinearMPC
    observer : DisturbanceObserver, optional
        Of all states and all disturbances of the problem. It is not stepped.

    Raises
    ------
    TypeError, ValueError
        For an observer of another model, or one whose measurements do not give the state.
    """

    problem: LinearMPC
    observer: DisturbanceObserver | None = None

    def __post_init__(self) -> None:
        observer, model = self.observer, self.problem.model
        if observer is None:
            return
        if not isinstance(observer, DisturbanceObserver):
            raise TypeError(
                f"observer = {observer!r} must be a DisturbanceObserver, e.g. that of "
                "mpc, observer = offset_free(mpc)."
            )
        its, own = (
            (each.n_states, each.n_inputs, each.n_disturbances) for each in (observer.model, model)
        )
        if its != own:
            raise ValueError(
                f"observer has {its} states, inputs and disturbances, the problem {own}. Give the "
                "observer of this problem's disturbances, all of them."
            )
        if observer.n_known:
            raise ValueError(
                f"The observer is told {observer.n_known} measured disturbances. A twin or a "
                "simulator of an observer with both kinds of disturbances is not there yet: "
                "train and compare in the env itself, as ImprovementGuard does."
            )
        n = model.n_states
        for name, matrix in (("C", observer.C), ("gain of the states", observer.gain[:n])):
            if matrix.shape != (n, n) or not np.linalg.cond(matrix) < SINGULAR:
                raise ValueError(
                    f"The observer's {name}, shape {matrix.shape}, cannot be inverted: the log "
                    "does not tell the plant's state. A twin needs an observer that measures all "
                    f"{n} states."
                )

    @property
    def size(self) -> int:
        """Number of entries of a row."""
        return self.problem.n_theta if self.observer is None else self._raw.stop

    @property
    def state(self) -> slice:
        """The entries of the plant's own state."""
        parts = self.problem.layout
        if self.observer is None:
            return parts.state
        return slice(parts.size, parts.size + parts.n_states)

    @property
    def given(self) -> slice:
        """The entries that an episode prescribes: references, and disturbances if measured."""
        parts = self.problem.layout
        return parts.constant if self.observer is None else parts.reference

    @property
    def _raw(self) -> slice:
        """The entries of the estimate of d before it is clipped."""
        return slice(self.state.stop, self.state.stop + self.problem.layout.n_disturbances)

    @property
    def _d(self) -> tuple[Array, Array]:
        """The bounds (d,) of the disturbance."""
        part = self.problem.layout.disturbance
        return self.problem.deviations.theta_min[part], self.problem.deviations.theta_max[part]

    @cached_property
    def inputs(self) -> Any:
        """Where in ``[row, u]`` stands what the plant's next state depends on, (k,)."""
        number, parts = np.arange(self.size + self.problem.model.n_inputs), self.problem.layout
        d = number[parts.disturbance] if self.observer is None else number[:0]
        return np.concatenate([number[self.state], d, number[self.size :]])

    @cached_property
    def linear(self) -> Array:
        """The step without residual and bounds of d, (size, size + m): ``row+ = . [row; u]``."""
        parts, model = self.problem.layout, self.problem.model
        theta = np.concatenate(self.problem.prediction, axis=1)
        if self.observer is None:
            return np.ascontiguousarray(theta)
        size, n, observer = parts.size, parts.n_states, self.observer
        found = np.zeros((self.size, self.size + model.n_inputs))
        found[:size, :size], found[:size, self.size :] = np.split(theta, [size], axis=1)
        found[: parts.n_states] = found[parts.disturbance] = 0.0
        found[self.state, self.state], found[self.state, self.size :] = model.A, model.B
        blind = np.eye(len(observer.gain)) - observer.gain @ observer.C_aug
        z = np.zeros((len(blind), found.shape[1]))
        before = blind @ observer.A
        z[:, parts.state], z[:, self._raw] = before[:, :n], before[:, n:]
        z[:, self.size :] = blind @ observer.B
        z += observer.gain @ observer.C @ found[self.state]
        found[parts.state], found[self._raw], found[parts.disturbance] = z[:n], z[n:], z[n:]
        return found

    @cached_property
    def spread(self) -> Array:
        """What a residual of the plant's state adds to a row, (size, n)."""
        parts = self.problem.layout
        found = np.zeros((self.size, parts.n_states))
        found[self.state] = np.eye(parts.n_states)
        if self.observer is not None:
            moved = self.observer.gain @ self.observer.C
            found[parts.state] = moved[: parts.n_states]
            found[self._raw] = found[parts.disturbance] = moved[parts.n_states :]
        return found

    @property
    def half(self) -> Array:
        """Half-widths (k,) of what the plant's next state depends on."""
        return self.features(self.begin(self.problem.theta_half), self.problem.u_half)

    def features(self, rows: Array, u: Array) -> Array:
        """Return what the plant's next state depends on, (..., k): ``[x, d, u]``, or ``[x, u]``."""
        return np.concatenate([rows, u], axis=-1)[..., self.inputs]

    def shown(self, rows: Array) -> Array:
        """Return theta (..., n_theta), as the law sees it."""
        return rows[..., : self.problem.n_theta]

    def clip(self, rows: Array) -> Array:
        """Clip the shown estimate of d to its bounds, in place; return which is inside of them."""
        if self.observer is None:
            return np.zeros((*rows.shape[:-1], 0), dtype=bool)
        (low, high), raw = self._d, rows[..., self._raw]
        rows[..., self.problem.layout.disturbance] = np.clip(raw, low, high)
        return np.asarray((raw > low) & (raw < high))

    def begin(self, thetas: Array) -> Array:
        """Return rows (..., size) of thetas (..., n_theta), or of rows: what is shown is so."""
        shown, parts = self.shown(thetas), self.problem.layout
        if self.observer is None:
            return shown.copy()
        x, d = shown[..., parts.state], shown[..., parts.disturbance]
        return np.concatenate([shown, x, d], axis=-1)

    def after(self, row: Array, u: Array, theta: Array) -> Array:
        """Return the row (size,) that shows theta (n_theta,) one step after another row.

        It is the observer's own step backward: from what it showed to what it had measured.
        """
        if self.observer is None:
            return theta.copy()
        observer, parts, n = self.observer, self.problem.layout, self.problem.layout.n_states
        z = observer.A @ np.concatenate([row[parts.state], row[self._raw]]) + observer.B @ u
        seen = np.linalg.solve(observer.gain[:n], theta[parts.state] - z[:n])
        d, shown, (low, high) = z[n:] + observer.gain[n:] @ seen, theta[parts.disturbance], self._d
        room = ROUNDED * (high - low)  # an observation rounds the bounds to float32
        d = np.where((shown > low + room) & (shown < high - room), shown, d)
        x = np.linalg.solve(observer.C, observer.C @ z[:n] + seen)
        return np.concatenate([theta, x, d])

    def recovered(self, thetas: Array, actions: Array) -> tuple[Array, Array]:
        """Return the rows (T + 1, size) and inputs (T, m) of an episode of thetas.

        Where d is NaN its states are the measured ones: the observer is run over them. Else what
        it measured follows from what it showed. An episode that begins amid an estimate loses its
        first row: nothing tells what was measured there.
        """
        if self.observer is None:
            return thetas, actions
        parts = self.problem.layout
        if np.isnan(thetas[:, parts.disturbance]).all():
            return self._run(thetas, actions), actions
        rows = [self.begin(thetas[0])]
        for theta, u in zip(thetas[1:], actions, strict=True):
            rows.append(self.after(rows[-1], u, theta))
        if np.allclose(thetas[0, parts.disturbance], np.clip(0.0, *self._d), atol=1e-12):
            return np.array(rows), actions
        return np.array(rows[1:]), actions[1:]

    def _run(self, thetas: Array, actions: Array) -> Array:
        """Return rows of thetas whose states were measured, and whose d is not known."""
        assert self.observer is not None
        observer, parts, n = self.observer, self.problem.layout, self.problem.layout.n_states
        x = thetas[:, parts.state]
        z = np.concatenate([x[0], np.zeros(parts.n_disturbances)])
        found = [z]
        for after, u in zip(x[1:], actions, strict=True):
            z = observer.A @ z + observer.B @ u
            found.append(z := z + observer.gain @ (observer.C @ after - observer.C_aug @ z))
        estimates = np.array(found)
        rows = np.concatenate([thetas, x, estimates[:, n:]], axis=1)
        rows[:, parts.state] = estimates[:, :n]
        self.clip(rows)
        return np.asarray(rows)
