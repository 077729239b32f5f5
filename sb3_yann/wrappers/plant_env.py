"""The reward that the critic is exact for, and an env from the equations of a plant."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from numpy.typing import ArrayLike
from scipy import linalg

from sb3_yann._validation import (
    Array,
    NonFiniteWarning,
    check_bounds,
    check_int,
    check_number,
    check_type,
    warn,
)
from sb3_yann.compare import EXCESS_ROOM
from sb3_yann.control import LinearMPC, StateEstimator
from sb3_yann.control.linear_system import with_units
from sb3_yann.control.linearization import called_as, require_order, slope_of
from sb3_yann.control.mpc.bound_excess import Bounds, bound_excess
from sb3_yann.control.wrapper_stack import SHOW_THETA, require_theta_order
from sb3_yann.env_pool import name_of
from sb3_yann.units import ActionUnits
from sb3_yann.wrappers.theta import (
    Env,
    EstimateState,
    PreviousInput,
    SetPoint,
    Vector,
    require_vector,
)


class StageCost(gym.Wrapper[Vector, Vector, Vector, Vector]):
    """Makes the reward minus the stage cost of the problem, for which the critic is exact.

    The cost is that of the observed theta and of the input played there. A step that takes a state,
    an output or an input beyond a hard bound of the problem, or moves an input too far, reports
    ``info["violation"]``; by how much is ``info["excess"]``, in half-widths, and what it added to
    the cost ``info["violation_cost"]``. What soft bounds cost is no part of the reward, since the
    critic is exact without it: it is ``info["penalty"]``.

    Parameters
    ----------
    env : gymnasium.Env
        Its observation is the theta of the problem, or what ``observation`` makes theta of.
    problem : LinearMPC
    violation_cost : float, default 0
        Added to the cost of a step that reports ``info["violation"]``.
    observation : AffineObservation, optional
        The map from what the env shows to theta: as in :class:`YannPolicy`. By default it is theta,
        in plant units where the problem's model has an operating point. Actions in [-1, 1] count as
        the inputs that they stand for.

    Examples
    --------
    >>> plant = gym.make("CSTR-v0")
    >>> env = StageCost(plant, plant.observation_space.problem, violation_cost=10)
    >>> _ = env.reset(seed=0)
    >>> env.step(np.zeros(1, np.float32))[1] < 0
    True
    """

    def __init__(
        self,
        env: Env,
        problem: LinearMPC,
        violation_cost: float = 0.0,
        observation: Callable[[ArrayLike], Array] | None = None,
    ) -> None:
        space = require_vector(env, "observation_space")
        super().__init__(env)
        check_type("problem", problem, LinearMPC, "a LinearMPC, such as that of the policy")
        self.inputs = require_vector(env, "action_space")
        units = ActionUnits.of(problem, self.inputs.low, self.inputs.high)
        u_ss = problem.model.u_ss
        self.units = units or ActionUnits("plant", np.ones_like(u_ss), u_ss.copy())
        if observation is not None:
            check_type("observation", observation, Callable, "an AffineObservation, or None")
        self.seen: Callable[[ArrayLike], Array] = observation or np.asarray
        shape = np.shape(self.seen(np.zeros(space.shape)))
        if shape != (problem.n_theta,):
            what = "The observation" if observation is None else "What the map makes of it"
            raise ValueError(
                f"{what} has shape {shape}, but theta = [{', '.join(problem.labels())}] has "
                f"{problem.n_theta} entries, in this order. {SHOW_THETA} Or pass observation="
                "AffineObservation(matrix, offset); or take with_extra(mpc, low, high), whose "
                "theta has signals that the model ignores."
            )
        if observation is None:
            require_theta_order(env, problem)
        self.problem = problem
        self.violation_cost = check_number("violation_cost", violation_cost)
        self.bounds = Bounds.of(problem)
        self.theta: Array = np.zeros(problem.n_theta)

    def reset(self, **kwargs: Any) -> tuple[Vector, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(**kwargs)
        if (shape := np.shape(observation)) != self.observation_space.shape:
            raise ValueError(
                f"The env's reset returned an observation of shape {shape}, and its "
                f"observation_space has {self.observation_space.shape}: return a vector, such as "
                "np.ravel(observation)."
            )
        self.theta = self.problem.units.to_deviations(self.seen(observation))
        return observation, info

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Step; the reward is the one of this wrapper."""
        u = np.atleast_1d(np.asarray(action, np.float64))
        if u.shape != self.inputs.shape:
            of = ", ".join(with_units(self.problem.model)[1])
            raise ValueError(f"action has shape {u.shape}, expected {self.inputs.shape}: {of}.")
        u = self.units.input(np.clip(u, self.inputs.low, self.inputs.high))
        cost = float(self.problem.deviations.stage_cost(self.theta, u))
        observation, _, terminated, truncated, info = self.env.step(action)
        after = self.problem.units.to_deviations(self.seen(observation))
        states = np.array([self.theta, after])
        excess = bound_excess(self.problem, states, u[None], bounds=self.bounds)
        info = {**info, "excess": float(excess.largest), "penalty": float(excess.penalty)}
        if excess.largest > EXCESS_ROOM:
            info["violation"] = True
        info["violation_cost"] = self.violation_cost if info.get("violation") else 0.0
        cost += info["violation_cost"]
        self.theta = after
        return observation, -cost, terminated, truncated, info


