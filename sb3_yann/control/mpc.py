"""Linear model predictive control and its condensed multi-parametric quadratic program."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann.control import lqr
from sb3_yann.control._validation import (
    Array,
    ReadOnlyArrays,
    as_array,
    as_bounds,
    as_discount,
    as_symmetric,
    same_fields,
)
from sb3_yann.control.explicit import ParametricQP, solve_explicit
from sb3_yann.control.linear_model import LinearModel
from sb3_yann.control.piecewise_affine import OUTSIDE, PiecewiseAffine


@dataclass(frozen=True, eq=False, init=False, repr=False)
class LinearMPC(ReadOnlyArrays):
    r"""The linear MPC problem, in deviations from the model's operating point.

    .. math::
        \min_{u_0 \dots u_{N-1}} \sum_{k=0}^{N-1} \gamma^k (x_k' Q x_k + u_k' R u_k)
            + \gamma^N x_N' P x_N, \quad x_{k+1} = A x_k + B u_k, \quad x_0 = \theta

    subject to ``u_min <= u_k <= u_max``, ``x_min <= x_k <= x_max`` for k = 1 ... N and the
    terminal set. The parameter of the problem and of its law is ``theta``, here the state.

    Parameters
    ----------
    model : LinearModel
        The prediction model, n states and m inputs.
    Q : array_like, shape (n, n)
        Weight of the state, symmetric positive semi-definite.
    R : array_like, shape (m, m)
        Weight of the input, symmetric positive definite.
    horizon : int
        Number N of predicted steps, at least 1.
    x_min, x_max : array_like, shape (n,), or float, optional
        Bounds of the predicted states; ``inf`` and None are no bound.
    u_min, u_max : array_like, shape (m,), or float, optional
        Bounds of the inputs. A policy needs them finite.
    theta_min, theta_max : array_like, shape (n,), or float, optional
        The box of parameters for which the problem is solved; the default is ``x_min``,
        ``x_max``. Given alone, without ``x_min`` and ``x_max``, they bound the parameters only
        and leave the predicted states free.
    terminal_cost : array_like, shape (n, n), optional
        P, symmetric positive semi-definite. The default is the Riccati solution of the same
        discount, with which the law is the LQR wherever no constraint acts. It is stored, so
        `dataclasses.replace` keeps it: replace it by None too, to have it solved anew.
    terminal_set : tuple of array_like, optional
        ``(F, g)`` of shapes (c, n) and (c,) for ``F x_N <= g``.
    gamma : float, default 1
        Discount in (0, 1]. At 1 this is the usual MPC. With the discount of the learner, the
        policy starts as the maximiser of its own critic wherever no constraint acts.
    outside : {"nearest", "zero"}, default "nearest"
        The law where the problem has no solution. See :class:`PiecewiseAffine`.

    Raises
    ------
    TypeError, ValueError
        For arguments of the wrong type, shape, sign or order, and where no Riccati solution
        exists.
    """

    model: LinearModel
    Q: Array
    R: Array
    horizon: int
    x_min: Array
    x_max: Array
    u_min: Array
    u_max: Array
    theta_min: Array
    theta_max: Array
    terminal_cost: Array
    terminal_set: tuple[Array, Array]
    gamma: float
    outside: str

    def __init__(
        self,
        model: LinearModel,
        *,
        Q: ArrayLike,
        R: ArrayLike,
        horizon: int,
        x_min: ArrayLike | None = None,
        x_max: ArrayLike | None = None,
        u_min: ArrayLike | None = None,
        u_max: ArrayLike | None = None,
        theta_min: ArrayLike | None = None,
        theta_max: ArrayLike | None = None,
        terminal_cost: ArrayLike | None = None,
        terminal_set: tuple[ArrayLike, ArrayLike] | None = None,
        gamma: float = 1.0,
        outside: str = "nearest",
    ) -> None:
        if not isinstance(model, LinearModel):
            raise TypeError(f"model = {model!r} must be a LinearModel, e.g. LinearModel(A, B, dt).")
        n, m = model.n_states, model.n_inputs
        if not (isinstance(outside, str) and outside in OUTSIDE):
            raise ValueError(f"outside = {outside!r} must be one of {OUTSIDE}.")
        values: dict[str, object] = {"model": model, "outside": outside}
        values["horizon"] = _as_horizon(horizon)
        values["gamma"] = gamma = as_discount(gamma)
        values["Q"] = state_weight = as_symmetric("Q", Q, n, definite=False)
        values["R"] = input_weight = as_symmetric("R", R, m, definite=True)
        values["x_min"], values["x_max"] = x_low, x_high = as_bounds("x", x_min, x_max, n)
        values["u_min"], values["u_max"] = as_bounds("u", u_min, u_max, m)
        values["theta_min"], values["theta_max"] = as_bounds(
            "theta",
            x_low if theta_min is None else theta_min,
            x_high if theta_max is None else theta_max,
            n,
        )
        values["terminal_cost"] = (
            lqr.riccati(model, state_weight, input_weight, gamma)
            if terminal_cost is None
            else as_symmetric("terminal_cost", terminal_cost, n, definite=False)
        )
        values["terminal_set"] = _as_half_spaces(terminal_set, n)
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def n_theta(self) -> int:
        """Number of parameters of the law."""
        return self.model.n_states

    def stage_cost(self, theta: ArrayLike, u: ArrayLike) -> Array:
        """Return ``x'Qx + u'Ru``; theta is (n,) or (batch, n), u is (m,) or (batch, m)."""
        x, v = np.asarray(theta, dtype=np.float64), np.asarray(u, dtype=np.float64)
        return np.asarray(np.sum((x @ self.Q) * x, axis=-1) + np.sum((v @ self.R) * v, axis=-1))

    def value_matrix(self, gamma: float) -> Array:
        """Return P (n, n): ``x' P x`` is the cost of the law from x on, under the discount gamma.

        Exact wherever the linear plant stays in the region of the law that holds the origin, for
        any ``gamma``, whichever discount the MPC has: P is the cost of the gain that this region
        has, not the smallest cost. Where both discounts agree, the two are the same.

        Raises
        ------
        ValueError
            If the law does not stabilise the model under this discount, or does not rest at the
            origin.
        """
        law = self.explicit()
        origin = np.zeros(self.n_theta)
        width = self.u_max - self.u_min
        rest = 1e-9 * np.where(np.isfinite(width), width, 1.0)
        if not law.in_domain(origin) or np.any(np.abs(law(origin)) > rest):
            raise ValueError(
                "The law does not rest at the origin: theta = 0 must be feasible with u = 0. "
                "Choose an operating point inside the bounds."
            )
        K = -law.gains[law.locate(origin)]
        return lqr.policy_value(self.model, self.Q, self.R, K, as_discount(gamma))

    def state_action_matrix(self, gamma: float) -> Array:
        """Return M (n+m, n+m): ``[x; u]' M [x; u]`` is the cost of u now and the law ever after.

        That is the stage cost and, from the next state on, :meth:`value_matrix`, which raises the
        same errors and holds in the same region.
        """
        P = self.value_matrix(gamma)
        return lqr.state_action_matrix(self.model, self.Q, self.R, P, gamma)

    def explicit(self) -> PiecewiseAffine:
        """Return the explicit law theta -> u_0, solved once, checked, and kept.

        Raises
        ------
        ValueError
            If the problem has no feasible parameter, or its box of parameters is not bounded.
        ExplicitSolutionError
            If the solution fails its check; the message says where.
        """
        return self._law

    @cached_property
    def _law(self) -> PiecewiseAffine:
        return solve_explicit(self.condensed(), self.u_min, self.u_max, self.outside)

    def condensed(self) -> ParametricQP:
        """Return the quadratic program in the stacked inputs ``U = (u_0, ..., u_{N-1})``."""
        A, B = self.model.A, self.model.B
        n, m, N = self.n_theta, self.model.n_inputs, self.horizon
        powers: list[Array] = [np.eye(n)]
        forced: list[Array] = [np.zeros((n, N * m))]
        for k in range(N):
            powers.append(A @ powers[-1])
            reach = A @ forced[-1]
            reach[:, k * m : (k + 1) * m] += B
            forced.append(reach)

        # x_k = powers[k] theta + forced[k] U; the factor 2 is for the form 1/2 U'HU + (F theta)'U
        H = 2 * np.kron(np.diag(self.gamma ** np.arange(N)), self.R)
        F: Array = np.zeros((N * m, n))
        for k in range(1, N + 1):
            weight = self.gamma**k * (self.terminal_cost if k == N else self.Q)
            H = H + 2 * forced[k].T @ weight @ forced[k]
            F = F + 2 * forced[k].T @ weight @ powers[k]

        rows: list[tuple[Array, Array, Array]] = [
            (np.eye(N * m), np.tile(self.u_max, N), np.zeros((N * m, n)))
        ]
        rows += [(-np.eye(N * m), -np.tile(self.u_min, N), np.zeros((N * m, n)))]
        for k in range(1, N + 1):
            rows += [(forced[k], self.x_max, -powers[k]), (-forced[k], -self.x_min, powers[k])]
        last, upper = self.terminal_set
        rows += [(last @ forced[N], upper, -last @ powers[N])]
        G, w, S = (np.concatenate(parts) for parts in zip(*rows, strict=True))
        bounded = np.isfinite(w)
        return ParametricQP(
            H=(H + H.T) / 2,
            F=F,
            c=np.zeros(N * m),
            G=G[bounded],
            w=w[bounded],
            S=S[bounded],
            theta_min=self.theta_min,
            theta_max=self.theta_max,
        )

    def __eq__(self, other: object) -> bool:
        """Tell whether both problems have the same model, weights, bounds and options."""
        if not isinstance(other, LinearMPC):
            return NotImplemented
        return same_fields(self, other, [field.name for field in fields(self)])

    def __hash__(self) -> int:
        """Return a hash that equal problems share."""
        return hash((self.model, self.horizon, self.Q.tobytes(), self.R.tobytes()))

    def __repr__(self) -> str:
        """Name the sizes and what is bounded."""
        return (
            f"LinearMPC(states={self.model.n_states}, inputs={self.model.n_inputs}, "
            f"horizon={self.horizon}, gamma={self.gamma:g}, outside={self.outside!r})"
        )


def _as_horizon(value: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"horizon = {value!r} must be a whole number of steps.")
    if value < 1:
        raise ValueError(f"horizon = {value} must be at least 1.")
    return int(value)


def _as_half_spaces(
    value: tuple[ArrayLike, ArrayLike] | None, n_states: int
) -> tuple[Array, Array]:
    if value is None:
        return np.zeros((0, n_states)), np.zeros(0)
    try:
        F, g = value
    except (TypeError, ValueError):
        raise TypeError(
            "terminal_set must be a pair (F, g) of arrays for F x_N <= g, "
            f"got {type(value).__name__}."
        ) from None
    F = as_array("terminal_set F", F, ("rows", n_states))
    return F, as_array("terminal_set g", g, (F.shape[0],))
