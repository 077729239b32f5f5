"""The disturbance observer estimates what nobody measures, and forgets it at a reset."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from general_problems import LOADED, THERMAL
from sample_plants import Plant
from sb3_yann import (
    DisturbanceObserver,
    IdentifiedOutputs,
    LinearModel,
    LinearMPC,
    StateEstimator,
    Tracking,
    identify_outputs,
    offset_free,
)
from sb3_yann._validation import Array
from sb3_yann.wrappers import EstimateState, ObserveDisturbance, SetPoint, StageCost


def test_the_estimate_of_a_constant_disturbance_is_exact_in_the_end() -> None:
    observer = DisturbanceObserver(LOADED, [0])
    rng = np.random.default_rng(0)
    x = np.array([1.0, -1.0])
    d = np.array([0.2])
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


def test_a_reset_forgets_what_was_estimated() -> None:
    observer = DisturbanceObserver(LOADED)
    observer.update([1, 2], [0])
    x_hat, d_hat = observer.reset([0.5, 0.1])
    assert (x_hat.tolist(), d_hat.tolist()) == (pytest.approx([0.5, 0.1]), [0.0])


BLIND = LinearModel([[1.2, 0], [0, 0.5]], [[1], [1]], 1.0, E=[[1], [1]])
IDLE = LinearModel([[1, 0], [0, 0.5]], [[1], [1]], 1.0, E=[[0], [0]])
BOTH = LinearModel(THERMAL.A, THERMAL.B, 1.0, E=np.eye(2))


@pytest.mark.parametrize(
    ("model", "kwargs", "message"),
    [
        (THERMAL, {}, "no disturbance to estimate: pass its matrix E"),
        (BOTH, {"measured": [0]}, "at most as many"),
        (BLIND, {"measured": [1]}, "do not see an unstable mode: eigenvalue 1.2"),
        (IDLE, {}, r"has rank 2, needed is 3"),
        (LOADED, {"gain": np.zeros((3, 2))}, "does not make the error of the estimate decay"),
        (LOADED, {"gain": np.zeros((2, 2))}, r"gain has shape \(2, 2\), expected \(3, 2\)"),
        (LOADED, {"measurement_noise": 0}, "measurement_noise = .* standard deviations, above 0"),
        (LOADED, {"state_noise": 1e300}, r"state_noise = \[1e\+300, 1.* ratios.* below 1e6"),
        (LOADED, {"state_noise": 2**63}, "too far apart, or too large, for a Kalman filter"),
        (BOTH, {"state_noise": [1e-96, 1], "disturbance_noise": [1, 1e96]}, "hides its gain"),
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


def test_a_measured_disturbance_is_told_and_no_part_of_the_estimate() -> None:
    E = np.array([[0.3, 0.1], [-0.2, 1.0]])
    model = LinearModel([[0.7, 0.2], [0.0, 0.9]], [[0.1], [0.4]], 1, E=E, estimated=[1])
    observer = DisturbanceObserver(model, measured=[1])
    rng = np.random.default_rng(3)
    x = np.zeros(2)
    for _ in range(200):  # the load moves at random, the unknown stays
        u = rng.normal(size=1)
        load = rng.normal(size=1)
        x = model.step(x, u, [load[0], 0.6])
        x_hat, d_hat = observer.update(x[1:], u, load)
    np.testing.assert_allclose([*x_hat, *d_hat], [*x, 0.6], atol=1e-9)
    for wrong in (None, [1.0, 2.0]):
        with pytest.raises(ValueError, match="d "):
            observer.update([0.0], [0.0], wrong)
    with pytest.raises(ValueError, match="takes 0 measured disturbances"):
        DisturbanceObserver(dataclasses.replace(model, estimated=())).update(x, u, load)


A = np.array([[0.9, 0.3], [0.0, 0.7]])
B = np.array([[0.0], [0.5]])


class Hidden(Plant):
    """A plant that shows its first state, about (50, 3), and differs from the model by a load."""

    def __init__(self, load: float = 0.0, lost: int = -1) -> None:
        super().__init__(lambda x, u: A @ x + B @ (u - 3) + [0.0, load], (-np.inf, np.inf), (1, 5))
        self.start = np.array([0.5, 0.0])
        self.lost = lost

    def reset(self, **given: Any) -> Any:
        self.k = -1
        return super().reset(**given)

    def shown(self) -> Array:
        self.k += 1
        return np.array([np.nan]) if self.k % 5 == self.lost else self.x[:1] + 50


def identified(dt: float = 1.0) -> IdentifiedOutputs:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(2, 4, (200, 1)), 4, axis=0)
    env = Hidden()
    y = [env.reset()[0], *[env.step(each)[0] for each in u]]
    return identify_outputs(np.array(y) + 0.01 * rng.normal(size=(801, 1)), u, dt=dt)


def test_the_estimator_of_a_model_predicts_as_the_model_does() -> None:
    found = identified()
    rng = np.random.default_rng(3)
    u = rng.uniform(2, 4, (300, 1))
    env = Hidden()
    y = np.array([env.reset()[0], *[env.step(each)[0] for each in u]])
    estimator = found.estimator()
    model = found.model
    y_ss = model.C @ model.x_ss
    estimator.reset(y[0] - y_ss)
    one_ahead = [estimator.C @ model.step(estimator.x_hat, u[0] - model.u_ss) + y_ss]
    for k in range(1, 300):
        estimator.update(y[k] - y_ss, u[k - 1] - model.u_ss)
        one_ahead.append(estimator.C @ model.step(estimator.x_hat, u[k] - model.u_ss) + y_ss)
    late = slice(100, None)  # both have forgotten where they began
    np.testing.assert_allclose(np.array(one_ahead)[late], found.predict(y, u, 1)[late], atol=1e-6)


@pytest.mark.filterwarnings("ignore:The measurement .* is not finite")
@pytest.mark.parametrize("lost", [-1, 2])
def test_tracking_from_outputs_alone_settles_without_offset(lost: int) -> None:
    found = identified()
    model = found.model
    n = model.n_states
    box = {"u_min": 1, "u_max": 5, "theta_min": model.x_ss - 20, "theta_max": model.x_ss + 20}
    tracking = Tracking(model.C, 45, 55)
    mpc = LinearMPC(model, Q=np.eye(n), R=[[0.1]], horizon=5, tracking=tracking, **box)
    free, observer = offset_free(mpc)
    quiet = offset_free(mpc, estimator=found.estimator())[1]
    assert observer.n_estimated == quiet.n_estimated == 1
    np.testing.assert_array_equal(quiet.noise["measurement_noise"], found.noise)
    assert np.linalg.norm(quiet.gain[n:]) < 0.5 * np.linalg.norm(observer.gain[n:])
    other = StateEstimator(dataclasses.replace(model, A=model.A / 2))
    of_another = "of another model than the problem: its A is"
    for given, message in (
        ({"measured": np.eye(n), "estimator": quiet}, r"estimator reads .* measured is"),
        ({"every": 2, "estimator": quiet}, r"every = 2, but the estimator has \[1\]: leave"),
        ({"estimator": other}, of_another),
    ):
        with pytest.raises(ValueError, match=message):
            offset_free(mpc, **given)
    reference = 52.0

    def rest(law: Any, wrapped: Any) -> float:
        shown, _ = wrapped.reset(seed=0)
        with np.errstate(all="ignore"):
            for _ in range(120):
                shown, *_ = wrapped.step(law.plant_input(shown))
        return float(wrapped.unwrapped.x[0] + 50)

    def followed(plant: Hidden) -> Any:
        return SetPoint(plant, 45, 55, schedule=lambda _: [reference])

    ends = free.disturbances.d_min, free.disturbances.d_max
    observed = ObserveDisturbance(followed(Hidden(0.4, lost)), observer, *ends)
    assert rest(free.online(), observed) == pytest.approx(reference, abs=1e-3)
    plain = EstimateState(followed(Hidden(0.4)), StateEstimator(model))
    assert abs(rest(mpc.online(), plain) - reference) > 0.1  # what the estimate takes away
    with pytest.raises(ValueError, match=of_another):
        StageCost(EstimateState(followed(Hidden()), other), mpc)


def test_a_filter_of_two_rates_uses_the_rare_readings_fully() -> None:
    a = [[0.95, 0.1, 0], [0, 0.9, 0], [0, 0.2, 0.98]]
    model = LinearModel(a, [[0.1], [0.5], [0]], 1, C=[[1, 0, 0], [0, 0, 1]])
    noise = {"state_noise": 0.1, "measurement_noise": 0.3}
    rng = np.random.default_rng(0)
    filters = StateEstimator(model, **noise), StateEstimator(model, **noise, every=[1, 20])
    x = np.zeros(3)
    errors = ([], [])
    for k in range(4000):
        y = model.C @ x + 0.3 * rng.normal(size=2)
        y[1] = y[1] if k % 20 == 0 else np.nan
        for each, own in zip(filters, errors, strict=True):
            own.append(each.update(y, [0.0])[0][2] - x[2] if k else each.reset(y)[0][2])
        x = model.step(x, [0.0]) + 0.1 * rng.normal(size=3)
    plain, rated = (float(np.mean(np.square(own[200:]))) for own in errors)
    assert rated < 0.85 * plain
    with pytest.raises(ValueError, match="one number, or one for each of 2 outputs"):
        StateEstimator(model, every=[1, 2, 3])


def test_the_filter_of_identified_outputs_does_not_depend_on_their_units() -> None:
    rng = np.random.default_rng(0)
    A, B = np.array([[0.9, 0.1], [0.2, 0.7]]), np.array([[1.0, 0.0], [0.3, 0.5]])
    u, y = rng.uniform(-1, 1, (400, 2)), np.zeros((401, 2))
    for k in range(400):
        y[k + 1] = A @ y[k] + B @ u[k] + 0.01 * rng.standard_normal(2)
    plain, scaled = (identify_outputs(y * each, u, 1.0, 2, 0) for each in (1.0, [1e6, 1e-6]))
    gains = (each.model.shown @ each.estimator().gain for each in (plain, scaled))
    gain, other = gains
    np.testing.assert_allclose(other * [[1e-6], [1e6]] * [1e6, 1e-6], gain, rtol=1e-3, atol=1e-4)


def test_rates_that_hardly_ever_meet_are_refused() -> None:
    with pytest.raises(ValueError, match=r"every = \[997, 1009\]: .* each 1,005,973 samples"):
        StateEstimator(THERMAL, every=[997, 1009])
