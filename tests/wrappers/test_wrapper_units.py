"""Wrappers show plant units, and the cost is that of the problem."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_yann import (
    AffineObservation,
    DisturbanceObserver,
    LinearModel,
    LinearMPC,
)
from sb3_yann.wrappers import (
    MeasuredDisturbance,
    ObserveDisturbance,
    PastInputs,
    PreviousInput,
    StageCost,
)

X_SS, U_SS = np.array([350.0, 2.0]), np.array([10.0])
MODEL = LinearModel([[0.9, 0.2], [0, 0.7]], [[0], [1]], 1.0, X_SS, U_SS)
MPC = LinearMPC(
    MODEL, Q=np.eye(2), R=[[1]], horizon=2, u_min=8, u_max=15, theta_min=[300, 0],
    theta_max=[400, 4],
)  # fmt: skip


class Reactor(gym.Env):
    """The model, as a plant that shows temperatures and takes flows, and perhaps more."""

    def __init__(self, extra: int = 0) -> None:
        low, high = [300.0, 0.0, *[-1.0] * extra], [400.0, 4.0, *[1.0] * extra]
        self.observation_space = gym.spaces.Box(np.array(low), np.array(high), dtype=np.float64)
        self.action_space = gym.spaces.Box(np.float32([8]), np.float32([15]))
        self.extra = extra

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = X_SS + np.array([5.0, 0.5])
        return self._show(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.x = X_SS + MODEL.step(self.x - X_SS, action - U_SS)
        return self._show(), 0.0, False, False, {}

    def _show(self) -> np.ndarray:
        return np.r_[self.x, np.full(self.extra, 0.5)]


def test_a_map_that_does_not_fit_is_named() -> None:
    env = Reactor()
    with pytest.raises(ValueError, match=r"What the map makes of it has shape \(1,\)"):
        StageCost(env, MPC, observation=AffineObservation([[1, 0]]))
    with pytest.raises(TypeError, match="observation = 3 must be an AffineObservation"):
        StageCost(env, MPC, observation=3)  # type: ignore[arg-type]


@pytest.mark.parametrize("normalized", [False, True])
def test_the_stage_cost_is_that_of_what_the_plant_shows_and_takes(normalized: bool) -> None:
    plant: Any = Reactor()
    if normalized:
        plant = gym.wrappers.RescaleAction(plant, np.float32([-1]), np.float32([1]))
    env = StageCost(plant, MPC)
    x = env.reset(seed=0)[0]
    action = np.array([0.0 if normalized else 11.5], np.float32)
    reward = env.step(action)[1]
    assert reward == pytest.approx(-float(MPC.stage_cost(x, [11.5])))
    assert reward == pytest.approx(-float(MPC.deviations.stage_cost(x - X_SS, [1.5])))


class Valve(gym.Env):
    """A level of 5 m, and a flow of 2 to 8 m3/h."""

    observation_space = gym.spaces.Box(0, 10, (1,), np.float64)

    def __init__(self, low: float, high: float) -> None:
        self.action_space = gym.spaces.Box(low, high, (1,), np.float64)


def test_an_observer_shows_plant_units() -> None:
    """The same numbers as about zero, with the operating point put on."""
    E, d_ss = [[0.0], [1.0]], [0.25]
    model = LinearModel(MODEL.A, MODEL.B, 1.0, X_SS, U_SS, E, d_ss)
    own = LinearModel(MODEL.A, MODEL.B, 1.0, E=E)
    env = ObserveDisturbance(Reactor(), DisturbanceObserver(model), -2, 2)
    observer = DisturbanceObserver(own)
    shown = [env.reset(seed=0)[0]]
    expected = [np.append(*observer.reset(env.unwrapped.x - X_SS))]
    for u in (11.0, 9.0, 14.0):
        shown.append(env.step(np.float32([u]))[0])
        expected.append(np.append(*observer.update(env.unwrapped.x - X_SS, u - U_SS)))
    rest = np.array([*X_SS, *d_ss])
    np.testing.assert_allclose(shown, np.array(expected) + rest, rtol=1e-6)


@pytest.mark.parametrize("wrap", [PreviousInput, lambda env, **u: PastInputs(env, [2], **u)])
def test_what_cannot_have_been_played_before_an_episode_is_asked_for(wrap: Any) -> None:
    with pytest.raises(ValueError, match=r"takes inputs from \[2.0\] to \[8.0\].*Pass initial"):
        wrap(Valve(2.0, 8.0))
    assert wrap(Valve(2.0, 8.0), initial=[5.0]).initial.tolist() == [5.0]
    with pytest.raises(ValueError, match=r"from \[0.0\] to \[8.0\]: zero, .*is hardly the one"):
        wrap(Valve(0.0, 8.0))  # a valve that is open from 0 to 100 % was open before
    wrap(Valve(-2.0, 8.0))
    PastInputs(Valve(2.0, 8.0), [0])


def test_an_observation_that_is_a_column_is_named() -> None:
    class Column(Reactor):
        def reset(self, **kwargs: Any) -> Any:
            observation, info = super().reset(**kwargs)
            return np.reshape(observation, (-1, 1)), info

    env = StageCost(Column(), MPC)
    with pytest.raises(ValueError, match=r"observation of shape \(2, 1\), .* has \(2,\)"):
        env.reset(seed=0)


class Fed(gym.Wrapper):
    """Tells its feed, near 10 kg/min."""

    def reset(self, **kwargs: Any) -> Any:
        return self.env.reset(**kwargs)[0], {"disturbance": [10.5]}


def test_a_measured_disturbance_is_what_the_plant_tells() -> None:
    plain = MeasuredDisturbance(Fed(Reactor()), 8, 12)
    assert plain.reset(seed=0)[0][-1] == 10.5
    model = LinearModel(
        np.eye(2) / 2, np.ones((2, 1)), 1.0, X_SS, [10], np.hstack([np.ones((2, 1)), np.eye(2)]),
        [10.0, 0, 0], estimated=[1, 2],
    )  # fmt: skip
    env = ObserveDisturbance(plain, DisturbanceObserver(model), [-2, -2], [2, 2])
    env.reset(seed=0)
    assert env.load.tolist() == [0.5]  # the observer counts from its operating point
