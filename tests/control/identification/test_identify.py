"""Data give the model back, with honest errors, and data that cannot are refused by name."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from errors import Message, raises
from sample_plants import played
from sb3_yann import Identified, LinearModel, LinearMPC, Log, Tracking, identify, identify_outputs
from sb3_yann.control.gains import Gains, responses
from sb3_yann.control.identification.least_squares import gains_of, regress
from sb3_yann.log import Episode

A = np.array([[0.9, 0.2], [0.0, 0.7]])
B = np.array([[0.0], [1.0]])
E = np.array([[0.3], [-0.1]])
SPREAD = np.array([1.31, 1.38])
"""Standard deviation of the states of this plant under inputs of plus and minus one."""


def record(
    seed: int,
    steps: int = 400,
    process: float = 0.0,
    sensor: float = 0.0,
    disturbed: bool = False,
    offset: Any = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states, inputs and disturbances; noises are fractions of the states' spread."""
    rng = np.random.default_rng(seed)
    u = rng.choice([-1.0, 1.0], (steps, 1))
    d = rng.normal(size=(steps, 1)) if disturbed else np.zeros((steps, 1))
    x = np.zeros((steps + 1, 2))
    noise = process * SPREAD * rng.normal(size=(steps, 2))
    for k in range(steps):
        x[k + 1] = A @ x[k] + B @ u[k] + E @ d[k] + noise[k] + offset
    return x + sensor * SPREAD * rng.normal(size=x.shape), u, d


def coverage(found: Identified) -> np.ndarray:
    """Tell which true entries of A and B lie in their 95 % intervals, shape (6,)."""
    inside = []
    for name, truth in (("A", A), ("B", B)):
        width = stats.t.isf(0.025, found.degrees_of_freedom)
        width = width * getattr(found, f"standard_error_{name}")
        inside.append((np.abs(getattr(found.model, name) - truth) <= width).ravel())
    return np.concatenate(inside)


def test_data_without_noise_give_the_matrices_back() -> None:
    x, u, d = record(0, disturbed=True)
    model = LinearModel.from_data(x, u, dt=0.5, disturbances=d)
    np.testing.assert_allclose(model.A, A, atol=1e-8)
    np.testing.assert_allclose(model.B, B, atol=1e-8)
    np.testing.assert_allclose(model.E, E, atol=1e-8)
    assert model.dt == 0.5
    assert "e-1" not in model.report() and "prediction by 0, 0 (" in model.report()


@pytest.mark.slow
def test_steady_gains_have_errors_and_one_that_may_be_zero_is_named() -> None:
    G = np.linalg.solve(np.eye(2) - A, B)
    none = np.zeros((400, 0))
    logs = [[Episode(*record(i, process=0.02)[:2], none)] for i in range(200)]
    gains = [gains_of(regress(log)) for log in logs]
    found = identify(*record(0, process=0.02)[:2], dt=1, held_out=0).model
    np.testing.assert_allclose(found.gains.errors, gains[0].errors)
    np.testing.assert_allclose(np.linalg.solve(np.eye(2) - found.A, found.B), gains[0].values)
    inside = [np.abs(each.values - G) <= 1.96 * each.errors for each in gains]
    share = np.mean(inside, axis=0)
    assert np.all(np.abs(share - 0.95) < 0.062), share
    known = Gains.of(A, B, 0, [np.array([[5.0], [0.1]])] * 4)
    told = LinearModel(A, B, dt=1, gains=known).report()
    assert f"x[0] {G[0, 0]:+.4g} ± 9.8, x[1] {G[1, 0]:+.4g} ± 0.2." in told
    assert "Not distinguishable from zero: u[0] on x[0]." in told


INTEGRATING = {
    "a level beside a lag": ([[1, 0], [0, 0.8]], [[0.05, -0.05], [0, 0.3]]),
    "a level behind a lag": ([[1, 0.02], [0, 0.8]], [[0.05, -0.04], [0.3, 0]]),
    "two in a row": ([[1, 0.1], [0, 1]], [[0.005], [0.1]]),
    "a slow lag": ([[0.998]], [[0.02, -0.01]]),
}


