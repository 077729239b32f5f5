"""Learning from a simulator beside the plant: there noise harms nobody."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._validation import Array, check_int, check_range, check_type
from sb3_yann.control.linearization.wrapper_stack import require_state_shown
from sb3_yann.policy.observations import normalized
from sb3_yann.policy.policies import require_yann_policy
from sb3_yann.policy.sb3_hooks import watch_buffer
from sb3_yann.rollout import (
    EnvPool,
    Rows,
    Source,
    Trajectories,
    as_source,
    make_env,
    one_env,
    preserve_rng,
    require_like_training,
    rollout,
)


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
    other actions; the guard decides what is accepted.

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
        check_int("per_episode", per_episode)
        check_range("step_tests", step_tests, 0, 1)
        check_int("max_hold_steps", max_hold_steps)
        check_range("noise", noise, 0, np.inf)
        check_int("seed", seed, 0)
        self.env = as_source(env)
        self.per_episode = per_episode
        self.seed = seed
        self.step_tests = step_tests
        self.max_hold_steps = max_hold_steps
        self.noise = noise
        # Single envs, whose steps are the training env's: copies that step as one may round.
        given = isinstance(self.env, gym.Env)
        self._pool = EnvPool(self.env if given else lambda: make_env(self.env))

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

    @property
    def _count(self) -> int:
        """Number of episodes at a time: one at least for each column of the replay buffer."""
        return max(self.per_episode, self.training_env.num_envs)

    def play(self) -> None:
        """Play episodes, and put their steps into the replay buffer."""
        first = self.seed + self.state.episodes
        seeds = range(first, first + self._count)
        explore = [_Exploration(self, np.random.default_rng([self.seed, k])) for k in seeds]
        scaled: list[list[Array]] = [[] for _ in seeds]
        space: Any = self.model.action_space

        def act(t: int, observations: NDArray[Any], rows: Rows) -> NDArray[Any]:
            actions, _ = self.policy.predict(
                normalized(self.model, observations), deterministic=True
            )
            own = np.asarray(self.policy.scale_action(actions), np.float64)
            for i, action in zip(rows, own, strict=True):
                scaled[i].append(explore[i](action))
            taken = self.policy.unscale_action(np.array([scaled[i][-1] for i in rows]))
            return np.clip(taken.astype(space.dtype), space.low, space.high)  # to the last bit

        with preserve_rng():
            played = rollout(act, self._pool, seeds)
        self.state.episodes += len(seeds)
        self._add(played, scaled)

    def _add(self, played: Trajectories, scaled: Sequence[Sequence[Array]]) -> None:
        """Add the episodes to the buffer, one after the other in each of its columns."""
        buffer: Any = self.model.replay_buffer
        if buffer.size():  # what else is under way in the training env goes on behind these rows
            last = buffer.pos - 1
            buffer.timeouts[last] = np.maximum(buffer.timeouts[last], buffer.dones[last] == 0)
        n = buffer.n_envs
        columns = []
        for i in range(n):
            own = range(i, len(scaled), n)
            over = [np.arange(1, length + 1) == length for length in played.lengths[own]]
            cuts = [each & bool(played.truncated[k]) for k, each in zip(own, over, strict=True)]
            parts = (
                [played.observations[k][:-1] for k in own],
                [played.observations[k][1:] for k in own],
                [np.array(scaled[k]) for k in own],
                [played.rewards[k].astype(np.float32) for k in own],
                over,
                cuts,
            )
            columns.append([np.concatenate(each) for each in parts])
        length = min(len(column[0]) for column in columns)
        for k in range(length):
            obs, after, u, reward, done, stopped = (
                np.array([column[part][k] for column in columns]) for part in range(6)
            )
            if k == length - 1:  # longer columns end here
                stopped = stopped | ~done
                done = np.ones(n, dtype=bool)
            infos = [{"TimeLimit.truncated": bool(each)} for each in stopped]
            buffer.add(obs, after, u, reward, done, infos)


class _Exploration:
    """What acts in one episode in the place of the policy's actions."""

    def __init__(self, settings: SimulatedEpisodes, rng: np.random.Generator) -> None:
        self.settings = settings
        self.rng = rng
        self.left = 0  # samples of a step test
        self.held: Array = np.zeros(0)

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
