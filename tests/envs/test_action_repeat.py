"""One action for several steps: the sum of their rewards, and nothing lost."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit

from sb3_yann_envs import ActionRepeat


class Counter(gym.Env):
    """Counts its steps; the reward is minus their number, the third is a violation."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, last: int = 10**6) -> None:
        self.last = last

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.actions = 0, []
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        self.actions.append(float(action[0]))
        info = {"violation": self.t == 3, "t": self.t}
        return np.full(1, self.t, np.float32), -float(self.t), self.t == self.last, False, info


def test_rewards_add_up_and_observation_and_info_are_the_last_ones() -> None:
    env = ActionRepeat(Counter(), 4)
    env.reset()
    observation, reward, terminated, truncated, info = env.step(np.array([0.5]))
    assert (observation[0], reward, terminated, truncated) == (4, -10, False, False)
    assert info == {"violation": True, "t": 4}
    assert env.unwrapped.actions == [0.5] * 4
    _, reward, *_, info = env.step(np.array([-1]))
    assert (reward, info) == (-26, {"violation": False, "t": 8})


def test_an_episode_ends_at_once() -> None:
    env = ActionRepeat(Counter(last=6), 4)
    env.reset()
    env.step(np.zeros(1))
    _, reward, terminated, truncated, info = env.step(np.zeros(1))
    assert (reward, terminated, truncated, info["t"]) == (-11, True, False, 6)


def test_a_time_limit_counts_steps_below_and_decisions_above() -> None:
    for env, steps in (
        (ActionRepeat(TimeLimit(Counter(), 6), 4), 6),
        (TimeLimit(ActionRepeat(Counter(), 4), 6), 24),
    ):
        env.reset()
        truncated = False
        while not truncated:
            *_, terminated, truncated, info = env.step(np.zeros(1))
            assert not terminated
        assert info["t"] == steps


def test_an_env_that_says_nothing_of_violations_still_says_nothing() -> None:
    env = ActionRepeat(gym.make("Pendulum-v1"), 2)
    env.reset(seed=0)
    assert "violation" not in env.step(np.zeros(1))[-1]


def test_gymnasium_makes_it_again_from_its_spec() -> None:
    spec = ActionRepeat(gym.make("Pendulum-v1"), 3).spec
    again = gym.make(spec)
    assert isinstance(again, ActionRepeat)
    assert again.k == 3


@pytest.mark.parametrize("k", [0, -1, 1.5, True, "2"])
def test_a_number_of_steps_that_is_none_is_named(k) -> None:
    with pytest.raises(ValueError, match="must be a whole number of steps"):
        ActionRepeat(Counter(), k)
