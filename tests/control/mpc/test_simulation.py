"""An MPC from a simulator alone, and the closed loop on a model."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from general_problems import servo
from sb3_yann import LinearModel, LinearMPC, Log, RateLimits, Tracking, identify

CART = LinearModel([[1, 1], [0, 1]], [[0], [1]], dt=1.0)
BOUNDS = {"x_min": -5, "x_max": 5, "u_min": -1, "u_max": 1}


def test_a_simulation_is_the_law_on_its_model() -> None:
    mpc = LinearMPC(CART, Q=np.eye(2), R=[[1]], horizon=2, **BOUNDS)
    thetas, inputs = mpc.simulate([-3, 1], 12)
    assert (thetas.shape, inputs.shape) == ((13, 2), (12, 1))
    np.testing.assert_allclose(inputs, mpc.explicit()(thetas[:-1]))
    np.testing.assert_allclose(thetas[1:], mpc.predict(thetas[:-1], inputs))
    assert np.abs(thetas[-1]).max() < 0.1


def test_it_plays_the_law_that_was_chosen(monkeypatch) -> None:
    mpc = LinearMPC(CART, Q=np.eye(2), R=[[1]], horizon=2, **BOUNDS)
    online = mpc.law("online")
    monkeypatch.setattr(LinearMPC, "explicit", None)  # nothing is searched for
    thetas, inputs = mpc.simulate([-3, 1], 5)
    np.testing.assert_array_equal(inputs, online(thetas[:-1]))


def test_r_stays_and_u_prev_follows() -> None:
    mpc = LinearMPC(
        CART, Q=np.eye(2), R=[[1]], horizon=2, **BOUNDS,
        tracking=Tracking([0], -2, 2), rate=RateLimits(-0.5, 0.5),
    )  # fmt: skip
    thetas, inputs = mpc.simulate([0, 0, 1.0, 0], 30)
    assert np.all(thetas[:, 2] == 1)
    np.testing.assert_array_equal(thetas[1:, 3], inputs[:, 0])
    assert abs(thetas[-1, 0] - 1) < 0.05


@pytest.mark.parametrize(("theta", "steps"), [([1, 2, 3], 5), ([0, 0], 0), ([0, np.nan], 5)])
def test_a_bad_start_is_named(theta: list[float], steps: int) -> None:
    mpc = LinearMPC(CART, Q=np.eye(2), R=[[1]], horizon=2, **BOUNDS)
    with pytest.raises(ValueError, match=r"theta0|steps = 0"):
        mpc.simulate(theta, steps)


def test_a_problem_names_its_bounds() -> None:
    text = repr(LinearMPC(CART, Q=np.eye(2), R=[[1]], horizon=2, **BOUNDS))
    assert "x_min=[-5, -5], x_max=[5, 5], u_min=[-1], u_max=[1]" in text
    assert "r_min" not in text
    assert "r_min=[" in repr(servo())


def test_a_start_in_deviations_is_refused() -> None:
    hot = LinearModel([[0.9]], [[0.5]], 1, x_ss=[350], u_ss=[40], state_names=["temperature"])
    limits = {"x_min": 330, "x_max": 370, "u_min": 20, "u_max": 60}
    mpc = LinearMPC(hot, Q=[[1]], R=[[1]], horizon=2, **limits)
    with pytest.raises(ValueError, match=r"temperature = 2 is shown.*this is a deviation"):
        mpc.simulate([2.0], 5)
    assert mpc.simulate([352.0], 5)[0][0] == 352


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
