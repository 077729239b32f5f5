"""The reward that the critic is exact for: minus the stage cost of the problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, check_number, check_type
from sb3_yann.compare import EXCESS_ROOM
from sb3_yann.control import LinearMPC
from sb3_yann.control.mpc.bound_excess import Bounds, bound_excess
from sb3_yann.units import ActionUnits
from sb3_yann.wrappers.spaces import Env, Vector, require_vector


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
    observation : AffineObservation or mapping, optional
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
        observation: Callable[[ArrayLike], Array] | Mapping[str, ArrayLike] | None = None,
    ) -> None:
        space = require_vector(env, "observation_space")
        super().__init__(env)
        check_type("problem", problem, LinearMPC, "a LinearMPC, such as that of the policy")
        self.inputs = require_vector(env, "action_space")
        names = problem.layout.names
        units = ActionUnits.of(problem, self.inputs.low, self.inputs.high)
        u_ss = problem.model.u_ss
        self.units = units or ActionUnits("plant", np.ones_like(u_ss), u_ss.copy())
        if observation is not None and not callable(observation):
            from sb3_yann.policy.observations import as_observation  # loads PyTorch

            observation = as_observation(observation, problem)
        self.seen: Callable[[ArrayLike], Array] = observation or _as_it_is
        shape = np.shape(self.seen(np.zeros(space.shape)))
        if shape != (problem.n_theta,):
            what = "The observation" if observation is None else "What the map makes of it"
            raise ValueError(
                f"{what} has shape {shape}, but theta = [{', '.join(names)}] has "
                f"{problem.n_theta} entries. Wrap the env so that it shows all, in this order, or "
                "pass observation=AffineObservation(matrix, offset)."
            )
        self.problem, self.violation_cost = problem, check_number("violation_cost", violation_cost)
        self.bounds = Bounds.of(problem)
        self.theta: Array = np.zeros(problem.n_theta)

    def reset(self, **kwargs: Any) -> tuple[Vector, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(**kwargs)
        shape = np.shape(observation)
        declared = self.observation_space.shape
        if shape != declared:
            raise ValueError(
                f"The env's reset returned an observation of shape {shape}, and its "
                f"observation_space has {declared}: return a vector, such as np.ravel(observation)."
            )
        self.theta = self.problem.units.to_deviations(self.seen(observation))
        return observation, info

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Step; the reward is the one of this wrapper."""
        u = np.clip(np.asarray(action, np.float64), self.inputs.low, self.inputs.high)
        u = self.units.input(u)
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


def _as_it_is(observation: ArrayLike) -> Array:
    """Return the observation as theta."""
    return np.asarray(observation, np.float64)
