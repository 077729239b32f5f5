"""Equations in any shape, their steady state, and the differences taken of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from sb3_yann import LinearModel
from sb3_yann.control.linearization import Jacobian, jacobian, notes_of
from sb3_yann_envs import cstr

NAN = np.nan
A = np.array([[0.0, 1.0], [-2.0, -0.3]])
B = np.array([[0.0], [1.0]])


def flat(x: Any, u: Any) -> Any:
    return A @ x + B @ u


def ragged(x: Any, u: Any) -> Any:
    return [x[1], -2 * x[0] - 0.3 * x[1] + u]  # a number, and an array with one entry


def stacked(x: Any, u: Any) -> Any:
    return np.vstack([x[1], -2 * x[0] - 0.3 * x[1] + u[0]])  # vectors in, a column out


@pytest.mark.parametrize("f", [ragged, stacked])
def test_lists_and_columns_that_are_returned_are_taken_as_vectors_are(f: Any) -> None:
    model, same = (LinearModel.from_dynamics(each, [0, 0], [0], 0.1) for each in (f, flat))
    np.testing.assert_allclose(model.A, same.A, atol=1e-9)
    np.testing.assert_allclose(model.B, same.B, atol=1e-9)


def test_the_state_of_the_reactor_is_solved_for() -> None:
    model = LinearModel.from_dynamics(cstr.dynamics, [NAN] * 4, cstr.U_SS, cstr.DT)
    np.testing.assert_allclose(cstr.dynamics(model.x_ss, model.u_ss), 0, atol=1e-6)
    assert "steady state: 4 entries" in model.notes[0]


def test_the_input_that_holds_a_level_is_solved_for() -> None:
    def tanks(x: Any, u: Any) -> Any:
        q = math.sqrt(x[0])  # raises below 0, where numpy's returns NaN
        return [u[0] - q, q - math.sqrt(x[1])]

    model = LinearModel.from_dynamics(tanks, [4, NAN], [NAN], 1.0)
    np.testing.assert_allclose([*model.x_ss, *model.u_ss], [4, 4, 2], atol=1e-6)


def test_several_steady_states_are_reported() -> None:
    model = LinearModel.from_dynamics(lambda x, u: x - x**3 + u, [NAN], [0], 0.1)
    assert "There are others, [1.0, 0.0]; [-1.0, 0.0]" in model.notes[0]


def test_more_unknowns_than_equations_are_reported() -> None:
    model = LinearModel.from_dynamics(lambda x, u: u - x, [NAN], [NAN], 0.1)
    assert "one of many" in model.notes[0]


def test_no_steady_state_is_an_error_that_says_how_near() -> None:
    with pytest.raises(ValueError, match=r"No steady state was found\. The best is x_ss = "):
        LinearModel.from_dynamics(lambda x, u: 1 + x**2, [NAN], [0], 0.1)


def test_of_several_steady_states_one_that_the_input_holds_is_taken() -> None:
    def reactor(x: Any, u: Any) -> Any:  # washed out, or with cells that live
        rate = 0.5 * x[1] / (1 + x[1]) * x[0]
        return [rate - u[0] * x[0], u[0] * (20 - x[1]) - 2 * rate]

    model = LinearModel.from_dynamics(reactor, [NAN, 3], [NAN], 0.5)
    np.testing.assert_allclose([*model.x_ss, *model.u_ss], [8.5, 3, 0.375], rtol=1e-6)
    assert "There are others, [0.0, 3.0, 0.0]" in model.notes[0]


EPS = np.finfo(float).eps
ONE = np.ones(1)


def of(f: Any, at: float = 0.0, longest: float = 0.1, noise: float = EPS) -> Jacobian:
    """Return the derivative of a function of one number."""
    return jacobian(lambda z: np.atleast_1d(f(z[0])), at * ONE, longest * ONE, noise * ONE, ["z"])


@pytest.mark.parametrize(("k", "smooth"), [(0.0049, True), (0.0052, False), (-0.0052, False)])
def test_slopes_that_differ_by_a_hundredth_of_the_steepest_are_a_kink(k, smooth) -> None:
    """Of z + k |z|: they differ by 2 k, and the steepest is 1 + k."""
    if smooth:
        of(lambda z: z + k * abs(z))
    else:
        with pytest.raises(ValueError, match=r"along z, its slopes to the two sides differ"):
            of(lambda z: z + k * abs(z))


def test_a_jump_has_no_slope() -> None:
    with pytest.raises(ValueError, match="no limit for short steps"):
        of(lambda z: z + 0.01 * np.sin(1e5 * z), at=0.3)
    with pytest.raises(ValueError, match=r"differ|no limit"):
        of(lambda z: z + (z > 0))


def test_a_point_in_float32_is_differenced_between_what_is_evaluated() -> None:
    def single(z: np.ndarray) -> np.ndarray:
        return z.astype(np.float32).astype(np.float64)

    found = jacobian(lambda z: z**2, 1.1 * ONE, 1e-2 * ONE, EPS * ONE, ["z"], single)
    assert found.value[0, 0] == pytest.approx(2 * float(np.float32(1.1)), rel=1e-6)
    with pytest.raises(ValueError, match="no finite value"):  # steps that rounding swallows
        jacobian(lambda z: z**2, 1.1 * ONE, 1e-8 * ONE, EPS * ONE, ["z"], single)


def test_the_notes_tell_what_is_dropped_what_bends_and_what_has_no_effect() -> None:
    def notes(change: list[float], value: Any = ((1.0, 1.0),), dropped: float = 0.0) -> list[str]:
        steps = np.array([0.5, 0.25])
        found = Jacobian(np.array(value), dropped, steps, np.array(change), 0.0)
        return notes_of(found, ["x[0]", "u[0]"])

    assert notes([0.1, 0.0]) == []
    bends = "The plant is not smooth within 0.25 of the operating point along u[0]: slopes differ"
    assert notes([0.0, 0.101]) == [f"{bends} by 10%."]
    (none,) = notes([np.nan, 0.0])
    assert "within 0.5 of the operating point along x[0]: it has no value" in none
    assert notes([0.0, 0.0], [[0.0, 1.0]]) == ["x[0] has no effect on the next state."]
    assert "(at most 1.5e-09) were set to zero" in notes([0.0, 0.0], dropped=1.5e-9)[0]


def test_steps_at_whose_ends_there_is_no_value_are_left_out() -> None:
    found = of(lambda z: np.sqrt(z) if z > 0.9 else np.nan, at=1.0, longest=0.3)
    assert found.value[0, 0] == pytest.approx(0.5, rel=1e-10)
    assert np.isnan(found.change[0])
    with pytest.raises(ValueError, match="no finite value on one of its sides"):
        of(lambda z: z if z >= 1 else np.nan, at=1.0)
