"""Callbacks: no action noise, episodes of a simulator beside the plant, diagnostics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._validation import Array, check_int, check_range, check_type, warn
from sb3_yann.control.wrapper_stack import require_state_shown
from sb3_yann.env_pool import EnvPool, Source, as_source, make_env, one_env, require_like_training
from sb3_yann.policy.exploring import Explores
from sb3_yann.policy.observations import normalized, require_frozen, require_same_statistics
from sb3_yann.policy.policies import StartsAsMPC, require_yann_policy
from sb3_yann.policy.sb3_hooks import watch_buffer
from sb3_yann.rollout import Rows, Trajectories, preserve_rng, rollout


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
        explores = isinstance(self.model.policy, Explores)
        kind = type(self.model).__name__
        if explores:
            warn(
                f"NoActionNoise turns nothing off here: {kind} adds no noise, its policy draws its "
                "actions. policy_kwargs={'initial_std': ...} says how far from the MPC's, and "
                "predict(..., deterministic=True) draws none."
            )
        # Here, not at the first step: SB3 draws the first action before it calls `_on_step`.
        if not hasattr(self.model, "replay_buffer"):
            if explores:
                return
            raise TypeError(
                f"NoActionNoise needs an off-policy algorithm, such as DDPG or TD3, not {kind}."
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

    Scalars, over the ended episodes that no dump has shown yet where nothing else is said:

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
        self._distances = list[float]()
        self._regions = list[int]()
        self._recorded = 0  # how many of them
        self._episodes = [list[tuple[Any, ...]]() for _ in range(self.training_env.num_envs)]

    def _on_step(self) -> bool:
        if "yann/violations" not in self.logger.name_to_value and self._recorded:
            # The logger was dumped, maybe in this step: what came since is still to show.
            del self._distances[: self._recorded], self._regions[: self._recorded]
            self._recorded = 0
        observations = np.asarray(self.model._last_obs)  # still s_t: SB3 advances it later
        # In [-1, 1]; on-policy algorithms call them otherwise.
        actions = self.locals.get("buffer_actions", self.locals["actions"])
        dones = self.locals["dones"]
        infos = self.locals["infos"]
        self.violations += sum(bool(info.get("violation", False)) for info in infos)
        for i, episode in enumerate(self._episodes):
            episode.append((observations[i], actions[i], self.locals["rewards"][i]))
            if dones[i]:
                self._record_episode(episode, infos[i])
                episode.clear()
        if not np.any(dones):
            return True
        if self._distances:
            self.logger.record("yann/distance_from_mpc_mean", float(np.mean(self._distances)))
            self.logger.record("yann/distance_from_mpc_max", float(np.max(self._distances)))
            self.logger.record("yann/region", int(np.bincount(self._regions).argmax()))
        self.logger.record("yann/regions_visited", len(set(self._regions)))
        self.logger.record("yann/violations", self.violations)
        self._recorded = len(self._distances)
        return True

    def _record_episode(self, episode: list[tuple[Any, ...]], info: dict[str, Any]) -> None:
        observations, actions, rewards = (np.array(part) for part in zip(*episode, strict=True))
        # At every step the law would take a tenth of the time of training.
        theta = self.policy.theta(observations)
        law = self.policy.actor.mu.law(theta).cpu().numpy()
        distances = np.max(np.abs(actions - law), axis=1) / 2
        known = np.isfinite(distances)  # the law knows none where an observation is not finite
        self._regions.extend(self.policy.actor.mu.regions(theta)[known].tolist())
        self._distances.extend(distances[known])
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


@dataclass
class Simulated:
    """How many episodes have been played, and whether another of training has ended since.

    It is saved with the model.
    """

    episodes: int = 0
    due: bool = True


class SimulatedEpisodes(BaseCallback):
    """Lets the policy learn from episodes of a simulator as well, and explores there alone.

    When training begins, and after each training episode, the policy as it is plays episodes in
    envs of its own, with noise and step tests. Their steps join those of the training env in the
    replay buffer, and none of its episodes changes. A simulator shows without harm what lies beyond
    other actions; the guard decides what is accepted. Half of the episodes, by chance, begin at its
    hard starts or where the last policy that it tried has lost: at their seeds, which are the same
    starts in the same simulator.

    Parameters
    ----------
    env : gymnasium.Env, str or callable
        The simulator: it shows and takes what the training env does, with its reward, and ends its
        episodes. A given env plays its episodes one after the other.
    per_episode : int, default 10
        Episodes in the simulator for each of training.
    step_tests : float, default 0.03
        Probability that a step test begins at a sample: an action drawn evenly from all of the
        action space, and held. A law on a bound goes on there whatever noise is added; this moves
        it away.
    max_hold_steps : int, default 15
        A step test lasts 1 to so many samples, drawn evenly.
    noise : float, default 0.1
        Standard deviation of normal noise on each action in [-1, 1] between step tests.
    seed : int, default 2_000_000
        Of the first episode in the simulator, from which the others count on, and of what is drawn.

    Raises
    ------
    TypeError, ValueError
        If the model has no YannPolicy, or the simulator is the training env or shaped otherwise.

    Examples
    --------
    >>> from stable_baselines3 import DDPG
    >>> from sb3_yann import NoActionNoise, SimulatedEpisodes
    >>> model = DDPG("YannPolicy", "CSTR-v0", device="cpu", learning_starts=500)
    >>> simulated = SimulatedEpisodes("CSTR-v0", per_episode=2)
    >>> model.learn(3, callback=[NoActionNoise(), simulated]).replay_buffer.size()
    803
    """

    model: OffPolicyAlgorithm

    def __init__(
        self,
        env: Source,
        per_episode: int = 10,
        step_tests: float = 0.03,
        max_hold_steps: int = 15,
        noise: float = 0.1,
        seed: int = 2_000_000,
    ) -> None:
        super().__init__()
        self.env = as_source(env)
        self.per_episode = check_int("per_episode", per_episode)
        self.step_tests = check_range("step_tests", step_tests, 0, 1)
        self.max_hold_steps = check_int("max_hold_steps", max_hold_steps)
        self.noise = check_range("noise", noise, 0, np.inf)
        self.seed = check_int("seed", seed, 0)
        # Single envs, whose steps are the training env's: copies that step as one may round.
        given = isinstance(self.env, gym.Env)
        self._pool = EnvPool(self.env if given else partial(make_env, self.env))

    @property
    def state(self) -> Simulated:
        """How far the model has got."""
        return vars(self.model).setdefault("simulated", Simulated())  # type: ignore[no-any-return]

    def _init_callback(self) -> None:
        self.policy = require_yann_policy(self.model.policy, "SimulatedEpisodes")
        check_type("model", self.model, OffPolicyAlgorithm, "one with a replay buffer")
        if getattr(self.model.replay_buffer, "optimize_memory_usage", False):
            raise ValueError(
                "optimize_memory_usage=True keeps the next observation as that of the next row, "
                "which here may be a simulator's. Build the model without it."
            )
        watch_buffer(self.model)

    def _on_training_start(self) -> None:
        with preserve_rng():
            require_like_training(self._pool, self.training_env, "The simulator")
            with one_env(self._pool) as env:
                require_state_shown(env, self.policy.observation_given)

    def _on_rollout_start(self) -> None:  # what was last seen of the plant is in the buffer now
        if self.state.due:
            self.state.due = False
            self.play()

    def _on_step(self) -> bool:
        self.state.due |= bool(np.any(self.locals["dones"]))
        return True

    def _on_training_end(self) -> None:
        self._pool.close()

    def play(self) -> None:
        """Play episodes, and put their steps into the replay buffer."""
        first = self.seed + self.state.episodes
        count = max(self.per_episode, self.training_env.num_envs)  # a column of the buffer has one
        drawn = [np.random.default_rng([self.seed, k]) for k in range(first, first + count)]
        seeds = [self._start(first + i, rng) for i, rng in enumerate(drawn)]
        explore = [_Exploration(self, rng) for rng in drawn]
        scaled: list[list[Array]] = [[] for _ in seeds]

        def act(t: int, observations: NDArray[Any], rows: Rows) -> NDArray[Any]:
            actions, _ = self.policy.predict(
                normalized(self.model, observations), deterministic=True
            )
            own = np.asarray(self.policy.scale_action(actions), np.float64)
            for i, action in zip(rows, own, strict=True):
                scaled[i].append(explore[i](action))
            return self.policy.unscale_action(np.array([scaled[i][-1] for i in rows]))

        with preserve_rng():
            played = rollout(act, self._pool, seeds)
        self.state.episodes += len(seeds)
        self._add(played, scaled)

    def _start(self, seed: int, rng: np.random.Generator) -> int:
        """Return a new seed, or with even odds one of the starts that a guard has seen lost."""
        state: Any = getattr(self.model, "guard_state", None)
        lost = state.evidence.to_learn if state else ()
        return int(rng.choice(lost)) if lost and rng.random() < 0.5 else seed

    def _add(self, played: Trajectories, scaled: Sequence[Sequence[Array]]) -> None:
        """Add the episodes to the buffer, one after the other in each of its columns."""
        buffer: Any = self.model.replay_buffer
        if buffer.size():  # what else is under way in the training env goes on behind these rows
            last = buffer.pos - 1
            buffer.timeouts[last] = np.maximum(buffer.timeouts[last], buffer.dones[last] == 0)
        columns: list[list[tuple[Any, ...]]] = [[] for _ in range(buffer.n_envs)]
        for k, actions in enumerate(scaled):
            shown = played.observations[k]
            for t, u in enumerate(actions):
                over = t == len(actions) - 1
                earned = np.float32(played.rewards[k][t])
                step = shown[t], shown[t + 1], u, earned, over, over and played.truncated[k]
                columns[k % len(columns)].append(step)
        length = min(map(len, columns))
        for t, steps in enumerate(zip(*columns, strict=False)):  # longer columns end there
            obs, after, u, reward, done, stopped = map(np.array, zip(*steps, strict=True))
            if t == length - 1:
                stopped = stopped | ~done
                done = np.ones(len(columns), dtype=bool)
            infos = [{"TimeLimit.truncated": bool(each)} for each in stopped]
            buffer.add(obs, after, u, reward, done, infos)


@dataclass
class _Exploration:
    """What acts in one episode in the place of the policy's actions."""

    settings: SimulatedEpisodes
    rng: np.random.Generator
    left: int = 0  # samples of a step test

    def __call__(self, action: Array) -> Array:
        """Return an action in [-1, 1], shape (m,)."""
        if self.left == 0 and self.rng.random() < self.settings.step_tests:
            self.left = int(self.rng.integers(1, self.settings.max_hold_steps + 1))
            self.held = self.rng.uniform(-1, 1, action.shape)
        if self.left > 0:
            self.left -= 1
            return self.held
        noise = self.settings.noise * self.rng.standard_normal(action.shape)
        return np.clip(action + noise, -1, 1)
