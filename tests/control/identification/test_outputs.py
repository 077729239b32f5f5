"""Models from outputs have the order, dead time and predictions of the plant."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

from experiments.outputs import Plant, inputs, random_plant
from sb3_yann import IdentifiedOutputs, LinearModel, Log, identify_outputs
from sb3_yann._validation import Array
from sb3_yann.control.identification.innovations import Chunks, Innovations
from sb3_yann.control.identification.outputs import Search
from sb3_yann.log import Episode

A = np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.7]])
B = np.array([[0.0, 0.1], [0.0, 0.3], [0.5, 0.0]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 1.0]])


def played(
    u: Array, A: Array, B: Array, C: Array, seed: int, noise: float = 0.05, delay: int = 0
) -> Array:
    """Return noisy outputs (T + 1, q) about (20, -3)."""
    rng = np.random.default_rng(seed)
    x = np.zeros(len(A))
    y = []
    for k in range(len(u) + 1):
        y.append(C @ x + [20.0, -3.0][: len(C)] + rng.normal(0, noise, len(C)))
        if k < len(u):
            v = u[k - delay] if k >= delay else np.zeros(B.shape[1])
            x = A @ x + B @ v + rng.normal(0, noise / 5, len(A))
    return np.array(y)


def steps(count: int, m: int, seed: int, hold: int = 4) -> Array:
    """Return inputs (count, m) that are held for some samples, about 3."""
    rng = np.random.default_rng(seed)
    return 3 + np.repeat(rng.uniform(-1, 1, (-(-count // hold), m)), hold, axis=0)[:count]


def best_possible(A: Array, B: Array, C: Array, y: Array, u: Array, delay: int = 0) -> Array:
    """Return what the Kalman filter of a plant of `played` predicts, 20 samples ahead."""
    offset = np.array([20.0, -3.0])[: len(C)]
    plant = Plant(A, B, C, np.full(u.shape[1], delay), 0.01, np.full(len(C), 0.05))
    return plant.predict(y - offset, u) + offset


def rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2)))


@pytest.fixture(scope="module")
def found() -> IdentifiedOutputs:
    u = steps(1200, 2, 0)
    return identify_outputs(played(u, A, B, C, 1), u, dt=0.5)


def test_predictions_come_close_to_the_best_possible_on_another_record(
    found: IdentifiedOutputs,
) -> None:
    u = steps(600, 2, 5)
    y = played(u, A, B, C, 6)
    guess = found.predict(y, u, ahead=20)
    best = best_possible(A, B, C, y, u)
    assert rms(guess - y[20:]) < 1.1 * rms(best - y[20:])


def test_order_gain_and_the_first_states_are_the_plants(found: IdentifiedOutputs) -> None:
    assert (found.order, found.delays) == (3, (0, 0))
    model = found.model
    np.testing.assert_array_equal(model.C, [[1, 0, 0], [0, 1, 0]])
    gain = model.C @ np.linalg.solve(np.eye(3) - model.A, model.B)
    np.testing.assert_allclose(gain, C @ np.linalg.solve(np.eye(3) - A, B), rtol=0.1, atol=0.1)
    inner = np.linalg.eigvals(model.A - found.gain @ model.C)
    assert np.max(np.abs(inner)) < 1


def test_the_operating_point_is_where_the_plant_rests(found: IdentifiedOutputs) -> None:
    model = found.model
    rest = C @ np.linalg.solve(np.eye(3) - A, B @ model.u_ss) + [20.0, -3.0]
    np.testing.assert_allclose(model.C @ model.x_ss, rest, atol=0.1)


def test_dead_time_is_told_from_order() -> None:
    a = np.array([[0.9, 0.2], [-0.2, 0.9]])
    b = np.array([[0.0], [0.5]])
    c = np.array([[1.0, 0.5]])
    u = steps(800, 1, 2)
    found = identify_outputs(played(u, a, b, c, 3, delay=5), u, dt=1)
    assert (found.order, found.delays, found.model.n_states) == (2, (5,), 7)
    assert not found.estimator().gain[2:].any()  # inputs on their way are known
    prompt = identify_outputs(played(u, a, b, c, 3), u, dt=1)
    assert (prompt.order, prompt.delays) == (2, (0,))
    fresh = steps(500, 1, 8)
    y = played(fresh, a, b, c, 9, delay=5)
    best = best_possible(a, b, c, y, fresh, delay=5)
    late = slice(40, None)  # the plant began at rest, which no record tells
    assert rms((found.predict(y, fresh) - y[20:])[late]) < 1.1 * rms((best - y[20:])[late])


def test_a_record_that_begins_at_rest_hides_no_dead_time() -> None:
    rng = np.random.default_rng(4006)
    plant, _ = random_plant(rng)
    u = inputs(1200, 2, rng)
    found = identify_outputs(plant.record(u, rng), u, dt=1)
    assert (found.order, found.delays) == (len(plant.A), (7, 4))
    assert plant.delays.tolist() == [7, 4]


def test_an_integrator_keeps_its_pole() -> None:
    a = np.array([[1.0, 0.3], [0.0, 0.8]])
    u = steps(800, 1, 4) - 3
    found = identify_outputs(played(u, a, 0.2 * np.eye(2)[:, 1:], np.eye(1, 2), 5), u, dt=1)
    assert np.max(np.abs(np.linalg.eigvals(found.model.A))) == pytest.approx(1, abs=0.01)


def test_records_with_gaps_give_nearly_the_same_model(found: IdentifiedOutputs) -> None:
    u = [steps(600, 2, 0), steps(600, 2, 1)]
    y = [played(each, A, B, C, 11 + i) for i, each in enumerate(u)]
    y[0][100:104] = np.nan
    y[1][300, 0] = np.nan
    u[1][200, 1] = np.nan
    cut = identify_outputs(y, u, dt=0.5)
    assert cut.order == 3
    assert "are left out" in cut.report()
    fresh = steps(600, 2, 5)
    z = played(fresh, A, B, C, 6)
    full = rms(found.predict(z, fresh) - z[20:])
    assert rms(cut.predict(z, fresh) - z[20:]) < 1.05 * full
    z[300:310, 1] = np.nan  # the filter goes on without them
    assert rms(cut.predict(z, fresh)[:-1] - played(fresh, A, B, C, 6)[20:-1]) < 1.2 * full


def test_a_log_gives_the_same_model_with_its_names() -> None:
    u = steps(400, 2, 0)
    y = played(u, A, B, C, 1)
    plain = identify_outputs(y, u, dt=0.5)
    log = Log(Log.from_arrays(y, u, 0.5).episodes, 0.5, ("T", "level"), ("steam", "feed"))
    named = identify_outputs(log, order=3, delay=0)
    np.testing.assert_array_equal(named.model.A, plain.model.A)
    assert named.model.state_names == ("T", "level", "x[2]")
    with pytest.raises(TypeError, match="log has its own"):
        identify_outputs(log, u)


def test_a_measured_disturbance_makes_E() -> None:
    both = steps(900, 2, 3)
    y = played(both, A, B, C, 4)
    log = Log.from_arrays(y, both[:, :1], 1, disturbances=both[:, 1:])
    found = identify_outputs(replace(log, disturbance_names=("feed",)))
    assert (found.model.n_inputs, found.model.disturbance_labels) == (1, ["feed"])
    guess = found.predict(y, both[:, :1], 20, disturbances=both[:, 1:])
    best = best_possible(A, B, C, y, both)
    assert rms(guess - y[20:]) < 1.1 * rms(best - y[20:])


@pytest.mark.parametrize(("dither", "decimals"), [(0.0, 15), (0.0, 3), (0.0, 1), (0.5, 1)])
def test_feedback_alone_identifies_nothing(dither: float, decimals: int) -> None:
    rng = np.random.default_rng(0)
    x = np.zeros(2)
    rows = []
    held = before = 0.0
    for _ in range(500):
        y = x[0] + 0.5 * rng.normal()
        held = held - 0.5 * (y - before) - 0.05 * y  # a PI controller at rest
        before = y
        rows.append([y, held + dither * rng.choice([-1, 1])])
        x = [[0.9, 0.2], [0.0, 0.7]] @ x + [0.0, 0.3 * rows[-1][1]] + 0.5 * rng.normal(size=2)
    y, u = np.hsplit(np.round(rows, decimals), 2)  # a historian rounds
    if dither:
        identify_outputs(y, u[:-1], dt=1, order=2, delay=0)
        return
    with pytest.raises(ValueError, match="feedback law alone"):
        identify_outputs(y, u[:-1], dt=1)
    with pytest.raises(ValueError, match=r"u\[0\] never changes"):
        identify_outputs(y, np.ones((499, 1)), dt=1)


def test_an_input_without_effect_is_named() -> None:
    u = steps(800, 2, 6)
    found = identify_outputs(played(u, A, B * [1, 0], C, 7), u, dt=1)
    assert "u[1] has no effect on the outputs" in found.report()
    assert "u[0] has no effect" not in found.report()
    assert found.delays == (0, 0)


def test_a_curved_plant_is_not_taken_for_dead_time() -> None:
    u = steps(800, 1, 1) - 3
    x = np.zeros(1)
    y = [np.zeros(1)]
    rng = np.random.default_rng(2)
    for each in u:
        x = 0.8 * x + each + 0.3 * each**2
        y.append(x + 0.01 * rng.normal(size=1))
    found = identify_outputs(np.array(y), u, dt=1)
    assert found.delays == (0,)
    assert "Curvature" in found.report() and "Dead time" not in found.report()
    assert "right. It is of a linear fit, and does not cover the curvature." in found.report()


def test_more_outputs_than_states() -> None:
    u = steps(600, 1, 6)
    c = np.array([[1.0], [2.0]])
    found = identify_outputs(played(u, np.array([[0.8]]), np.array([[1.0]]), c, 7), u, dt=1)
    assert found.order == 1
    y = played(u, np.array([[0.8]]), np.array([[1.0]]), c, 8)
    assert rms(found.predict(y, u, 5) - y[5:]) < 0.1


def test_C_is_kept_by_copies_units_and_sampling() -> None:
    model = LinearModel([[0.5, 0], [0, 0.2]], [[1], [1]], dt=1, x_ss=[1, 2], u_ss=[0], C=[[1, 1]])
    copies = copy.deepcopy(model), pickle.loads(pickle.dumps(model))
    for each in (*copies, model.about_zero(), model.named(["a", "b"])):
        np.testing.assert_array_equal(each.C, [[1, 1]])
    assert model != LinearModel(model.A, model.B, 1, [1, 2], [0])
    sampled = LinearModel.from_continuous([[0, 1], [0, 0]], [[0], [1]], dt=0.5, C=[[1, 0]])
    np.testing.assert_array_equal(sampled.C, [[1, 0]])


def test_a_filter_forgets_within_a_record_or_half_as_fast_as_its_model() -> None:
    one, zero = np.eye(1), np.zeros(1)
    model = Innovations(one / 2, one, -0.4 * one, one, zero, zero, one)  # its filter's pole is .9
    for count, forgets in ((50, False), (500, True)):
        record = Episode(np.zeros((count + 1, 1)), np.zeros((count, 1)), np.zeros((count, 0)))
        assert Chunks([record]).forgets(model) == forgets


def test_an_output_that_is_read_now_and_then_is_no_gap(monkeypatch) -> None:
    u = steps(1200, 2, 0)
    y = played(u, A, B, C, 1)
    y[np.arange(len(y)) % 10 > 0, 1] = np.nan

    # In favour of a model that never reads the slow output.
    monkeypatch.setattr(Search, "criterion", lambda _, model, start: model.K[:, 1].any() - 1.0)
    found = identify_outputs(y, u, dt=0.5, order=3, delay=0)
    assert found.gain[:, 1].any()
    assert found.every == (1, 10) and "Read now and then: y[1] every 10" in found.report()
    fresh = steps(800, 2, 5)
    z = played(fresh, A, B, C, 6)
    best = best_possible(A, B, C, z, fresh)
    shown = z.copy()
    shown[np.arange(len(z)) % 10 > 0, 1] = np.nan
    guess = found.predict(shown, fresh, ahead=20)
    late = slice(60, None)
    for i in range(2):  # of a filter that reads each sample
        assert rms((guess - z[20:])[late, i]) < 1.2 * rms((best - z[20:])[late, i])
    estimator = found.estimator()
    assert estimator.every.tolist() == [1, 10]
    np.testing.assert_allclose(estimator.noise["measurement_noise"], found.noise)  # offset_free


def test_a_slow_output_hides_dead_time_only_if_it_answers_sooner() -> None:
    u = steps(700, 1, 2)
    b = np.array([[0.3], [0.0], [0.5]])
    y = played(u, A, b, C, 3, delay=5)
    y[np.arange(len(y)) % 10 > 0, 1] = np.nan
    assert identify_outputs(y, u, dt=1, order=3).delays == (5,)
    y[::10, 1] = played(u, A, b, C, 4)[::10, 1]
    assert identify_outputs(y, u, dt=1, order=3).delays == (0,)
    alone = identify_outputs(y[:, 1:], u, dt=1, order=3)
    assert (alone.every, alone.delays) == ((10,), (0,)) and alone.long_fit > 80
    with pytest.raises(ValueError, match=r"y\[1\] has 29 readings.*fewer than 30"):
        identify_outputs(y[:290], u[:289], dt=1)


@pytest.mark.nightly
def test_intervals_of_poles_and_gains_hold_the_truth_nearly_as_often_as_they_say() -> None:
    plant = {"A": np.array([[0.9, 0.05], [0.0, 0.8]]), "B": np.array([[0.5, 0.0], [0.0, 0.3]])}
    C = np.array([[1.0, 0.0]])
    gains = C @ np.linalg.solve(np.eye(2) - plant["A"], plant["B"])
    inside = []
    for seed in range(20):
        u = steps(600, 2, seed)
        found = identify_outputs(played(u, **plant, C=C, seed=seed), u, dt=1, order=2)
        told = found.model.gains
        assert told is not None and not told.errors[1:].any()  # only the first state is an output
        inside.append(np.abs(told.values[:1] - gains) <= 1.96 * told.errors[:1])
    assert np.mean(inside) > 0.85
    says = "± is a 95 % interval, under process and sensor noise, if the order is right.\n"
    assert says in found.report()


def test_an_output_that_integrates_has_a_rate_and_no_gain() -> None:
    tank = {"A": np.array([[1.0]]), "B": np.array([[0.05, -0.05]]), "C": np.array([[1.0]])}
    u = steps(600, 2, 0, hold=8)
    found = identify_outputs(played(u, **tank, seed=0, noise=0.02), u, dt=2, order=1, delay=0)
    gains = found.model.gains
    assert gains is not None and gains.integrators == 1 and np.all(gains.degrees == 1)
    assert np.all(np.abs(gains.values - tank["B"]) <= 1.96 * gains.errors)
    assert "may integrate" in found.report() and "per sample" in found.report()
    assert "A pole that may be 1 may be a load that drifts, and is not measured" in found.report()
