"""YannPolicy on problems with references, disturbances and rates: exact at the start."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG

from general_problems import LOADED, solved
from sample_plants import LinearPlant, feasible_states
from sb3_yann import YannPolicy
from sb3_yann.control import DisturbanceObserver, LinearMPC
from sb3_yann.wrappers import ObserveDisturbance, PreviousInput, SetPoint, StageCost

NAMES = [
    "servo",
    "servo with a disturbance",
    "servo with a weight on nothing but the rate",
    "servo with all of it",
    "soft states",
    "invariant with all of it",
    "two tanks, all parts",
]


@pytest.mark.parametrize("name", NAMES)
def test_predict_equals_an_independent_online_qp(name: str) -> None:
    mpc = solved(name)
    model = DDPG(YannPolicy, LinearPlant(mpc), policy_kwargs={"problem": mpc})
    thetas, expected = feasible_states(mpc, 1000)
    actions, _ = model.predict(thetas.astype(np.float32))
    assert np.max(np.abs(actions - expected) / (mpc.u_max - mpc.u_min)) < 1e-5


class LoadedPlant(gym.Env):
    """The linear plant with a load that nobody measures; a plain regulator's observation."""

    def __init__(self, load: float = 0.2) -> None:
        self.load = np.array([load])
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = gym.spaces.Box(np.float32([-1]), np.float32([2]))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = np.zeros(2)
        return self.x.astype(np.float32), {}

    def step(self, action):
        self.x = LOADED.step(self.x, np.asarray(action, np.float64), self.load)
        return self.x.astype(np.float32), 0.0, False, False, {}


def wrapped(mpc: LinearMPC, reference: float = 0.5) -> gym.Env:
    env = SetPoint(LoadedPlant(), [-1], [1], schedule=lambda step: [reference])
    env = ObserveDisturbance(
        env, DisturbanceObserver(LOADED), mpc.disturbances.d_min, mpc.disturbances.d_max
    )
    return StageCost(PreviousInput(env), mpc)


def test_a_wrapped_plant_starts_as_offset_free_mpc_in_sb3() -> None:
    mpc = solved("servo with all of it")
    env = wrapped(mpc)
    model = DDPG(YannPolicy, env, policy_kwargs={"problem": mpc})
    theta, _ = env.reset(seed=0)
    for _ in range(150):
        action, _ = model.predict(theta)
        error = np.abs(action - mpc.explicit()(theta)) / (mpc.u_max - mpc.u_min)
        assert np.max(error) < 1e-5
        theta, reward, *_ = env.step(action)
    np.testing.assert_allclose(theta, [*mpc.steady_state([0.5], [0.2])[0], 0.5, 0.2, action[0]],
                               atol=1e-5)  # fmt: skip
    assert abs(reward) < 1e-9


@pytest.mark.parametrize(
    ("name", "pinned"),
    [("servo", False), ("regulator with a disturbance", False), ("regulator with rates", True)],
)
def test_the_equilibrium_is_pinned_only_where_there_is_one(name: str, pinned: bool) -> None:
    mpc = solved(name)
    policy = DDPG(YannPolicy, LinearPlant(mpc), policy_kwargs={"problem": mpc}).policy
    assert policy.pin_equilibrium is pinned
    kwargs = {"problem": mpc, "pin_equilibrium": True}
    policy = DDPG(YannPolicy, LinearPlant(mpc), policy_kwargs=kwargs).policy
    assert policy.pin_equilibrium is True