Slope = Callable[[Array, Array], ArrayLike]
UNITS_OF_TIME = (24.0, 60.0, 1000.0, 1440.0, 3600.0, 86400.0)
"""How often milliseconds, seconds, minutes, hours and days go into one another."""


class PlantEnv(gym.Wrapper[Any, Any, Any, Any]):
    """The equations ``dx/dt = f(x, u)`` as an env in plant units.

    It shows theta, in the order of ``mpc.layout.names``: the state, and what else the MPC has. Of
    ``tracking=Tracking([0], r_min, r_max)`` theta is ``[x, r]``: the set-point r is drawn uniformly
    between r_min and r_max at each reset, and held for the episode, or drawn anew every ``hold``
    steps; so are bounds that change. No :class:`SetPoint` is needed around it. The reward is minus
    the MPC's stage cost, and ``info["state"]`` the state. The inputs are held for a sample,
    ``mpc.model.dt``, in which the classical Runge-Kutta method takes ``substeps`` equal steps, and
    shorter ones where these err by more than a thousandth of the half-width of theta's box.
    ``reset(options={"state": x})`` begins in a state. Where it is no longer finite an episode
    terminates, in the last one that was, with ``info["violation"]``; a warning says where f was
    not, and how often.

    Parameters
    ----------
    f : callable
        From a state (n,) and an input (m,), in plant units, to dx/dt (n,).
    mpc : LinearMPC
        Without measured disturbances: those are the env's own, see :class:`MeasuredDisturbance`.
    start_low, start_high : array_like, shape (n,), or float, optional
        The box that episodes begin in. By default it is a quarter of the width of theta's box to
        either side of ``mpc.model.x_ss``, and ends where that box does.
    max_episode_steps : int, default 100
    hold : int, optional
        Steps after which another set-point is drawn; by default it stays for the episode.
    observer : StateEstimator, optional
        What estimates the disturbances of the MPC, as :func:`offset_free` returns it, or the states
        that no sensor shows. It reads ``C x`` of the state.
    substeps : int, default 10

    Examples
    --------
    >>> from sb3_yann import LinearModel
    >>> f = lambda x, u: (u - x**0.5) / 4
    >>> tank = LinearModel.from_dynamics(f, x_ss=[4], u_ss=[2], dt=1)
    >>> limits = {"u_min": 0, "u_max": 5, "theta_min": 0, "theta_max": 9}
    >>> mpc = LinearMPC(tank, Q=[[1]], R=[[1]], horizon=3, **limits)
    >>> env = PlantEnv(f, mpc)
    >>> env.reset(options={"state": [4]})[0], env.step([2])[0].round(6), env.action_space.high
    (array([4.]), array([4.]), array([5.]))
    """

    def __init__(
        self,
        f: Slope,
        mpc: LinearMPC,
        *,
        start_low: ArrayLike | None = None,
        start_high: ArrayLike | None = None,
        max_episode_steps: int = 100,
        hold: int | None = None,
        observer: StateEstimator | None = None,
        substeps: int = 10,
    ) -> None:
        check_type("f", f, Callable, "a function (x, u) -> dx/dt")
        check_type("mpc", mpc, LinearMPC, "a LinearMPC")
        layout = mpc.layout
        x_ss = mpc.model.x_ss
        n = mpc.model.n_states
        if layout.n_disturbances and observer is None:
            raise ValueError(
                "The MPC has disturbances, and f(x, u) has none. If they are estimated, pass the "
                "observer. Else write an env that shows them, and wrap it in MeasuredDisturbance "
                "and StageCost."
            )
        box = mpc.theta_min[layout.state], mpc.theta_max[layout.state]
        half = (box[1] - box[0]) / 4
        lowest = np.maximum(x_ss - half, box[0]) if start_low is None else start_low
        highest = np.minimum(x_ss + half, box[1]) if start_high is None else start_high
        start = check_bounds("start_", lowest, highest, n, equal=True)
        if not np.all(np.isfinite(start)):
            raise ValueError(
                "The MPC's box of states is not bounded, so it is not known where episodes begin: "
                "pass start_low and start_high."
            )
        off = np.abs(np.clip(start, *box) - start) > EXCESS_ROOM * mpc.theta_half[layout.state]
        for i in np.flatnonzero(off.any(axis=0)):
            warn(
                f"{with_units(mpc.model)[0][i]} may begin at {start[0][i]:g} to {start[1][i]:g}, "
                f"beyond theta's box, for which the MPC is made: {box[0][i]:g} to {box[1][i]:g}. "
                "Change start_low and start_high, or widen theta_min and theta_max."
            )
        check_int("substeps", substeps)
        if observer is not None:
            check_type("observer", observer, StateEstimator, "that of offset_free(mpc)")
        C = np.eye(n) if observer is None else observer.C
        plant = Equations(f, mpc, start, substeps, C)
        with np.errstate(all="ignore"):
            plant.slope(x_ss, mpc.model.u_ss)
        if plant.fault:
            raise ValueError(f"{plant.fault}, the operating point.")
        require_order(f, mpc.model.dt, x_ss, mpc.model.u_ss)
        env: Any = plant
        warn_of_another_time(plant.slope, mpc)
        if layout.n_references:
            r = mpc.tracking
            env = SetPoint(env, r.r_min, r.r_max, hold=hold, preview=r.preview)
        if observer is not None:
            env = EstimateState(env, observer, mpc.disturbances.d_min, mpc.disturbances.d_max)
        if layout.bounds:
            part = layout.limits
            env = SetPoint(env, mpc.theta_min[part], mpc.theta_max[part], hold=hold)
        if layout.n_previous:
            env = PreviousInput(env, mpc.model.u_ss)
        limit = check_int("max_episode_steps", max_episode_steps)
        self.mpc = mpc
        super().__init__(TimeLimit(StageCost(env, mpc), limit))


