"""A LinearModel is sampled exactly, linearized rightly, named, and cannot be changed."""

import dataclasses
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from errors import Message, raises
from sb3_yann import LinearModel
from sb3_yann_envs import cstr

MODEL = LinearModel(
    [[1, 0.1], [0, 0.9]], [[0], [1]], 0.5, x_ss=[1, 2], u_ss=[3], E=[[2], [0]], d_ss=[4]
)


@settings(derandomize=True, max_examples=50, deadline=None)
@given(st.integers(1, 4), st.integers(1, 3), st.floats(1e-3, 2.0), st.integers(0, 2**32 - 1))
def test_sampling_is_the_matrix_exponential(n: int, m: int, dt: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    B = rng.normal(size=(n, m))
    # x' = A x + B u with u' = 0, in one exponential (Van Loan 1978)
    both = expm(dt * np.vstack([np.hstack([A, B]), np.zeros((m, n + m))]))
    for k in (0, m):  # inputs alone, and the first as an input, others as disturbances
        model = LinearModel.from_continuous(A, B[:, : m - k + 1], dt, E=B[:, m - k + 1 :])
        found = np.hstack([model.A, model.B, model.E])
        np.testing.assert_allclose(found, both[:n], rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(("A", "B", "dt"), [(800, 1, 1), (0.1, 1, 1e5), (0, 1e308, 1e10)])
def test_a_model_that_cannot_be_sampled_says_why(A, B, dt) -> None:
    message = r"Sampled every dt = .* too large for numbers; its poles are \[.*unit of time"
    with pytest.raises(ValueError, match=message):
        LinearModel.from_continuous([[A]], [[B]], dt)


def test_dynamics_take_measured_disturbances() -> None:
    def f(x: Any, u: Any, d: Any) -> Any:
        return [-x[0] * d[0] + u[0] + 6 + d[1] ** 2 - 1]

    model = LinearModel.from_dynamics(f, [3], [0], 0.1, d_ss=[2, 1])  # at rest
    exact = LinearModel.from_continuous([[-2]], [[1]], 0.1, E=[[-3, 2]])  # by hand
    np.testing.assert_allclose(model.A, exact.A, atol=1e-9)
    np.testing.assert_allclose(model.E, exact.E, atol=1e-9)
    assert model.d_ss.tolist() == [2, 1]


def test_dynamics_are_exact_to_nine_digits_in_coordinates_of_hundreds() -> None:
    x = cstr.X_SS
    u = cstr.U_SS
    truth = np.zeros((4, 5))
    for i in range(5):  # complex steps: no difference is taken, so nothing is lost to rounding
        z = np.concatenate([x, u]).astype(complex)
        z[i] += 1e-30j
        truth[:, i] = np.array(cstr._rates.py_func(*z)).imag / 1e-30
    model = LinearModel.from_dynamics(cstr.dynamics, x, u, cstr.DT)
    exact = LinearModel.from_continuous(truth[:, :4], truth[:, 4:], cstr.DT)
    np.testing.assert_allclose(model.A, exact.A, atol=1e-9)
    np.testing.assert_allclose(model.B, exact.B, atol=1e-9)


def test_step_takes_one_state_and_a_batch() -> None:
    x = np.array([[1.0, 2.0], [3.0, 4.0]])
    u = np.array([[1.0], [-1.0]])
    expected = [[1.2, 2.8], [3.4, 2.6]]  # by hand
    np.testing.assert_allclose(MODEL.step(x, u), expected)
    np.testing.assert_allclose(MODEL.step(x[0], u[0]), expected[0])
    with_disturbances = MODEL.step(np.ones((2, 2)), np.zeros((2, 1)), [[1.0], [-1.0]])
    np.testing.assert_allclose(with_disturbances, [[3.1, 0.9], [-0.9, 0.9]])  # by hand


def test_notes_are_no_part_of_equality() -> None:
    noted = LinearModel(**{**vars(MODEL), "notes": ["found in the attic"]})
    assert (noted, hash(noted), repr(noted)) == (MODEL, hash(MODEL), repr(MODEL))
    assert noted.notes == ("found in the attic",)


def test_a_changed_model_loses_the_notes_and_the_drift_of_the_old_one() -> None:
    noted = LinearModel(**{**vars(MODEL), "notes": ["fits"], "drift": [1, 0]})
    assert (noted.notes, noted.drift.tolist()) == (("fits",), [1, 0])
    assert not np.any(dataclasses.replace(noted, dt=1.0).drift)
    assert dataclasses.replace(noted, dt=1.0).notes == ()


def reaction(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Concentration in mol/l of a trace that flows in and reacts with itself."""
    return np.array([u[0] * (1e-5 - x[0]) - 1e4 * x[0] ** 2])


TRACE = (np.sqrt(1.4) - 1) / 2e4
"""Where it rests with u = 1: the root of 1e4 x**2 + x - 1e-5."""


def test_trace_off_its_steady_state_is_refused_by_its_scale_and_warned_of_without() -> None:
    point = ([1.9 * TRACE], [1.0], 0.1)
    with pytest.raises(ValueError, match=r"no steady state.* with a scale of \[1e-05\]"):
        LinearModel.from_dynamics(reaction, *point, scale=[1e-5])
    with pytest.warns(UserWarning, match="much beside itself. Pass scale="):
        LinearModel.from_dynamics(reaction, *point)
    model = LinearModel.from_dynamics(reaction, [TRACE], [1.0], 0.1, scale=[1e-5])
    np.testing.assert_allclose(model.A, np.exp(0.1 * (-1 - 2e4 * TRACE)), rtol=1e-9)


def test_a_steady_state_that_hardly_moves_is_not_warned_of(recwarn) -> None:
    """A small part of itself, although more than rounding; a zero has no part of itself."""

    def tank(x, u):
        return np.array([u[0] - 0.01 * x[0], 1e-4 - 0.01 * x[1]])

    LinearModel.from_dynamics(tank, [100.001, 0.0], [1.0], 0.1, scale=None)
    assert not recwarn


def test_bend_that_is_short_beside_one_is_linearized_with_its_scale() -> None:
    def f(x, u):
        return 1e-6 * (u - np.tanh(x / 1e-6))

    with pytest.raises(ValueError, match="pass scale="):
        LinearModel.from_dynamics(f, [0], [0], 0.1)
    model = LinearModel.from_dynamics(f, [0], [0], 0.1, scale=[1e-6])
    np.testing.assert_allclose(model.A, np.exp(-0.1), rtol=1e-9)


@pytest.mark.filterwarnings("ignore:invalid value encountered in sqrt")
def test_tank_that_is_nearly_empty_is_linearized_with_shorter_steps() -> None:
    level = 1e-4
    rest = [2e-3 * np.sqrt(level)]
    model = LinearModel.from_dynamics(lambda x, u: u - 2e-3 * np.sqrt(x), [level], rest, 0.1)
    np.testing.assert_allclose(model.A, np.exp(-0.1 * 1e-3 / np.sqrt(level)), rtol=1e-9)
    assert "along x[0]: it has no value there" in model.notes[0]


NAMES: dict[str, Any] = {
    "state_names": ["level", "T.top"],
    "input_names": ["pump"],
    "units": {"level": "cm", "pump": "V"},
}
A = [[0.9, 0.1], [0.0, 0.8]]
B = [[1.0], [0.5]]


def test_names_and_units_are_shown_and_a_gain_is_one_of_changes() -> None:
    model = LinearModel(A, B, dt=1.0, x_ss=[12, 350], u_ss=[3], **NAMES)
    report = model.report()
    assert "States: level (cm), T.top. Inputs: pump (V)." in report
    assert "  pump (V): level +12.5 cm, T.top +2.5.\n" in report
    assert repr(model).startswith("LinearModel(states=['level (cm)', 'T.top'], inputs=['pump (V)']")
    assert "x_ss=[12.0, 350.0]" in repr(model)
    assert model.units == ("cm", "", "V")
    assert "Scaling: entries of B from 0.5 to 1.\n" in report  # nothing to balance
    assert "What one unit more of an input, held, does in the end:\n" in report


def test_names_are_kept_by_copies_and_do_not_count_in_equality() -> None:
    model = LinearModel(A, B, dt=1.0, **NAMES)
    plain = LinearModel(A, B, dt=1.0)
    assert model == plain
    assert hash(model) == hash(plain)
    for other in (
        dataclasses.replace(model, A=np.eye(2)),
        pickle.loads(pickle.dumps(model)),
        plain.named(**NAMES),
    ):
        assert other.state_names == ("level", "T.top")
        assert (other.input_names, other.units) == (model.input_names, model.units)


def test_naming_a_model_keeps_its_notes_and_drift() -> None:
    model = LinearModel(A, B, dt=1.0, notes=["from a log"], drift=[0.1, 0]).named(["a", "b"])
    assert (model.notes, model.drift.tolist()) == (("from a log",), [0.1, 0])
    fed = LinearModel(A, B, dt=1.0, E=[[0.1], [0]]).named(
        units={"feed": "kg/s"}, disturbance_names=["feed"]
    )
    assert (fed.disturbance_labels, fed.units[-1]) == (["feed"], "kg/s")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"state_names": "ab"}, TypeError("state_names = 'ab' must be a list of str")),
        ({"state_names": ["a"]}, "must be 2 different names"),
        ({"state_names": ["a", "a"]}, "must be 2 different names"),
        ({"state_names": ["a", "b"], "input_names": ["a"]}, "'a'. name two signals"),
        ({"state_names": ["u[0]", "b"]}, "name two signals"),
        ({"input_names": [1]}, TypeError("input_names = .* must be a list of str")),
        ({"units": {"speed": "m"}}, "units has .'speed'., but the names are"),
        ({"units": ["m"]}, "must have one entry for each of"),
        ({"units": {"x[0]": 1}}, TypeError("must map names to str")),
    ],
)
def test_bad_names_are_named(changes: Any, message: Message) -> None:
    with raises(message):
        LinearModel(A, B, dt=1.0, **changes)


@pytest.mark.parametrize(
    "name", ["T\x1b[31m", "T\n", "a\tb", "\x00", "\x7f", "\ud800", "a\u2028b", "\uffff"]
)
def test_what_is_no_text_is_refused_in_names_and_units(name: str) -> None:
    for own in ({"state_names": [name, "b"]}, {"input_names": [name]}, {"units": [name, "", ""]}):
        with pytest.raises(ValueError, match="holds a character that is no text"):
            LinearModel(A, B, dt=1.0, **own)
    LinearModel(A, B, dt=1.0, state_names=["\N{SNOWMAN}", "T\N{NO-BREAK SPACE}1"])
