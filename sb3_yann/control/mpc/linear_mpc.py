"""Linear model predictive control: the problem, its parameter, its cost and its explicit law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann._validation import (
    Array,
    ReadOnlyArrays,
    as_bounds,
    as_discount,
    as_symmetric,
    same_fields,
)
from sb3_yann.control import lqr
from sb3_yann.control.explicit.solve import ParametricQP, SolveBudget, solve_explicit
from sb3_yann.control.law.piecewise_affine import INFEASIBLE, PiecewiseAffine
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc import reachability
from sb3_yann.control.mpc import value as quadratic_value
from sb3_yann.control.mpc._arguments import (
    as_box,
    as_half_spaces,
    as_horizon,
    as_linear_cost,
    as_outputs,
    as_rate_weight,
    as_soft_penalty,
    as_softness,
    require_bounded_thing,
)
from sb3_yann.control.mpc._checks import (
    require_room_to_rest,
    require_same_rest,
    softened_box,
    warn_of_drift,
    warn_of_unused_softness,
)
from sb3_yann.control.mpc.condensing import condense
from sb3_yann.control.mpc.error_coordinates import ErrorSystem, error_system
from sb3_yann.control.mpc.report import report
from sb3_yann.control.mpc.steady_state import SteadyStates, steady_states
from sb3_yann.control.mpc.terminal_set import invariant_set
from sb3_yann.control.mpc.theta_layout import ThetaLayout


@dataclass(frozen=True, eq=False, init=False, repr=False)
class LinearMPC(ReadOnlyArrays):
    r"""The linear MPC problem, in deviations from the model's operating point.

    .. math::
        \min_{u_0 \dots u_{N-1}} \sum_{k=0}^{N-1} \gamma^k (e_k' Q e_k + v_k' R v_k
            + \Delta u_k' S \Delta u_k) + \gamma^N z_N' P z_N,
            \quad x_{k+1} = A x_k + B u_k + E d

    with ``e = x - x_s`` and ``v = u - u_s`` the distance from the steady state that the reference r
    and the disturbance d ask for (:meth:`steady_state`), ``delta u_k = u_k - u_{k-1}``, and
    ``z = e``, or ``[e; u_prev - u_s]`` where there is an S. All are subject to
    ``u_min <= u_k <= u_max``, ``du_min <= delta u_k <= du_max`` for k = 0 ... N-1, to
    ``x_min <= x_k <= x_max``, ``y_min <= C_y x_k <= y_max`` for k = 1 ... N, and to the terminal
    set.

    The parameter of the problem and of its law is ``theta = [x, r, d, u_prev]``, of which there are
    those parts that the problem uses (:attr:`parameters`): r with ``tracked``, d where the model
    has an E, ``u_prev`` with a bound or a weight on the rate. r and d are constant over the
    horizon. Without all of these theta is the state, ``x_s = 0`` and ``u_s = 0``: a regulator.

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
        The box of states for which the problem is solved; the default is ``x_min``,
        ``x_max``, and where these are soft, half their distance beyond each. Given alone, without
        ``x_min`` and ``x_max``, they bound the parameters only and leave the predicted states
        free. They are stored with shape (n_theta,): the rest of the box is that of r, d and u,
        from which one given for all of theta must not differ.
    terminal_cost : array_like, shape (n_z, n_z), optional
        P, symmetric positive semi-definite; n_z is n, or n + m with an S. The default is the
        Riccati solution of the same discount, with which the law is the LQR wherever no constraint
        acts. It is stored, so `dataclasses.replace` keeps it: replace it by None too, to have it
        solved anew.
    terminal_set : "invariant" or tuple of array_like, optional
        ``(F, g)`` of shapes (c, n) and (c,) for ``F x_N <= g``, or (c, n_theta) for
        ``F theta_N <= g`` (its u_prev is ``u_{N-1}``). "invariant" is the set in which the
        gain of the terminal cost keeps all hard constraints for ever: the law then never leaves
        its domain on the model, where x_min and x_max bound that. See
        :func:`~sb3_yann.control.mpc.terminal_set.invariant_set`. Stored as (F, g), as the
        terminal cost is: replace it by "invariant" again where anything else changes.
    gamma : float, default 1
        Discount in (0, 1]. At 1 this is the usual MPC. With the discount of the learner, the
        policy starts as the maximizer of its own critic wherever no constraint acts.
    infeasible : {"nearest_region", "zero_input"}, default "nearest_region"
        The law where the problem has no solution. See :class:`PiecewiseAffine`.
    tracked : array_like, shape (p, n), or list of int, optional
        C of the tracked outputs ``C x``, or indices of tracked states.
    r_min, r_max : array_like, shape (p,), or float, optional
        The box of references, in deviations as the states are.
    d_min, d_max : array_like, shape (d,), or float, optional
        The box of disturbances.
    du_min, du_max : array_like, shape (m,), or float, optional
        Bounds of the change of the inputs from one sample to the next: 0 lies between them.
    S : array_like, shape (m, m), optional
        Weight of that change, symmetric positive semi-definite.
    outputs : array_like, shape (q, n), or list of int, optional
        C_y of the bounded outputs, or indices of states.
    y_min, y_max : array_like, shape (q,), or float, optional
        Their bounds.
    x_soft, y_soft : array_like, shapes (n,) and (q,), or float, optional
        The violation of each bound that counts as one unit; 0, the default, keeps the bound hard;
        a single number is for all that have a bound. Soft bounds of the states share one slack
        over the horizon, those of the outputs another. The law ends at theta_min and theta_max,
        which are to reach beyond soft bounds, as they do by default.
    soft_penalty : float, optional
        The largest violation s, in units, costs ``soft_penalty (s + s^2)``: an exact penalty, with
        the square that keeps the program strictly convex. It is no part of :meth:`stage_cost`.
    linear_cost : tuple of array_like, optional
        ``(q, r)`` of shapes (n,) and (m,): ``q'e_k + r'v_k`` is added to the stage cost, with what
        goes with it to the terminal cost. The law then rests elsewhere than at the steady state,
        and there is no :meth:`value_matrix`, hence no policy: for one, take the state and input
        where the law rests as the operating point, and leave the linear cost out. Without a
        discount this is the same law wherever no constraint acts at rest.

    Raises
    ------
    TypeError, ValueError
        For arguments of the wrong type, shape, sign or order, where no Riccati solution
        exists, and where a reference or a disturbance has no steady state.
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
    infeasible: str
    tracked: Array
    r_min: Array
    r_max: Array
    d_min: Array
    d_max: Array
    du_min: Array
    du_max: Array
    S: Array
    outputs: Array
    y_min: Array
    y_max: Array
    x_soft: Array
    y_soft: Array
    soft_penalty: float
    linear_cost: tuple[Array, Array]

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
        terminal_set: tuple[ArrayLike, ArrayLike] | str | None = None,
        gamma: float = 1.0,
        infeasible: str = "nearest_region",
        tracked: ArrayLike | Sequence[int] | None = None,
        r_min: ArrayLike | None = None,
        r_max: ArrayLike | None = None,
        d_min: ArrayLike | None = None,
        d_max: ArrayLike | None = None,
        du_min: ArrayLike | None = None,
        du_max: ArrayLike | None = None,
        S: ArrayLike | None = None,
        outputs: ArrayLike | Sequence[int] | None = None,
        y_min: ArrayLike | None = None,
        y_max: ArrayLike | None = None,
        x_soft: ArrayLike | None = None,
        y_soft: ArrayLike | None = None,
        soft_penalty: float | None = None,
        linear_cost: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> None:
        if not isinstance(model, LinearModel):
            raise TypeError(f"model = {model!r} must be a LinearModel, e.g. LinearModel(A, B, dt).")
        n, m = model.n_states, model.n_inputs
        if not (isinstance(infeasible, str) and infeasible in INFEASIBLE):
            raise ValueError(f"infeasible = {infeasible!r} must be one of {INFEASIBLE}.")
        self._set(model=model, infeasible=infeasible, horizon=as_horizon(horizon))
        self._set(gamma=as_discount(gamma), Q=as_symmetric("Q", Q, n))
        self._set(R=as_symmetric("R", R, m, definite=True), S=as_rate_weight(S, m))
        self._set(tracked=as_outputs("tracked", tracked, n))
        self._set(outputs=as_outputs("outputs", outputs, n))
        self._set(linear_cost=as_linear_cost(linear_cost, n, m))
        for name, low, high, size in (
            ("x", x_min, x_max, n),
            ("u", u_min, u_max, m),
            ("r", r_min, r_max, len(self.tracked)),
            ("d", d_min, d_max, model.n_disturbances),
            ("du", du_min, du_max, m),
            ("y", y_min, y_max, len(self.outputs)),
        ):
            require_bounded_thing(name, low, high, size)
            lower, upper = as_bounds(name, low, high, size)
            self._set(**{f"{name}_min": lower, f"{name}_max": upper})
        self._set(x_soft=as_softness("x_soft", x_soft, self.x_min, self.x_max))
        self._set(y_soft=as_softness("y_soft", y_soft, self.y_min, self.y_max))
        self._set(soft_penalty=as_soft_penalty(soft_penalty, self.x_soft, self.y_soft))
        inputs, free = (self.u_min, self.u_max), self.layout.has_constants
        require_room_to_rest(*inputs, self.du_min, self.du_max, free)
        self._set_box(theta_min, theta_max)
        box = self.theta_min[:n], self.theta_max[:n]
        warn_of_unused_softness(self.x_soft, (self.x_min, self.x_max), box)
        self._set_terminal(terminal_cost, terminal_set)
        warn_of_drift(model, *box)

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _set_box(self, theta_min: ArrayLike | None, theta_max: ArrayLike | None) -> None:
        """Store the box of theta: that of the states, then of r, d and the previous input."""
        size = self.n_theta
        default = softened_box(self.x_min, self.x_max, self.x_soft)
        parts = [as_box("theta", (theta_min, theta_max), default, size)]
        parts += [(self.r_min, self.r_max), (self.d_min, self.d_max)]
        parts += [(self.u_min, self.u_max)] if self.layout.n_previous else []
        low, high = (np.concatenate(bounds) for bounds in zip(*parts, strict=True))
        low, high = as_bounds("theta", low, high, size)
        for name, given, stored in (("theta_min", theta_min, low), ("theta_max", theta_max, high)):
            require_same_rest(name, given, stored, self.layout.names, self.model.n_states)
        self._set(theta_min=low, theta_max=high)

    def _set_terminal(
        self,
        cost: ArrayLike | None,
        half_spaces: tuple[ArrayLike, ArrayLike] | str | None,
    ) -> None:
        errors = self.error_system
        self._set(
            terminal_cost=lqr.riccati(errors.model, errors.Q, errors.R, self.gamma, errors.cross)
            if cost is None
            else as_symmetric("terminal_cost", cost, len(errors.Q))
        )
        if isinstance(half_spaces, str) and half_spaces == "invariant":
            self._set(terminal_set=None)  # what follows must not look at it
            half_spaces = invariant_set(self)
        n = self.model.n_states
        self._set(terminal_set=as_half_spaces(half_spaces, n, self.n_theta))  # type: ignore[arg-type]

    @property
    def has_rate_bounds(self) -> bool:
        """Whether the change of an input is bounded."""
        return bool(np.any(np.isfinite([self.du_min, self.du_max])))

    @cached_property
    def layout(self) -> ThetaLayout:
        """What theta holds, and where."""
        rated = np.any(self.S) or self.has_rate_bounds
        return ThetaLayout(
            n_states=self.model.n_states,
            n_references=len(self.tracked),
            n_disturbances=self.model.n_disturbances,
            n_previous=self.model.n_inputs if rated else 0,
        )

    @property
    def n_theta(self) -> int:
        """Number of parameters of the law."""
        return self.layout.size

    @cached_property
    def prediction(self) -> tuple[Array, Array]:
        """A_bar (n_theta, n_theta) and B_bar (n_theta, m): ``theta+ = A_bar theta + B_bar u``."""
        parts, model = self.layout, self.model
        A, B = np.eye(parts.size), np.zeros((parts.size, model.n_inputs))
        A[parts.state, parts.state], A[parts.state, parts.disturbance] = model.A, model.E
        A[parts.previous, parts.previous] = 0.0
        B[parts.state] = model.B
        B[parts.previous] = np.eye(model.n_inputs)[: parts.n_previous]
        return A, B

    def predict(self, theta: ArrayLike, u: ArrayLike) -> Array:
        """Return the next theta on the model; theta is (n_theta,) or (batch, n_theta)."""
        A, B = self.prediction
        return np.asarray(theta) @ A.T + np.asarray(u) @ B.T

    @cached_property
    def steady_states(self) -> SteadyStates:
        """The map from r and d to the steady state, within bounds or not."""
        x_unit = np.maximum(np.abs(self.theta_min), np.abs(self.theta_max))[self.layout.state]
        u_unit = (self.u_max - self.u_min) / 2
        x_unit, u_unit = (np.where(np.isfinite(unit), unit, 1.0) for unit in (x_unit, u_unit))
        return steady_states(self.model, self.tracked, self.Q, self.R, x_unit, u_unit)

    @cached_property
    def error_system(self) -> ErrorSystem:
        """The coordinates about the steady state in which the cost is quadratic."""
        return error_system(self.model, self.layout, self.steady_states, self.Q, self.R, self.S)

    def is_reachable(
        self, r: ArrayLike | None = None, d: ArrayLike | None = None
    ) -> NDArray[np.bool_]:
        """Tell whether the steady state for r (p,) and d (d,) lies within the bounds of x, u and y.

        Of both a batch of rows may be given; None is zero. Soft bounds count too.
        """
        return np.asarray(np.all(reachability.margins(self, r, d) >= 0, axis=-1))

    def steady_state(
        self, r: ArrayLike | None = None, d: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Return x_s (n,) and u_s (m,) for the reference r (p,) and disturbance d (d,).

        Where several steady states have ``C x_s = r``, the one with the smallest
        ``x_s'Q x_s + u_s'R u_s``.

        Raises
        ------
        ValueError
            If it lies beyond a bound of x, u or y.
        """
        return reachability.steady_state(self, r, d)

    @property
    def stage_matrix(self) -> Array:
        """W (n_theta + m, n_theta + m): the stage cost is ``[theta; u]' W [theta; u]``."""
        return self.error_system.stage_matrix

    def stage_cost(self, theta: ArrayLike, u: ArrayLike) -> Array:
        """Return the stage cost, ``x'Qx + u'Ru`` for a regulator, without penalties.

        theta is (n_theta,) or (batch, n_theta), u is (m,) or (batch, m).
        """
        at, v, errors = np.asarray(theta, np.float64), np.asarray(u, np.float64), self.error_system
        z, v = at @ errors.T.T, v - at @ errors.U.T
        cost = np.sum((z @ errors.Q) * z, axis=-1) + np.sum((v @ errors.R) * v, axis=-1)
        q, r = self.linear_cost
        if np.any(q) or np.any(r):
            cost = cost + z[..., : len(q)] @ q + v @ r
        if errors.cross is not None:
            cost = cost + 2 * np.sum((z @ errors.cross) * v, axis=-1)
        return np.asarray(cost)

    def value_matrix(self, gamma: float) -> Array:
        """Return P (n_theta, n_theta): ``theta' P theta`` is the cost of the law from theta on.

        Under the discount gamma, and exact wherever the linear plant stays in the region of the
        law that holds the origin, for any ``gamma``, whichever discount the MPC has: P is the cost
        of the gain that this region has, not the smallest cost. Where both discounts agree, the two
        are the same. r and d are taken to stay as they are.

        Raises
        ------
        ValueError
            If the law does not stabilize the model under this discount, or does not rest at the
            origin.
        """
        return quadratic_value.value_matrix(self, gamma)

    def state_action_matrix(self, gamma: float) -> Array:
        """Return M: ``[theta; u]' M [theta; u]`` is the cost of u now and the law ever after.

        Its shape is (n_theta + m, n_theta + m). That is the stage cost and, from the next theta
        on, :meth:`value_matrix`, which raises the same errors and holds in the same region.
        """
        return quadratic_value.state_action_matrix(self, gamma)

    def explicit(
        self,
        solver: str = "walk",
        *,
        time_limit: float | None = None,
        region_limit: int | None = None,
        progress: bool = False,
    ) -> PiecewiseAffine:
        """Return the explicit law theta -> u_0, solved once, checked, and kept.

        Parameters
        ----------
        solver : {"walk", "ppopt"}, default "walk"
            What finds the regions: a walk over them from facet to facet, or, as a reference and
            many times slower, ppopt. Where ppopt's regions pass the check, both give the same law.
        time_limit : float, optional
            Seconds after which to give up the search. A law that was kept takes none.
        region_limit : int, optional
            The most regions that the law may have. The walk gives up beyond; ppopt tells their
            number only at its end.
        progress : bool, default False
            Show how many regions were found so far.

        Raises
        ------
        ValueError
            If the problem has no feasible parameter, or its box of parameters is not bounded.
        ExplicitLimitError
            If a limit is reached; the message says how far the search came and what to change.
        ExplicitSolutionError
            If the solution fails its check; the message says where.
        """
        limits = SolveBudget(time_limit, region_limit, progress)
        if solver not in self._laws:
            self._laws[solver] = solve_explicit(
                self.condensed(), self.u_min, self.u_max, self.infeasible, solver, limits
            )
        limits.require(self._laws[solver].n_regions)
        return self._laws[solver]

    @cached_property
    def _laws(self) -> dict[str, PiecewiseAffine]:
        """The laws solved so far, by solver."""
        return {}

    def condensed(self) -> ParametricQP:
        """Return the quadratic program in the stacked inputs, and slacks if there are any.

        The variables are ``U = (u_0, ..., u_{N-1})`` and, after them, those of the soft bounds.
        """
        return condense(self)[0]

    def report(self, samples: int = 500, seed: int = 0) -> str:
        """Return what the problem and its law are, in words and sampled shares of the box.

        See :func:`sb3_yann.control.mpc.report.report`.
        """
        return report(self, samples, seed)

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
            f"horizon={self.horizon}, gamma={self.gamma:g}, infeasible={self.infeasible!r})"
        )
