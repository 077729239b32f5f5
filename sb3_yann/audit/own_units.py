"""A plant in its own units, as the law takes it: theta, and inputs as deviations."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.linearization.wrapper_stack import require_state_shown
from sb3_yann.control.model.labels import labels_of
from sb3_yann.control.mpc.plant_units import MOST, InputUnits, misread_state
from sb3_yann.wrappers.spaces import Env, Vector, require_vector


class FromOperatingPoint(gym.Wrapper[Vector, Vector, Vector, Vector]):
    """Shows theta of an absolute problem, and takes its inputs as deviations.

    Parameters
    ----------
    env : gymnasium.Env
        Shows all of theta, and takes inputs, in absolute values.
    problem : LinearMPC
        Its operating point is taken off.
    """

    def __init__(self, env: Env, problem: LinearMPC) -> None:
        super().__init__(env)
        seen, self.taken = (require_vector(env, f"{k}_space") for k in ("observation", "action"))
        self.theta_ss: Array = problem.theta_ss
        self.u_ss: Array = problem.model.u_ss
        self.observation_space = _shifted(seen, self.theta_ss)
        self.action_space = _shifted(self.taken, self.u_ss)

    def reset(self, **kwargs: Any) -> tuple[Vector, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(**kwargs)
        return np.asarray(observation, np.float64) - self.theta_ss, info

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Step with the operating point put on the action, and taken off the observation."""
        u = np.clip(action + self.u_ss, self.taken.low, self.taken.high)
        observation, reward, terminated, truncated, info = self.env.step(u.astype(self.taken.dtype))
        theta = np.asarray(observation, np.float64) - self.theta_ss
        return theta, float(reward), terminated, truncated, info


def showing_theta(
    make: Callable[[], gym.Env[Any, Any]], problem: LinearMPC, observation_given: bool = False
) -> Callable[[], gym.Env[Any, Any]]:
    """Return a function that makes envs that show theta and take deviations.

    Parameters
    ----------
    make : callable
        Makes an env that shows as many values as theta has.
    problem : LinearMPC
        Where it is absolute, an env that takes absolute inputs shows absolute values.
    observation_given : bool, default False
        Whether the user said what the env shows.

    Raises
    ------
    ValueError
        If its actions are in other units, and the problem does not say what the env shows.
    """
    with closing(make()) as env:
        space = require_vector(env, "action_space")
        require_state_shown(env, observation_given)
    units = InputUnits.of(problem, space.low, space.high)
    if units is None or units.kind == "deviation":
        return make
    if units.kind == "absolute" and problem.absolute:
        return lambda: FromOperatingPoint(make(), problem)
    low, high = problem.u_min.tolist(), problem.u_max.tolist()
    cure = "the plant in sb3_yann.wrappers.Deviations(env, mpc.model), or state the MPC with "
    cure += "absolute=True"
    if units.kind == "normalized":
        cure = "it in gymnasium.wrappers.RescaleAction(env, mpc.u_min, mpc.u_max)"
    raise ValueError(
        f"The env takes {units.kind} inputs, from {space.low.tolist()} to "
        f"{space.high.tolist()}, and the MPC deviations, from {low} to {high}. Wrap {cure}."
    )


def require_deviations(problem: LinearMPC, theta: Array) -> None:
    """Raise where theta (steps, n_theta) holds absolute values instead of deviations.

    Nor may references and measured disturbances lie beyond their box in nearly all steps.
    """
    i = misread_state(problem, theta)
    if i is None:
        _require_box(problem, theta)
        return
    name = labels_of(problem.model)[0][i]
    raise ValueError(
        f"The env shows state {name!r} = {theta[0, i]:.6g}, and theta counts from the operating "
        f"point, {problem.model.x_ss[i]:.6g}: these are absolute values. Wrap the plant in "
        "sb3_yann.wrappers.Deviations(env, mpc.model)."
    )


def _require_box(problem: LinearMPC, theta: Array) -> None:
    """Raise where a reference or a disturbance lies beyond its box in nearly all steps."""
    rest, room = problem.theta_ss, 1e-3 * problem.theta_half
    beyond = (theta < problem.theta_min - room) | (theta > problem.theta_max + room)
    for i in np.flatnonzero(np.mean(beyond, axis=0) >= MOST):
        if i < problem.model.n_states or i >= problem.layout.disturbance.stop:
            continue
        shown = f"{theta[0, i]:.6g}, from the operating point {rest[i]:.6g} on"
        raise ValueError(
            f"{problem.labels()[i]} is {shown}, and the MPC was solved for "
            f"{problem.theta_min[i]:.6g} to {problem.theta_max[i]:.6g}: give the wrapper that "
            "shows it bounds in the units of the env below it, absolute or deviations."
        )


def _shifted(space: spaces.Box, point: Array) -> Any:
    """Return the box of what is seen minus the point."""
    return spaces.Box(space.low - point, space.high - point, dtype=np.float64)
