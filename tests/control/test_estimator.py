"""Estimates from outputs alone: the states of a model, offset-free tracking, missing readings."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_yann import (
    IdentifiedOutputs,
    LinearModel,
    LinearMPC,
    StateEstimator,
    Tracking,
    identify_outputs,
    offset_free,
)
from sb3_yann._validation import Array
from sb3_yann.wrappers import EstimateState, ObserveDisturbance, SetPoint

A, B = np.array([[0.9, 0.3], [0.0, 0.7]]), np.array([[0.0], [0.5]])


class Hidden(gym.Env[Array, Array]):
    """A plant that shows its first state, about (50, 3), and differs from the model by a load."""

    def __init__(self, load: float = 0.0, lost: int = -1) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
        self.action_space = spaces.Box(1.0, 5.0, (1,), np.float64)
        self.load, self.lost, self.x, self.k = load, lost, np.zeros(2), 0

    def reset(self, *, seed: int | None = None, options: object = None) -> Any:
        super().reset(seed=seed)
        self.x, self.k = np.array([0.5, 0.0]), 0
        return self.x[:1] + 50, {}

    def step(self, action: Array) -> Any:
        self.x = A @ self.x + B @ (np.asarray(action, float) - 3) + [0.0, self.load]
        self.k += 1
        shown = [np.nan] if self.k % 5 == self.lost else self.x[:1] + 50
        return np.array(shown), 0.0, False, False, {}


def identified(dt: float = 1.0) -> IdentifiedOutputs:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(2, 4, (200, 1)), 4, axis=0)
    env, y = Hidden(), []
    y.append(env.reset()[0])
    for each in u:
        y.append(env.step(each)[0])
    return identify_outputs(np.array(y) + 0.01 * rng.normal(size=(801, 1)), u, dt=dt)


def test_the_estimator_of_a_model_predicts_as_the_model_does() -> None:
    found = identified()
    rng = np.random.default_rng(3)
    u = rng.uniform(2, 4, (300, 1))
    env = Hidden()
    y = np.array([env.reset()[0], *[env.step(each)[0] for each in u]])
    estimator, model = found.estimator(), found.model
    y_ss = model.C @ model.x_ss
    estimator.reset(y[0] - y_ss)
    one_ahead = [estimator.expected(u[0] - model.u_ss) + y_ss]
    for k in range(1, 300):
        estimator.update(y[k] - y_ss, u[k - 1] - model.u_ss)
        one_ahead.append(estimator.expected(u[k] - model.u_ss) + y_ss)
    late = slice(100, None)  # both have forgotten where they began
    np.testing.assert_allclose(np.array(one_ahead)[late], found.predict(y, u, 1)[late], atol=1e-6)


def test_a_state_that_the_outputs_do_not_see_is_named() -> None:
    model = LinearModel([[1.2, 0], [0, 0.5]], [[1], [1]], dt=1, C=[[0, 1]])
    with pytest.raises(ValueError, match=r"do not see an unstable mode: eigenvalue 1\.2"):
        StateEstimator(model)


@pytest.mark.filterwarnings("ignore:The measurement .* is not finite")
@pytest.mark.parametrize("lost", [-1, 2])
def test_tracking_from_outputs_alone_settles_without_offset(lost: int) -> None:
    model = identified().model
    n = model.n_states
    half = 20 * np.ones(n)
    mpc = LinearMPC(
        model,
        Q=np.eye(n),
        R=[[0.1]],
        horizon=5,
        u_min=1,
        u_max=5,
        theta_min=model.x_ss - half,
        theta_max=model.x_ss + half,
        tracking=Tracking(model.C, 45, 55),
    )
    free, observer = offset_free(mpc)
    assert observer.n_estimated == 1
    low, high = free.disturbances.d_min, free.disturbances.d_max
    reference = 52.0
    env = ObserveDisturbance(
        SetPoint(Hidden(0.4, lost), 45, 55, schedule=lambda _: [reference]), observer, low, high
    )
    law = free.online()
    shown, _ = env.reset(seed=0)
    with np.errstate(all="ignore"):
        for _ in range(120):
            shown, *_ = env.step(law.plant_input(shown))
    assert env.unwrapped.x[0] + 50 == pytest.approx(reference, abs=1e-3)
    plain = EstimateState(
        SetPoint(Hidden(0.4), 45, 55, schedule=lambda _: [reference]), StateEstimator(model)
    )
    law = mpc.online()
    shown, _ = plain.reset(seed=0)
    assert shown.shape == (n + 1,)
    for _ in range(120):
        shown, *_ = plain.step(law.plant_input(shown))
    assert abs(plain.unwrapped.x[0] + 50 - reference) > 0.1  # what the estimate takes away


def test_a_filter_of_two_rates_uses_the_rare_readings_fully() -> None:
    a = [[0.95, 0.1, 0], [0, 0.9, 0], [0, 0.2, 0.98]]
    model = LinearModel(a, [[0.1], [0.5], [0]], 1, C=[[1, 0, 0], [0, 0, 1]])
    noise = {"state_noise": 0.1, "measurement_noise": 0.3}
    rng = np.random.default_rng(0)
    filters = StateEstimator(model, **noise), StateEstimator(model, **noise, every=[1, 20])
    x, errors = np.zeros(3), ([], [])
    for k in range(4000):
        y = model.C @ x + 0.3 * rng.normal(size=2)
        y[1] = y[1] if k % 20 == 0 else np.nan
        for each, own in zip(filters, errors, strict=True):
            own.append(each.update(y, [0.0])[0][2] - x[2] if k else each.reset(y)[0][2])
        x = model.step(x, [0.0]) + 0.1 * rng.normal(size=3)
    plain, rated = (float(np.mean(np.square(own[200:]))) for own in errors)
    assert rated < 0.85 * plain
    with pytest.raises(ValueError, match="every = "):
        StateEstimator(model, every=[1, 2, 3])
