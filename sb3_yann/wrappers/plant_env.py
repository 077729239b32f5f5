"""An env from the equations of a plant, in plant units, with all that its MPC's theta holds."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from numpy.typing import ArrayLike
from scipy import linalg

from sb3_yann._validation import Array, check_bounds, check_int, check_type
from sb3_yann.control import DisturbanceObserver, LinearMPC
from sb3_yann.wrappers.stage_cost import StageCost
from sb3_yann.wrappers.theta import ObserveDisturbance, PreviousInput, SetPoint

Slope = Callable[[Array, Array], ArrayLike]
UNITS_OF_TIME = (24.0, 60.0, 1000.0, 1440.0, 3600.0, 86400.0)
"""How often milliseconds, seconds, minutes, hours and days go into one another."""


class PlantEnv(gym.Wrapper[Any, Any, Any, Any]):
    """The equations ``dx/dt = f(x, u)`` as an env in plant units.

    The reward is minus the stage cost of the MPC. It shows the state, and what else theta holds:
    set-points and bounds that change, drawn at random, and the previous input. The inputs are held
    for a sample, ``mpc.model.dt``, in which the classical Runge-Kutta method takes ``substeps``
    equal steps. ``reset(options={"state": x})`` begins in a state. Where the state is no longer
    finite an episode terminates, in the last one that was, with ``info["violation"]``.

    Parameters
    ----------
    f : callable
        From a state (n,) and an input (m,), in plant units, to dx/dt (n,).
    mpc : LinearMPC
        Without measured disturbances: those are the env's own, see :class:`MeasuredDisturbance`.
    start_low, start_high : array_like, shape (n,), or float, optional
        The box that episodes begin in; by default half as wide as that of theta, about the
        operating point.
    max_episode_steps : int, default 100
    hold : int, optional
        Steps after which another set-point is drawn, as of :class:`SetPoint`.
    observer : DisturbanceObserver, optional
        What estimates the disturbances of the MPC, as :func:`offset_free` returns it.
    substeps : int, default 10

    Raises
    ------
    TypeError, ValueError
        If an argument is of no use, or it is not known where episodes begin.

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
        observer: DisturbanceObserver | None = None,
        substeps: int = 10,
    ) -> None:
        if not callable(f):
            raise TypeError(f"f = {f!r} must be a function (x, u) -> dx/dt.")
        check_type("mpc", mpc, LinearMPC, "a LinearMPC")
        layout, x_ss, n = mpc.layout, mpc.model.x_ss, mpc.model.n_states
        if layout.n_disturbances and observer is None:
            raise ValueError(
                "The MPC has disturbances, and f(x, u) has none. If they are estimated, pass the "
                "observer. Else write an env that shows them, and wrap it in MeasuredDisturbance "
                "and StageCost."
            )
        half = (mpc.theta_max - mpc.theta_min)[layout.state] / 4
        low = np.maximum(x_ss - half, mpc.theta_min[layout.state])
        high = np.minimum(x_ss + half, mpc.theta_max[layout.state])
        lowest = low if start_low is None else start_low
        highest = high if start_high is None else start_high
        start = check_bounds("start", lowest, highest, n)
        if not np.all(np.isfinite(start)):
            raise ValueError(
                "The MPC's box of states is not bounded, so it is not known where episodes begin: "
                "pass start_low and start_high."
            )
        check_int("substeps", substeps)
        env: Any = Equations(f, mpc, start, substeps)
        if ratio := ratio_of_time_units(env._slope, mpc):
            faster = ratio < 1
            times = 1 / ratio if faster else ratio
            warnings.warn(
                f"f(x, u) is {times:g} times as {'fast' if faster else 'slow'} as the model of the "
                f"MPC, whose dt = {mpc.model.dt:g}{f' {mpc.model.time_unit}'.rstrip()}. If f is in "
                "another unit of time than dt, pass lambda x, u: np.asarray(f(x, u)) "
                f"{'/' if faster else '*'} {times:g}.",
                stacklevel=2,
            )
        if layout.n_references:
            r = mpc.tracking
            env = SetPoint(env, r.r_min, r.r_max, hold=hold, preview=r.preview)
        if observer is not None:
            env = ObserveDisturbance(env, observer, mpc.disturbances.d_min, mpc.disturbances.d_max)
        if layout.bounds:
            part = layout.limits
            env = SetPoint(env, mpc.theta_min[part], mpc.theta_max[part], hold=hold)
        if layout.n_previous:
            env = PreviousInput(env, mpc.model.u_ss)
        limit = check_int("max_episode_steps", max_episode_steps)
        self.mpc = mpc
        super().__init__(TimeLimit(StageCost(env, mpc), limit))


