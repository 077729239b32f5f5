"""A plant in its own units is seen in deviations, and its cost is that of the problem."""

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
    Tracking,
)
from sb3_yann.wrappers import (
    Deviations,
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
    theta_max=[400, 4], absolute=True,
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


def test_the_plant_is_seen_in_deviations() -> None:
    env = Deviations(Reactor(), MODEL)
    assert env.observation_space.low.tolist() == [-50, -2]
    assert env.action_space.high.tolist() == MPC.u_max.tolist() == [5]
    assert env.reset(seed=0)[0].tolist() == [5, 0.5]
    x = env.step(np.array([1.0]))[0]
    np.testing.assert_allclose(x, MODEL.step([5, 0.5], [1.0]), atol=1e-9)
    env.step(np.array([5.0 + 1e-9]))  # rounding does not leave the plant's own space


def test_set_points_that_the_plant_shows_count_from_the_operating_point_of_a_problem() -> None:
    wanted = Tracking([0], 349.5, 352)
    mpc = LinearMPC(
        MODEL, Q=np.eye(2), R=[[1]], horizon=2, u_min=8, u_max=15, tracking=wanted, absolute=True
    )  # fmt: skip
    env = Deviations(Reactor(extra=2), mpc)
    assert env.reset(seed=0)[0].tolist() == [5, 0.5, 0.5 - 350, 0.5]
    assert env.observation_space.low[2:].tolist() == [-1 - 350, -1]
    assert Deviations(Reactor(), mpc).reset(seed=0)[0].tolist() == [5, 0.5]


def test_what_comes_after_the_states_is_left_alone() -> None:
    env = Deviations(Reactor(extra=2), MODEL)
    assert env.reset(seed=0)[0].tolist() == [5, 0.5, 0.5, 0.5]
    assert env.observation_space.high[2:].tolist() == [1, 1]


def test_a_model_of_another_plant_is_named() -> None:
    other = LinearModel(np.eye(3), np.ones((3, 1)), 1.0)
    with pytest.raises(ValueError, match=r"shows \(2,\) and takes \(1,\), but .* 3 states"):
        Deviations(Reactor(), other)
    with pytest.raises(TypeError, match="must be a LinearModel"):
        Deviations(Reactor(), MODEL.A)  # type: ignore[arg-type]


@pytest.mark.parametrize("between", [lambda env: env, lambda env: gym.wrappers.TimeLimit(env, 9)])
def test_the_operating_point_is_not_taken_off_twice(between) -> None:
    with pytest.raises(ValueError, match="wrapped in Deviations already"):
        Deviations(between(Deviations(Reactor(), MODEL)), MODEL)


def test_an_action_that_is_nan_does_not_reach_the_plant() -> None:
    env = Deviations(Reactor(), MODEL)
    before, _ = env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action = \[nan\] must not be NaN"):
        env.step(np.array([np.nan]))
    np.testing.assert_allclose(env.step(np.array([0.0]))[0], MODEL.step(before, [0.0]), atol=1e-9)


class AbsoluteShow(gym.ObservationWrapper):
    """Shows absolute states of a plant that takes deviations."""

    def observation(self, observation: Any) -> Any:
        return observation + X_SS


def test_the_stage_cost_of_absolute_observations_is_that_of_deviations() -> None:
    plain = StageCost(Deviations(Reactor(), MODEL), MPC)
    shown = AbsoluteShow(Deviations(Reactor(), MODEL))
    mapped = StageCost(shown, MPC, observation=AffineObservation.deviation(X_SS))
    for env in (plain, mapped):
        env.reset(seed=0)
    for u in ([1.0], [-0.5]):
        costs = [env.step(np.array(u))[1] for env in (plain, mapped)]
        assert costs[0] == pytest.approx(costs[1], abs=1e-9)
        assert costs[0] < -1


def test_a_map_that_does_not_fit_is_named() -> None:
    env = Deviations(Reactor(), MODEL)
    with pytest.raises(ValueError, match=r"What the map makes of it has shape \(1,\)"):
        StageCost(env, MPC, observation=AffineObservation([[1, 0]]))
    with pytest.raises(TypeError, match="observation = 3 must be an AffineObservation"):
        StageCost(env, MPC, observation=3)  # type: ignore[arg-type]


def test_the_stage_cost_of_an_absolute_plant_follows_its_problem() -> None:
    """What is shown and taken are absolute values, where the problem and the bounds say so."""
    env = StageCost(Reactor(), MPC)
    x = env.reset(seed=0)[0]
    reward = env.step(np.array([11.5], np.float32))[1]
    assert reward == pytest.approx(-float(MPC.stage_cost(x - X_SS, [1.5])))
    plain = gym.wrappers.RescaleAction(Reactor(), np.float32([-1]), np.float32([1]))
    env = StageCost(plain, MPC, observation={"center": np.zeros(2), "scale": np.ones(2)})
    env.reset(seed=0)
    assert env.step(np.array([0.0], np.float32))[1] == pytest.approx(
        -float(MPC.stage_cost(x - X_SS, [1.5]))
    )


def test_dead_time_comes_before_deviations() -> None:
    model = LinearModel(np.eye(3) / 2, np.ones((3, 1)), 1.0, [*X_SS, 10.0], [10.0])
    with pytest.raises(ValueError, match="of one with dead time wrap the plant in PastInputs"):
        Deviations(Reactor(), model)


class Valve(gym.Env):
    """A level of 5 m, and a flow of 2 to 8 m3/h."""

    observation_space = gym.spaces.Box(0, 10, (1,), np.float64)

    def __init__(self, low: float, high: float) -> None:
        self.action_space = gym.spaces.Box(low, high, (1,), np.float64)


@pytest.mark.parametrize(("low", "high"), [(2.0, 8.0), (0.0, 8.0), (-8.0, -2.0)])
def test_an_observer_refuses_absolute_inputs(low: float, high: float) -> None:
    u_ss = [-5.0 if high < 0 else 5.0]
    model = LinearModel([[0.9]], [[0.5]], 1.0, [5.0], u_ss, [[1.0]])
    observer = DisturbanceObserver(model)
    with pytest.raises(ValueError, match=r"inputs from .* which are absolute.*Deviations"):
        ObserveDisturbance(Valve(low, high), observer, -1, 1)
    ObserveDisturbance(Deviations(Valve(low, high), model), observer, -1, 1)


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

    env = StageCost(Column(), MPC, observation="absolute")
    with pytest.raises(ValueError, match=r"observation of shape \(2, 1\), .* has \(2,\)"):
        env.reset(seed=0)


class Fed(gym.Wrapper):
    """Tells its feed, near 10 kg/min."""

    def reset(self, **kwargs: Any) -> Any:
        return self.env.reset(**kwargs)[0], {"disturbance": [10.5]}


def test_a_measured_disturbance_counts_from_its_operating_point_too() -> None:
    model = LinearModel(np.eye(2) / 2, np.ones((2, 1)), 1.0, X_SS, [10], np.ones((2, 1)), [10.0])
    env = MeasuredDisturbance(Deviations(Fed(Reactor()), model), -2, 2)
    assert env.reset(seed=0)[0][-1] == 0.5
    plain = MeasuredDisturbance(Fed(Reactor()), 8, 12)
    assert plain.reset(seed=0)[0][-1] == 10.5
