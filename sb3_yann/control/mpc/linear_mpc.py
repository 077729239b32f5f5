"""Linear model predictive control: the problem, its cost and its explicit law."""

from __future__ import annotations

from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann._validation import Array, as_array, as_bounds, as_discount, as_symmetric
from sb3_yann.control import lqr
from sb3_yann.control.explicit.budget import SolveBudget
from sb3_yann.control.explicit.parametric_qp import ParametricQP
from sb3_yann.control.explicit.solve import solve_explicit
from sb3_yann.control.law.piecewise_affine import INFEASIBLE, PiecewiseAffine
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc import reachability
from sb3_yann.control.mpc import value as quadratic_value
from sb3_yann.control.mpc._arguments import (
    as_horizon,
    softened_box,
    theta_box,
    warn_of_drift,
    warn_of_no_rest,
    warn_of_unused_softness,
)
from sb3_yann.control.mpc.condensing import condense
from sb3_yann.control.mpc.groups import (
    DisturbanceBounds,
    OutputBounds,
    RateLimits,
    SoftBounds,
    Terminal,
    Tracking,
)
from sb3_yann.control.mpc.problem import MPCProblem, layout_of
from sb3_yann.control.mpc.report import report
from sb3_yann.control.mpc.terminal_set import invariant_set

G = TypeVar("G")