@pytest.mark.slow
@pytest.mark.parametrize("noise", [[0.003], [0.03], [1e-6, 0.003]])
@pytest.mark.parametrize("plant", INTEGRATING)
def test_rates_of_what_integrates_have_intervals_that_hold(plant: str, noise: Any) -> None:
    A, B = (np.array(each, float) for each in INTEGRATING[plant])
    n, m = B.shape
    integrators = int(np.sum(np.linalg.eigvals(A) > 0.99))
    inside = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.uniform(-1, 1, (50, m)), 8, axis=0)
        sizes = np.array(noise)[-n:]
        x = played(
            lambda x, u, r=rng, s=sizes: A @ x + B @ u + s * r.normal(size=n), u, np.zeros(n)
        )
        gains = gains_of(regress([Episode(x, u, np.zeros((400, 0)))]))
        if gains.integrators < integrators and plant == "a slow lag":
            continue  # its gain is told, as of another lag
        assert gains.integrators == integrators
        true = np.take_along_axis(responses(A, B, integrators), gains.degrees[None], 0)[0]
        inside.append(np.abs(gains.values - true) <= 1.96 * gains.errors)
    assert len(inside) > 30 and np.mean(inside) > 0.9


@pytest.mark.nightly
def test_intervals_hold_the_truth_as_often_as_they_say_under_process_noise() -> None:
    draws = [identify(*record(i, process=0.02)[:2], dt=1, held_out=0) for i in range(200)]
    share = np.mean([coverage(found) for found in draws], axis=0)
    # 0.95 in 200 draws has a standard deviation of 0.0154: four of these to either side.
    assert np.all((share > 0.888) & (share < 1.0)), share
    assert 0.92 < np.mean(share) < 0.98


def test_residuals_are_white_under_process_noise() -> None:
    warned = ["correlated" in identify(*record(i, process=0.02)[:2], dt=1).model.report()
              for i in range(20)]  # fmt: skip
    assert sum(warned) <= 2


@pytest.mark.parametrize(
    ("sensor", "bias", "within"), [(0.1, -0.009, 0.002), (0.02, -0.0004, 0.0002)]
)
def test_sensor_noise_biases_the_poles_as_stated(sensor: float, bias: float, within: float) -> None:
    draws = [identify(*record(i, 4000, sensor=sensor)[:2], dt=1, held_out=0) for i in range(10)]
    found = np.mean([np.diag(each.model.A - A) for each in draws], axis=0)
    np.testing.assert_allclose(found, bias, atol=within)  # what the docstring of identify states
    if sensor == 0.1:  # beyond the intervals, and reported
        assert not any(coverage(each)[0] or coverage(each)[3] for each in draws)
        assert all("sensor noise" in each.model.report() for each in draws)
        assert all("under process noise alone" in each.model.report() for each in draws)


def test_episodes_are_not_joined_at_their_ends() -> None:
    x, u, _ = record(0)
    y, v, _ = record(1)
    y += 100 * np.eye(2)[0] * 0.9 ** np.arange(len(y))[:, None]  # another start, far away
    model = LinearModel.from_data([x, y], [u, v], dt=1, held_out=0)
    np.testing.assert_allclose(model.A, A, atol=1e-8)


def test_the_last_of_all_steps_are_held_out_however_long_the_episodes() -> None:
    x, u, _ = record(0, process=0.1)
    first = identify([x[:21], x[22:321]], [u[:20], u[22:320]], dt=1, held_out=0)
    both = identify([x[:21], x[22:]], [u[:20], u[22:]], dt=1, held_out=80 / 398)
    assert both.model == first.model and np.isnan(first.one_step_fit).all()
    assert "Fit over 80 steps held out" in both.model.report()


def test_episodes_too_short_for_ten_steps_state_no_fit_ten_steps_ahead() -> None:
    x, u, _ = record(0, process=0.1)
    starts = range(0, 400, 8)
    notes = identify([x[k : k + 9] for k in starts], [u[k : k + 8] for k in starts], dt=1).model
    assert "No episode of them is 10 steps long" in notes.report()
    assert "nan" not in notes.report()


def test_rows_that_are_missing_are_noticed_by_their_time() -> None:
    x, u, _ = record(0, offset=0.0)
    time = 0.5 * np.arange(401) + 0.02 * np.sin(np.arange(401))  # with some jitter
    kept = np.setdiff1d(np.arange(401), [7, 100, 101, 250])
    found = identify(x[kept], u[kept[:-1]], dt=0.5, time=time[kept])
    np.testing.assert_allclose(found.model.A, A, atol=1e-8)
    assert "3 steps at gaps, or of another time than dt, are left out" in found.report()
    assert np.abs(identify(x[kept], u[kept[:-1]], dt=0.5).model.A - A).max() > 1e-3


