"""Every action lies in the action space, to the last bit of its type."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import DDPG
from stable_baselines3.common.noise import NormalActionNoise

from policy_samples import make_policy
from sb3_yann import LinearModel, LinearMPC, YannPolicy
from sb3_yann.commissioning.plant import Plant

MODEL = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1)
# With these SB3's own formula ends a bit above the upper bound, or below the lower one.
BOUNDS = [(-6.405920704482398, 2.770888466262316), (-3.1813471661220563, 0.7685641746834422),
          (-5.561286541406757, 0.2744693227757833)]  # fmt: skip


def problem(low: float, high: float) -> LinearMPC:
    design = {"Q": np.eye(2), "R": [[0.1]], "horizon": 3, "x_min": -5, "x_max": 5}
    return LinearMPC(MODEL, **design, u_min=low, u_max=high)


def box(low: float, high: float, dtype=np.float32) -> spaces.Box:
    return spaces.Box(np.array([low], dtype), np.array([high], dtype), dtype=dtype)


def problem_within(space: spaces.Box) -> LinearMPC:
    return problem(float(space.low[0]), float(space.high[0]))


def policy_of(space: spaces.Box) -> YannPolicy:
    observed = spaces.Box(-np.inf, np.inf, (2,))
    return make_policy(observed, space, problem=problem_within(space))


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("bounds", BOUNDS)
def test_a_saturated_prediction_lies_in_the_action_space(bounds, dtype) -> None:
    policy = policy_of(box(*bounds, dtype))
    seen = np.random.default_rng(0).uniform(-50, 50, (300, 2)).astype(np.float32)
    actions = policy.predict(seen)[0]
    assert np.ptp(actions) > 0.99 * (bounds[1] - bounds[0])
    assert all(policy.action_space.contains(each) for each in actions)


@pytest.mark.parametrize("bounds", BOUNDS)
def test_a_scaled_action_of_one_is_the_bound(bounds) -> None:
    policy = policy_of(box(*bounds))
    ends = policy.unscale_action(np.float32([[-1], [1]]))
    assert all(policy.action_space.contains(each) for each in ends)
    np.testing.assert_allclose(ends[:, 0], bounds, rtol=1e-6)


class Strict(gym.Env):
    """Takes no action that is outside its action space."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def __init__(self, dtype) -> None:
        self.action_space, self.saturated = box(*BOUNDS[0], dtype), 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._observe(), {}

    def step(self, action):
        assert self.action_space.contains(action), repr(action)
        self.steps += 1
        self.saturated += bool(np.isin(action, [self.action_space.low, self.action_space.high]))
        return self._observe(), 0.0, False, self.steps == 20, {}

    def _observe(self):
        return self.np_random.uniform(-5, 5, 2).astype(np.float32)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_no_step_of_training_leaves_the_action_space(dtype) -> None:
    env, noise = Strict(dtype), NormalActionNoise(np.zeros(1), np.ones(1))
    kwargs = {"problem": problem_within(env.action_space)}
    model = DDPG(YannPolicy, env, policy_kwargs=kwargs, action_noise=noise, learning_starts=20)
    model.learn(100)
    assert env.saturated > 10


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("by", ["mpc", "policy"])
def test_no_step_of_a_commissioning_leaves_the_action_space(by, dtype) -> None:
    env = Strict(dtype)
    plant = Plant(
        env, DDPG(YannPolicy, env, policy_kwargs={"problem": problem_within(env.action_space)})
    )
    plant.play(plant.begin(seed=0), getattr(plant, by), watchdog=None)
    assert env.saturated > 3
