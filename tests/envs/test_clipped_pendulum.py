"""The clipped pendulum: Gymnasium's simulator, observed as a state and started near upright."""

from typing import Any

import control
import numpy as np
import pytest
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from numpy.typing import NDArray

from sb3_yann_envs import clipped_pendulum
from sb3_yann_envs.clipped_pendulum import ClippedPendulumEnv


def act(torque: float) -> NDArray[np.float32]:
    return np.array([torque], dtype=np.float32)


def started(state: Any = (0.0, 0.0)) -> ClippedPendulumEnv:
    env = ClippedPendulumEnv()
    env.reset(options={"state": state})
    return env


def gymnasium_pendulum(state: Any) -> PendulumEnv:
    env = PendulumEnv()
    env.reset()
    env.state = np.array(state, dtype=np.float64)
    return env


def side_it_falls_to(starts: NDArray[np.float64], torque: float) -> NDArray[np.float64]:
    """Return the sign of the angle at which pendulums under a constant torque pass a quarter turn.

    `starts` has shape (batch, 2). A pendulum that has not fallen after 400 steps counts as 0.
    """
    theta = starts[:, 0]
    speed = starts[:, 1]
    side: NDArray[np.float64] = np.zeros(len(starts))
    for _ in range(400):
        speed = np.clip(speed + 0.05 * (15.0 * np.sin(theta) + 3.0 * torque), -8.0, 8.0)
        theta = theta + 0.05 * speed
        side = np.where((side == 0) & (np.abs(theta) > np.pi / 2), np.sign(theta), side)
    return side


@pytest.mark.parametrize("seed", range(5))
def test_a_trajectory_is_gymnasiums_bit_for_bit(seed: int) -> None:
    # Actions in float64: Gymnasium multiplies a float32 torque in float32, which rounds.
    rng = np.random.default_rng(seed)
    start = rng.uniform([-np.pi, -8.0], [np.pi, 8.0])
    ours = started(start)
    theirs = gymnasium_pendulum(start)
    for torque in rng.uniform(-3.0, 3.0, 200):
        action = np.array([torque])
        _, our_reward, *_, info = ours.step(action)
        _, their_reward, *_ = theirs.step(action)  # type: ignore[no-untyped-call]
        theta, speed = theirs.state
        assert our_reward == their_reward
        assert info["state"][1] == speed
        assert info["state"][0] == (theta + np.pi) % (2 * np.pi) - np.pi


def test_upright_is_a_fixed_point() -> None:
    rates = clipped_pendulum.dynamics(clipped_pendulum.X_SS, clipped_pendulum.U_SS)
    np.testing.assert_array_equal(rates, 0.0)
    observation, reward, *_ = started().step(act(0.0))
    np.testing.assert_array_equal(observation, 0.0)
    assert reward == 0.0


def test_the_linearized_dynamics_give_the_printed_model() -> None:
    plant = control.nlsys(
        lambda t, x, u, params: clipped_pendulum.dynamics(x, u), None, states=2, inputs=1, outputs=2
    )
    model = control.linearize(plant, clipped_pendulum.X_SS, clipped_pendulum.U_SS)
    model = model.sample(clipped_pendulum.DT, method="zoh")
    np.testing.assert_array_equal(np.round(model.A, 4), clipped_pendulum.PRINTED_A)
    np.testing.assert_array_equal(np.round(model.B, 4), clipped_pendulum.PRINTED_B)


@pytest.mark.parametrize(
    "theta", [np.pi, -np.pi, np.nextafter(np.pi, 0.0), np.nextafter(-np.pi, 0.0), np.float32(np.pi)]
)
def test_an_angle_that_rounds_to_pi_stays_in_the_space(theta: float) -> None:
    observation, info = ClippedPendulumEnv().reset(options={"state": [theta, 8.0]})
    env = ClippedPendulumEnv()
    assert observation in env.observation_space
    # And the observation itself is a valid start again.
    assert env.reset(options={"state": observation})[0] in env.observation_space
    assert -np.pi <= info["state"][0] <= np.pi


def test_one_start_in_five_must_swing_round() -> None:
    # A start is lost when it falls to one side although the torque pushes fully to the other.
    # Dynamic programming on a grid of 241 x 241 classified 4,000 starts in the same way.
    env = ClippedPendulumEnv()
    starts = np.array([env.reset(seed=seed)[1]["state"] for seed in range(4000)])
    lost = (side_it_falls_to(starts, -2.0) > 0) | (side_it_falls_to(starts, 2.0) < 0)
    assert 0.18 < lost.mean() < 0.23