class LinearMPC(MPCProblem):
    r"""The linear MPC problem, in deviations from the model's operating point.

    .. math::
        \min_{u_0 \dots u_{N-1}} \sum_{k=0}^{N-1} \gamma^k (e_k' Q e_k + v_k' R v_k
            + \Delta u_k' R_{du} \Delta u_k) + \gamma^N z_N' P z_N,
            \quad x_{k+1} = A x_k + B u_k + E d

    Here ``e = x - x_s`` and ``v = u - u_s`` are the distances from the steady state for the
    reference r and the disturbance d (:meth:`steady_state`), ``delta u_k = u_k - u_{k-1}``, and
    ``z = e``, or ``[e; u_prev - u_s]`` with a weight R_du. All are subject to
    ``u_min <= u_k <= u_max``, ``du_min <= delta u_k <= du_max`` for k = 0 ... N-1, to
    ``x_min <= x_k <= x_max``, ``y_min <= C_y x_k <= y_max`` for k = 1 ... N, and to the terminal
    set.

    The parameter of the problem and of its law is ``theta = [x, r, d, u_prev]``, with those parts
    that the problem uses (:attr:`layout`): r with ``tracking``, d where the model has an E,
    ``u_prev`` with a bound or a weight on the rate. r and d are constant over the horizon. Without
    all of these theta is the state, ``x_s = 0`` and ``u_s = 0``: a regulator.

    All arguments are stored, as arrays of full shape. `dataclasses.replace` changes some of them.
    It keeps the stored ``terminal``: pass None to have that solved anew.

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
        The box of states for which the problem is solved; the default is ``x_min``, ``x_max``, and
        where these are soft, half their distance beyond each. Given alone they bound the parameters
        only and leave the predicted states free. They are stored with shape (n_theta,): the rest is
        the box of r, d and u.
    gamma : float, default 1
        Discount in (0, 1]. At 1 this is the usual MPC. With the discount of the learner, the
        policy starts as the maximizer of its own critic wherever no constraint acts.
    infeasible : {"nearest_region", "zero_input"}, default "nearest_region"
        The law where the problem has no solution. See :class:`PiecewiseAffine`.
    tracking : Tracking, optional
        The outputs that follow a reference.
    disturbances : DisturbanceBounds, optional
        The box of the model's disturbances.
    rate : RateLimits, optional
        Bounds and weight of the change of the inputs.
    outputs : OutputBounds, optional
        Bounds of predicted outputs.
    soft : SoftBounds, optional
        Which bounds may be broken. The penalty is no part of :meth:`stage_cost`.
    terminal : Terminal, optional
        The terminal cost, by default the Riccati solution, and the terminal set.

    Raises
    ------
    TypeError, ValueError
        For arguments of the wrong type, shape, sign or order, where no Riccati solution
        exists, and where a reference or a disturbance has no steady state.

    Examples
    --------
    >>> cart = LinearModel([[1, 1], [0, 1]], [[0], [1]], dt=1.0)
    >>> mpc = LinearMPC(cart, Q=np.eye(2), R=[[1]], horizon=2, x_min=-5, x_max=5, u_min=-1, u_max=1)
    >>> mpc.explicit()([-5.0, 0.0])
    array([1.])
    """

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
        gamma: float = 1.0,
        infeasible: str = "nearest_region",
        tracking: Tracking | None = None,
        disturbances: DisturbanceBounds | None = None,
        rate: RateLimits | None = None,
        outputs: OutputBounds | None = None,
        soft: SoftBounds | None = None,
        terminal: Terminal | None = None,
    ) -> None:
        if not isinstance(model, LinearModel):
            raise TypeError(f"model = {model!r} must be a LinearModel, e.g. LinearModel(A, B, dt).")
        n, m = model.n_states, model.n_inputs
        if not (isinstance(infeasible, str) and infeasible in INFEASIBLE):
            raise ValueError(f"infeasible = {infeasible!r} must be one of {INFEASIBLE}.")
        values: dict[str, Any] = {"model": model, "infeasible": infeasible}
        values |= {"horizon": as_horizon(horizon), "gamma": as_discount(gamma)}
        values |= {"Q": as_symmetric("Q", Q, n), "R": as_symmetric("R", R, m, definite=True)}
        following = _as_group("tracking", tracking, Tracking).sized(n)
        change = _as_group("rate", rate, RateLimits).sized(m)
        loads = _as_group("disturbances", disturbances, DisturbanceBounds)
        loads = loads.sized(model.n_disturbances)
        seen = _as_group("outputs", outputs, OutputBounds).sized(n)
        x, u = as_bounds("x", x_min, x_max, n), as_bounds("u", u_min, u_max, m)
        relaxed = _as_group("soft", soft, SoftBounds).sized(x, (seen.y_min, seen.y_max))
        values |= {"tracking": following, "rate": change, "disturbances": loads}
        values |= {"outputs": seen, "soft": relaxed}

        layout = layout_of(model, following, change)
        if not layout.has_constants:  # otherwise there are other places to rest
            warn_of_no_rest(*u)
        rest = [(following.r_min, following.r_max), (loads.d_min, loads.d_max)]
        rest += [u] if layout.n_previous else []
        low, high = theta_box(layout, (theta_min, theta_max), softened_box(x, relaxed.x), rest)
        warn_of_unused_softness(relaxed.x, x, (low[:n], high[:n]))
        warn_of_drift(model, low[:n], high[:n])
        for name, pair in {"x": x, "u": u, "theta": (low, high)}.items():
            values[f"{name}_min"], values[f"{name}_max"] = pair
        draft = MPCProblem(**values, terminal=Terminal())
        given = _as_group("terminal", terminal, Terminal)
        super().__init__(**values, terminal=_completed(given, draft))

    def predict(self, theta: ArrayLike, u: ArrayLike) -> Array:
        """Return the next theta on the model; theta is (n_theta,) or (batch, n_theta)."""
        A, B = self.prediction
        return np.asarray(theta) @ A.T + np.asarray(u) @ B.T

    def is_reachable(
        self, r: ArrayLike | None = None, d: ArrayLike | None = None
    ) -> NDArray[np.bool_]:
        """Tell whether the steady state for r (p,) and d (d,) lies within the bounds of x, u and y.

        Of both a batch of rows may be given; None is zero. Soft bounds count too.
        """
        return reachability.is_reachable(self, r, d)

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

    def stage_cost(self, theta: ArrayLike, u: ArrayLike) -> Array:
        """Return the stage cost, ``x'Qx + u'Ru`` for a regulator, without penalties.

        theta is (n_theta,) or (batch, n_theta), u is (m,) or (batch, m).
        """
        at, v, errors = np.asarray(theta, np.float64), np.asarray(u, np.float64), self.error_system
        z, v = at @ errors.to_error.T, v - at @ errors.to_input.T
        cost = np.sum((z @ errors.Q) * z, axis=-1) + np.sum((v @ errors.R) * v, axis=-1)
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
        return quadratic_value.value_matrix(self, self.explicit(), gamma)

    def state_action_matrix(self, gamma: float) -> Array:
        """Return M: ``[theta; u]' M [theta; u]`` is the cost of u now and the law ever after.

        Its shape is (n_theta + m, n_theta + m). That is the stage cost and, from the next theta
        on, :meth:`value_matrix`, which raises the same errors and holds in the same region.
        """
        return quadratic_value.state_action_matrix(self, self.explicit(), gamma)

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
        budget = SolveBudget(time_limit, region_limit, progress)
        if solver not in self._laws:
            self._laws[solver] = solve_explicit(
                self.condensed(), self.u_min, self.u_max, self.infeasible, solver, budget
            )
        budget.require(self._laws[solver].n_regions)
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
        return report(self, self.explicit(), samples, seed)


def _as_group(name: str, value: G | None, kind: type[G]) -> G:
    """Return a group of arguments; None is one that says nothing."""
    if value is not None and not isinstance(value, kind):
        raise TypeError(
            f"{name} = {value!r} must be a {kind.__name__}, e.g. {name}={kind.__name__}(...)."
        )
    return kind() if value is None else value


def _completed(terminal: Terminal, problem: MPCProblem) -> Terminal:
    """Return the terminal cost and set of a problem, solved where they are left to it."""
    errors, given = problem.error_system, vars(terminal)
    cost, half_spaces = given["cost"], given["set"]
    if cost is None:
        cost = lqr.riccati(errors.model, errors.Q, errors.R, problem.gamma, errors.cross)
    else:
        cost = as_symmetric("Terminal.cost", cost, len(errors.Q))
    n, size = problem.model.n_states, problem.n_theta
    if isinstance(half_spaces, str):
        half_spaces = invariant_set(problem, cost)
    F, g = half_spaces or (np.zeros((0, size)), np.zeros(0))
    if F.shape[1] != size:
        F = np.pad(as_array("Terminal.set F", F, ("rows", n)), ((0, 0), (0, size - n)))
    return Terminal(cost, (F, g))
