"""A twin as a Gymnasium env, with the plant's spaces."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array, check_int
from sb3_yann.compare import EXCESS_ROOM
from sb3_yann.control import StateEstimator
from sb3_yann.control.mpc.bound_excess import bound_excess
from sb3_yann.twin.dynamics import Dynamics
from sb3_yann.twin.limits import Limits
from sb3_yann.twin.log import Episode
from sb3_yann.twin.starts import Starts
from sb3_yann_envs.spaces import ProblemBox

Single = NDArray[np.float32]


class TwinEnv(gym.Env[Single, Single]):
    """Episodes of a member of a twin: theta is observed, the reward is minus the stage cost.

    Theta and inputs are in plant units where the problem's model has an operating point.

    ``info["excess"]`` and ``info["penalty"]`` are those of
    :class:`~sb3_yann.wrappers.StageCost`, and an excess is a violation.

    An episode begins in the box of the log's first states, takes the references and disturbances of
    one of its episodes, and lasts as long. ``info["violation"]`` reports a state beyond the
    problem's bounds, or outside what the log shows: there the twin knows nothing.

    :meth:`PlantTwin.env` makes one.

    Parameters
    ----------
    dynamics : Dynamics
        The members.
    episodes : tuple of Episode
        The log.
    starts : Starts
        Where episodes begin.
    limits : Limits
        Beyond which there is a violation.
    member : int, optional
        The member that acts; by default the seed of an episode decides: seed modulo members.
    """

    metadata: dict[str, Any] = {"render_modes": []}
    observation_space: ProblemBox

    def __init__(
        self,
        dynamics: Dynamics,
        episodes: tuple[Episode, ...],
        starts: Starts,
        limits: Limits,
        member: int | None = None,
    ) -> None:
        members = len(dynamics.members)
        if member is not None and check_int("member", member, 0) >= members:
            raise ValueError(f"member = {member} must be below {members}, how many there are.")
        self.dynamics, self.episodes, self.starts, self.limits = dynamics, episodes, starts, limits
        self.member, self.render_mode, problem = member, None, dynamics.problem
        low, high = (each.astype(np.float32) for each in (problem.theta_min, problem.theta_max))
        self.observation_space = ProblemBox(low, high, problem=problem)
        u_min, u_max = (each.astype(np.float32) for each in (problem.u_min, problem.u_max))
        self.action_space = gym.spaces.Box(u_min, u_max)
        self._theta: Array | None = None  # a row

    @property
    def observer(self) -> StateEstimator | None:
        """The observer that is a part of the twin, None where there is none."""
        return self.dynamics.row.estimator

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Single, dict[str, Any]]:
        """Start an episode, from a random theta or ``options["state"]``, (n,) or (n_theta,)."""
        super().reset(seed=seed)
        problem, members = self.dynamics.problem, self.dynamics.members
        acting = int(self.np_random.integers(len(members)))
        if self.member is not None:
            acting = self.member
        elif seed is not None:
            acting = seed % len(members)
        self._acting = Dynamics(problem, self.dynamics.coordinates, (members[acting],))
        self._episode = self.episodes[int(self.np_random.integers(len(self.episodes)))]
        row = self.dynamics.row
        theta = row.shown(self._episode.thetas[0]).copy()
        state = problem.layout.state
        units = problem.units
        theta[state] = self.starts.draw(1, self.np_random)[0, state]
        if options:
            given = np.asarray(options.get("state"), np.float64)
            if given.shape not in ((problem.model.n_states,), (problem.n_theta,)):
                sizes = f"({problem.model.n_states},) or ({problem.n_theta},)"
                raise ValueError(f"options['state'] has shape {given.shape}, expected {sizes}.")
            if not np.all(np.isfinite(given)):
                raise ValueError(f"options['state'] = {given.tolist()} must be finite numbers.")
            theta[: len(given)] = units.to_deviations(given)
        self._theta, self._steps = row.begin(theta), 0
        shown = units.to_plant(theta)
        return shown.astype(np.float32), {"state": shown.copy(), "member": acting}

    def step(self, action: Single) -> tuple[Single, float, bool, bool, dict[str, Any]]:
        """Hold an input, clipped to its bounds, for one sample."""
        if self._theta is None:
            raise gym.error.ResetNeeded("Call env.reset() before env.step().")
        u = np.asarray(action, np.float64)
        if u.shape != self.action_space.shape or not np.all(np.isfinite(u)):
            wanted = f"{self.action_space.shape} finite numbers"
            raise ValueError(f"action = {action!r} must be {wanted}.")
        row, units = self.dynamics.row, self.dynamics.problem.units
        problem = self.dynamics.problem.deviations
        u = np.clip(units.input_to_deviations(u), problem.u_min, problem.u_max)
        before = self._theta
        after = self._acting.step(before[None, None], u[None, None])[0, 0]
        self._steps += 1
        if self._steps < len(self._episode.thetas):
            after[row.given] = self._episode.thetas[self._steps, row.given]
        self._theta = after
        beyond = bound_excess(problem, row.shown(np.array([before, after])), u[None])
        excess = float(beyond.largest)
        theta = units.to_plant(row.shown(after))
        cost = float(problem.stage_cost(row.shown(before), u))
        info = {
            "cost": cost,
            "violation": bool(self.limits.violated(after)) or excess > EXCESS_ROOM,
            "excess": excess,
            "penalty": float(beyond.penalty),
            "state": theta,
        }
        over = self._steps >= len(self._episode)
        return theta.astype(np.float32), -cost, False, over, info
