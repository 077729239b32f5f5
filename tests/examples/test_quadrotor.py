"""The quadrotor rests where it should, turns as a rigid body does, and falls when it tilts."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from quadrotor import hover
from quadrotor_plant import DRAG, GRAVITY, INERTIA, MASS, Quadrotor, derivative

HOVER = np.full(4, MASS * GRAVITY / 4)


def test_it_rests_where_the_thrusts_carry_it_at_any_place_and_yaw() -> None:
    x = np.zeros(12)
    x[[0, 1, 2, 5]] = 3.0, -2.0, 1.0, 0.7
    np.testing.assert_allclose(derivative(x, HOVER), 0, atol=1e-14)


def test_without_thrust_energy_goes_into_the_drag_and_angular_momentum_stays() -> None:
    x = np.array([0, 0, 0, 0.3, -0.2, 0.5, 1.0, -2.0, 0.5, 0.4, -0.3, 0.6])
    rate = derivative(x, np.zeros(4))
    v = x[6:9]
    w = x[9:]
    power = MASS * v @ rate[6:9] + MASS * GRAVITY * v[2]
    np.testing.assert_allclose(power, -DRAG * np.linalg.norm(v) ** 3)
    np.testing.assert_allclose(w @ (INERTIA * rate[9:]), 0, atol=1e-15)  # rotational energy
    np.testing.assert_allclose((INERTIA * w) @ (INERTIA * rate[9:]), 0, atol=1e-15)


@pytest.mark.filterwarnings("ignore:.*For Box action spaces", "ignore:.*infinity")
def test_it_falls_when_it_tilts_too_far_and_is_a_gymnasium_env() -> None:
    env = Quadrotor()
    env.reset(seed=0, options={"state": [0, 0, 0, 1.3] + [0] * 8})
    _, reward, terminated, _, info = env.step(HOVER.astype(np.float32))
    assert terminated and info["violation"] and reward < -1000
    check_env(Quadrotor(), skip_render_check=True)


def test_its_mpc_hovers_with_the_thrusts_that_carry_it() -> None:
    mpc = hover()
    np.testing.assert_allclose(mpc.model.u_ss, HOVER)
    law = mpc.online()
    env = Quadrotor()
    assert isinstance(env, gymnasium.Env)
    x, _ = env.reset(seed=0)
    for _ in range(100):
        x = env.step(np.float32(mpc.model.u_ss + law(x.astype(float))))[0]
    assert np.abs(x).max() < 0.02
