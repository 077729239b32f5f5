"""Callbacks: no action noise, and what a control engineer wants to see in tensorboard."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann.policy.exploring import Explores
from sb3_yann.policy.observations import require_frozen, require_same_statistics
from sb3_yann.policy.policies import StartsAsMPC, require_yann_policy
from sb3_yann.policy.sb3_hooks import watch_buffer


class NoActionNoise(BaseCallback):
    """Lets the policy act alone, from the first step of every `learn` on.

    It removes the model's action noise, and its random first actions (``learning_starts`` is 0).
    Both stay off after `learn` returns. TD3's smoothing of the *target* policy stays.

    Examples
    --------
    >>> from stable_baselines3 import DDPG
    >>> model = DDPG("YannPolicy", "CSTR-v0", device="cpu").learn(2, callback=NoActionNoise())
    >>> model.learning_starts
    0
    """

    model: OffPolicyAlgorithm

    def _init_callback(self) -> None:
        if isinstance(self.model.policy, Explores):
            warnings.warn(
                f"NoActionNoise turns nothing off here: {type(self.model).__name__} adds no noise, "
                "its policy draws its actions. policy_kwargs={'initial_std': ...} says how far "
                "from the MPC's, and predict(..., deterministic=True) draws none.",
                stacklevel=2,
            )
        # Here, not at the first step: SB3 draws the first action before it calls `_on_step`.
        if not hasattr(self.model, "replay_buffer"):
            if isinstance(self.model.policy, Explores):
                return
            raise TypeError(
                "NoActionNoise needs an off-policy algorithm, such as DDPG or TD3, not "
                f"{type(self.model).__name__}."
            )
        self.model.action_noise = None
        self.model.learning_starts = 0
        if isinstance(self.model.policy, StartsAsMPC):
            watch_buffer(self.model)  # another one may have been loaded since
            require_same_statistics(self.model)

    def _on_rollout_start(self) -> None:
        normalize = self.model.get_vec_normalize_env()
        if normalize is not None and isinstance(self.model.policy, StartsAsMPC):
            require_frozen(normalize)

    def _on_step(self) -> bool:
        return True


class ControlDiagnostics(BaseCallback):
    """Records what SB3 does not: how far the policy is from its MPC, and whether limits held.

    Scalars, over the steps since the last dump where nothing else is said:

    - ``yann/distance_from_mpc_mean``, ``yann/distance_from_mpc_max``: distance of the executed
      action from the MPC's, as a fraction of the input range (largest over the inputs).
    - ``yann/region``: the region that was in use most often; ``yann/regions_visited``: how many.
    - ``yann/violations``: steps with ``info["violation"]``, since the start of this `learn`.
    - ``yann/critic_error``: mean of ``|Q(s, a) - G|`` over the last finished episode, relative to
      that of ``|G|``. G is the discounted return that followed; where the episode was cut off, the
      critic's value of its last state is added.

    Examples
    --------
    >>> from stable_baselines3 import DDPG
    >>> model = DDPG("YannPolicy", "CSTR-v0", device="cpu")
    >>> _ = model.learn(10, callback=[NoActionNoise(), ControlDiagnostics()])
    """

    model: OffPolicyAlgorithm

    def _init_callback(self) -> None:
        self.policy = require_yann_policy(self.model.policy, "ControlDiagnostics")
        watch_buffer(self.model)
        self.violations = 0
        self._forget()
        n_envs = self.training_env.num_envs
        self._episodes: list[list[tuple[Any, ...]]] = [[] for _ in range(n_envs)]

    def _on_step(self) -> bool:
        if "yann/violations" not in self.logger.name_to_value and self._recorded:
            self._forget()  # the logger was dumped
        observations = np.asarray(self.model._last_obs)  # still s_t: SB3 advances it later
        # In [-1, 1]; on-policy algorithms call them otherwise.
        actions = self.locals.get("buffer_actions", self.locals["actions"])
        layer = self.policy.actor.mu
        with th.no_grad():
            theta = self.policy.theta(observations)
            law = layer.law(theta).cpu().numpy()
            regions = layer.regions(theta)
        distances = np.max(np.abs(actions - law), axis=1) / 2
        known = np.isfinite(distances)  # the law knows none where an observation is not finite
        self._regions.extend(regions[known].tolist())
        self._distances.extend(distances[known])
        dones = self.locals["dones"]
        infos = self.locals["infos"]
        self.violations += sum(bool(info.get("violation", False)) for info in infos)
        for i, episode in enumerate(self._episodes):
            episode.append((observations[i], actions[i], self.locals["rewards"][i]))
            if dones[i]:
                self._record_critic_error(episode, infos[i])
                episode.clear()
        if np.any(dones):
            self._record()
        return True

    def _forget(self) -> None:
        self._distances: list[float] = []
        self._regions: list[int] = []
        self._recorded = False

    def _record(self) -> None:
        if self._distances:
            self.logger.record("yann/distance_from_mpc_mean", float(np.mean(self._distances)))
            self.logger.record("yann/distance_from_mpc_max", float(np.max(self._distances)))
            self.logger.record("yann/region", int(np.bincount(self._regions).argmax()))
        self.logger.record("yann/regions_visited", len(set(self._regions)))
        self.logger.record("yann/violations", self.violations)
        self._recorded = True

    def _record_critic_error(self, episode: list[tuple[Any, ...]], info: dict[str, Any]) -> None:
        observations, actions, rewards = (np.array(part) for part in zip(*episode, strict=True))
        value = 0.0
        if info.get("TimeLimit.truncated", False):
            last = np.asarray(info["terminal_observation"])[None]
            obs = th.as_tensor(last, device=self.model.device)
            value = float(self._value(last, self.policy.actor(obs).detach())[0])
        returns = np.empty(len(rewards))
        for t in reversed(range(len(rewards))):
            returns[t] = value = rewards[t] + self.model.gamma * value
        error = np.abs(self._value(observations, actions) - returns)
        size = max(float(np.abs(returns).mean()), 1e-30)
        if math.isfinite(found := float(error.mean()) / size):
            self.logger.record("yann/critic_error", found)

    def _value(self, observations: Any, actions: Any) -> NDArray[np.float32]:
        """Return the first critic's Q, shape (batch,), of quantiles their mean."""
        with th.no_grad():
            q = self.policy.critic.q1_forward(
                th.as_tensor(observations, device=self.model.device),
                th.as_tensor(actions, dtype=th.float32, device=self.model.device),
            )
        return np.asarray(q.cpu().numpy().mean(axis=1))