def test_fit_is_what_its_definition_says() -> None:
    x, u, _ = record(0, process=0.1)
    found = identify(x, u, dt=1, offset=False)
    test = x[320:]
    inputs = u[320:]
    for steps, fit in ((1, found.one_step_fit), (10, found.ten_step_fit)):
        predicted = []
        for k in range(80 - steps + 1):
            state = test[k]
            for j in range(steps):
                state = found.model.A @ state + found.model.B @ inputs[k + j]
            predicted.append(state)
        missed = np.linalg.norm(np.array(predicted) - test[steps:], axis=0)
        moved = np.linalg.norm(test[steps:] - test[steps:].mean(axis=0), axis=0)
        np.testing.assert_allclose(fit, 100 * (1 - missed / moved))


def test_operating_point_is_where_the_plant_rests() -> None:
    x, u, _ = record(0, offset=np.array([1.0, 2.0]))
    model = LinearModel.from_data(x[20:], u[20:] + 5, dt=1, u_ss=[5.5])
    rest = np.linalg.solve(np.eye(2) - A, B @ [0.5] + [1.0, 2.0])
    np.testing.assert_allclose(model.A, A, atol=1e-8)
    np.testing.assert_allclose(model.x_ss, rest, atol=1e-6)
    assert model.u_ss == [5.5]


def test_input_that_holds_a_given_state_is_found() -> None:
    x, u, _ = record(0)
    model = LinearModel.from_data(x, u + 5, dt=1, x_ss=[2.0, 1.0])
    np.testing.assert_allclose(model.u_ss, [5.3], atol=1e-6)  # (1 - .7) * 1 = .3


DOUBLE = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1)


