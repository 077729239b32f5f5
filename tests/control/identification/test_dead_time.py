"""Dead time is found, and held as states of the model; curvature is not taken for it."""

from typing import Any

import numpy as np
import pytest

from sample_plants import played
from sb3_yann import LinearModel, identify

A = np.array([[0.9, 0.2], [0.0, 0.7]])
B = np.array([[0.0, 0.5], [1.0, 0.0]])


def late(delays: tuple[int, int], noise: float, hold: int = 1, mean: float = 0.0) -> Any:
    """Return states and actions of a plant whose inputs act late; noise in units of the state."""
    rng = np.random.default_rng(sum(delays) + hold)
    u = mean + np.repeat(rng.choice([-1.0, 1.0], (600 // hold, 2)), hold, axis=0)
    x = np.zeros((601, 2))
    for k in range(600):
        acting = np.array([u[k - L, j] if k >= L else 0.0 for j, L in enumerate(delays)])
        x[k + 1] = A @ x[k] + B @ acting + noise * rng.normal(size=2)
    return x, u


@pytest.mark.parametrize("delays", [(0, 0), (1, 0), (2, 5), (3, 3), (0, 8)])
@pytest.mark.parametrize(("noise", "hold"), [(0.0, 1), (0.02, 5), (0.1, 1)])
def test_dead_time_is_found_for_each_input(
    delays: tuple[int, int], noise: float, hold: int
) -> None:
    found = identify(*late(delays, noise, hold), dt=1, delay="auto")
    assert found.model.n_states == 2 + sum(delays)
    if any(delays):
        assert f"inputs act for {list(delays)} samples" in found.model.report()


def test_a_model_with_dead_time_predicts_and_rests() -> None:
    x, u = late((2, 0), 0.0, mean=0.3)
    model = LinearModel.from_data(x, u, dt=1, delay=[2, 0])
    np.testing.assert_allclose(model.A[:2, :2], A, atol=1e-6)
    np.testing.assert_allclose(model.A[:2, 3], B[:, 0], atol=1e-6)  # the older of the two acts
    np.testing.assert_array_equal(model.A[2:], [[0, 0, 0, 0], [0, 0, 1, 0]])
    np.testing.assert_array_equal(model.B[2:], [[1, 0], [0, 0]])
    np.testing.assert_allclose(model.x_ss[2:], model.u_ss[0], atol=1e-6)
    np.testing.assert_allclose(A @ model.x_ss[:2] + B @ model.u_ss, model.x_ss[:2], atol=1e-6)


def test_a_given_steady_state_is_completed_by_the_inputs_that_rest_there() -> None:
    x, u = late((1, 0), 0.0)
    model = LinearModel.from_data(x, u, dt=1, delay=[1, 0], x_ss=[0, 0], u_ss=[0, 0])
    assert model.x_ss.shape == (3,)
    with pytest.raises(ValueError, match=r"x_ss is given without u_ss.*pass both, or neither"):
        identify(x, u, dt=1, delay=1, x_ss=[0, 0])


def test_inputs_on_their_way_rest_where_a_given_input_does_however_far_from_the_data() -> None:
    x, u = late((2, 3), 0.0)
    for far in (1.5, 40.0):
        model = LinearModel.from_data(x, u, dt=1, delay=[2, 3], u_ss=[far, -far])
        np.testing.assert_array_equal(model.x_ss[2:], np.repeat([far, -far], [2, 3]))
    near = LinearModel.from_data(x, u, dt=1, delay=[2, 3], u_ss=[0.5, 0.2])
    rest = near.x_ss[:2]
    np.testing.assert_allclose(A @ rest + B @ near.u_ss, rest, atol=1e-6)


def test_what_is_certain_of_the_memory_is_left_out_of_the_notes() -> None:
    report = LinearModel.from_data(*late((2, 3), 0.02), dt=1, delay=[2, 3]).report()
    told = next(each for each in report.splitlines() if "95 % confidence" in each)
    assert told.count("within") == 2 and "unstable" not in told and "hardly" not in told
    assert "held out, 100 % is perfect: 9" in report and "100, 100" not in report


def test_names_of_the_inputs_on_their_way_follow_from_those_of_the_inputs() -> None:
    model = LinearModel.from_data(*late((2, 0), 0.02), dt=1, delay=[2, 0])
    named = model.named(["T", "h"], ["w", "v"], ["K", "m", "kg/s", "V"])
    assert named.state_names == ("T", "h", "w(k-1)", "w(k-2)")
    assert named.units == ("K", "m", "kg/s", "kg/s", "kg/s", "V")
    assert named.named(["a", "b"], ["c", "d"]).state_names == ("a", "b", "c(k-1)", "c(k-2)")
    assert model.named(["T", "h"], ["w", "v"], {"T": "K", "w": "kg"}).units[2:4] == ("kg", "kg")
    whole = named.named(["a", "b", "c", "d"], ["e", "f"], {"a": "K"})
    assert whole.state_names == ("a", "b", "c", "d") and whole.units[0] == "K"
    assert model.named(["T", "h"]).state_names == ("T", "h", "u[0](k-1)", "u[0](k-2)")
    with pytest.raises(ValueError, match="must be 4 different names"):
        model.named(["a", "b", "c"])


def curved(x: Any, u: Any) -> Any:
    a, b = x
    return a + 0.2 * (b - a**3 - 0.5 * a * b), 0.8 * b + 0.5 * np.exp(u[0])


def test_curvature_is_called_by_its_name() -> None:
    u = np.repeat(np.random.default_rng(0).uniform(-1, 1, (80, 1)), 5, axis=0)
    x = played(curved, u, [0, 0])
    model = LinearModel.from_data(x, u, dt=1)  # warns of no dead time
    assert "Curvature: squares and products" in model.report()
    assert "sensor noise" not in model.report()
    assert identify(x, u, dt=1, delay="auto").model.n_states == 2


@pytest.mark.parametrize("delay", [0, 2, 5])
def test_dead_time_of_a_curved_plant_is_found(delay: int) -> None:
    rng = np.random.default_rng(delay)
    u = np.repeat(rng.uniform(-1, 1, (125, 1)), 4, axis=0)
    late = np.vstack([np.zeros((delay, 1)), u[: 500 - delay]])
    x = played(lambda x, u: np.subtract(curved(x, u), [0, 0.5]), late, [0, 0])
    x = x + 0.005 * rng.normal(size=x.shape)
    assert identify(x, u, dt=1, delay="auto").model.n_states == 2 + delay


@pytest.mark.parametrize("delay", ["soon", -1, [1, 2, 3], 1.5, True, [[1], [1, 2]]])
def test_a_bad_delay_is_named(delay: Any) -> None:
    with pytest.raises(ValueError, match=r"delay = .* must be"):
        identify(*late((0, 0), 0.0), dt=1, delay=delay)


def test_the_wrapper_that_shows_inputs_on_their_way_is_named_with_what_they_were() -> None:
    rng = np.random.default_rng(0)
    u = rng.uniform(30, 50, 300)
    x = [70.0, 70.0, 70.0]
    for k in range(2, 300):
        x.append(70 + 0.9 * (x[-1] - 70) + 0.3 * (u[k - 2] - 40))
    found = identify(np.array(x)[:, None], u[:, None], dt=1, delay="auto", u_ss=[40])
    assert found.delays == (2,)
    assert "PastInputs(env, [2], initial=[40])" in str(found)
