"""Learning from a simulator beside the plant: there noise harms nobody."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._validation import Array, check_int, check_range
from sb3_yann.control.linearization.wrapper_stack import require_state_shown
from sb3_yann.evaluation.episodes import Source, as_source, make_env, watch_length
from sb3_yann.policy._finite import watch_buffer
from sb3_yann.policy.policies import require_yann_policy


@dataclass
class Simulated:
    """How far a model has got, which is saved with it.

    Attributes
    ----------
    episodes : int, that have been played
    due : bool, whether a training episode has ended since
    """

    episodes: int = 0
    due: bool = True


class _Row(NamedTuple):
    observation: Any
    next_observation: Any
    action: Array
    reward: float
    done: bool
    truncated: bool


class SimulatedEpisodes(BaseCallback):
    """Lets the policy learn from episodes of a simulator as well, and explores there alone.

    When training begins, and after each training episode, the policy as it is plays episodes in
    envs of its own, with noise and step tests. Their steps join those of the training env in the
    replay buffer, and none of its episodes changes: the plant meets the policy alone. What the
    buffer holds of a simulator, :meth:`PlantTwin.from_buffer` leaves out.

    A policy that acts without noise sees little but what it does already. Where the way to a better
    one leads through other actions, a simulator shows them without harm. It may differ from the
    plant, as the model of the MPC does: the guard decides what is accepted.

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
    longest : int, default 15
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
        longest: int = 15,
        noise: float = 0.1,
        seed: int = 2_000_000,
    ) -> None:
        super().__init__()
        check_int("per_episode", per_episode)
        check_range("step_tests", step_tests, 0, 1)
        check_int("longest", longest)
        check_range("noise", noise, 0, np.inf)
        check_int("seed", seed, 0)
        self.env, self.per_episode, self.seed = as_source(env), per_episode, seed
        self.step_tests, self.longest, self.noise = step_tests, longest, noise
        self._envs: list[gym.Env[Any, Any]] = []

    @property
    def state(self) -> Simulated:
        """How far the model has got."""
        return vars(self.model).setdefault("simulated", Simulated())  # type: ignore[no-any-return]

    def _init_callback(self) -> None:
        self.policy = require_yann_policy(self.model.policy, "SimulatedEpisodes")
        if getattr(self.model.replay_buffer, "optimize_memory_usage", False):
            raise ValueError(
                "optimize_memory_usage=True keeps the next observation as that of the next row, "
                "which here may be a simulator's. Build the model without it."
            )
        watch_buffer(self.model)

    def _on_training_start(self) -> None:
        training = self.training_env
        self._envs = [self.env] if isinstance(self.env, gym.Env) else []
        with _same_random_states():
            while not isinstance(self.env, gym.Env) and len(self._envs) < self._count:
                self._envs.append(make_env(self.env))
        own = [each.unwrapped for each in getattr(training, "envs", [])]
        if any(env.unwrapped is each for env in self._envs for each in own):
            raise ValueError(
                "The simulator is the training env, whose episodes its own would interrupt. Give "
                "it another one, e.g. its id."
            )
        ours, theirs = self._envs[0], training
        require_state_shown(ours, self.policy.told)
        if (
            ours.observation_space.shape != theirs.observation_space.shape
            or ours.action_space != theirs.action_space
        ):
            raise ValueError(
                f"The simulator has observations of shape {ours.observation_space.shape} and "
                f"{ours.action_space}, the training env {theirs.observation_space.shape} and "
                f"{theirs.action_space}. Give it a simulator of this plant."
            )

    def _on_rollout_start(self) -> None:  # what was last seen of the plant is in the buffer now
        if self.state.due:
            self.state.due = False
            self.play()

    def _on_step(self) -> bool:
        self.state.due |= bool(np.any(self.locals["dones"]))
        return True

    def _on_training_end(self) -> None:
        if not isinstance(self.env, gym.Env):
            for each in self._envs:
                each.close()
        self._envs = []

    @property
    def _count(self) -> int:
        """Number of episodes at a time: one at least for each column of the replay buffer."""
        return max(self.per_episode, self.training_env.num_envs)

    def play(self) -> None:
        """Play episodes, and put their steps into the replay buffer."""
        first = self.seed + self.state.episodes
        seeds = range(first, first + self._count)
        with _same_random_states():
            if isinstance(self.env, gym.Env):
                episodes = [self._side_by_side([self.env], [each])[0] for each in seeds]
            else:
                episodes = self._side_by_side(self._envs, seeds)
        self.state.episodes += len(episodes)
        self._add(episodes)

    def _side_by_side(
        self, envs: Sequence[gym.Env[Any, Any]], seeds: Sequence[int]
    ) -> list[list[_Row]]:
        """Return the rows of one episode in each env."""
        explore = [_Exploration(self, np.random.default_rng([self.seed, k])) for k in seeds]
        seen = [np.array(env.reset(seed=k)[0]) for env, k in zip(envs, seeds, strict=True)]
        episodes: list[list[_Row]] = [[] for _ in envs]
        running = [*range(len(envs))]
        while running:
            actions = self._actions(np.stack([seen[i] for i in running]))
            for i, action in zip([*running], actions, strict=True):
                scaled = explore[i](action)
                observation, reward, terminated, truncated, _ = envs[i].step(self._taken(scaled))
                after, over = np.array(observation), bool(terminated or truncated)
                cut = bool(truncated and not terminated)
                episodes[i].append(_Row(seen[i], after, scaled, float(reward), over, cut))
                seen[i] = after
                if over:
                    running.remove(i)
            if running:
                watch_length(envs[running[0]], len(episodes[running[0]]))
        return episodes

    def _actions(self, observations: NDArray[Any]) -> Array:
        """Return the policy's actions in [-1, 1], shape (batch, m)."""
        normalize = self.model.get_vec_normalize_env()
        if normalize is not None:
            observations = np.asarray(normalize.normalize_obs(observations))
        actions, _ = self.policy.predict(observations, deterministic=True)
        return np.asarray(self.policy.scale_action(actions), np.float64)

    def _taken(self, scaled: Array) -> NDArray[Any]:
        """Return an action of the env, within its bounds to the last bit."""
        space: Any = self.model.action_space
        taken = self.policy.unscale_action(scaled).astype(space.dtype)
        return np.clip(taken, space.low, space.high)

    def _add(self, episodes: list[list[_Row]]) -> None:
        """Add the episodes to the buffer, one after the other in each of its columns."""
        buffer: Any = self.model.replay_buffer
        if buffer.size():  # what else is under way in the training env goes on behind these rows
            last = buffer.pos - 1
            buffer.timeouts[last] = np.maximum(buffer.timeouts[last], buffer.dones[last] == 0)
        n = buffer.n_envs
        columns = [[row for rows in episodes[i::n] for row in rows] for i in range(n)]
        length = min(map(len, columns))
        marks = vars(buffer).setdefault("simulated", np.zeros((buffer.buffer_size, n), dtype=bool))
        for k in range(length):
            rows = [column[k] for column in columns]
            obs, after, u, reward, done, cut = (np.array(each) for each in zip(*rows, strict=True))
            if k == length - 1:  # longer columns end here
                cut, done = cut | ~done, np.ones(n, dtype=bool)
            at = buffer.pos
            infos = [{"TimeLimit.truncated": bool(each)} for each in cut]
            buffer.add(obs, after, u, reward.astype(np.float32), done, infos)
            marks[at] = True


class _Exploration:
    """What acts in one episode in the place of the policy's actions."""

    def __init__(self, settings: SimulatedEpisodes, rng: np.random.Generator) -> None:
        self.settings, self.rng = settings, rng
        self.left = 0  # samples of a step test
        self.held: Array = np.zeros(0)

    def __call__(self, action: Array) -> Array:
        """Return an action in [-1, 1], shape (m,)."""
        if self.left == 0 and self.rng.random() < self.settings.step_tests:
            self.left = int(self.rng.integers(1, self.settings.longest + 1))
            self.held = self.rng.uniform(-1, 1, action.shape)
        if self.left > 0:
            self.left -= 1
            return self.held
        noise = self.settings.noise * self.rng.standard_normal(action.shape)
        return np.clip(action + noise, -1, 1)


@contextmanager
def _same_random_states() -> Iterator[None]:
    """Leave the global generators of Python and numpy, from which older envs draw, as they are."""
    python, legacy = random.getstate(), np.random.get_state()  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(legacy)  # noqa: NPY002
