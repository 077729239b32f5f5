"""Episodes on the plant itself: an accepted policy acts, or the MPC, and a watchdog looks on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._validation import Array
from sb3_yann.commissioning.watchdog import Alarm, Watchdog
from sb3_yann.compare import EXCESS_ROOM
from sb3_yann.control.linearization.wrapper_stack import require_state_shown
from sb3_yann.control.mpc.bound_excess import BoundNames, bound_excess
from sb3_yann.improvement.imitation import policy_of
from sb3_yann.improvement.simulator import Excited
from sb3_yann.policy.observations import normalized
from sb3_yann.policy.policies import require_yann_policy
from sb3_yann.twin.dynamics import law_of
from sb3_yann.twin.replay_buffer import normalization_of

Inputs = Callable[[Array], Array]
LONGEST = 1_000_000
"""Steps after which an episode is taken for one that never ends."""


@dataclass(frozen=True)
class PlantEpisode:
    """One episode as it was played.

    Attributes
    ----------
    thetas, actions : ndarray, shapes (T + 1, n_theta) and (T, m)
        What was measured (estimates, where it was not finite), and the inputs.
    reward : float
        The plant's own, summed.
    violations : int
        Steps with ``info["violation"]`` or too large an excess over a hard bound of the problem,
        and an end that is no time limit.
    alarm : Alarm or None
        Why the MPC took over.
    step : int
        The step after which it did, -1 where it did not.
    apart : float
        The largest distance of the policy's inputs from the MPC's, in input ranges, whichever of
        them acted.
    excited : bool
        Whether random steps were added to the MPC's inputs: its cost is not the MPC's.
    """

    thetas: Array
    actions: Array
    reward: float
    violations: int
    alarm: Alarm | None
    step: int
    apart: float
    excited: bool = False

    @property
    def usable_for_fitting(self) -> bool:
        """Whether it shows the plant as it is: no sensor and no actuator was doubted."""
        return self.alarm is None or self.alarm.kind == "violation"


class Plant:
    """A plant's env, and the two that may act on it.

    Parameters
    ----------
    env : gymnasium.Env
    model : DDPG or TD3
        Its actor is the policy.
    """

    def __init__(self, env: gym.Env[Any, Any], model: OffPolicyAlgorithm) -> None:
        self.env, self.model = env, model
        self.yann = require_yann_policy(model.policy, "Commissioning")
        self.problem = self.yann.problem
        normalization_of(model)  # or raise, before anything acts on the plant
        require_state_shown(env, self.yann.observation_given)
        for name in ("observation_space", "action_space"):
            own, its = getattr(model, name), getattr(env, name)
            if own.shape != its.shape or (
                name == "action_space"
                and not np.allclose([own.low, own.high], [its.low, its.high], rtol=1e-4)
            ):
                raise ValueError(
                    f"plant_env has {name} = {its}, the model {own}: it is another plant."
                )
        self.law, self.device = law_of(self.problem), self.yann.device
        self.range = self.problem.deviations.u_max - self.problem.deviations.u_min
        units = self.yann.action_units
        self.as_is = units.kind == "plant" and not np.any(units.shift)

    def policy(self, theta: Array) -> Array:
        """Return the policy's inputs (rows, m); the MPC's where they are not finite."""
        layer = self.yann.actor.mu
        if self.device.type == "cpu":
            u = policy_of(layer, self.problem)(theta)
        else:
            with th.no_grad():
                actions = layer(th.as_tensor(theta, device=self.device)).double().cpu().numpy()
            u = (
                self.problem.deviations.u_max + self.problem.deviations.u_min
            ) / 2 + self.range / 2 * actions
        finite = np.isfinite(u)
        return u if finite.all() else np.where(finite, u, self.mpc(theta))

    def mpc(self, theta: Array) -> Array:
        """Return the MPC's inputs (rows, m)."""
        return self.law(theta)

    def excited_mpc(self, seed: int, share: float) -> Inputs:
        """Return the MPC of one episode, moved at random by a share of the range at most."""
        moved, steps = Excited(self.problem, seed, 2 * share), count()
        within = self.problem.deviations.input_range

        def act(theta: Array) -> Array:
            return np.clip(moved(next(steps), theta, np.arange(len(theta))), *within(theta))

        return act

    def begin(self, seed: int) -> Array:
        """Reset the plant, and return the first theta (n_theta,).

        Raises
        ------
        ValueError
            If it is not finite: no prediction could take its place.
        """
        known = self._theta(self.env.reset(seed=seed)[0])
        if not np.isfinite(known).all():
            raise ValueError(
                f"The plant's first reading has {self._not_finite(known)}. Nothing has been "
                "played; mend the sensor, and run again."
            )
        return known

    def play(
        self,
        known: Array,
        act: Inputs,
        watchdog: Watchdog | None,
        allowed: float = np.inf,
    ) -> PlantEpisode:
        """Play an episode; after an alarm the MPC acts, from the very sample on.

        Parameters
        ----------
        known : ndarray, shape (n_theta,)
            From :meth:`begin`.
        act : callable
            The one that acts until then: :meth:`policy`, :meth:`mpc` or :meth:`excited_mpc`.
        watchdog : Watchdog, optional
            Without one only violations and readings that are not finite are seen.
        allowed : float, optional
            Half-widths by which the policy may exceed a hard bound of the problem. A violation that
            the plant reports is none where its size is known, and allowed.
        """
        if watchdog is not None:
            watchdog.start(known)
        thetas, actions, reward, violations, apart = [known], list[Array](), 0.0, 0, 0.0
        excited = act not in (self.policy, self.mpc)
        alarm, step, over, space = None, -1, False, cast(Any, self.env.action_space)
        while not over:
            u = act(known[None])[0].astype(np.float32)
            wanted = u if act == self.policy else self.policy(known[None])[0]
            law = self.mpc(known[None])[0]
            apart = max(apart, float(np.max(np.abs(wanted - law) / self.range)))
            action = u if self.as_is else self.yann.action_units.action(u).astype(np.float32)
            action = np.clip(action, space.low, space.high).astype(space.dtype)  # to the last bit
            observation, gained, terminated, over, info = self.env.step(action)
            over, read = over or terminated, self._theta(observation)
            after = self._known(known, u, read)
            beyond = bound_excess(self.problem, np.array([known, after]), u[None])
            excess = beyond.largest
            limit = allowed if act == self.policy else np.inf
            sized = EXCESS_ROOM < excess <= limit
            reported = bool(info.get("violation", False)) and not sized
            unsafe = reported or terminated or bool(excess > limit)
            reward, violations = reward + float(gained), violations + unsafe
            if alarm is None:
                why = "The plant reports a violation, or ends the episode." if unsafe else ""
                if excess > limit:
                    names = BoundNames.of(self.problem)
                    why = f"On the plant {names.in_words(float(beyond.worst), float(excess))}."
                found = self._look(watchdog, known, u, read, why)
                if found is not None:
                    alarm, step, act = found, len(actions), self.mpc
            known = after
            thetas.append(known)
            actions.append(u.astype(np.float64))
            if len(actions) >= LONGEST:
                raise RuntimeError(f"An episode of the plant did not end in {LONGEST} steps.")
        played = np.array(thetas), np.array(actions)
        return PlantEpisode(*played, reward, violations, alarm, step, apart, excited)

    def _theta(self, observation: Any) -> Array:
        seen = normalized(self.model, observation)
        return np.asarray(self.yann.theta(np.asarray(seen)[None]).double().cpu().numpy()[0])

    def _known(self, before: Array, u: Array, read: Array) -> Array:
        """Return a reading, with the model's prediction in place of what is not finite."""
        if np.isfinite(read).all():
            return read
        predicted = np.asarray(self.problem.deviations.predict(before, u.astype(np.float64)))
        return np.where(np.isfinite(read), read, predicted)

    def _look(
        self, watchdog: Watchdog | None, known: Array, u: Array, read: Array, why: str
    ) -> Alarm | None:
        if not np.isfinite(read).all():
            return Alarm("not a number", f"It reads {self._not_finite(read)}.")
        if why:
            return Alarm("violation", why)
        if watchdog is None:
            return None
        return watchdog.watch(known, u.astype(np.float64), read)

    def _not_finite(self, theta: Array) -> str:
        """Return which entries are not finite, by name."""
        wrong = np.flatnonzero(~np.isfinite(theta))
        return ", ".join(f"{self.problem.labels()[i]} = {theta[i]}" for i in wrong)
