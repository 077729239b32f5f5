"""A control.StateSpace becomes a LinearModel with its states, and what is lost is said."""

from typing import Any

import control
import numpy as np
import pytest

from sb3_yann import LinearModel

A = [[0, 1], [-4, -0.5]]
B = [[0, 1], [1, 0]]
EYE = np.eye(2)
ZERO = np.zeros((2, 2))


def test_a_discrete_system_is_taken_as_it_is() -> None:
    model = LinearModel.from_statespace(control.ss(A, B, EYE, ZERO, 0.1), x_ss=[1, 2])
    assert model == LinearModel(A, B, 0.1, [1, 2])
    assert model.notes == ("From a control.StateSpace, taken as it is, discrete.",)


def test_a_continuous_system_is_sampled_exactly() -> None:
    model = LinearModel.from_statespace(control.ss(A, B, EYE, ZERO), 0.1)
    assert model == LinearModel.from_continuous(A, B, 0.1)


def test_a_discrete_system_without_a_sampling_time_takes_the_given_one() -> None:
    model = LinearModel.from_statespace(control.ss(A, B, EYE, ZERO, True), 0.1)
    assert model == LinearModel(A, B, 0.1)


@pytest.mark.parametrize("name", [1, "wind"])
def test_an_input_may_be_a_measured_disturbance(name: Any) -> None:
    system = control.ss(A, B, EYE, ZERO, 0.1, inputs=["valve", "wind"])
    model = LinearModel.from_statespace(system, disturbances=[name], d_ss=[7])
    assert model == LinearModel(A, [[0], [1]], 0.1, E=[[1], [0]], d_ss=[7])


def test_a_feedthrough_that_is_dropped_is_reported() -> None:
    report = LinearModel.from_statespace(control.ss(A, B, EYE, EYE, 0.1)).report()
    assert "D is not zero and was dropped" in report
    assert "C is not the identity" not in report


def test_outputs_that_are_not_the_states_are_reported() -> None:
    report = LinearModel.from_statespace(control.ss(A, B, [[1, 0]], 0, 0.1)).report()
    assert "C is not the identity:" in report
    assert "Estimate them by a StateEstimator." in report


def test_states_that_no_observer_finds_are_reported() -> None:
    system = control.ss([[0.5, 0], [0, 0.6]], B, [[1, 0]], 0, 0.1)
    assert "not possible: the outputs show 1 of 2" in LinearModel.from_statespace(system).report()


BAD_SYSTEMS: list[tuple[Any, dict[str, Any], type[Exception], str]] = [
    (control.tf([1], [1, 1]), {}, TypeError, "must be a control.StateSpace"),
    (control.ss(A, B, EYE, ZERO), {}, ValueError, "the system is continuous. Pass dt"),
    (control.ss(A, B, EYE, ZERO, True), {}, ValueError, "discrete, without a sampling time. Pass"),
    (control.ss(A, B, EYE, ZERO, None), {"dt": 1}, ValueError, "system.dt is None"),
    (control.ss(A, B, EYE, ZERO, 0.1), {"dt": 0.2}, ValueError, "discrete with dt = 0.1, and is"),
    (control.ss(A, B, EYE, ZERO), {"dt": 0}, ValueError, "dt = 0 must be a finite number above 0"),
    (control.ss(A, B, EYE, ZERO, 1), {"disturbances": ["wind"]}, ValueError, "'wind' is no input"),
    (control.ss(A, B, EYE, ZERO, 1), {"disturbances": [2]}, ValueError, "2 is no input"),
    (control.ss(A, B, EYE, ZERO, 1), {"disturbances": [0, 1]}, ValueError, "at least one input"),
]


@pytest.mark.parametrize(("system", "arguments", "error", "message"), BAD_SYSTEMS)
def test_bad_system_is_named(
    system: Any, arguments: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=f"(?s){message}"):
        LinearModel.from_statespace(system, **arguments)
