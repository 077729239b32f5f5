"""An MPC from a simulator alone: its model by differences, its bounds from the spaces."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from sb3_yann import LinearModel, LinearMPC, Log, identify


class Heater(gym.Env):
    """Shows a temperature near 350 K, takes a power of 20 to 60 kW."""

    observation_space = gym.spaces.Box(300, 400, (1,), np.float64)
    action_space = gym.spaces.Box(20, 60, (1,), np.float64)
    dt = 60.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array((options or {}).get("state", [350.0]), np.float64)
        return self.state.copy(), {}

    def step(self, power):
        self.state = 350 + 0.9 * (self.state - 350) + 0.05 * (np.asarray(power) - 40)
        return self.state.copy(), 0.0, False, False, {}


def test_the_bounds_are_those_of_the_spaces_as_the_plant_shows_them() -> None:
    mpc = LinearMPC.from_env(Heater, Q=[[1]], R=[[0.01]], horizon=3, dt=60.0, x_ss=[350], u_ss=[40])
    np.testing.assert_allclose([mpc.model.A[0, 0], mpc.model.B[0, 0]], [0.9, 0.05], atol=1e-6)
    by_hand = LinearMPC(
        mpc.model, Q=[[1]], R=[[0.01]], horizon=3, u_min=20, u_max=60, theta_min=300,
        theta_max=400,
    )  # fmt: skip
    assert mpc == by_hand
    law = mpc.explicit()
    np.testing.assert_allclose(law.plant_input([350.0]), [40], atol=1e-6)
    assert 20 <= law.plant_input([390.0])[0] < 40


def test_what_is_given_counts_more_than_the_spaces() -> None:
    mpc = LinearMPC.from_env("ClippedPendulum-v0", Q=np.eye(2), R=[[1]], horizon=2, u_max=1.5)
    assert mpc.u_max.tolist() == [1.5] and mpc.u_min.tolist() == [-2]
    with pytest.raises(TypeError, match="colour"):
        LinearMPC.from_env("ClippedPendulum-v0", Q=np.eye(2), R=[[1]], horizon=2, colour=1)


def test_what_identify_returns_is_a_model_for_it() -> None:
    rng = np.random.default_rng(0)
    u = rng.normal(size=(80, 1))
    x = np.zeros((81, 1))
    for k in range(80):
        x[k + 1] = 0.8 * x[k] + 0.5 * u[k]
    found = identify(Log.from_arrays(x, u, 1.0), x_ss=[0], u_ss=[0])
    mpc = LinearMPC(found, Q=[[1]], R=[[1]], horizon=2, x_min=-5, x_max=5, u_min=-1, u_max=1)
    assert isinstance(mpc.model, LinearModel) and mpc.explicit()([5.0])[0] == pytest.approx(-1)
