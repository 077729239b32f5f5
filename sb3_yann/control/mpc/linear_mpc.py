"""Linear model predictive control: the problem, its cost and its explicit law."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann import _validation as check
from sb3_yann._validation import (
    Array,
    Bounds,
    Given,
    check_array,
    check_bounds,
    check_symmetric,
    finite_sizes,
    to_float,
    warn,
)
from sb3_yann.control.explicit.budget import BudgetTimer, ExplicitLimitError
from sb3_yann.control.explicit.certificate import ExplicitSolutionError
from sb3_yann.control.explicit.parametric_qp import ParametricQP
from sb3_yann.control.explicit.solve import load_kernels, require_sane_sizes, solve_explicit
from sb3_yann.control.law import INFEASIBLE_OPTIONS, PiecewiseAffine
from sb3_yann.control.linear_system import labels_of
from sb3_yann.control.model.identify import Identified
from sb3_yann.control.model.identify_outputs import IdentifiedOutputs
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc.condensing import condense
from sb3_yann.control.mpc.coordinates import theta_box
from sb3_yann.control.mpc.groups import (
    DisturbanceBounds,
    LinearCost,
    MixedBounds,
    OutputBounds,
    RateLimits,
    SoftBounds,
    Terminal,
    Tracking,
    bound_entry,
    parametric_box,
    parametric_names,
)
from sb3_yann.control.mpc.invariant_sets import KeptSet, completed, hard_rows, kept_set
from sb3_yann.control.mpc.problem import MPCProblem, Value, value
from sb3_yann.control.mpc.report import report
from sb3_yann.control.online import LAWS, Law, OnlineLaw, OnlineLawWarning, steepness
from sb3_yann.control.simulator import borrow, largest_bound

if TYPE_CHECKING:
    from sb3_yann.control.simulator import Maker

G = TypeVar("G")
EFFORT = 1.0
"""What "auto" spends on an explicit law, in what about a second does, by what it counts."""
REGIONS = 5000
"""The most regions of a law that "auto" takes."""
LARGE = 50_000
"""Constraints times parameters beyond which a single region takes long, and none is looked for."""
ONLINE_CHOSEN = "_online_chosen"
"""Notes in a problem that its online law was chosen, and travels with it."""


@dataclass(frozen=True, eq=False, init=False, repr=False)
class LinearMPC(MPCProblem):
    r"""The linear MPC problem, in plant units where the model has an operating point.

    .. math::
        \min_{u_0 \ldots u_{N-1}} \sum_{k=0}^{N-1} \gamma^k (e_k' Q e_k + v_k' R v_k
            + \Delta u_k' R_{du} \Delta u_k + p' x_k + q' u_k) + \gamma^N z_N' P z_N,
            \quad x_{k+1} = A x_k + B u_k + E d_k

    ``e = x - x_s`` and ``v = u - u_s`` are distances from the steady state of the reference r and
    the disturbance d, ``z = e``, or ``[e; u_prev - u_s]`` with a weight R_du. Bounds hold for u_k
    and ``delta u_k = u_k - u_{k-1}``, k = 0 ... N-1, and for x_k and the outputs, k = 1 ... N.

    The parameter of the law is ``theta = [x, r, d, bounds, u_prev]``, with the parts that the
    problem uses (:attr:`layout`): r with ``tracking``, d where the model has an E, bounds that
    change at run time, ``u_prev`` with a bound or a weight on the rate. r and d are constant over
    the horizon, but for a preview; e and v count from the steady state of each sample.

    The formula is one of deviations from the model's operating point. Bounds, theta and inputs are
    what the plant shows and takes, at every method; of a model without an operating point they are
    the same. Laws and networks alone take deviations: :attr:`deviations` is the problem they solve,
    and :meth:`PiecewiseAffine.plant_input` the law in plant units.

    `dataclasses.replace` changes some arguments. It keeps the stored ``terminal``: replace that by
    None too, to have it solved anew.

    Parameters
    ----------
    model : LinearModel, Identified or IdentifiedOutputs
        The prediction model, n states and m inputs; or what `identify` returns.
    Q : array_like, shape (n, n)
        Weight of the state, symmetric positive semi-definite.
    R : array_like, shape (m, m)
        Weight of the input, symmetric positive semi-definite. An input without one needs a weight
        of its rate, or must move a state that has a terminal cost.
    horizon : int
        Number N of predicted steps, at least 1.
    x_min, x_max : array_like, shape (n,), or float, optional
        Bounds of the predicted states; ``inf`` and None are no bound.
    u_min, u_max : array_like, shape (m,), or float, optional
        Bounds of the inputs. A policy needs them finite.
    theta_min, theta_max : array_like, shape (n,), or float, optional
        The box of states for which the problem is solved, by default ``x_min``, ``x_max``, and half
        their distance beyond where they are soft. Stored with those of r, d and u_prev: (n_theta,).
    gamma : float, default 1
        Discount in (0, 1]; the learner's makes the policy start as its critic's maximizer.
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
    mixed : MixedBounds, optional
        Bounds of combinations of states and inputs.
    price : LinearCost, optional
        Linear terms p and q of the stage cost.
    parametric_bounds : list of str, optional
        Bounds that change at run time, such as ["u_max"] or ["u_max[0]", "mixed_min"]: they join
        theta. The problem's own are the widest, and each may move in to the other side. One of an
        input is reached as fast as `RateLimits` allow.
    control_horizon : int or sequence of int, optional
        The number of samples in which the inputs move, before they stay; or for how many samples
        each move is held, which sum up to the horizon. The default is each sample.

    Raises
    ------
    TypeError, ValueError
        For a wrong type, shape, sign or order, where no Riccati solution exists, and where a
        reference or a disturbance has no steady state.

    Examples
    --------
    >>> cart = LinearModel([[1, 1], [0, 1]], [[0], [1]], dt=1.0)
    >>> mpc = LinearMPC(cart, Q=np.eye(2), R=[[1]], horizon=2, x_min=-5, x_max=5, u_min=-1, u_max=1)
    >>> mpc.explicit()([-5.0, 0.0])
    array([1.])
    """

    def __init__(  # noqa: PLR0913 (the user's arguments)
        self,
        model: LinearModel | Identified | IdentifiedOutputs,
        *,
        Q: ArrayLike,
        R: ArrayLike,
        horizon: int,
        x_min: Given = None,
        x_max: Given = None,
        u_min: Given = None,
        u_max: Given = None,
        theta_min: Given = None,
        theta_max: Given = None,
        gamma: float = 1.0,
        infeasible: str = "nearest_region",
        tracking: Tracking | None = None,
        disturbances: DisturbanceBounds | None = None,
        rate: RateLimits | None = None,
        outputs: OutputBounds | None = None,
        soft: SoftBounds | None = None,
        terminal: Terminal | None = None,
        mixed: MixedBounds | None = None,
        price: LinearCost | None = None,
        parametric_bounds: Sequence[str] = (),
        control_horizon: int | Sequence[int] | None = None,
    ) -> None:
        if isinstance(model, Identified | IdentifiedOutputs):
            model = model.model
        if not isinstance(model, LinearModel):
            raise TypeError(f"model = {model!r} must be a LinearModel, e.g. LinearModel(A, B, dt).")
        n = model.n_states
        m = model.n_inputs
        check.check_type("horizon", horizon, (int, np.integer), "a whole number of steps")
        horizon = check.check_int("horizon", horizon)
        gamma = check.check_discount(gamma)
        infeasible = check.check_choice("infeasible", infeasible, INFEASIBLE_OPTIONS)
        Q = check_symmetric("Q", Q, n)
        R = check_symmetric("R", R, m)
        x = check_bounds("x", x_min, x_max, n)
        u = check_bounds("u", u_min, u_max, m)
        tracking = _as_group("tracking", tracking, Tracking).sized(n, model.state_names)
        d = _as_group("disturbances", disturbances, DisturbanceBounds).sized(model.n_disturbances)
        rate = _as_group("rate", rate, RateLimits).sized(m)
        outputs = _as_group("outputs", outputs, OutputBounds).sized(n, model.state_names)
        mixed = _as_group("mixed", mixed, MixedBounds).sized(n, m)
        y = (outputs.y_min, outputs.y_max)
        soft = _as_group("soft", soft, SoftBounds).sized(x, y, mixed.soft)
        price = _as_group("price", price, LinearCost).sized(n, m)
        terminal = _as_group("terminal", terminal, Terminal)
        moves = _as_control_horizon(control_horizon, horizon)
        _require_preview_within(model, horizon, tracking.preview, d.preview)
        problem = MPCProblem(
            model, Q, R, horizon, *x, *u, *x, gamma, infeasible,
            tracking, d, rate, outputs, soft, terminal, mixed, price, control_horizon=moves,
        )  # fmt: skip
        names = parametric_names(parametric_bounds, problem.limits)
        problem = replace(problem, parametric_bounds=names)
        layout = problem.layout
        rest = [(tracking.r_min, tracking.r_max), (d.d_min, d.d_max)]
        rest += [parametric_box(names, problem.limits)]
        rest += [u] if layout.n_previous else []
        width = x[1] - x[0]
        # Theta's box reaches half a width beyond soft bounds.
        beyond = np.where((soft.x > 0) & np.isfinite(width), 0.5 * width, 0.0)
        box = x[0] - beyond, x[1] + beyond
        low, high = theta_box(layout, (theta_min, theta_max), box, rest)
        problem = replace(problem, theta_min=low, theta_max=high)
        states = low[:n], high[:n]
        _warn_of_misread_bounds(problem)
        _warn_of_unused_softness(soft.x, x, states)
        _warn_of_unreachable(tracking, x, states)
        _warn_of_drift(model, *states)
        problem = replace(problem, terminal=completed(problem))
        if soft.penalty is None:
            _choose_penalty(problem.deviations)
        super().__init__(**{each.name: getattr(problem, each.name) for each in fields(problem)})
        if not np.any(model.B):
            raise ValueError(
                "B of the model is zero: no input does anything, so there is nothing to control. "
                "Look for the inputs' effect in the model's units and sampling time."
            )

    @classmethod
    def from_env(
        cls, env: Maker, *, Q: ArrayLike, R: ArrayLike, horizon: int, **options: Any
    ) -> LinearMPC:
        """Return the MPC of a simulator: its model by differences, its bounds from its spaces.

        The inputs keep the bounds of the action space. The box of states for which the problem is
        solved is the observation space, where that shows the state and has bounds. Those of a
        :class:`PlantEnv`, and its bounds of the states, are those of its own MPC.

        Parameters
        ----------
        env : gymnasium.Env, str or callable
            The simulator, its id or a function that makes it, as `LinearModel.from_env` takes it.
        Q, R, horizon : array_like, shapes (n, n) and (m, m), and int
            As of `LinearMPC`.
        **options
            ``x_ss``, ``u_ss``, ``dt``, ``set_state``, ``get_state`` and ``scale`` are those of
            `LinearModel.from_env`, ``state_names``, ``input_names``, ``units`` and ``time_unit``
            those of `LinearModel.named`; all others those of `LinearMPC`, as the plant shows them.

        Examples
        --------
        >>> mpc = LinearMPC.from_env("ClippedPendulum-v0", Q=np.eye(2), R=[[1]], horizon=2)
        >>> mpc.u_max.tolist(), mpc.theta_max.round(2).tolist()
        ([2.0], [3.14, 8.0])
        """
        names = ("x_ss", "u_ss", "dt", "set_state", "get_state", "scale")
        of_model = {name: options.pop(name) for name in names if name in options}
        labels = ("state_names", "input_names", "units", "time_unit")
        of_names = {name: options.pop(name) for name in labels if name in options}
        model = LinearModel.from_env(env, **of_model)
        model = model.named(**of_names) if of_names else model
        with borrow(env) as borrowed:
            shown = borrowed.env.observation_space
            action = borrowed.env.action_space
            own = getattr(borrowed.env, "mpc", None)
        limits = {"u_min": action.low, "u_max": action.high}
        if shown.shape == (model.n_states,):
            low = np.asarray(shown.low, np.float64)
            high = np.asarray(shown.high, np.float64)
            bounded = np.abs([low, high]) < largest_bound(model.x_ss)
            for side, end, within in (("min", low, bounded[0]), ("max", high, bounded[1])):
                given: Any = options.get(f"x_{side}")
                fits = given is not None and np.shape(given) in ((), end.shape)
                far = np.full(end.shape, -np.inf if side == "min" else np.inf)
                limits[f"theta_{side}"] = np.where(within, end, given if fits else far)
        if isinstance(own, LinearMPC):  # a PlantEnv's
            states = own.layout.state
            limits |= {"x_min": own.x_min, "x_max": own.x_max}
            limits |= {"theta_min": own.theta_min[states], "theta_max": own.theta_max[states]}
        mpc = cls(model, Q=Q, R=R, horizon=horizon, **{**limits, **options})
        room = 1e-6 * (1 + np.abs(model.x_ss))
        outside = (model.x_ss < mpc.x_min - room) | (model.x_ss > mpc.x_max + room)
        if "x_ss" not in of_model and np.any(outside):
            raise ValueError(
                f"A reset led the plant to rest at x_ss = {model.x_ss.round(4).tolist()}, beyond "
                f"x_min = {mpc.x_min.tolist()} or x_max = {mpc.x_max.tolist()}. Pass x_ss=[...], "
                "the state to hold; NaN where it is not known."
            )
        return mpc

    def predict(self, theta: ArrayLike, u: ArrayLike) -> Array:
        """Return the next theta on the model; theta is (n_theta,) or (batch, n_theta)."""
        A, B = self.prediction
        at, v = self._deviations_of(theta, u)
        return self.units.to_plant(at @ A.T + v @ B.T)

    def _deviations_of(self, theta: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        at = to_float("theta", theta)
        v = to_float("u", u)
        for name, given, size in ("theta", at, self.n_theta), ("u", v, self.model.n_inputs):
            if given.shape[-1:] != (size,) and not (given.ndim == 0 and size == 1):
                raise ValueError(f"{name} has shape {given.shape}, expected (..., {size}).")
        return (
            self.units.to_deviations(np.atleast_1d(at)),
            self.units.input_to_deviations(np.atleast_1d(v)),
        )

    def simulate(self, theta0: ArrayLike, steps: int) -> tuple[Array, Array]:
        """Return thetas (steps + 1, n_theta) and inputs (steps, m) of the law on its own model.

        A theta0 in deviations, where the plant has others, is refused.
        """
        law = self.law()
        shown = check_array("theta0", theta0, (self.n_theta,))
        if words := self.shown_as_deviation(shown[None]):
            raise ValueError(f"theta0 = {shown.tolist()}: {words}")
        count = check.check_int("steps", steps, hint="It counts the inputs that are played.")
        A, B = self.prediction
        thetas = np.empty((count + 1, self.n_theta))
        inputs = np.empty((count, self.model.n_inputs))
        thetas[0] = self.units.to_deviations(shown)
        for k in range(count):
            inputs[k] = law(thetas[k])
            thetas[k + 1] = A @ thetas[k] + B @ inputs[k]
        return self.units.to_plant(thetas), self.units.input_to_plant(inputs)

    def stage_cost(self, theta: ArrayLike, u: ArrayLike) -> Array:
        """Return the stage cost, without penalties, at theta (..., n_theta) and u (..., m).

        Q and R weigh distances from x_s and u_s of theta's r and d, within the bounds or not: where
        :meth:`is_reachable` says no, a part of the cost stays with any controller.
        """
        errors = self.error_system
        at, v = self._deviations_of(theta, u)
        v = v - at @ errors.to_input.T
        z = at @ errors.to_error.T
        cost = np.sum((z @ errors.Q) * z, axis=-1) + np.sum((v @ errors.R) * v, axis=-1)
        if errors.cross is not None:
            cost = cost + 2 * np.sum((z @ errors.cross) * v, axis=-1)
        if self.price.counts:
            price = self.deviations.price
            v = v + at @ errors.to_input.T
            cost = cost + at[..., self.layout.state] @ price.x + v @ price.u + price.constant
        return np.asarray(cost)

    @property
    def has_hard_bounds(self) -> bool:
        """Whether a bound of a state or an output is hard, or a mixed one, or one in theta."""
        return bool(self.parametric_bounds or len(hard_rows(self, ("x", "y", "mixed"))[1]))

    @cached_property
    def kept_set(self) -> KeptSet:
        """The set in which the hard bounds can be kept, computed once: see `KeptSet`."""
        return kept_set(self)

    def value_matrix(self, gamma: float) -> Array:
        """Return P (n_theta, n_theta): ``theta' P theta`` is the cost of the law from theta on.

        Theta stands for deviations. It is exact for any ``gamma``, while the linear plant stays in
        the region of the law that holds the origin and r and d are constant; where both discounts
        agree, no cost is smaller. With a price it is a part of :meth:`value_terms`.

        Raises
        ------
        ValueError
            If the law is unstable under this discount, or does not rest at the origin.
        """
        return self.value_terms(gamma).P

    def value_terms(self, gamma: float) -> Value:
        """Return P, slope and constant: the cost is ``theta' P theta + slope' theta + constant``.

        Theta stands for deviations. Without a price there is P alone. With one it holds in the
        region in which the model rests under the law, and needs a gamma below 1.
        """
        gamma = check.check_discount(gamma)  # before the law, which may take long
        return value(self.deviations, self.law(), gamma)

    def state_action_terms(self, gamma: float) -> Value:
        """Return the terms of the cost of u now, the law ever after, as a form of ``[theta; u]``.

        They hold where :meth:`value_matrix` does, and raise its errors.
        """
        after = self.value_terms(gamma)
        own = self.deviations
        AB = np.hstack(own.prediction)
        return Value(
            np.asarray(own.stage_matrix + gamma * AB.T @ after.P @ AB),
            own.stage_slope + gamma * AB.T @ after.slope,
            own.price.constant + gamma * after.constant,
        )

    def explicit(
        self,
        solver: str = "walk",
        *,
        time_limit: float | None = None,
        region_limit: int | None = None,
    ) -> PiecewiseAffine:
        """Return the explicit law theta -> u_0, solved once, checked, and kept.

        A bound that all inputs together move by less than 1e-7 of the half-widths of the box, such
        as that of a position one short step ahead, bounds theta alone: the set where the problem
        has a solution is smaller by so much.

        Parameters
        ----------
        solver : {"walk", "ppopt"}, default "walk"
            A walk from facet to facet, or ppopt, the many times slower reference.
        time_limit : float, optional
            Seconds after which to give up, by the clock. To load compiled code, once in a process,
            does not count. A law that was kept takes none.
        region_limit : int, optional
            The most regions that the law may have. ppopt counts them only at its end.

        Raises
        ------
        ValueError
            If the problem has no feasible parameter, or its box of parameters is not bounded.
        ExplicitLimitError
            If a limit is reached; the message says how far the search came and what to change.
        ExplicitSolutionError
            If the solution fails its check; the message says where.
        """
        return self._solved(time_limit, region_limit, solver=solver)

    def _solved(
        self,
        time_limit: float | None = None,
        region_limit: int | None = None,
        effort_limit: float | None = None,
        solver: str = "walk",
    ) -> PiecewiseAffine:
        """Return the explicit law, solved within a budget unless it is there."""
        if solver not in self._laws:
            box = zip(self.labels(units=True), self.theta_min, self.theta_max, strict=True)
            of_law = np.delete(np.array([*box], object), self.extra, axis=0)
            if far := [each for each in of_law if not np.isfinite(each[2] - each[1])]:
                ends = ", ".join(f"{name} from {low:g} to {high:g}" for name, low, high in far)
                raise ValueError(
                    f"The law needs a bounded box of theta, not {ends}. Pass finite theta_min and "
                    "theta_max (or x_min and x_max), u_min and u_max, and where theta holds them, "
                    "r_min and r_max of Tracking, disturbances=DisturbanceBounds(d_min, d_max)."
                )
            load_kernels()
            limits = self.deviations.u_min, self.deviations.u_max
            with BudgetTimer(time_limit, region_limit, effort_limit) as timer:
                program = self.condensed().without(self.extra)
                law = solve_explicit(program, *limits, self.infeasible, solver, timer)
            self._laws[solver] = self._widened(law)
        law = self._laws[solver]
        if region_limit is not None and law.n_regions > region_limit:  # it was there
            with BudgetTimer(region_limit=region_limit) as timer:
                timer.count(law.n_regions)
        return law

    def _widened(self, law: PiecewiseAffine) -> PiecewiseAffine:
        """Return a law of theta without extra signals as one of theta, on its plant."""
        own = self.deviations
        return law.widened(self.extra, own.theta_min, own.theta_max).on_plant(*self._plant)

    def take_laws(self, other: LinearMPC) -> None:
        """Take over the laws of the same problem without extra signals, as far as solved."""
        self._laws.update({name: self._widened(law) for name, law in other._laws.items()})

    def online(self) -> OnlineLaw:
        """Return the law theta -> u_0 that solves the program at each point: there at once.

        ValueError if the box of theta or an input's range is so large that rounding hides the rest.
        """
        return self._online

    def law(self, kind: str = "auto") -> Law:
        """Return :meth:`explicit` or :meth:`online`, the same function where it is feasible.

        "auto" is what was solved or chosen before; else the explicit law if it is found with the
        effort of about a second, of at most 5,000 regions; else the online law, with an
        :class:`OnlineLawWarning`. The effort is counted, not clocked: the choice is the same on
        every machine, whatever else that does.
        """
        check.check_choice("kind", kind, LAWS)
        if kind == "auto" and self._laws:
            return next(iter(self._laws.values()))
        if kind == "explicit":
            return self.explicit()
        if kind == "auto" and ONLINE_CHOSEN not in vars(self):
            rows, n = self.condensed().S.shape
            why = f"It has {rows} constraints on {n} parameters, too many to look for regions."
            if rows * n <= LARGE:
                try:
                    return self._solved(region_limit=REGIONS, effort_limit=EFFORT)
                except ExplicitLimitError as error:
                    why = (
                        f"{error} Or call problem.explicit() before, which has no limit by default."
                    )
                except ExplicitSolutionError as error:
                    why = str(error)
            warn(
                "The program will be solved online, at each point. It is the same law, and "
                f"policies train on it as well. {why} To skip the search, and this warning, "
                "choose problem.law('online'), or law='online' of a policy. An online law is "
                "exported as C, FMU or npz, not as Structured Text or ONNX.",
                OnlineLawWarning,
            )
        vars(self)[ONLINE_CHOSEN] = True
        return self.online()

    @cached_property
    def _online(self) -> OnlineLaw:
        program = self.condensed()
        limits = self.deviations.u_min, self.deviations.u_max
        require_sane_sizes(program, *limits)
        return OnlineLaw.of(program, *limits, self.infeasible).on_plant(*self._plant)

    @property
    def _plant(self) -> tuple[Any, ...]:
        """What a law knows of the plant: see `PlantLaw`."""
        moving = np.full((2, self.model.n_inputs), -1)
        for at, name in enumerate(self.parametric_bounds, start=self.layout.limits.start):
            kind, i, upper = bound_entry(name)
            if kind == "u":
                moving[int(upper), i] = at
        rate = np.stack([self.rate.du_min, self.rate.du_max]) if self.has_rate_bounds else None
        moves = moving if np.any(moving >= 0) else None
        return self.model, self.theta_ss, rate, moves, self.clamped

    @cached_property
    def _laws(self) -> dict[str, PiecewiseAffine]:
        return {}

    def condensed(self) -> ParametricQP:
        """Return the program in ``U = (u_0, ..., u_{N-1})`` and the slacks, in deviations."""
        return condense(self)[0]

    def report(self, samples: int = 500, seed: int = 0) -> str:
        """Return :func:`~sb3_yann.control.mpc.report.report` of the problem and its law."""
        check.check_int("samples", samples)
        check.check_int("seed", seed, 0)
        return report(self, self.law(), samples, seed)


def _as_control_horizon(
    value: int | Sequence[int] | None, horizon: int
) -> int | tuple[int, ...] | None:
    """Return the number of samples in which inputs move, or the lengths of their blocks."""
    if value is None:
        return None
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
        moves = check.check_int("control_horizon", value)
        if moves > horizon:
            raise ValueError(
                f"control_horizon = {moves} must be at most the horizon, {horizon}: inputs move in "
                "so many of its samples."
            )
        return moves
    if isinstance(value, (str, bool)) or not isinstance(value, (Sequence, np.ndarray)):
        raise TypeError(
            f"control_horizon = {value!r} must be a number of samples, or a list of the lengths of "
            "blocks."
        )
    blocks = tuple(check.check_int("control_horizon", each) for each in value)
    if sum(blocks) != horizon:
        raise ValueError(
            f"The blocks control_horizon = {[*blocks]} make {sum(blocks)} samples, and the horizon "
            f"is {horizon}: they must sum up to it."
        )
    return blocks


def _require_preview_within(model: LinearModel, horizon: int, reference: int, load: int) -> None:
    """Raise where a preview is longer than the horizon, or nothing measures what it foresees."""
    for name, ahead in (("Tracking", reference), ("DisturbanceBounds", load)):
        if ahead > horizon:
            raise ValueError(
                f"{name}.preview = {ahead} must be at most the horizon, {horizon}: the law looks "
                "no further."
            )
    measured = model.n_disturbances - len(model.estimated)
    if load and sorted(model.estimated) != [*range(measured, model.n_disturbances)]:
        raise ValueError(
            f"estimated = {[*model.estimated]}: with a preview, theta holds the measured "
            "disturbances before the estimated ones. Sort the columns of E so."
        )
    if load and not measured:
        raise ValueError(
            "DisturbanceBounds.preview is of measured disturbances, and all are estimated."
        )


def _warn_of_drift(model: LinearModel, lower: Array, upper: Array) -> None:
    """Warn of an operating point that moves noticeably: the law would rest beside it."""
    width = (upper - lower) / 2
    size = np.where(np.isfinite(width), width, np.maximum(np.abs(model.x_ss), 1.0))
    if np.any(np.abs(model.drift) > 1e-3 * size):
        warn(
            f"x_ss = {model.x_ss.tolist()} with u_ss = {model.u_ss.tolist()} is no steady state: "
            f"there the plant moves by {model.drift.tolist()} in one sample, and the law will rest "
            "beside its references. Identify it with an x_ss and u_ss at which it rests."
        )


def _warn_of_unused_softness(softness: Array, bounds: Bounds, box: Bounds) -> None:
    """Warn of soft bounds of states that no theta of the box breaks."""
    (lower, upper) = bounds
    (low, high) = box
    unused = (softness > 0) & (low >= lower) & (high <= upper)
    if np.any(unused):
        i = int(np.argmax(unused))
        warn(
            f"SoftBounds.x softens the bounds {lower[i]:g} to {upper[i]:g} of x[{i}], but theta_min"
            f" = {low[i]:g} and theta_max = {high[i]:g} do not exceed them: the law ends there. "
            "Give theta_min and theta_max the states from which it is to come back."
        )


def _warn_of_unreachable(tracking: Tracking, bounds: Bounds, box: Bounds) -> None:
    """Warn where bounds and box of the states leave a tracked output few set-points or none."""
    C = tracking.C[..., None]
    both = np.maximum(bounds[0], box[0]), np.minimum(bounds[1], box[1])
    with np.errstate(invalid="ignore"):  # 0 times an open side
        ends = np.where(C != 0, C * np.stack(both, axis=-1), 0.0)
        low = ends.min(axis=-1).sum(axis=-1)
        high = ends.max(axis=-1).sum(axis=-1)
        by = np.maximum(tracking.r_max - high, low - tracking.r_min)
    none = (tracking.r_min > high) | (tracking.r_max < low)
    for i in np.flatnonzero(none | (np.isfinite(by) & (by > high - low)))[:1]:
        warn(
            f"x_min and x_max, or theta_min and theta_max, keep r[{i}] between {low[i]:g} and "
            f"{high[i]:g}, and its set-points are {tracking.r_min[i]:g} to {tracking.r_max[i]:g}: "
            f"{'none' if none[i] else 'few'} can be reached. Have they the same units and order?"
        )


def _warn_of_misread_bounds(problem: MPCProblem) -> None:
    """Warn of the first bounds that leave out the operating point: the law cannot rest there.

    References and disturbances are other places to rest at: beside them it counts for inputs, and
    for what holds 0, which are deviations.
    """
    model = problem.model
    tracking = problem.tracking
    d = problem.disturbances
    states = problem.layout.state
    names, inputs = labels_of(model)
    ranges = {
        "x": (*problem.limits["x"], model.x_ss, names),
        "theta": (problem.theta_min[states], problem.theta_max[states], model.x_ss, names),
        "u": (*problem.limits["u"], model.u_ss, inputs),
        "d": (d.d_min, d.d_max, model.d_ss, model.disturbance_labels),
        "r": (tracking.r_min, tracking.r_max, tracking.C @ model.x_ss, None),
        "y": (*problem.limits["y"], problem.outputs.C @ model.x_ss, None),
    }
    has_point = bool(np.any(model.x_ss) or np.any(model.u_ss))
    has_constants = problem.layout.has_constants
    always = ["u"] * (has_point or not has_constants)
    always += ["x", "theta"] * (has_point and not has_constants)
    for name, (lower, upper, points, labels) in ranges.items():
        left_out = (lower > points) | (upper < points)
        if name not in always:
            left_out &= (lower < 0) & (upper > 0)
        for i in np.flatnonzero(left_out)[:1]:
            called = labels[i] if labels else f"{name}[{i}]"
            warn(
                f"{name}_min = {lower[i]:g} and {name}_max = {upper[i]:g} leave out {called} = "
                f"{points[i]:g}, the operating point: the law cannot rest there. Bounds are what "
                "the plant shows and takes, no deviations, and so are x_ss and u_ss of the model. "
                "Have they the same units and order?"
            )
            return


def _as_group(name: str, value: G | None, kind: type[G]) -> G:
    """Return a group of arguments; None is one that says nothing."""
    return check.check_options(name, kind() if value is None else value, kind)


def _choose_penalty(problem: MPCProblem) -> None:
    """Store 100 times the cost of coming back from the bounds, at most, with inputs at theirs.

    A unit of violation that is larger than a bound counts as so many times more. It is less where a
    slack would cost so much more than inputs that solvers lose digits, down to ten times the share
    of a unit in that cost, which multipliers are like.
    """
    n = problem.model.n_states
    x, u, y, mixed = (finite_sizes(*problem.limits[kind]) for kind in ("x", "u", "y", "mixed"))
    x = np.where(x > 0, x, finite_sizes(problem.theta_min[:n], problem.theta_max[:n]))
    terminal = problem.terminal.cost[:n, :n]
    total = x @ (np.abs(problem.Q) + np.abs(terminal)) @ x + u @ np.abs(problem.R) @ u
    total += problem.horizon * (np.abs(problem.price.x) @ x + np.abs(problem.price.u) @ u)
    units = [(problem.soft.x, x), (problem.soft.y, y), (problem.mixed.soft, mixed)]
    parts = [unit[size > 0] / size[size > 0] for unit, size in units]
    wide = max(float(part.max(initial=0.0)) for part in parts)
    if not total > 0:
        raise ValueError(
            "SoftBounds.penalty is missing, and it is not known how much a violation should cost: "
            "neither states nor inputs have a bound that costs anything. Pass the cost of one unit "
            "of violation."
        )
    cost = float(total)
    most = 100 * cost * max(1.0, wide)
    problem.soft._store(penalty=most)
    with contextlib.suppress(ValueError):  # the laws say so
        steep = steepness(condense(problem)[0], problem.u_min, problem.u_max)
        problem.soft._store(penalty=most if steep <= 1 else max(most / steep, 10 * cost * wide))
