"""A simulator in plant units, as laws compute with it: theta and inputs in deviations."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.linearization.wrapper_stack import require_state_shown
from sb3_yann.units import ActionUnits, Units
from sb3_yann.wrappers.theta import require_vector

Map = Callable[[Array], Array]
"""From an observation to theta."""


class InDeviations(gym.Wrapper[Any, Any, Any, Any]):
    """An env in plant units as laws compute with it: it shows theta, and takes u, in deviations.

    Parameters
    ----------
    env : gymnasium.Env
        Shows all of theta, and takes inputs, in plant units.
    units : Units
        Of its problem.
    observation : callable, optional
        From what the env shows to theta in plant units. By default it shows that.
    """

    def __init__(
        self, env: gym.Env[Any, Any], units: Units, observation: Map | None = None
    ) -> None:
        super().__init__(env)
        self.units = units
        self.observation = observation
        seen: Any = env.observation_space
        taken: Any = env.action_space
        self.taken: spaces.Box = taken
        far = np.full(len(units.theta_ss), np.inf)
        low, high = (seen.low, seen.high) if observation is None else (-far, far)
        self.observation_space = spaces.Box(
            low - units.theta_ss, high - units.theta_ss, dtype=np.float64
        )
        self.action_space = spaces.Box(
            taken.low - units.u_ss, taken.high - units.u_ss, dtype=np.float64
        )

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(**kwargs)
        return self._theta(observation), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step with the operating point put on the action, and taken off the observation."""
        # Rounding must not leave the space of the env.
        u = np.clip(self.units.input_to_plant(action), self.taken.low, self.taken.high)
        observation, reward, *ends, info = self.env.step(u.astype(self.taken.dtype))
        terminated, truncated = ends
        return self._theta(observation), float(reward), terminated, truncated, info

    def _theta(self, shown: Any) -> Array:
        return self.units.to_deviations(
            shown if self.observation is None else self.observation(np.ravel(shown))
        )


def in_deviations(
    make: Callable[[], gym.Env[Any, Any]], problem: LinearMPC, observation: Map | None = None
) -> Callable[[], gym.Env[Any, Any]]:
    """Return a function that makes envs that show theta, and take inputs, in deviations.

    Parameters
    ----------
    make : callable
        Makes an env that takes the inputs in plant units.
    problem : LinearMPC
        Its operating point is taken off.
    observation : callable, optional
        From what it shows to theta in plant units. By default it shows that.

    Raises
    ------
    ValueError
        If its actions are in other units.
    """
    with closing(make()) as env:
        space = require_vector(env, "action_space")
        require_state_shown(env, observation is not None)
    units = ActionUnits.of(problem, space.low, space.high)
    if units is not None and units.kind == "normalized":
        raise ValueError(
            f"The env takes normalized inputs, from {space.low.tolist()} to {space.high.tolist()}, "
            f"and the MPC inputs from {problem.u_min.tolist()} to {problem.u_max.tolist()}. Wrap "
            "it in gymnasium.wrappers.RescaleAction(env, mpc.u_min, mpc.u_max)."
        )
    own = problem.deviations
    if units is None and own is not problem and ActionUnits.of(own, space.low, space.high):
        raise ValueError(
            f"The env takes deviations, from {space.low.tolist()} to {space.high.tolist()}, and "
            f"the MPC is in plant units, from {problem.u_min.tolist()} to {problem.u_max.tolist()}."
            " Leave x_ss and u_ss out of its model, or take the env in plant units."
        )
    if observation is None and not problem.units.shifted:
        return make
    return partial(_wrapped, make, problem.units, observation)


def _wrapped(
    make: Callable[[], gym.Env[Any, Any]], units: Units, observation: Map | None
) -> gym.Env[Any, Any]:
    return InDeviations(make(), units, observation)


def require_theta_shown(problem: LinearMPC, theta: Array) -> None:
    """Raise where theta (steps, n_theta), in deviations, was made of what are deviations already.

    Nor may references and measured disturbances lie beyond their box in nearly all steps.
    """
    shown = problem.units.to_plant(theta)
    if words := problem.shown_as_deviation(shown):
        raise ValueError(f"The env is not that of the MPC. {words}")
    room = 1e-3 * problem.theta_half
    most = 0.9  # share of the rows that must speak for it
    beyond = (shown < problem.theta_min - room) | (shown > problem.theta_max + room)
    for i in np.flatnonzero(np.mean(beyond, axis=0) >= most):
        if problem.model.n_states <= i < problem.layout.disturbance.stop:
            raise ValueError(
                f"{problem.labels()[i]} is {shown[0, i]:.6g}, and the MPC was solved for "
                f"{problem.theta_min[i]:.6g} to {problem.theta_max[i]:.6g}: give the wrapper that "
                "shows it the bounds of the MPC."
            )
