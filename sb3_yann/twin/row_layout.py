"""What a twin steps: theta, and behind it the memory of an observer of the disturbance."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array, check_type
from sb3_yann.control import DisturbanceObserver, LinearMPC, StateEstimator


@dataclass(frozen=True)
class RowLayout:
    """What a row of a twin holds: theta, and behind it what the law does not see.

    Without an observer a row is theta. With one the x and d of theta are *estimates*, and behind
    theta stands the plant's own state (n,), which does not know d. The observer steps its estimate
    from what it measures: ``z+ = (I - L C) (A z + B u) + L C x+`` with ``z = [x_hat; d_hat]``, and
    clips d_hat to its bounds.

    Where the measurements do not tell the plant's state, a row is theta, and the estimate itself is
    what is learnt: ``x_hat+ = A x_hat + B u + E d_hat + residual(x_hat, d_hat, u)``. The residual
    is ``L_x e``, of the innovations e, and moves d_hat by ``L_d L_x^+ residual``. Or it is
    ``hidden``: behind theta stands a guess of the plant's own state, which `sb3_yann.twin.hidden`
    finds.
    """

    problem: LinearMPC
    estimator: StateEstimator | None = None
    hidden: bool = False

    def __post_init__(self) -> None:
        estimator = self.estimator
        model = self.problem.model
        if estimator is None:
            return
        wanted = "a StateEstimator, e.g. that of mpc, observer = offset_free(mpc)"
        check_type("observer", estimator, StateEstimator, wanted)
        its, own = ((each.n_states, each.n_inputs) for each in (estimator.model, model))
        blind = model.n_disturbances - len(self.problem.extra)
        theirs = estimator.model.n_disturbances
        if its != own or not blind <= theirs <= model.n_disturbances:
            raise ValueError(
                f"observer has {(*its, theirs)} states, inputs and disturbances, the problem "
                f"{(*own, model.n_disturbances)}. Give the observer of this problem's "
                "disturbances, all of them."
            )

    @cached_property
    def observer(self) -> StateEstimator | None:
        """The estimator where it determines the plant's state and all disturbances, else None."""
        found = self.estimator
        n = self.problem.model.n_states
        if found is None or found.n_estimated != self.problem.layout.n_disturbances:
            return None
        whole = self.hidden or (isinstance(found, DisturbanceObserver) and found.C.shape == (n, n))
        matrices = [found.gain[:n]] if self.hidden else [found.gain[:n], found.C]
        # 1e10: condition number from which on a matrix is not inverted
        return found if whole and max(map(np.linalg.cond, matrices)) < 1e10 else None

    @property
    def is_estimate(self) -> bool:
        """Whether the plant's own state is in no entry: the estimator's memory stands for it."""
        return self.estimator is not None and self.observer is None

    @cached_property
    def _estimated(self) -> slice:
        """The entries of disturbances that an estimator moves."""
        part = self.problem.layout.disturbance
        if self.observer is not None:
            return part
        count = 0 if self.estimator is None else self.estimator.n_estimated
        return slice(part.stop - count, part.stop)

    @cached_property
    def _shown(self) -> NDArray[np.intp]:
        """The entries of an observer's estimate ``[x_hat; d_hat]``."""
        return np.asarray(np.r_[self.problem.layout.state, self.problem.layout.disturbance])

    @cached_property
    def size(self) -> int:
        """Number of entries of a row."""
        return self.problem.n_theta if self.observer is None else self.state.stop

    @cached_property
    def state(self) -> slice:
        """The entries of the plant's own state."""
        parts = self.problem.layout
        if self.observer is None:
            return parts.state
        return slice(parts.size, parts.size + parts.n_states)

    @cached_property
    def given(self) -> Any:
        """The entries that an episode prescribes: references, what is measured of d, and bounds."""
        parts = self.problem.layout
        found = slice(parts.constant.start, self._estimated.start)
        if found.stop == parts.disturbance.stop:
            return parts.constant
        return np.r_[found, parts.limits] if parts.bounds else found

    @cached_property
    def measured(self) -> Array:
        """The part (n, n) of a state that the measurements show."""
        assert self.observer is not None
        return np.asarray(np.linalg.pinv(self.observer.C) @ self.observer.C)

    @cached_property
    def inputs(self) -> Any:
        """Where in ``[row, u]`` stands what the plant's next state depends on, (k,)."""
        number = np.arange(self.size + self.problem.model.n_inputs)
        parts = self.problem.layout
        d = parts.now[parts.n_references :] if self.observer is None else number[:0]
        return np.concatenate([number[self.state], d, number[self.size :]])

    @cached_property
    def linear(self) -> Array:
        """The step without residual and bounds of d, (size, size + m): ``row+ = . [row; u]``."""
        model = self.problem.model
        theta = np.concatenate(self.problem.prediction, axis=1)
        observer = self.observer
        if observer is None:
            return np.ascontiguousarray(theta)
        size = self.problem.n_theta
        found = np.zeros((self.size, self.size + model.n_inputs))
        found[:size, :size], found[:size, self.size :] = np.split(theta, [size], axis=1)
        found[self.state, self.state] = model.A
        found[self.state, self.size :] = model.B
        blind = np.eye(len(observer.gain)) - observer.gain @ observer.C_aug
        z = observer.gain @ observer.C @ found[self.state]
        z[:, self._shown] += blind @ observer.A
        z[:, self.size :] += blind @ observer.B
        found[self._shown] = z
        return found

    @cached_property
    def spread(self) -> Array:
        """What a residual of the plant's state adds to a row, (size, n)."""
        n = self.problem.model.n_states
        found = np.zeros((self.size, n))
        found[self.state] = np.eye(n)
        if self.observer is not None:
            found[self._shown] = self.observer.gain @ self.observer.C
        elif self.estimator is not None:
            gain = self.estimator.gain
            found[self._estimated] = gain[n:] @ np.linalg.pinv(gain[:n])
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
        """Clip the estimate of d to its bounds, in place; return which is inside of them."""
        own = self.problem.deviations
        low, high = (each[self._estimated] for each in (own.theta_min, own.theta_max))
        d = rows[..., self._estimated]
        inside = (d > low) & (d < high)
        if d.size:
            rows[..., self._estimated] = np.clip(d, low, high)
        return np.asarray(inside)

    def begin(self, thetas: Array) -> Array:
        """Return rows (..., size) of thetas (..., n_theta), or of rows: what is shown is so."""
        shown = self.shown(thetas)
        if self.observer is None:
            return shown.copy()
        x = shown[..., self.problem.layout.state]
        if self.hidden and thetas.shape[-1] == self.size:  # what is not measured stays
            own = thetas[..., self.state]
            x = own + (x - own) @ self.measured.T
        return np.concatenate([shown, x], axis=-1)

    def after(self, row: Array, u: Array, theta: Array) -> Array:
        """Return the row (size,) that shows theta (n_theta,) one step after another row.

        It is the observer's own step backward: from what it showed to what it had measured.
        """
        if self.observer is None:
            return theta.copy()
        observer = self.observer
        x_hat = theta[self.problem.layout.state]
        before = (observer.A @ row[self._shown] + observer.B @ u)[: len(x_hat)]
        seen = np.linalg.pinv(observer.gain[: len(x_hat)]) @ (x_hat - before)
        shows = np.linalg.pinv(observer.C) @ seen + self.measured @ before
        return np.concatenate([theta, shows + x_hat - self.measured @ x_hat])

    def recovered(self, thetas: Array, actions: Array) -> tuple[Array, Array]:
        """Return the rows (T + 1, size) and inputs (T, m) of an episode of thetas.

        What an observer measured follows from what it showed. An episode that begins amid an
        estimate loses its first row: what was measured there is not known.
        """
        if self.observer is None:
            return thetas, actions
        rows = [self.begin(thetas[0])]
        for theta, u in zip(thetas[1:], actions, strict=True):
            rows.append(self.after(rows[-1], u, theta))
        first: Array = np.zeros(self.size)
        self.clip(first)
        if np.allclose(thetas[0, self._estimated], first[self._estimated], atol=1e-12):
            return np.array(rows), actions
        return np.array(rows[1:]), actions[1:]

    def estimated(
        self, episodes: Iterable[Any], loads: Sequence[Any] | None
    ) -> tuple[list[Any], list[Array] | None]:
        """Return episodes of outputs as episodes of estimates, and all disturbances of each.

        Those of theta stay as they are.
        """
        pairs = [*episodes]
        if any(np.ndim(x) == 2 and np.shape(x)[1] == self.problem.n_theta for x, _ in pairs):
            return pairs, None if loads is None else [*loads]
        found = []
        disturbances = []
        for i, (outputs, inputs) in enumerate(pairs):
            y = np.asarray(outputs, np.float64).reshape(len(outputs), -1)
            given = np.zeros(0) if loads is None else np.asarray(loads[i], np.float64)
            known = np.broadcast_to(given, (len(y), given.shape[-1]))
            x_hat, d_hat = self.run(y, inputs, known)
            found.append((x_hat, inputs))
            disturbances.append(np.hstack([known, d_hat]))
        return found, disturbances if self.problem.layout.n_disturbances else None

    def run(self, outputs: Array, inputs: Array, loads: Array) -> tuple[Array, Array]:
        """Return what the estimator makes of outputs (T + 1, q), inputs (T, m) and measured d.

        States (T + 1, n) and estimated disturbances (T + 1, d) within their bounds, all of it in
        plant units. A reading that is NaN is left out.
        """
        estimator = copy.deepcopy(self.estimator)
        assert estimator is not None
        model = estimator.model
        y = np.asarray(outputs, np.float64) - estimator.C @ model.x_ss
        u = np.asarray(inputs, np.float64).reshape(len(y) - 1, -1) - model.u_ss
        k = estimator.n_known
        d = loads[:, :k] - model.d_ss[:k]
        estimator.reset(y[0])
        bounds = self.problem.deviations.disturbances
        first = self.problem.layout.n_disturbances - estimator.n_estimated
        found = [estimator.estimate]
        for t in range(len(u)):
            x_hat, d_hat = estimator.update(y[t + 1], u[t], d[t] if k else None)
            d_hat = np.clip(d_hat, bounds.d_min[first:], bounds.d_max[first:])
            estimator.estimate = np.concatenate([x_hat, d_hat])
            found.append(estimator.estimate)
        x_hat, d_hat = np.split(np.array(found), [model.n_states], axis=1)
        return x_hat + model.x_ss, d_hat + model.d_ss[k:]