def warn_of_another_time(slope: Callable[[Array, Array], Array], mpc: LinearMPC) -> None:
    """Warn where f is far off the model, and nearly right in another unit of time or as a map.

    Compared are the effects of state and input on the next state, in half-widths of their boxes.
    """
    model = mpc.model
    n = mpc.model.n_states
    point = np.concatenate([model.x_ss, model.u_ss])
    half = np.concatenate([mpc.theta_half[mpc.layout.state], mpc.u_half])
    size = np.where(np.isfinite(half) & (half > 0), half, 1.0)
    with np.errstate(all="ignore"):
        ahead, behind = (
            np.array([slope(*np.split(point + side * each, [n])) for each in np.diag(size)])
            for side in (1e-4, -1e-4)
        )
        rates = np.zeros((point.size, point.size))
        rates[:n] = ((ahead - behind) / 2e-4 / size[:n]).T
    at_rest = np.eye(n, point.size)
    effects = np.hstack([model.A, model.B]) * size / size[:n, None] - at_rest
    if not (np.all(np.isfinite(rates)) and np.any(effects)):
        return

    def error(next_state: Array) -> float:
        found = np.linalg.norm(next_state[:n] - at_rest - effects) / np.linalg.norm(effects)
        return float(np.nan_to_num(found, nan=np.inf))

    def error_of(ratio: float) -> float:
        with np.errstate(all="ignore"):
            return error(linalg.expm(ratio * model.dt * rates))

    if error_of(1.0) <= 0.8:
        return
    ratio = min([*UNITS_OF_TIME, *(1 / each for each in UNITS_OF_TIME)], key=error_of)
    if error(rates) < 0.2:
        warn(
            "f(x, u) looks like the next state, and f is the slope dx/dt: what it gives is that of "
            f"the MPC's model after dt = {model.dt:g}. Of a map write a gymnasium.Env, and wrap it "
            "in StageCost."
        )
    elif error_of(ratio) < 0.2:
        times = max(ratio, 1 / ratio)
        pace, cure = ("fast", "/") if ratio < 1 else ("slow", "*")
        warn(
            f"f(x, u) is {times:g} times as {pace} as the model of the "
            f"MPC, whose dt = {model.dt:g}{f' {model.time_unit}'.rstrip()}. If f is in "
            f"another unit of time than dt, pass lambda x, u: np.asarray(f(x, u)) {cure} "
            f"{times:g}."
        )


