"""Estimates states, and constant disturbances that nothing measures, from measured outputs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from sb3_yann._validation import (
    Array,
    check_array,
    check_int,
    check_outputs,
    check_positive_vector,
    check_symmetric,
)
from sb3_yann.control import lqr
from sb3_yann.control.model.linear_model import LinearModel


class StateEstimator:
    """A steady-state Kalman filter for states, and for disturbances that are ``estimated``.

    The model is augmented to ``x+ = A x + B u + E d + w``, ``d+ = d``, ``y = C x + v``. What it
    takes and returns are deviations, as of a law: :class:`sb3_yann.wrappers.EstimateState` shows
    plant units. A reading that is NaN is left out: the model predicts it.

    Parameters
    ----------
    model : LinearModel
        Disturbances that are not ``estimated`` are measured, and :meth:`update` takes them.
    measured : array_like, shape (q, n), or list of int, optional
        C, or the indices of the measured states. The default is the model's C.
    state_noise, disturbance_noise, measurement_noise : array_like or float, default 1
        Standard deviations of w, of the steps of d, and of v, of shapes (n,), (d,) and (q,), per
        sample; or their covariances (n, n), (d, d) and (q, q). Only their ratios matter: more
        disturbance noise makes the estimate of d faster and rougher.
    every : int or sequence of int, default 1
        Each output is read every so many samples, together where several are: 60 for a laboratory's
        hourly value among readings of every minute.
    cross_noise : array_like, shape (n, q), optional
        Covariance of w and v, which a model in innovation form has.
    gain : array_like, shape (n + d, q), optional
        A Luenberger gain to use instead: ``[x; d]`` is corrected by ``gain (y - C x)``.

    Raises
    ------
    ValueError
        For a state or disturbance that the measurements do not determine, and a gain with unstable
        error.

    Examples
    --------
    >>> from sb3_yann.control import LinearModel
    >>> model = LinearModel([[0.9, 0.2], [0, 0.5]], [[0.0], [1.0]], dt=1, C=[[1, 0]])
    >>> estimator, x = StateEstimator(model), np.array([1.0, -1.0])
    >>> _ = estimator.reset(x[:1])
    >>> for _ in range(50):
    ...     x = model.step(x, [0.3])
    ...     x_hat, _ = estimator.update(x[:1], [0.3])
    >>> bool(np.allclose(x_hat, x))
    True
    """

    def __init__(
        self,
        model: LinearModel,
        measured: ArrayLike | Sequence[int] | None = None,
        *,
        state_noise: ArrayLike = 1.0,
        disturbance_noise: ArrayLike = 1.0,
        measurement_noise: ArrayLike = 1.0,
        cross_noise: ArrayLike | None = None,
        every: int | Sequence[int] = 1,
        gain: ArrayLike | None = None,
    ) -> None:
        if not isinstance(model, LinearModel):
            raise TypeError(f"model = {model!r} must be a LinearModel, e.g. LinearModel(A, B, dt).")
        known = self._measured(model)
        n = model.n_states
        d = model.n_disturbances - len(known)
        self.model = model
        self.C = check_outputs("measured", model.shown if measured is None else measured, n)
        E = np.delete(model.E, known, axis=1)
        _require_observable(model, E, self.C)
        q = len(self.C)
        self.A = np.block([[model.A, E], [np.zeros((d, n)), np.eye(d)]])
        self.B = np.vstack([model.B, np.zeros((d, model.n_inputs))])
        self.E = np.vstack([model.E[:, known], np.zeros((d, len(known)))])
        self.C_aug = np.hstack([self.C, np.zeros((q, d))])
        W, w_std = _covariance("state_noise", state_noise, n)
        D, d_std = _covariance("disturbance_noise", disturbance_noise, d)
        V, v_std = _covariance("measurement_noise", measurement_noise, q)
        cross = np.zeros((n, q)) if cross_noise is None else cross_noise
        cross = check_array("cross_noise", cross, (n, q))
        self.noise = {"state_noise": W, "measurement_noise": V, "cross_noise": cross}
        cross = np.vstack([cross, np.zeros((d, q))])
        periods = [check_int("every", each) for each in np.ravel(every).tolist()]
        if len(periods) not in (1, q):
            raise ValueError(f"every = {every} must be one number, or one for each of {q} outputs.")
        self.every = np.resize(periods, q)
        self._period = int(np.lcm.reduce(self.every))
        if gain is None:
            if self._period > max(20_000, 2 * self.every.max()):
                raise ValueError(
                    f"every = {self.every.tolist()}: all outputs are read together each "
                    f"{self._period:,} samples only, and the filter's gain would take too long. "
                    "Pass numbers with common factors, such as 60 for 59 and 61."
                )
            found = self._kalman_gain(linalg.block_diag(W, D), V, cross)
            if found is None:
                raise ValueError(
                    f"state_noise = {w_std}, disturbance_noise = {d_std} and measurement_noise = "
                    f"{v_std} are too far apart, or too large, for a Kalman filter: rounding hides "
                    "its gain. Only their ratios matter: keep these below 1e6."
                )
            self.gain = found
        else:
            self.gain = check_array("gain", gain, (n + d, q))
        radius = self._radius(self.gain)
        if not radius < 1:
            raise ValueError(
                f"gain = {self.gain.tolist()} does not make the error of the estimate decay: its "
                f"spectral radius is {radius:.6g}, not below 1. Leave it out for a Kalman filter."
            )
        self.estimate: Array = np.zeros(n + d)

    def require_model(
        self, model: LinearModel, parts: Sequence[str] = ("A", "B", "E", "x_ss", "u_ss")
    ) -> None:
        """Raise ValueError unless the estimator is of a model, in so many ``parts`` of it."""
        for part in parts:
            own = getattr(self.model, part)
            wanted = getattr(model, part)
            if own.shape != wanted.shape or not np.allclose(own, wanted):
                raise ValueError(
                    f"The estimator is of another model than the problem: its {part} is "
                    f"{own.tolist()}, expected {wanted.tolist()}. Take found.estimator() of the "
                    "MPC's model, or the observer that offset_free(mpc) returned with the MPC."
                )

    def _measured(self, model: LinearModel) -> list[int]:
        """Return which disturbances are measured."""
        return [*model.measured]

    @property
    def n_measured(self) -> int:
        """Number of measured outputs q."""
        return len(self.C)

    @property
    def n_estimated(self) -> int:
        """Number of estimated disturbances."""
        return len(self.A) - self.model.n_states

    @property
    def n_known(self) -> int:
        """Number of measured disturbances, which :meth:`update` takes."""
        return int(self.E.shape[1])

    @property
    def x_hat(self) -> Array:
        """The estimated state (n,)."""
        return self.estimate[: self.model.n_states].copy()

    @property
    def d_hat(self) -> Array:
        """The estimated disturbance (d,)."""
        return self.estimate[self.model.n_states :].copy()

    def reset(
        self, y: ArrayLike, u: ArrayLike | None = None, d: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Restart from a reading y (q,); return x_hat and d_hat.

        With the plant's input u (m,), and its measured disturbances d, the filter starts where it
        would rest, had y, u and d always been these. Without u, d_hat is 0 and x_hat the smallest
        state that gives y. What is NaN counts as at the operating point.
        """
        now = np.array(y, np.float64)
        now = check_array("y", np.where(np.isnan(now), 0.0, now), (self.n_measured,))
        if u is None:
            smallest = np.linalg.pinv(self.C) @ now
            self.estimate = np.concatenate([smallest, np.zeros(self.n_estimated)])
        else:
            u = check_array("u", u, (self.model.n_inputs,))
            d = check_array("d", np.zeros(self.n_known) if d is None else d, (self.n_known,))
            self.estimate = self.resting @ np.concatenate([now, u, d])
        return self.x_hat, self.d_hat

    def update(self, y: ArrayLike, u: ArrayLike, d: ArrayLike | None = None) -> tuple[Array, Array]:
        """Return x_hat (n,) and d_hat, from y (q,) now, and the last input u (m,).

        Measured disturbances d are those that acted together with u.
        """
        if (d is None) != (self.n_known == 0):
            raise ValueError(
                f"d = {d!r}, but the observer takes {self.n_known} measured disturbances: those "
                "of its model that are not `estimated`. Pass what acted together with u."
            )
        predicted = self.A @ self.estimate + self.B @ check_array("u", u, (self.model.n_inputs,))
        if d is not None:
            predicted = predicted + self.E @ check_array("d", d, (self.n_known,))
        now = np.array(y, np.float64)
        if now.shape == (self.n_measured,):
            now = np.where(np.isnan(now), self.C_aug @ predicted, now)
        now = check_array("y", now, (self.n_measured,))
        self.estimate = predicted + self.gain @ (now - self.C_aug @ predicted)
        return self.x_hat, self.d_hat

    @cached_property
    def resting(self) -> Array:
        """The matrix from constant ``[y; u; d]`` to the estimate at which the filter rests."""
        left = np.eye(len(self.A)) - self.gain @ self.C_aug
        driven = np.hstack([self.gain, left @ self.B, left @ self.E])
        return np.asarray(np.linalg.solve(np.eye(len(self.A)) - left @ self.A, driven))

    def _kalman_gain(self, W: Array, V: Array, cross: Array) -> Array | None:
        """Return the steady-state gain of the filter, None where rounding hides it."""
        if np.any(self.every > 1):
            return self._gain_of_rates(W, V, cross)
        try:
            with np.errstate(all="ignore"):
                P = linalg.solve_discrete_are(self.A.T, self.C_aug.T, W, V, s=cross)
                spread = self.C_aug @ P @ self.C_aug.T + V
                gain = np.asarray(np.linalg.solve(spread, self.C_aug @ P).T)
                if np.any(cross):
                    # What v shows of w moves the state one sample later.
                    shared = np.linalg.solve(spread, cross.T).T
                    gain = gain + before_step(self.A, shared)
            if self._radius(gain) < 1:
                return gain
        except ValueError:  # a LinAlgError is one
            pass
        return None

    def _gain_of_rates(self, W: Array, V: Array, cross: Array) -> Array:
        """Return the mean gain of each output, over the samples at which it is read, in the end."""
        A = self.A
        C = self.C_aug
        gain: Array = np.zeros((len(A), len(C)))
        _, (unit, _) = linalg.matrix_balance(A, permute=False, separate=True)
        P = W + np.mean(np.diag(W) / unit**2) * np.diag(unit**2)  # definite, whatever the units
        for _ in range(max(40, 100_000 // self._period)):  # some seconds at most
            before = gain
            gain = np.zeros_like(before)
            for k in range(self._period):
                seen = np.flatnonzero(k % self.every == 0)
                S = C[seen] @ P @ C[seen].T + V[np.ix_(seen, seen)]
                own = np.linalg.solve(S, C[seen] @ P).T
                next_step = np.linalg.solve(S, cross[:, seen].T).T
                gain[:, seen] += own + before_step(A, next_step)
                ahead = A @ own + next_step
                moved = A - ahead @ C[seen]
                shared = ahead @ cross[:, seen].T
                of_sensors = ahead @ V[np.ix_(seen, seen)] @ ahead.T
                P = moved @ P @ moved.T + W + of_sensors - shared - shared.T
            if np.allclose(gain, before, rtol=1e-9, atol=1e-12 * np.abs(gain).max()):
                break
        return gain / (self._period / self.every)

    def _radius(self, gain: Array) -> float:
        """Return by which factor the error of the estimate changes in a period, in the end."""
        error = np.eye(len(self.A))
        for k in range(self._period):
            seen = k % self.every == 0
            error = (np.eye(len(self.A)) - gain[:, seen] @ self.C_aug[seen]) @ self.A @ error
        return lqr.spectral_radius(error)


class DisturbanceObserver(StateEstimator):
    """The estimator of a constant disturbance that makes an MPC offset-free.

    In the theta of a :class:`LinearMPC` with the same model, ``d_hat`` stands for the disturbance
    that nothing measures. Measured tracked outputs then settle without offset (Pannocchia &
    Rawlings, Disturbance models for offset-free model-predictive control, AIChE J. 49, 2003). With
    fewer disturbances than measured outputs, E must describe the disturbance.

    Where the model does not say which of its disturbances are ``estimated``, all of them are. The
    arguments are those of :class:`StateEstimator`.

    Examples
    --------
    >>> from sb3_yann.control import LinearModel
    >>> model = LinearModel([[0.5]], [[1.0]], dt=1, E=[[1.0]])
    >>> observer, x = DisturbanceObserver(model), 0.0
    >>> for _ in range(50):  # the plant with d = 2
    ...     x = 0.5 * x + 2.0
    ...     x_hat, d_hat = observer.update([x], [0.0])
    >>> d_hat.round(6).tolist()
    [2.0]
    """

    def _measured(self, model: LinearModel) -> list[int]:
        measured = [*model.measured] if model.estimated else []
        if len(measured) == model.n_disturbances:
            hint = "pass its matrix E, e.g. E = B for a load at the input."
            raise ValueError(f"The model has no disturbance to estimate: {hint}")
        return measured


def before_step(A: Array, after: Array) -> Array:
    """Return the least x (n, q) with ``A x = after``, balanced: states may differ much in units."""
    balanced, (scale, _) = linalg.matrix_balance(A, permute=False, separate=True)
    found = np.linalg.lstsq(balanced, after / scale[:, None], rcond=None)[0]
    return np.asarray(scale[:, None] * found)


def _covariance(name: str, value: ArrayLike, size: int) -> tuple[Array, list[float]]:
    """Return a covariance (size, size) and standard deviations, given either."""
    if np.ndim(value) < 2:
        deviations = check_positive_vector(name, value, size, "Give standard deviations, above 0.")
        with np.errstate(all="ignore"):
            return np.diag(deviations**2), deviations.tolist()
    given = check_symmetric(name, value, size)
    return given, np.sqrt(np.diag(given)).tolist()


def _require_observable(model: LinearModel, E: Array, C: Array) -> None:
    """Raise unless the augmented model is detectable (Pannocchia & Rawlings 2003, Lemma 1)."""
    n = model.n_states
    d = E.shape[1]
    q = len(C)
    for pole in np.linalg.eigvals(model.A):
        if abs(pole) > 1 - 1e-9 and _rank(np.vstack([pole * np.eye(n) - model.A, C])) < n:
            raise ValueError(
                f"The measurements do not see an unstable mode: eigenvalue {pole:.6g} of A is not "
                "observable through C. Measure another output."
            )
    if d == 0:
        return
    rank = _rank(np.block([[model.A - np.eye(n), E], [C, np.zeros((q, d))]]))
    if rank < n + d:
        raise ValueError(
            f"The {q} measured outputs do not determine the {d} disturbances at steady state: "
            f"[[A - I, E], [C, 0]] has rank {rank}, needed is {n + d}. Have at most as many "
            "disturbances as measured outputs, and none that the outputs cannot tell apart. Where "
            "a sensor measures some of them, name the others: LinearModel(..., estimated=[...])."
        )


def _rank(matrix: Array) -> int:
    """Return the rank of a matrix with columns and rows brought to unit length."""
    for axis in (0, 1):
        length = np.linalg.norm(matrix, axis=axis, keepdims=True)
        matrix = matrix / np.where(length > 0, length, 1.0)
    return int(np.linalg.matrix_rank(matrix, tol=1e-9))
