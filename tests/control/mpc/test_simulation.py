"""The closed loop on the model, and what a problem says of itself in a line."""

from __future__ import annotations

import numpy as np
import pytest

from general_problems import servo
from sb3_yann import LinearModel, LinearMPC, RateLimits, Tracking

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