class Equations(gym.Env[Array, Array]):
    """A plant that shows outputs ``C x`` of its state and takes its inputs.

    The 1st, 10th, 100th step in which a function was not finite is warned of, over all envs of it.
    """

    lost = Counter[Any]()

    def __init__(
        self, f: Slope, mpc: LinearMPC, start: tuple[Array, Array], substeps: int, C: Array
    ) -> None:
        self.f = f
        self.C = C
        self.plant_name = name_of(f)
        self.start = start
        self.substeps = substeps
        self.dt = mpc.model.dt
        self.observation_space = spaces.Box(-np.inf, np.inf, (len(C),), np.float64)
        self.action_space = spaces.Box(mpc.u_min, mpc.u_max, dtype=np.float64)
        self.state: Array = mpc.model.x_ss
        self.model = mpc.model
        half = (mpc.theta_max - mpc.theta_min)[mpc.layout.state] / 2
        seen = np.max(np.abs([*start, self.state]), axis=0)
        size = np.where(np.isfinite(half) & (half > 0), half, seen)
        self.weight = 1 / np.where(size > 0, size, 1.0)
        self.time = 0.0
        self.fault = ""  # of a step: where f was not finite first

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin in the box of starts, or in ``options["state"]``."""
        super().reset(seed=seed)
        self.state = self.np_random.uniform(*self.start)
        self.time = 0.0
        if options and "state" in options:
            given = np.asarray(options["state"], np.float64)
            if given.shape != self.state.shape or not np.all(np.isfinite(given)):
                wanted = f"{len(self.state)} finite numbers"
                raise ValueError(f"options['state'] = {options['state']!r} must be {wanted}.")
            self.state = given
        return self.C @ self.state, {"state": self.state.copy()}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold the inputs, clipped to their bounds, for a sample."""
        box: Any = self.action_space
        u = np.clip(np.asarray(action, np.float64), box.low, box.high)
        with np.errstate(all="ignore"):
            x = self._held(u)
        lost = not np.all(np.isfinite(x))
        if self.fault:
            key = getattr(self.f, "__code__", self.plant_name)
            self.lost[key] += 1
            if str(self.lost[key]).strip("0") == "1":
                when = f"t = {self.time:g} {self.model.time_unit}".rstrip()
                often = f" So did {self.lost[key]} episodes." if self.lost[key] > 1 else ""
                ends = "the episode ends there, as a violation."
                warn(f"{self.fault}, {when}: {ends}{often}", NonFiniteWarning)
        self.state = self.state if lost else x
        self.time += self.dt
        info = {"state": self.state.copy(), **({"violation": True} if lost else {})}
        return self.C @ self.state, 0.0, lost, False, info

    def _held(self, u: Array) -> Array:
        """Return the state after a sample, not finite where no step is short enough.

        The error of a step is that of the third-order formula that its slopes and the first one of
        the next make; where it is too large the step is cut in half.
        """
        finest = 1024  # parts that a substep may be cut into
        largest_error = 1e-3  # of a substep, in half-widths of theta's box, else in sizes of states
        self.fault = ""
        x = self.state
        k1 = self.slope(x, u)
        step = finest
        left = finest * self.substeps
        while left:
            h = self.dt / self.substeps * (step / finest)
            k2 = self.slope(x + h / 2 * k1, u)
            k3 = self.slope(x + h / 2 * k2, u)
            k4 = self.slope(x + h * k3, u)
            after = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            following = self.slope(after, u)
            error = h / 6 * float((np.abs(following - k4) * self.weight).max())
            if error <= largest_error:
                x = after
                k1 = following
                left -= step
                if error < largest_error / 16 and left % (2 * step) == 0:
                    step = min(2 * step, finest)
            elif step > 1:
                self.fault = ""
                step //= 2
            else:
                self.fault = self.fault or f"f(x, u) changes too fast for steps of {h:.3g}"
                return after * np.nan
        return x

    def slope(self, x: Array, u: Array) -> Array:
        """Return dx/dt; `fault` says where it was not finite first."""
        slope = np.asarray(slope_of(self.f, x, u), np.float64)
        if slope.shape != x.shape:
            of_x = ", ".join(with_units(self.model)[0])
            raise ValueError(f"f returned the shape {slope.shape}. {called_as(x, u)} x is {of_x}.")
        wrong = np.flatnonzero(~np.isfinite(slope))
        if wrong.size and not self.fault and np.all(np.isfinite(x)):
            states, inputs, _ = with_units(self.model)
            values = zip((*states, *inputs), (*x, *u), strict=True)
            at = ", ".join(f"{name} = {value:.6g}" for name, value in values)
            self.fault = f"f(x, u) is {slope[wrong[0]]} for the slope of {states[wrong[0]]} at {at}"
        return slope
