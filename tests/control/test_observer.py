"""The disturbance observer estimates what nobody measures, and forgets it at a reset."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from general_problems import LOADED, THERMAL
from sb3_yann import DisturbanceObserver, LinearModel, LinearMPC, offset_free


def test_the_estimate_of_a_constant_disturbance_is_exact_in_the_end() -> None:
    observer, rng = DisturbanceObserver(LOADED, [0]), np.random.default_rng(0)
    x, d = np.array([1.0, -1.0]), np.array([0.2])
    observer.reset(x[:1])
    for _ in range(200):
        u = rng.uniform(-1, 1, 1)
        x = LOADED.step(x, u, d)
        x_hat, d_hat = observer.update(x[:1], u)
    np.testing.assert_allclose(x_hat, x, atol=1e-9)
    np.testing.assert_allclose(d_hat, d, atol=1e-9)


def test_the_kalman_gain_is_the_limit_of_the_time_varying_filter() -> None:
    observer = DisturbanceObserver(
        LOADED, [0], state_noise=[0.1, 0.2], disturbance_noise=0.3, measurement_noise=0.5
    )
    P = np.eye(3)
    for _ in range(500):
        P = observer.A @ P @ observer.A.T + np.diag([0.01, 0.04, 0.09])
        K = P @ observer.C_aug.T / (observer.C_aug @ P @ observer.C_aug.T + 0.25)
        P = P - K @ observer.C_aug @ P
    np.testing.assert_allclose(observer.gain, K, rtol=1e-9)


def test_more_disturbance_noise_makes_a_faster_estimate() -> None:
    slow, fast = (
        float(np.abs(DisturbanceObserver(LOADED, disturbance_noise=size).gain[2]).max())
        for size in (0.1, 10.0)
    )
    assert fast > slow


def test_a_reset_forgets_what_was_estimated() -> None:
    observer = DisturbanceObserver(LOADED)
    observer.update([1, 2], [0])
    x_hat, d_hat = observer.reset([0.5, 0.1])
    assert (x_hat.tolist(), d_hat.tolist()) == (pytest.approx([0.5, 0.1]), [0.0])


@pytest.mark.parametrize(
    ("model", "kwargs", "message"),
    [
        (THERMAL, {}, "no disturbance to estimate: pass its matrix E"),
        (LinearModel(LOADED.A, LOADED.B, 1.0, E=np.eye(2)), {"measured": [0]}, "at most as many"),
        (
            LinearModel([[1.2, 0], [0, 0.5]], [[1], [1]], 1.0, E=[[1], [1]]),
            {"measured": [1]},
            "do not see an unstable mode: eigenvalue 1.2",
        ),
        (
            LinearModel([[1, 0], [0, 0.5]], [[1], [1]], 1.0, E=[[0], [0]]),
            {},
            r"has rank 2, needed is 3",
        ),
        (LOADED, {"gain": np.zeros((3, 2))}, "does not make the error of the estimate decay"),
        (LOADED, {"gain": np.zeros((2, 2))}, r"gain has shape \(2, 2\), expected \(3, 2\)"),
        (LOADED, {"measurement_noise": 0}, "measurement_noise = .* standard deviations, above 0"),
        (
            LOADED,
            {"state_noise": 1e300},
            r"state_noise = \[1e\+300, 1e\+300\].* ratios.* below 1e6",
        ),
        (LOADED, {"state_noise": 2**63}, "too far apart, or too large, for a Kalman filter"),
        (LOADED, {"measurement_noise": 1e100}, r"measurement_noise = \[1e\+100, 1e\+100\] are too"),
        (
            LinearModel([[0.9, 0.2], [0, 0.8]], [[0], [1]], 1.0, E=np.eye(2)),
            {"state_noise": [1e-96, 1], "disturbance_noise": [1, 1e96]},
            "rounding hides its gain",
        ),
        (LOADED, {"measured": 0}, r"measured = 0 must be a list of indices of states: \[0\]"),
        (LOADED, {"measured": [5]}, r"measured = \[5\] must be indices of states"),
    ],
)
def test_bad_argument_of_an_observer_is_named(
    model: LinearModel, kwargs: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        DisturbanceObserver(model, **kwargs)  # type: ignore[arg-type]


def test_bad_measurements_are_named() -> None:
    with pytest.raises(ValueError, match=r"y has shape \(1,\), expected \(2,\)"):
        DisturbanceObserver(LOADED).update([1], [0])
    with pytest.raises(ValueError, match="u holds NaN"):
        DisturbanceObserver(LOADED).update([1, 2], [np.nan])


def test_the_observer_of_an_offset_free_mpc_knows_no_units() -> None:
    """A temperature in thousandths of a degree is estimated as fast as one in degrees."""
    units = np.diag([1.0, 1000.0])
    A, B = units @ THERMAL.A @ np.linalg.inv(units), units @ THERMAL.B
    gains = []
    for model, unit in ((THERMAL, np.eye(2)), (LinearModel(A, B, 1.0), units)):
        Q, half = np.linalg.inv(unit @ unit), np.diag(unit) * 5
        box = {"theta_min": -half, "theta_max": half, "u_min": -1, "u_max": 1}
        _, observer = offset_free(LinearMPC(model, Q=Q, R=[[1]], horizon=2, **box))
        gains.append(observer.gain)
    both = np.kron(np.eye(2), units)  # of the states and of their disturbances
    np.testing.assert_allclose(gains[1], both @ gains[0] @ np.linalg.inv(units), rtol=1e-6)


@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_units_of_measurement_and_state_do_not_decide_what_is_determined(unit: float) -> None:
    plain = LinearModel([[0.5, 0.1], [0.0, 0.8]], [[0.0], [1.0]], 1, E=[[0.0], [1.0]])
    observer = DisturbanceObserver(plain, [0])
    other = DisturbanceObserver(plain, [[unit, 0.0]], gain=observer.gain / unit)
    for each, y in ((observer, 0.7), (other, 0.7 * unit)):
        each.reset([y])
        each.update([y], [0.3])
    np.testing.assert_allclose(other.estimate, observer.estimate)
    T = np.diag([1.0, np.sqrt(unit)])
    scaled = LinearModel(
        T @ plain.A @ np.linalg.inv(T), T @ plain.B, 1, E=T @ plain.E, x_ss=[0.0, 0.0]
    )
    moved = DisturbanceObserver(
        scaled, [0], gain=np.vstack([T @ observer.gain[:2], observer.gain[2:]])
    )
    moved.reset([0.7])
    moved.update([0.7], [0.3])
    np.testing.assert_allclose(moved.estimate, observer.estimate * [1.0, np.sqrt(unit), 1.0])
    for blind in ([[0.0, 0.0]], [[0.0, unit]]):
        stuck = LinearModel([[1.0, 0.0], [0.0, 0.8]], [[1.0], [1.0]], 1, E=[[0.0], [1.0]])
        with pytest.raises(ValueError, match="do not see an unstable mode: eigenvalue 1 of A"):
            DisturbanceObserver(stuck, blind)


def test_a_measured_disturbance_is_told_and_no_part_of_the_estimate() -> None:
    E = np.array([[0.3, 0.1], [-0.2, 1.0]])
    model = LinearModel([[0.7, 0.2], [0.0, 0.9]], [[0.1], [0.4]], 1, E=E, estimated=[1])
    observer, rng, x = (
        DisturbanceObserver(model, measured=[1]),
        np.random.default_rng(3),
        np.zeros(2),
    )
    for _ in range(200):  # the load moves at random, the unknown stays
        u, load = rng.normal(size=1), rng.normal(size=1)
        x = model.step(x, u, [load[0], 0.6])
        x_hat, d_hat = observer.update(x[1:], u, load)
    np.testing.assert_allclose([*x_hat, *d_hat], [*x, 0.6], atol=1e-9)
    for wrong in (None, [1.0, 2.0]):
        with pytest.raises(ValueError, match="d "):
            observer.update([0.0], [0.0], wrong)
    with pytest.raises(ValueError, match="takes 0 measured disturbances"):
        DisturbanceObserver(dataclasses.replace(model, estimated=())).update(x, u, load)
