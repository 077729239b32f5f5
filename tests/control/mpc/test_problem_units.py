"""A problem in plant units solves the same problem as its deviations, about zero."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import warnings
from typing import Any

import numpy as np
import pytest

from sb3_yann import (
    DisturbanceBounds,
    LinearModel,
    LinearMPC,
    OutputBounds,
    RateLimits,
    SoftBounds,
    Terminal,
    Tracking,
)
from sb3_yann.control.mpc.bound_excess import BoundNames, bound_excess, excess_of_episodes

X_SS = np.array([350.0, 2.0])
U_SS = np.array([10.0])
D_SS = np.array([5.0])
MODEL = LinearModel(
    [[0.9, 0.2], [0, 0.7]], [[0], [1]], 1.0, X_SS, U_SS, E=[[0.1], [0.0]], d_ss=D_SS
)
OWN = LinearModel(MODEL.A, MODEL.B, 1.0, E=MODEL.E)
WEIGHTS: dict[str, Any] = {"Q": np.eye(2), "R": [[1]], "horizon": 2, "rate": RateLimits(-0.5, 0.5)}
SOFT = SoftBounds(x=[1, 0], penalty=100)


def deviations() -> LinearMPC:
    return LinearMPC(
        OWN, **WEIGHTS, x_min=[-20, -1], x_max=[20, 3], u_min=-2, u_max=5,
        tracking=Tracking([0], -5, 5), disturbances=DisturbanceBounds(-1, 2),
        outputs=OutputBounds([[1, 1]], y_max=30), soft=SOFT,
    )  # fmt: skip


def shown() -> LinearMPC:
    return LinearMPC(
        MODEL, **WEIGHTS, x_min=[330, 1], x_max=[370, 5], u_min=8, u_max=15,
        tracking=Tracking([0], 345, 355), disturbances=DisturbanceBounds(4, 7),
        outputs=OutputBounds([[1, 1]], y_max=382), soft=SOFT,
    )  # fmt: skip


def test_the_deviations_of_a_problem_are_the_problem_about_zero() -> None:
    assert shown().deviations == deviations()
    assert deviations().deviations == deviations()


def test_a_terminal_set_is_in_plant_units_too() -> None:
    mpc = dataclasses.replace(shown(), terminal=Terminal(set="invariant"))
    own = dataclasses.replace(deviations(), terminal=Terminal(set="invariant"))
    F, g = mpc.terminal.set
    np.testing.assert_allclose(g - F @ mpc.theta_ss, own.terminal.set[1])
    given = dataclasses.replace(mpc, terminal=Terminal(set=([[1.0, 0], [-1, 0]], [355, -345])))
    np.testing.assert_allclose(given.deviations.terminal.set[1], [5, 5])


def test_what_a_problem_tells_is_in_plant_units() -> None:
    mpc = shown()
    own = deviations()
    rng = np.random.default_rng(0)
    theta = rng.uniform(own.theta_min, own.theta_max, (20, own.n_theta))
    u = rng.uniform(own.u_min, own.u_max, (20, 1))
    at = theta + mpc.theta_ss
    np.testing.assert_allclose(mpc.stage_cost(at, u + U_SS), own.stage_cost(theta, u))
    np.testing.assert_allclose(mpc.predict(at, u + U_SS), own.predict(theta, u) + mpc.theta_ss)
    np.testing.assert_allclose(mpc.explicit().plant_input(at), own.explicit()(theta) + U_SS)
    thetas, inputs = mpc.simulate(at[0], 5)
    expected = own.simulate(theta[0], 5)
    np.testing.assert_allclose(thetas, expected[0] + mpc.theta_ss)
    np.testing.assert_allclose(inputs, expected[1] + U_SS)
    x, v = mpc.steady_state([352.0], [5.5])
    expected = own.steady_state([2.0], [0.5])
    np.testing.assert_allclose(x, expected[0] + X_SS)
    np.testing.assert_allclose(v, expected[1] + U_SS)
    assert mpc.is_reachable([[350.0], [1e4]]).tolist() == [True, False]
    with pytest.raises(ValueError, match=r"r = \[10000.0\] with d = \[5.0\] is not reachable"):
        mpc.steady_state([1e4])
    with pytest.raises(ValueError, match=r"x\[0\] = 1 is shown.*this is a deviation"):
        mpc.simulate([1.0, 0, 0, 0, 0], 2)


COPIES = [
    lambda mpc: mpc,
    copy.copy,
    copy.deepcopy,
    lambda mpc: pickle.loads(pickle.dumps(mpc)),
    lambda mpc: dataclasses.replace(mpc, horizon=mpc.horizon),
]


@pytest.mark.parametrize("copied", COPIES)
def test_what_is_replaced_is_in_plant_units_and_the_rest_stays(copied) -> None:
    mpc = copied(shown())
    tracking = dataclasses.replace(mpc.tracking, r_max=352)
    loads = dataclasses.replace(mpc.disturbances, d_min=3.5)
    outputs = dataclasses.replace(mpc.outputs, y_max=377)
    found = dataclasses.replace(
        mpc, x_max=[365, 4.5], u_min=9, theta_min=[335, 1.5], tracking=tracking, outputs=outputs,
        disturbances=loads,
    )  # fmt: skip
    expected = LinearMPC(
        MODEL, **WEIGHTS, x_min=[330, 1], x_max=[365, 4.5], u_min=9, u_max=15,
        theta_min=[335, 1.5], theta_max=shown().theta_max[:2],
        tracking=Tracking([0], 345, 352), disturbances=DisturbanceBounds(3.5, 7),
        outputs=OutputBounds([[1, 1]], y_max=377), soft=SOFT,
    )  # fmt: skip
    assert found == expected
    assert dataclasses.replace(found) == found


def test_bounds_stay_where_they_are_when_the_operating_point_moves() -> None:
    moved = dataclasses.replace(MODEL, x_ss=[345.0, 2.5], u_ss=[11.0], d_ss=[4.5])
    found = dataclasses.replace(shown(), model=moved)
    assert found.x_min.tolist() == [330, 1] and found.outputs.y_max.tolist() == [382]
    own = found.deviations
    np.testing.assert_allclose(own.x_min + moved.x_ss, [330, 1])
    np.testing.assert_allclose(own.u_max + moved.u_ss, [15])
    np.testing.assert_allclose(own.tracking.r_max + 345, [355])
    np.testing.assert_allclose(own.disturbances.d_min + moved.d_ss, [4])
    np.testing.assert_allclose(own.outputs.y_max + 347.5, [382])


def test_the_report_calls_states_by_their_names() -> None:
    mpc = dataclasses.replace(shown(), model=MODEL.named(["T", "c"], units={"T": "K"}))
    text = mpc.report(samples=50)
    for line in (
        "T (K)                     310 to 390        [350]     state 0",
        "set-point of T (K)        345 to 355        [350]     reference of tracked output 0",
        "d[0]                        4 to 7          [5]       disturbance",
        "previous u[0]               8 to 15         [10]      input of the step before 0",
        "few parameters (T, c, set-point of T, d[0], u_prev[0]):",
        "  [350, 2, 350, 5, 10] -> u = [10]",
    ):
        assert line in text
    assert "x[0] " in shown().report(samples=50).splitlines()[1]


def test_what_limits_the_plan_is_called_by_its_name() -> None:
    mpc = shown()
    named = dataclasses.replace(mpc, model=MODEL.named(["T", "c"], ["flow"]))
    text = named.report(samples=50)
    assert "% the rate of flow at its lower bound" in text and "never: flow at its" in text
    assert "Soft bounds: T; a unit costs 100." in text
    assert "u[0]" not in text and "x[0]" not in text and "-> flow = [10]" in text


def test_an_input_that_cannot_rest_is_reported() -> None:
    tank = LinearModel([[0.9]], [[0.5]], dt=1, x_ss=[12], u_ss=[3])
    box = {"theta_min": 0, "theta_max": 20, "u_min": 4, "u_max": 10}
    with pytest.warns(UserWarning, match=r"u_min = 4 and u_max = 10 leave out u\[0\] = 3, .*Line"):
        LinearMPC(tank, Q=[[1]], R=[[1]], horizon=2, **box)


def test_a_warning_names_the_line_that_led_to_it_and_comes_once() -> None:
    tank = LinearModel([[0.9]], [[0.5]], dt=1, x_ss=[12], u_ss=[3], input_names=["inflow"])
    mpc = LinearMPC(tank, Q=[[1]], R=[[1]], horizon=2, x_min=0, x_max=20, u_min=0, u_max=10)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")
        for _ in range(2):
            dataclasses.replace(mpc, u_min=4)  # in a function that dataclasses writes
    assert [each.filename for each in told] == [__file__]
    assert "leave out inflow = 3, the operating point" in str(told[0].message)


def test_a_box_that_leaves_out_the_operating_point_is_reported() -> None:
    tanks = LinearModel(
        np.eye(2) / 2, [[1], [1]], 1, x_ss=[12, 1], u_ss=[3], state_names=["h", "c"]
    )
    given = {"Q": np.eye(2), "R": [[1]], "horizon": 2, "u_min": 0, "u_max": 9}
    with pytest.warns(UserWarning) as told:
        LinearMPC(tanks, x_min=[0, 5], x_max=[3, 20], **given)  # swapped
    assert [str(each.message)[:60] for each in told] == [
        "h = 12, the operating point, lies outside its bounds, 0 to 3",
        "c = 1, the operating point, lies outside its bounds, 5 to 20",
    ]


def test_deviations_are_told_with_what_to_pass() -> None:
    plant = LinearModel([[0.9]], [[1.0]], 1, x_ss=[1500], u_ss=[3])
    box: dict[str, Any] = {"x_min": 0, "x_max": 3000, "u_min": 0, "u_max": 6}
    given = {"Q": [[1]], "R": [[1]], "horizon": 2, **box}
    with pytest.warns(UserWarning, match=r"r_min = -900 and .* pass r_min = 600 and r_max = 2400"):
        LinearMPC(plant, **given, tracking=Tracking([0], -900, 900))
    LinearMPC(plant, **given, tracking=Tracking([0], 600, 2400))
    LinearMPC(plant, **given, tracking=Tracking([0], 1600, 2400))  # beside it, as may be


def test_a_column_is_not_taken_for_a_batch() -> None:
    tanks = LinearModel(np.eye(2) / 2, [[1], [1]], 1, x_ss=[12, 1], u_ss=[3])
    given = {"Q": np.eye(2), "R": [[1]], "horizon": 2, "u_min": 0, "u_max": 9}
    law = LinearMPC(tanks, x_min=[0, 0], x_max=[20, 3], **given).online()
    with pytest.raises(ValueError, match=r"shown has shape \(2, 1\), expected \(2,\) or"):
        law.plant_input([[12.0], [1.0]])


def test_a_bound_at_the_operating_point_is_zero_and_no_minus_zero() -> None:
    mpc = LinearMPC(
        MODEL, **WEIGHTS, theta_min=[350, 0], theta_max=[400, 2], u_min=10, u_max=15,
        x_min=[350, -np.inf], x_max=[np.inf, 2],
        tracking=Tracking([0], 350, 355), disturbances=DisturbanceBounds(4, 5),
    ).deviations  # fmt: skip
    for ours, expected in (
        (mpc.u_min, [0]), (mpc.u_max, [5]), (mpc.x_min, [0, -np.inf]), (mpc.x_max, [np.inf, 0]),
        (mpc.theta_min[:2], [0, -2]), (mpc.theta_max[:2], [50, 0]),
        (mpc.tracking.r_min, [0]), (mpc.tracking.r_max, [5]), (mpc.disturbances.d_max, [0]),
    ):  # fmt: skip
        assert ours.tolist() == expected and not np.any(np.signbit(ours[ours == 0]))


def test_a_bound_that_is_not_given_stays_none_of_one_side_alone() -> None:
    common = {"theta_min": [300, 0], "theta_max": [400, 4],
              "disturbances": DisturbanceBounds(4, 7)}  # fmt: skip
    low = LinearMPC(MODEL, **WEIGHTS, **common, u_min=8, x_min=[340, 1]).deviations
    assert low.u_min.tolist() == [-2] and np.isinf(low.u_max) and np.isinf(low.x_max).all()
    high = LinearMPC(MODEL, **WEIGHTS, **common, u_max=15, x_max=[360, 3]).deviations
    assert high.u_max.tolist() == [5] and np.isinf(high.u_min) and np.isinf(high.x_min).all()
    assert high.x_max.tolist() == [10, 1]


# ---- By how much episodes exceed the bounds of their problem, and what its soft bounds cost ----


TANK = LinearModel(np.diag([0.9, 0.8]), np.eye(2), dt=1.0)
BOX: Any = {"theta_min": [-4, -50], "theta_max": [4, 50]}


def tank(**more: Any) -> LinearMPC:
    given: Any = {"Q": np.eye(2), "R": np.eye(2), "horizon": 2, "u_min": -2, "u_max": 2}
    return LinearMPC(TANK, **{**given, **BOX, **more})


def episode(states: Any) -> tuple[Any, Any]:
    return np.array(states, float), np.zeros((len(states) - 1, 2))


def test_an_excess_is_counted_from_the_first_step_on_in_half_widths_of_theta_s_box() -> None:
    mpc = tank(x_min=[-2, -10], x_max=[2, 10])
    found = excess_of_episodes(mpc, [episode([[9, 0], [3, 0], [2.5, -12]]), episode([[0, 0]] * 2)])
    np.testing.assert_allclose(found.largest, [1 / 4, 0], atol=1e-5)
    np.testing.assert_allclose(found.summed, [1 / 4 + 0.5 / 4 + 2 / 50, 0], atol=1e-5)
    assert not found.penalty.any()


def test_an_output_s_excess_is_that_of_its_combination_of_states() -> None:
    mpc = tank(outputs=OutputBounds([[1, 0.1]], y_min=-3, y_max=3))
    found = excess_of_episodes(mpc, [episode([[0, 0], [2, 40]])])
    np.testing.assert_allclose(found.largest, [3 / (4 + 5)], atol=1e-5)


def test_inputs_and_rates_count_from_the_previous_input_in_theta_on() -> None:
    mpc = tank(rate=RateLimits(-0.5, 0.5))
    thetas = np.array([[0, 0, 1, 0], [0, 0, 2, 0], [0, 0, 2.2, 0]], float)
    found = bound_excess(mpc, thetas, np.array([[2, 0], [2.2, 0]]))
    np.testing.assert_allclose(found.largest, 0.5 / 2, atol=1e-5)  # 1 - .5, of half the range
    np.testing.assert_allclose(found.summed, 0.5 / 2 + 0.2 / 2, atol=1e-5)


def test_a_soft_bound_is_no_hard_excess_and_costs_its_penalty_in_each_step() -> None:
    soft = SoftBounds(x=[0.5, 4], y=2, penalty=10)
    mpc = tank(x_min=[-2, -10], x_max=[2, 10], outputs=OutputBounds([[1, 1]], y_max=4), soft=soft)
    found = excess_of_episodes(mpc, [episode([[0, 0], [3, -14], [0, 5]])])
    # Of the states (3 - 2) / 0.5 counts, not (14 - 10) / 4; then the output, (5 - 4) / 2.
    np.testing.assert_allclose(found.penalty, [10 * (2 + 4) + 10 * (0.5 + 0.25)], rtol=1e-4)
    assert not found.largest.any() and found.any_bound[0] > 0


def test_the_penalty_of_a_step_is_the_mpc_s_own_for_a_horizon_of_one_step() -> None:
    model = LinearModel([[1.2]], [[1.0]], dt=1.0)
    given: Any = {"Q": [[1.0]], "R": [[1.0]], "horizon": 1, "u_min": -1, "u_max": 1}
    mpc = LinearMPC(model, **given, x_min=-2, x_max=2, soft=SoftBounds(x=0.3, penalty=50),
                    theta_min=-6, theta_max=6)  # fmt: skip
    theta = np.array([4.0])
    u = mpc.explicit()(theta)
    found = bound_excess(mpc, np.array([theta, mpc.predict(theta, u)]), u[None])
    s = (1.2 * 4 - 1 - 2) / 0.3
    np.testing.assert_allclose(found.penalty, 50 * (s + s**2), rtol=1e-4)


def test_what_is_not_finite_exceeds_by_inf() -> None:
    found = excess_of_episodes(tank(x_max=[2, 10]), [episode([[0, 0], [np.nan, 0]])])
    assert np.isinf(found.largest[0]) and np.isinf(found.summed[0])


def test_steps_that_are_not_taken_do_not_count_and_batches_are_episode_by_episode() -> None:
    mpc = tank(x_min=[-2, -10], x_max=[2, 10])
    rng = np.random.default_rng(0)
    thetas = 4 * rng.normal(size=(6, 3, 2))
    inputs = rng.normal(size=(5, 3, 2))
    taken = np.arange(5)[:, None] < np.array([5, 2, 4])
    batch = bound_excess(mpc, thetas, inputs, taken)
    for i, length in enumerate((5, 2, 4)):
        one = bound_excess(mpc, thetas[: length + 1, i], inputs[:length, i])
        np.testing.assert_allclose([each[i] for each in batch], [*one])


@pytest.mark.parametrize("scale", [1.0, 1e5])
def test_a_bound_with_an_open_side_has_no_hidden_unit(scale: float) -> None:
    model = LinearModel([[0.9]], [[1.0]], dt=1.0)
    mpc = LinearMPC(model, Q=[[1]], R=[[1]], horizon=2, u_max=1, x_max=2 * scale)
    found = bound_excess(mpc, np.array([[0.0], [3 * scale]]), np.zeros((1, 1)))
    np.testing.assert_allclose(found.largest, 0.5, atol=1e-5)


def test_a_hard_bound_is_named_before_a_soft_one_that_is_exceeded_by_more() -> None:
    soft = SoftBounds(x=[1, 0], penalty=1)
    mpc = tank(x_min=[-2, -10], x_max=[2, 10], soft=soft)
    names = BoundNames.of(mpc)
    for states, words in (
        ([0, 15], "x[1] exceeds its bound by 5"),
        ([4, 15], "x[1] exceeds its bound by 5"),
        ([-4, 0], "x[0] exceeds its soft bound by 2"),
        ([0, 0], ""),
    ):
        found = excess_of_episodes(mpc, [episode([[0, 0], states])])
        size = found.largest[0] or found.any_bound[0]
        assert names.in_words(np.asarray(found.worst)[0], size) == words