def ratio_of_time_units(slope: Callable[[Array, Array], Array], mpc: LinearMPC) -> float | None:
    """Return by what a unit of time explains that f and the model differ; None where none does.

    Compared are the effects of state and input on the next state, in half-widths of their boxes. A
    plant that is not its model is no reason: the model must be far off, by five times at least, and
    nearly right with another unit.
    """
    model, n = mpc.model, mpc.model.n_states
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
    effects = np.hstack([model.A - np.eye(n), model.B]) * size / size[:n, None]
    if not (np.all(np.isfinite(rates)) and np.any(effects)):
        return None

    def error(ratio: float) -> float:
        with np.errstate(all="ignore"):
            held = linalg.expm(ratio * model.dt * rates)[:n] - np.eye(n, point.size)
            found = np.linalg.norm(held - effects) / np.linalg.norm(effects)
        return float(np.nan_to_num(found, nan=np.inf))

    ratios = [*UNITS_OF_TIME, *(1 / each for each in UNITS_OF_TIME)]
    best = min(ratios, key=error)
    return best if error(1.0) > 0.8 and error(best) < 0.2 else None


class Equations(gym.Env[Array, Array]):
    """A plant that shows its state and takes its inputs."""

    def __init__(self, f: Slope, mpc: LinearMPC, start: tuple[Array, Array], substeps: int) -> None:
        self.f, self.start, self.substeps, self.dt = f, start, substeps, mpc.model.dt
        self.observation_space = spaces.Box(-np.inf, np.inf, (mpc.model.n_states,), np.float64)
        self.action_space = spaces.Box(mpc.u_min, mpc.u_max, dtype=np.float64)
        self.state: Array = mpc.model.x_ss

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin in the box of starts, or in ``options["state"]``."""
        super().reset(seed=seed)
        self.state = self.np_random.uniform(*self.start)
        if options and "state" in options:
            given = np.asarray(options["state"], np.float64)
            if given.shape != self.state.shape or not np.all(np.isfinite(given)):
                wanted = f"{len(self.state)} finite numbers"
                raise ValueError(f"options['state'] = {options['state']!r} must be {wanted}.")
            self.state = given
        return self.state.copy(), {"state": self.state.copy()}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold the inputs, clipped to their bounds, for a sample."""
        box: Any = self.action_space
        u = np.clip(np.asarray(action, np.float64), box.low, box.high)
        with np.errstate(all="ignore"):
            reached = self._advance(u)
        lost = not np.all(np.isfinite(reached))
        if not lost:
            self.state = reached
        info = {"state": self.state.copy(), **({"violation": True} if lost else {})}
        return self.state.copy(), 0.0, lost, False, info

    def _advance(self, u: Array) -> Array:
        """Return the state one sample later."""
        x, h = self.state, self.dt / self.substeps
        for _ in range(self.substeps):
            k1 = self._slope(x, u)
            k2 = self._slope(x + h / 2 * k1, u)
            k3 = self._slope(x + h / 2 * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + self._slope(x + h * k3, u))
        return x

    def _slope(self, x: Array, u: Array) -> Array:
        slope = np.asarray(self.f(x, u), np.float64)
        if slope.shape != x.shape:
            raise ValueError(f"f(x, u) has shape {slope.shape}, expected dx/dt, {x.shape}.")
        return slope