def drive(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return states and inputs of the double integrator with a little process noise."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (200, 1))
    return played(lambda x, u: DOUBLE.step(x, u) + rng.normal(0, 0.001, 2), u, [0, 0]), u


@pytest.mark.parametrize("seed", range(10))
def test_double_integrator_rests_at_its_operating_point(seed: int) -> None:
    x, u = drive(seed)
    model = LinearModel.from_data(x, u, dt=0.1)
    assert x[:, 0].min() <= model.x_ss[0] <= x[:, 0].max()
    np.testing.assert_allclose(model.x_ss[1], 0, atol=0.01)
    np.testing.assert_allclose(model.u_ss, 0, atol=0.01)
    assert not np.any(model.drift)


def test_law_of_a_model_whose_operating_point_moves_is_warned_of() -> None:
    model = LinearModel.from_data(*drive(0), dt=0.1, x_ss=[0, 0.5], u_ss=[0])
    assert (model.x_ss.tolist(), model.u_ss.tolist()) == ([0, 0.5], [0])
    assert "moves by 0.05" in model.report()
    np.testing.assert_allclose(model.drift, [0.05, 0], atol=1e-3)
    box = {"theta_min": -5, "theta_max": 5, "u_min": -1, "u_max": 1}
    with pytest.warns(UserWarning, match=r"moves by \[0\.0.* will rest beside its references"):
        LinearMPC(model, Q=np.eye(2), R=[[1]], horizon=1, tracking=Tracking([0], -1, 1), **box)


def delayed(steps: int, hold: int = 1, process: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """Return a record in which the input acts so many steps late."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1, 1, (400 // hold, 1)), hold, axis=0)
    late = np.vstack([np.zeros((steps, 1)), u[: 400 - steps]])
    noise = process * SPREAD
    return played(lambda x, u: A @ x + B @ u + noise * rng.normal(size=2), late, [0, 0]), u


@pytest.mark.parametrize("steps", [1, 3, 8])
@pytest.mark.parametrize("process", [0.0, 0.05])
def test_delayed_input_is_named_with_its_delay(steps: int, process: float) -> None:
    with pytest.warns(UserWarning, match=rf"no effect beyond chance.* acts {steps} samples late"):
        found = identify(*delayed(steps, process=process), dt=1)
    assert "Poor: 10 steps ahead" in found.model.report()


def test_delay_of_an_input_that_is_held_is_named() -> None:
    with pytest.warns(UserWarning, match=r"The residuals follow u\[0\] of \d steps before"):
        identify(*delayed(3, hold=5), dt=1)


@pytest.mark.parametrize("early", [1, 2])
def test_inputs_that_stand_some_rows_too_early_are_named(early: int) -> None:
    x, u = delayed(0, hold=5)
    for fit, shown in ((identify, x), (identify_outputs, x[:, 1:])):
        with pytest.warns(UserWarning, match=f"answers inputs that stand {early} rows? later"):
            fit(shown[early:], u[:-early], dt=1)


def test_input_without_effect_is_warned_of_by_the_log_s_name() -> None:
    x, u, _ = record(0, process=0.1)
    both = np.hstack([u, np.random.default_rng(5).normal(size=u.shape)])
    with pytest.warns(UserWarning, match=r"u\[1\] has no effect on the next state beyond chance"):
        identify(x, both, dt=1)
    names = {"state_names": ("level", "T"), "input_names": ("pump", "heater")}
    log = replace(Log.from_arrays(x, both, 1), **names)
    with pytest.warns(UserWarning, match="heater has no effect on the next state beyond chance"):
        assert "Note: heater has no effect" in identify(log).model.report()
    with pytest.raises(ValueError, match=r"do not excite the plant: .*heater never changes"):
        identify(replace(Log.from_arrays(x, 0 * both, 1), **names))


def test_sensor_noise_is_taken_for_no_delay() -> None:
    for seed in range(5):
        noisy = record(seed, 4000, sensor=0.1)[:2]
        identify(*noisy, dt=1)  # a warning would be an error
        assert identify(*noisy, dt=1, delay="auto").delays == (0,)
    rng = np.random.default_rng(358)  # a short log, whose latest input's share alone tells
    a = rng.uniform(0.5, 0.95)
    u = np.repeat(rng.uniform(-1, 1, 150), 4)[:150, None]
    x = played(lambda x, u: a * x + u, u, [0.0]) + 0.5 * rng.normal(size=(151, 1))
    with pytest.warns(UserWarning, match=r"biases A towards zero.*identify_outputs"):
        assert identify(x, u, dt=1, delay="auto").delays == (0,)


def closed_loop(test_signal: float, noise=0.0, integral=0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    x, u = np.ones((201, 2)), np.zeros((200, 1))
    sensor = noise * np.random.default_rng(1).normal(size=x.shape)
    for k in range(200):
        y = (x + sensor)[: k + 1]
        u[k] = y[-1] @ [-0.4, -0.2] - integral * y[:, 0].sum() + test_signal * rng.normal()
        x[k + 1] = A @ x[k] + B @ u[k] + 0.1 * rng.normal(size=2)
    return x + sensor, u


def test_feedback_without_a_test_signal_is_refused_and_named() -> None:
    with pytest.raises(ValueError, match=r"0\.4 x\[0\] \+0\.2 x\[1\] \+1 u\[0\] never changes|"
                       r"1 x\[0\] \+0\.5 x\[1\] \+2\.5 u\[0\] never changes"):  # fmt: skip
        LinearModel.from_data(*closed_loop(0.0), dt=1)
    with pytest.raises(ValueError, match=r"u\[0\] is a function of earlier outputs and inputs"):
        identify(*closed_loop(0.0, noise=0.3, integral=0.1), dt=1)


def test_feedback_with_a_test_signal_is_identified() -> None:
    found = identify(*closed_loop(0.5), dt=1)
    assert np.all(np.abs(found.model.A - A) < 5 * found.standard_error_A)


def test_ridge_takes_what_is_refused_otherwise_and_says_so() -> None:
    model = LinearModel.from_data(*closed_loop(0.0), dt=1, ridge=1e-3)
    assert "A ridge of 0.001 biases" in model.report()
    assert "Weakly excited" in model.report()


@pytest.mark.parametrize("constant", [0.0, 0.1, 475.0])
def test_input_that_never_moves_is_named(constant: float) -> None:
    x, u, _ = record(0)
    both = np.hstack([u, np.full_like(u, constant)])
    with pytest.raises(ValueError, match=r"do not excite the plant: u\[1\] never changes\. What"):
        LinearModel.from_data(x, both, dt=1)


def test_states_that_are_sums_of_others_are_named() -> None:
    x, u, _ = record(0)
    with pytest.raises(ValueError, match=r"x\[0\] .*x\[1\] .*x\[2\] never changes"):
        LinearModel.from_data(np.column_stack([x, x.sum(axis=1)]), u, dt=1)


def test_units_do_not_count_in_what_is_refused() -> None:
    x, u, _ = record(0)
    model = LinearModel.from_data(x * [1e6, 1e-6], u, dt=1)
    np.testing.assert_allclose(model.A, A * [[1, 1e12], [1e-12, 1]], rtol=1e-8, atol=1e-8)


X, U, _ = record(0)
BROKEN = X.copy()
BROKEN[[3, 7], 1] = np.nan
MASKED = np.ma.array(X, mask=np.arange(802).reshape(401, 2) == 14)  # a sensor that failed
BAD_DATA: list[tuple[dict[str, Any], Message]] = [
    ({"states": BROKEN}, "states of episode 0 holds NaN .* in 2 rows, first in row 3"),
    ({"actions": [U, U * np.inf], "states": [X, X]}, "actions of episode 1 holds NaN"),
    ({"states": X[:-1]}, r"actions of episode 0 has 400 rows, states has 400.*T \+ 1"),
    ({"states": [X, X]}, "actions has 1 episodes, states has 2"),
    ({"states": X[:, 0]}, r"states of episode 0 has shape \(401,\).*reshape"),
    ({"states": [X, X[:, :1]], "actions": [U, U]}, r"shape \(401, 1\), expected"),
    ({"states": X[:1], "actions": U[:0]}, "actions of episode 0 has 0 rows"),
    ({"states": X[:5], "actions": U[:4]}, "3 steps to fit 4 parameters"),
    ({"states": X.T, "actions": U[:, :1].T}, r"\(2, 401\) .* one step .* transpose"),
    ({"disturbances": U[:-1]}, "disturbances of episode 0 has 399 rows"),
    ({"held_out": 1.0}, r"held_out = 1\.0 must lie in \[0, 1\)"),
    ({"states": MASKED}, "states.* has masked entries.*Leave their rows out"),
    ({"ridge": -1}, "ridge = -1 must be a finite number of at least 0"),
    ({"dt": 0}, "dt = 0 must be a finite number above 0"),
    ({"x_ss": [1]}, r"x_ss has shape \(1,\), expected \(2,\)"),
    ({"time": np.arange(400)}, r"time of episode 0 has shape \(400,\), expected \(401,"),
    ({"time": np.arange(401) % 400}, "time of episode 0 does not increase after row 39"),
    ({"time": np.arange(401) + 0.3 * (np.arange(401) % 2)}, r"% of .* dt = 1 by .* even ones"),
    ({"time": np.arange(401) / 60}, r"dt = 1, but a step of the log takes 0\.0166667"),
    ({"time": [np.arange(401)] * 2}, "time has 2 episodes, states has 1"),
    ({"d_ss": [0.0]}, "d_ss is given, but there are no disturbances"),
    ({"states": "many"}, TypeError("states = 'many' is not an array")),
]


@pytest.mark.parametrize(("changes", "message"), BAD_DATA)
def test_bad_data_are_named(changes: dict[str, Any], message: Message) -> None:
    with raises(message):
        identify(**{"states": X, "actions": U, "dt": 1, **changes})


def test_standard_errors_are_those_of_least_squares() -> None:
    x, u, d = record(0, steps=40, process=0.1, disturbed=True)
    found = identify(x, u, dt=1, disturbances=d, held_out=0)
    assert found.degrees_of_freedom == 40 - 5
    Z = np.column_stack([np.ones(40), x[:-1], u, d])
    coefficients, squares, *_ = np.linalg.lstsq(Z, x[1:], rcond=None)
    errors = np.sqrt(np.outer(np.diag(np.linalg.inv(Z.T @ Z)), squares / 35)).T
    np.testing.assert_allclose(np.diag(found.noise_covariance), squares / 35)
    for name, columns in (("A", [1, 2]), ("B", [3]), ("E", [4])):
        np.testing.assert_allclose(getattr(found.model, name), coefficients.T[:, columns])
        np.testing.assert_allclose(getattr(found, f"standard_error_{name}"), errors[:, columns])


def test_what_is_fitted_rests_at_zero_without_an_offset_and_at_the_mean_with_one() -> None:
    x, u, _ = record(0, process=0.05)
    without = identify(x, u + 0.5, dt=1, offset=False).model
    assert not np.any([*without.x_ss, *without.u_ss])
    model = identify(x, u + 0.5, dt=1).model
    np.testing.assert_allclose(model.u_ss, np.mean(u[:320] + 0.5, axis=0))
    given = identify(x, u, dt=1, offset=False, u_ss=[0.25]).model
    assert given.u_ss.tolist() == [0.25] and given.x_ss.tolist() == [0.0, 0.0]
