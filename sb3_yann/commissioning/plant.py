"""Episodes on the plant itself: an accepted policy acts, or the MPC, and a watchdog looks on."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from typing import Any, cast

import gymnasium as gym
import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._progress import bar
from sb3_yann._validation import Array, Feedback
from sb3_yann.commissioning.watchdog import Alarm, Watchdog
from sb3_yann.compare import EXCESS_ROOM
from sb3_yann.control.mpc.bound_excess import BoundNames, bound_excess
from sb3_yann.control.wrapper_stack import require_state_shown
from sb3_yann.env_pool import require_like
from sb3_yann.improvement.imitation import policy_of
from sb3_yann.improvement.simulator import Excited
from sb3_yann.policy.checks import LOST_STATISTICS
from sb3_yann.policy.observations import normalized
from sb3_yann.policy.policies import require_yann_policy
from sb3_yann.rollout import limit_of
from sb3_yann.twin.dynamics import law_of

ENDLESS = 1_000_000  # steps after which an episode is taken for one that never ends


@dataclass(frozen=True)
class PlantEpisode:
    """One episode as it was played.

    ``thetas`` (T + 1, n_theta) were measured, or estimated where that was not finite; ``actions``
    are (T, m), ``reward`` the plant's own, summed. ``violations`` counts steps with
    ``info["violation"]`` or beyond a hard bound, and an end that is no time limit; ``unsafe``
    those of them that were not allowed, see :meth:`Plant.play`. After ``step`` the MPC took over
    because of ``alarm``, -1 where it did not. ``apart`` is the largest distance of the policy's
    inputs from the MPC's, in input ranges. Where it was ``excited`` random steps were added to the
    MPC's inputs.
    """

    thetas: Array
    actions: Array
    reward: float
    violations: int
    alarm: Alarm | None
    step: int
    apart: float
    excited: bool = False
    unsafe: int = 0

    @property
    def usable_for_fitting(self) -> bool:
        """Whether it shows the plant as it is: no sensor and no actuator was doubted."""
        return self.alarm is None or self.alarm.kind == "violation"


class Plant:
    """A plant's env, and the two that may act on it: the MPC and the actor of a model."""

    def __init__(self, env: gym.Env[Any, Any], model: OffPolicyAlgorithm) -> None:
        self.env = env
        self.model = model
        self.yann = require_yann_policy(model.policy, "Commissioning")
        self.problem = self.yann.problem
        if model.get_vec_normalize_env() is None and getattr(model, "sees_normalized", False):
            raise ValueError(LOST_STATISTICS)  # before anything acts on the plant
        require_state_shown(env, self.yann.observation_given)
        require_like(env, model, "plant_env", "the model")
        self.mpc = law_of(self.problem)
        self.range = self.problem.deviations.u_max - self.problem.deviations.u_min
        units = self.yann.action_units
        self.as_is = units.kind == "plant" and not np.any(units.shift)

    def policy(self, theta: Array) -> Array:
        """Return the policy's inputs (rows, m); the MPC's where they are not finite."""
        u = policy_of(self.yann.actor.mu, self.problem)(theta)
        finite = np.isfinite(u)
        return u if finite.all() else np.where(finite, u, self.mpc(theta))

    def excited_mpc(self, seed: int, share: float) -> Feedback:
        """Return the MPC of one episode, moved at random by a share of the range at most."""
        moved = Excited(self.problem, seed, 2 * share)
        steps = count()
        within = self.problem.deviations.input_range

        def act(theta: Array) -> Array:
            return np.clip(moved(next(steps), theta, np.arange(len(theta))), *within(theta))

        return act

    def begin(self, seed: int) -> Array:
        """Reset the plant, and return the first theta (n_theta,).

        If it is not finite that is a ValueError: no prediction could take its place.
        """
        known = self._theta(self.env.reset(seed=seed)[0])
        if not np.isfinite(known).all():
            raise ValueError(
                f"The plant's first reading has {self._not_finite(known)}. Nothing has been "
                "played; mend the sensor, and run again."
            )
        return known

    def play(
        self, known: Array, act: Feedback, watchdog: Watchdog | None, allowed: float = np.inf
    ) -> PlantEpisode:
        """Play an episode from :meth:`begin`; after an alarm the MPC acts, from the very sample on.

        Until then it is ``act``: :meth:`policy`, `mpc` or :meth:`excited_mpc`. The policy may
        exceed a hard bound by the ``allowed`` half-widths, the MPC by any: what the plant reports
        alarms nobody where its size is known, and allowed.
        """
        if watchdog is not None:
            watchdog.start(known)
        thetas = [known]
        actions = list[Array]()
        reward = 0.0
        violations = unsafe = 0
        apart = 0.0
        excited = act not in (self.policy, self.mpc)
        alarm = None
        step = -1
        over = False
        space = cast(Any, self.env.action_space)
        passed = bar("an episode of the plant: steps", total=limit_of(self.env))
        while not over:
            u = act(known[None])[0].astype(np.float32)
            wanted = u if act == self.policy else self.policy(known[None])[0]
            law = self.mpc(known[None])[0]
            apart = max(apart, float(np.max(np.abs(wanted - law) / self.range)))
            action = u if self.as_is else self.yann.action_units.action(u).astype(np.float32)
            action = np.clip(action, space.low, space.high).astype(space.dtype)  # to the last bit
            observation, gained, terminated, truncated, info = self.env.step(action)
            over = terminated or truncated
            read = self._theta(observation)
            predicted = self.problem.deviations.predict(known, u.astype(np.float64))
            after = np.where(np.isfinite(read), read, predicted)
            beyond = bound_excess(self.problem, np.array([known, after]), u[None])
            excess = beyond.largest
            limit = allowed if act == self.policy else np.inf
            sized = EXCESS_ROOM < excess <= limit
            lost = terminated and not info.get("is_success", False)
            violated = bool(info.get("violation", False)) or lost
            forbidden = lost or bool(excess > limit) or (violated and not sized)
            reward += float(gained)
            violations += violated or bool(excess > EXCESS_ROOM)
            unsafe += forbidden
            if alarm is None:
                if not np.isfinite(read).all():
                    alarm = Alarm("not a number", f"It reads {self._not_finite(read)}.")
                elif excess > limit:
                    why = BoundNames.of(self.problem).in_words(float(beyond.worst), float(excess))
                    alarm = Alarm("violation", f"On the plant {why}.")
                elif forbidden:
                    why = "The plant reports a violation, or ends the episode."
                    alarm = Alarm("violation", why)
                elif watchdog is not None:
                    alarm = watchdog.watch(known, u.astype(np.float64), read)
                if alarm is not None:
                    step = len(actions)
                    act = self.mpc
            known = after
            passed.update()
            thetas.append(known)
            actions.append(u.astype(np.float64))
            if len(actions) >= ENDLESS:
                raise RuntimeError(f"An episode of the plant did not end in {ENDLESS} steps.")
        passed.close()
        played = np.array(thetas), np.array(actions)
        return PlantEpisode(*played, reward, violations, alarm, step, apart, excited, unsafe)

    def _theta(self, observation: Any) -> Array:
        """Return theta; NaN where it follows from a reading that is not finite."""
        seen = np.array(normalized(self.model, observation))
        lost = ~np.isfinite(seen)
        if not lost.any():
            return np.asarray(self.yann.theta(seen[None]).double().cpu().numpy()[0])
        both = np.stack([seen, seen])
        both[:, lost] = [[0.0], [1.0]]
        one, other = self.yann.theta(both).double().cpu().numpy()
        return np.where(one == other, one, np.nan)

    def _not_finite(self, theta: Array) -> str:
        """Return which entries are not finite, by name."""
        wrong = np.flatnonzero(~np.isfinite(theta))
        return ", ".join(f"{self.problem.labels()[i]} = {theta[i]}" for i in wrong)
