"""An input that moves the env against the model is reported, and nothing else is."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_yann import ImprovementGuard, LinearModel, LinearMPC, NoActionNoise, headroom
from sb3_yann.wrappers import StageCost

A = np.array([[0.9, 0.2], [0.0, 0.7]])
B = np.array([[0.3, 0.0], [0.1, 0.5]])
MODEL = LinearModel(A, B, dt=1.0, input_names=["valve", "heater"])
MPC = LinearMPC(
    MODEL, Q=np.eye(2), R=np.eye(2), horizon=2, theta_min=-4, theta_max=4, u_min=-1, u_max=1
)


class Plant(gym.Env[Any, Any]):
    """The model with other gains, a noise that the seed repeats, and a curve."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, gains: Any, late: bool = False) -> None:
        self.gains = np.array(gains)
        self.late = late

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-3, 3, 2)
        self.t = 0
        self.u = np.zeros(2)
        return self.x.copy(), {}

    def step(self, action: Any) -> Any:
        u = self.u if self.late else np.asarray(action, float)
        self.u = np.asarray(action, float)
        noise = 0.3 * self.np_random.normal(size=2)
        self.x = A @ self.x - 0.1 * self.x**3 / 9 + B @ (self.gains * u) + noise
        self.t += 1
        return self.x.copy(), 0.0, False, self.t == 12, {}


def said(run: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        run()
    told = [str(each.message) for each in found]
    return [each for each in told if "against the sign" in each]


def guarded(plant: Any) -> Any:
    def run() -> None:
        def make() -> gym.Env[Any, Any]:
            return StageCost(plant(), MPC)

        options = {"problem": MPC}
        model = DDPG("YannPolicy", make(), policy_kwargs=options, seed=0, learning_starts=10**6)
        guard = ImprovementGuard(make, n_eval_episodes=4, n_new_starts=2, n_final_starts=2)
        model.learn(12, callback=[NoActionNoise(), guard])

    return run


@pytest.mark.parametrize("gains", [(1, -0.6), (-2, 1)])
def test_a_guard_names_an_input_of_the_other_sign(gains: Any) -> None:
    (message,) = said(guarded(lambda: Plant(gains)))
    name = ["valve", "heater"][int(np.argmin(gains))]
    assert message.startswith(f"{name} moves the env against the sign of the model's B: ")
    assert f"{min(gains):.2g} times as far in a step, from 4 starts" in message


@pytest.mark.parametrize("plant", [{"gains": (3, 0.2)}, {"gains": (1, 1), "late": True}])
def test_another_gain_and_dead_time_are_no_other_sign(plant: Any) -> None:
    assert not said(guarded(lambda: Plant(**plant)))


def test_headroom_tells_it_too() -> None:
    assert len(said(lambda: headroom(MPC, lambda: Plant((-1, -1)), n_starts=3))) == 2


def test_a_plant_that_is_not_linear_has_the_signs_of_its_model() -> None:
    model = DDPG("YannPolicy", "ClippedPendulum-v0", seed=0, learning_starts=10**6)
    guard = ImprovementGuard("ClippedPendulum-v0", n_eval_episodes=6, n_final_starts=2)
    assert not said(lambda: model.learn(20, callback=[NoActionNoise(), guard]))
