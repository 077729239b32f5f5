"""What an env takes follows from its bounds; absolute states from where they lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sb3_yann import LinearModel, LinearMPC
from sb3_yann.control.mpc.plant_units import InputUnits, misread_state

MODEL = LinearModel(np.eye(2) / 2, np.eye(2), 1.0, x_ss=[1, 0], u_ss=[300, -2])
MPC = LinearMPC(
    MODEL, Q=np.eye(2), R=np.eye(2), horizon=1, x_min=-2, x_max=2, u_min=[-1, -3], u_max=[2, 5]
)
BOUNDS = {
    "deviation": ([-1, -3], [2, 5]),
    "absolute": ([299, -5], [302, 3]),
    "normalized": ([-1, -1], [1, 1]),
}


def test_a_bound_on_one_side_is_compared_on_that_side() -> None:
    mpc = replace(MPC, u_min=[0, -3], u_max=[np.inf, np.inf])
    above = [np.inf, np.inf]
    found = InputUnits.of(mpc, np.array([0.0, -3]), np.array(above))
    assert found is not None and found.kind == "deviation"
    found = InputUnits.of(mpc, np.array([300.0, -5]), np.array(above))
    assert found is not None and found.kind == "absolute"
    assert InputUnits.of(mpc, np.array([-5.0, -3]), np.array(above)) is None
    assert InputUnits.of(mpc, np.array([0.0, -3]), np.array([1e6, np.inf])) is None


@pytest.mark.parametrize("kind", BOUNDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_bounds_tell_what_an_env_takes(kind: str, dtype: type) -> None:
    low, high = (np.array(side, dtype) for side in BOUNDS[kind])
    units = InputUnits.of(MPC, low, high)
    assert units is not None and units.kind == kind
    np.testing.assert_allclose(units.input([low, high]), [MPC.u_min, MPC.u_max], atol=1e-12)
    u = np.random.default_rng(0).uniform(MPC.u_min, MPC.u_max, (9, 2))
    np.testing.assert_allclose(units.input(units.action(u)), u, atol=1e-12)


def test_bounds_rounded_to_float32_still_fit() -> None:
    mpc = replace(MPC, u_min=[-1 / 3, -3], u_max=[2 / 3, 5])
    low, high = np.float32([300 - 1 / 3, -5]), np.float32([300 + 2 / 3, 3])
    units = InputUnits.of(mpc, low, high)
    assert units is not None and units.kind == "absolute"


@pytest.mark.parametrize(
    ("low", "high"),
    [([299, -5], [302, 3.1]), ([299, -3], [302, 5]), ([-1, -1], [1, 2]), ([299], [302])],
    ids=["a bound of its own", "one of each", "half normalized", "one input"],
)
def test_other_bounds_tell_nothing(low: list[float], high: list[float]) -> None:
    assert InputUnits.of(MPC, np.array(low, float), np.array(high, float)) is None


def test_a_problem_knows_whether_it_was_stated_in_absolute_values() -> None:
    bounds = {"u_min": [299, -5], "u_max": [302, 3], "theta_min": -1, "theta_max": 3}
    mpc = LinearMPC(MODEL, Q=np.eye(2), R=np.eye(2), horizon=1, absolute=True, **bounds)
    assert mpc.absolute and not MPC.absolute
    other = replace(mpc, horizon=2)  # what is stored are deviations; what is given stays absolute
    assert other.u_min.tolist() == mpc.u_min.tolist() == [-1, -3]
    assert other.absolute and replace(other, horizon=1) == mpc


@pytest.mark.parametrize(
    "theta",
    [[2.5, 0], [2.1, 0], [2.5, 9], [0, 0]],
    ids=["near to zero", "just outside", "outside anyway", "inside"],
)
def test_a_deviation_is_not_taken_for_an_absolute_value(theta: list[float]) -> None:
    assert misread_state(MPC, np.array([theta])) is None


def test_the_state_that_lies_at_the_operating_point_is_found() -> None:
    mpc = replace(MPC, model=replace(MODEL, x_ss=[1, -30]))
    assert misread_state(mpc, np.array([[1.2, -30.5], [0.8, -29]])) == 1
    assert misread_state(mpc, np.array([[-0.8, 29.5]]), sign=-1) == 1
    assert misread_state(mpc, np.zeros((0, 2))) is None


@pytest.mark.parametrize(("beyond", "fits"), [(1.9e-6, True), (2.1e-6, False)])
def test_bounds_may_be_two_millionths_of_a_half_width_off(beyond: float, fits: bool) -> None:
    half = np.array([1.5, 4.0])
    for kind, (low, high) in BOUNDS.items():
        size = half if kind != "normalized" else np.ones(2)
        for sign in (1, -1):
            moved = np.array(low, float) + sign * beyond * size
            found = InputUnits.of(MPC, moved, np.array(high, float))
            assert (found is not None) == fits and (found is None or found.kind == kind)


def test_nine_rows_of_ten_must_speak_for_an_absolute_state() -> None:
    mpc = replace(MPC, model=replace(MODEL, x_ss=[1, -30]))
    absolute, plain = [1.2, -30.5], [0.5, 0.5]
    assert misread_state(mpc, np.array([absolute] * 9 + [plain])) == 1
    assert misread_state(mpc, np.array([absolute] * 8 + [plain] * 2)) is None
    outside = [1.2, -37.0]  # as absolute as as a deviation
    assert misread_state(mpc, np.array([absolute] * 9 + [outside])) == 1
    assert misread_state(mpc, np.array([absolute] * 8 + [outside] * 2)) is None
    assert misread_state(MPC, np.array([absolute] * 9)) is None  # of the first state alone


def test_the_state_that_is_farther_from_zero_than_twice_from_its_point_is_named() -> None:
    mpc = replace(MPC, model=replace(MODEL, x_ss=[5, -30]))
    assert misread_state(mpc, np.array([[4.0, -30.0]])) == 1
    mpc = replace(MPC, model=replace(MODEL, x_ss=[3.0, 0.0]))
    assert misread_state(mpc, np.array([[2.1, 0.0]])) == 0  # 0.9 from the point, 2.1 from zero
    mpc = replace(MPC, model=replace(MODEL, x_ss=[4.0, 0.0]))
    assert misread_state(mpc, np.array([[2.5, 0.0]])) is None  # 1.5 is more than half of it
