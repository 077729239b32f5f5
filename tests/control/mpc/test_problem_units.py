"""A problem in plant units solves the same problem as its deviations, about zero."""

import copy
import dataclasses
import pickle
import warnings
from typing import Any

import numpy as np
import pytest
from scipy import optimize

from general_problems import servo, solved
from sb3_yann import (
    DisturbanceBounds,
    DisturbanceObserver,
    LinearModel,
    LinearMPC,
    OutputBounds,
    PiecewiseAffine,
    RateLimits,
    SoftBounds,
    Terminal,
    Tracking,
    offset_free,
)
from sb3_yann.control.mpc.bound_excess import BoundNames, bound_excess, excess_of_episodes
from sb3_yann.units import Units

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
        "previous u[0]               8 to 15         [10]      input 0 of the step before",
    ):
        assert line in text
    assert "x[0] " in shown().report(samples=50).splitlines()[1]


def test_what_limits_the_plan_is_called_by_its_name() -> None:
    mpc = shown()
    named = dataclasses.replace(mpc, model=MODEL.named(["T", "c"], ["flow"]))
    text = named.report(samples=50)
    assert "% the rate of flow at its lower bound" in text and "never: flow at its" in text
    assert "Soft bounds: T; a unit costs 100." in text
    assert "u[0]" not in text and "x[0]" not in text


def test_a_warning_names_the_line_that_led_to_it_and_comes_once() -> None:
    tank = LinearModel([[0.9]], [[0.5]], dt=1, x_ss=[12], u_ss=[3], input_names=["inflow"])
    mpc = LinearMPC(tank, Q=[[1]], R=[[1]], horizon=2, x_min=0, x_max=20, u_min=0, u_max=10)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")
        for _ in range(2):
            dataclasses.replace(mpc, u_min=4)  # in a function that dataclasses writes
    assert [each.filename for each in told] == [__file__]
    message = str(told[0].message)
    assert message.startswith("u_min = 4 and u_max = 10 leave out inflow = 3, the operating point")
    assert "no deviations" in message
    with pytest.warns(UserWarning, match="leave out inflow = 3.* Have they the same units"):
        dataclasses.replace(mpc, u_max=1, tracking=Tracking([0], 1, 20))


def test_a_box_that_leaves_out_the_operating_point_is_reported() -> None:
    tanks = LinearModel(
        np.eye(2) / 2, [[1], [1]], 1, x_ss=[12, 1], u_ss=[3], state_names=["h", "c"]
    )
    given = {"Q": np.eye(2), "R": [[1]], "horizon": 2, "u_min": 0, "u_max": 9}
    with pytest.warns(UserWarning) as told:
        LinearMPC(tanks, x_min=[0, 5], x_max=[3, 20], **given)  # swapped
    assert [str(each.message).partition(":")[0] for each in told] == [
        "x_min = 0 and x_max = 3 leave out h = 12, the operating point",
    ]


def test_set_points_that_are_deviations_are_told() -> None:
    plant = LinearModel([[0.9]], [[1.0]], 1, x_ss=[1500], u_ss=[3])
    box: dict[str, Any] = {"x_min": 0, "x_max": 3000, "u_min": 0, "u_max": 6}
    given = {"Q": [[1]], "R": [[1]], "horizon": 2, **box}
    with pytest.warns(UserWarning, match=r"r_min = -900 and .* leave out r\[0\] = 1500"):
        LinearMPC(plant, **given, tracking=Tracking([0], -900, 900))
    LinearMPC(plant, **given, tracking=Tracking([0], 600, 2400))
    LinearMPC(plant, **given, tracking=Tracking([0], 1600, 2400))  # beside it, as may be


def test_what_does_not_fit_theta_or_the_states_is_named() -> None:
    tanks = LinearModel(np.eye(2) / 2, [[1], [1]], 1, x_ss=[12, 1], u_ss=[3])
    given = {"Q": np.eye(2), "R": [[1]], "horizon": 2, "u_min": 0, "u_max": 9}
    law = LinearMPC(tanks, x_min=[0, 0], x_max=[20, 3], **given).online()
    with pytest.raises(ValueError, match=r"theta has shape \(2, 1\), expected \(2,\) or .*: x"):
        law.plant_input([[12.0], [1.0]])
    law = LinearMPC(tanks, **given, rate=RateLimits(-1, 1)).online()
    with pytest.raises(ValueError, match=r"x\[0\], x\[1\], then mpc.layout.names\[2:\]."):
        law.plant_input([12.0, 1.0])
    with pytest.raises(ValueError, match=r"Terminal.set F has shape \(1, 4\), .* \(rows, 2\)"):
        LinearMPC(tanks, **given, terminal=Terminal(set=([[1, 0, 0, 0]], [2])))
    with pytest.raises(ValueError, match=r"\['h'\], but the model's states have no names: model.n"):
        LinearMPC(tanks, **given, tracking=Tracking(["h"], 0, 9))


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
    found = excess_of_episodes(mpc, [episode([[0, 0], [np.nan, 0]])])
    assert np.isinf([found.largest, found.summed]).all()


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


TRACKING = ["servo", "servo with all of it", "two tanks, all parts", "more inputs than outputs"]


def reachable_constants(mpc: LinearMPC, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """References (count, p) and disturbances (count, d) with a steady state inside the bounds."""
    rng = np.random.default_rng(seed)
    parts = mpc.layout
    theta = rng.uniform(mpc.theta_min, mpc.theta_max, (20 * count, mpc.n_theta))
    r = theta[:, parts.reference]
    d = theta[:, parts.disturbance]
    inside = mpc.is_reachable(r, d)
    assert inside.sum() >= count
    return r[inside][:count], d[inside][:count]


@pytest.mark.parametrize("name", TRACKING)
def test_a_hundred_reachable_references_are_reached_without_offset(name: str) -> None:
    mpc = solved(name)
    r, d = reachable_constants(mpc, 100)
    start = np.zeros((100, mpc.n_theta))
    start[:, mpc.layout.constant] = np.hstack([r, d])
    theta = start
    for _ in range(150):
        theta = mpc.predict(theta, mpc.explicit()(theta))
    reached = theta[:, mpc.layout.state] @ mpc.tracking.C.T
    assert np.max(np.abs(reached - r)) < 1e-6


@pytest.mark.parametrize("name", TRACKING)
def test_the_steady_state_rests_and_shows_the_reference(name: str) -> None:
    mpc = solved(name)
    for r, d in zip(*reachable_constants(mpc, 5), strict=True):
        x, u = mpc.steady_state(r, d)
        np.testing.assert_allclose(mpc.model.step(x, u, d), x, atol=1e-12)
        np.testing.assert_allclose(mpc.tracking.C @ x, r, atol=1e-12)
        theta = np.concatenate([x, r, d, u[: mpc.layout.n_previous]])
        np.testing.assert_allclose(mpc.explicit()(theta), u, atol=1e-9)


def test_of_many_steady_states_it_is_the_cheapest() -> None:
    mpc = solved("more inputs than outputs")
    x, u = mpc.steady_state([0.3], [0.1, -0.1])
    A = mpc.model.A
    B = mpc.model.B

    def state(v: np.ndarray) -> np.ndarray:
        return np.linalg.solve(np.eye(2) - A, B @ v + mpc.model.E @ [0.1, -0.1])

    best = optimize.minimize(
        lambda v: state(v) @ mpc.Q @ state(v) + v @ mpc.R @ v,
        np.zeros(2),
        constraints={"type": "eq", "fun": lambda v: mpc.tracking.C @ state(v) - 0.3},
        tol=1e-14,
    )
    np.testing.assert_allclose(u, best.x, atol=1e-6)
    np.testing.assert_allclose(x, state(u), atol=1e-9)


def test_reachable_is_what_the_bounds_allow() -> None:
    mpc = servo(u_max=0.1)  # gain from u to x[0] at rest is 0.5 / 0.2 * 0.2 / 0.1 = 5
    assert mpc.is_reachable([0.49])
    assert not mpc.is_reachable([0.51])
    np.testing.assert_array_equal(mpc.is_reachable([[0.2], [0.9]]), [True, False])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"u_max": 0.1}, r"r = \[0.9\] with d = \[\] is not reachable: .*, and u\[0\] > u_max\[0"),
        ({"x_max": 0.5}, r"and x\[0\] > x_max\[0\]. Ask is_reachable"),
        ({"outputs": OutputBounds([[1, 1]], y_max=0.5)}, r"and y\[0\] > y_max\[0\]"),
    ],
)
def test_an_unreachable_reference_is_named_with_the_bound(
    changes: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        servo(**changes).steady_state([0.9])


def test_a_reference_of_another_shape_is_named() -> None:
    with pytest.raises(ValueError, match=r"r has shape \(2,\), expected \(1,\)"):
        servo().steady_state([1, 2])
    with pytest.raises(ValueError, match=r"d has shape \(1,\), expected \(0,\)"):
        servo().is_reachable([1], [1])


@pytest.mark.parametrize("horizon", [1, 5, 10])
def test_of_inputs_that_cost_their_moves_alone_the_least_norm_is_taken(horizon: int) -> None:
    mpc = LinearMPC(
        LinearModel([[0.8]], [[0.3, 0.2]], 1), Q=[[1]], R=np.zeros((2, 2)), horizon=horizon,
        u_min=-1, u_max=1, theta_min=-1, theta_max=1, tracking=Tracking([0], -0.5, 0.5),
        rate=RateLimits(R_du=np.eye(2)),
    )  # fmt: skip
    np.testing.assert_allclose(mpc.steady_states.u.ravel(), np.array([0.3, 0.2]) * 0.2 / 0.13)
    law = mpc.online()
    x = 0.0
    u = np.zeros(2)
    for _ in range(80):
        u = law([x, 0.3, *u])
        x = 0.8 * x + np.array([0.3, 0.2]) @ u
    np.testing.assert_allclose(x, 0.3, atol=1e-9)


MPC = servo(x_min=[-5, -2], x_max=[5, 2])


def test_a_disturbance_is_a_twentieth_of_a_state_s_half_width_or_what_is_given() -> None:
    mpc, _ = offset_free(MPC)
    np.testing.assert_allclose(mpc.disturbances.d_max, [0.25, 0.1])
    np.testing.assert_allclose(mpc.disturbances.d_min, [-0.25, -0.1])
    np.testing.assert_array_equal(mpc.model.E, np.eye(2))
    given, _ = offset_free(MPC, [0.1, 0.5])
    assert given.disturbances.d_max.tolist() == [0.1, 0.5]
    assert mpc.theta_min.tolist() == [-5, -2, -1, -0.25, -0.1]
    for name in ("Q", "R", "u_min", "u_max", "x_min", "x_max"):
        np.testing.assert_array_equal(getattr(mpc, name), getattr(MPC, name))
    assert mpc.horizon == MPC.horizon and mpc.gamma == MPC.gamma


def test_the_observer_takes_all_noises_for_equal_in_half_widths() -> None:
    mpc, observer = offset_free(MPC)
    half = [5.0, 2.0]
    expected = DisturbanceObserver(
        mpc.model, state_noise=half, disturbance_noise=half, measurement_noise=half
    )
    np.testing.assert_array_equal(observer.gain, expected.gain)
    assert observer.model is mpc.model and observer.n_measured == 2


def test_names_and_operating_point_stay_and_a_terminal_set_is_solved_anew() -> None:
    model = dataclasses.replace(MPC.model, x_ss=[3.0, 4.0], u_ss=[5.0])
    named = model.named(["a", "b"], ["c"], {"a": "K"})
    shift = named.x_ss
    box = {"x_min": MPC.x_min + shift, "x_max": MPC.x_max + shift, "u_min": MPC.u_min + 5}
    box |= {"theta_min": MPC.theta_min[:2] + shift, "theta_max": MPC.theta_max[:2] + shift}
    box |= {"tracking": Tracking([0], MPC.tracking.r_min + 3, MPC.tracking.r_max + 3)}
    given = dataclasses.replace(MPC, model=named, **box, u_max=MPC.u_max + 5)
    mpc, _ = offset_free(given)
    assert (mpc.model.state_names, mpc.model.input_names) == (("a", "b"), ("c",))
    assert mpc.model.units == ("K", "", "")
    assert [*mpc.model.x_ss, *mpc.model.u_ss] == [3, 4, 5]
    assert len(mpc.terminal.set[1]) == 0
    assert len(offset_free(solved("invariant"))[0].terminal.set[1]) > 0


def test_the_notes_of_the_model_stay_and_its_drift_is_made_up_for() -> None:
    noted = LinearModel(
        [[0.8]], [[0.3]], 2.0, notes=["fitted to a log"], drift=[0.4], state_names=["T"]
    )
    with pytest.warns(UserWarning, match="no steady state"):
        mpc = LinearMPC(noted, Q=[[1]], R=[[1]], horizon=2, x_min=-3, x_max=3, u_min=-1, u_max=1)
    model = offset_free(mpc)[0].model
    assert (model.notes, model.drift.tolist(), model.dt) == (("fitted to a log",), [0.0], 2.0)
    assert "Note: fitted to a log" in model.report()


def test_a_terminal_cost_that_was_given_stays() -> None:
    mpc = dataclasses.replace(MPC, terminal=Terminal(cost=7 * np.eye(2)))
    np.testing.assert_array_equal(offset_free(mpc)[0].terminal.cost, 7 * np.eye(2))


def test_that_disturbances_are_estimated_survives_copies_pickles_files_and_replace(tmp_path):
    mpc, _ = offset_free(MPC)
    mpc.explicit().save(tmp_path / "law.npz")
    copies = [
        copy.deepcopy(mpc).model,
        pickle.loads(pickle.dumps(mpc)).model,
        dataclasses.replace(mpc, horizon=3).model,
        dataclasses.replace(mpc.model, dt=0.5),
        mpc.model.named(["a", "b"]),
        PiecewiseAffine.load(tmp_path / "law.npz").model,
    ]
    assert [each.estimated for each in copies] == 6 * [(0, 1)]
    assert MPC.model.estimated == ()


def test_nothing_calls_an_estimated_disturbance_measured() -> None:
    mpc, _ = offset_free(MPC)
    for text in (mpc.model.report(), mpc.report(samples=20), repr(mpc.model)):
        assert "measured" not in text and "estimate" in text


def test_measured_disturbances_stay_before_the_estimated_ones() -> None:
    mpc, observer = offset_free(solved("servo with a disturbance"), [0.3, 0.4])
    assert (mpc.model.estimated, mpc.model.measured) == ((1, 2), (0,))
    assert (observer.n_estimated, observer.n_known) == (2, 1)
    given = solved("servo with a disturbance")
    np.testing.assert_array_equal(mpc.model.E, np.hstack([given.model.E, np.eye(2)]))
    assert mpc.disturbances.d_max.tolist() == [*given.disturbances.d_max, 0.3, 0.4]


@pytest.mark.parametrize("estimated", [[1], [-1], [0, 0], [0.5], 0, "0"])
def test_an_index_of_no_disturbance_is_named(estimated) -> None:
    with pytest.raises((TypeError, ValueError), match="estimated"):
        LinearModel([[0.5]], [[1]], 1, E=[[1]], estimated=estimated)


def test_what_estimates_disturbances_already_or_is_no_mpc_is_named() -> None:
    with pytest.raises(ValueError, match="has 2 estimated disturbances already"):
        offset_free(offset_free(MPC)[0])
    with pytest.raises(TypeError, match=r"mpc = LinearModel.* must be a LinearMPC"):
        offset_free(MPC.model)
    for wrong in ([0.1, 0.0], [0.1, -1.0], [0.1]):
        with pytest.raises(ValueError, match="d_max"):
            offset_free(MPC, wrong)


@pytest.mark.parametrize("measured", [None, [0]])
def test_a_plant_with_a_load_that_is_measured_settles_without_offset(measured) -> None:
    model = LinearModel([[0.9, 0.2], [0, 0.8]], [[0], [0.5]], 1.0, E=[[0.3], [0.1]])
    preview = DisturbanceBounds(-1, 1, preview=2)
    mpc, observer = offset_free(servo(model, disturbances=preview, horizon=5), measured=measured)
    assert mpc.layout.names[2:6] == ("r[0]", "d[0]", "d_1[0]", "d_2[0]")
    x = np.zeros(2)
    load = np.array([0.5])
    law = mpc.online()
    y = slice(0, 2 if measured is None else 1)
    x_hat, d_hat = observer.reset(x[y])
    for _ in range(300):
        u = law(np.concatenate([x_hat, [0.7], np.tile(load, 3), d_hat]))
        x = model.A @ [0.98 * x[0], x[1]] + 1.1 * model.B @ u + 0.8 * model.E @ load + [0.05, 0]
        x_hat, d_hat = observer.update(x[y], u, load)
    assert x[0] == pytest.approx(0.7, abs=1e-6)
    with pytest.raises(ValueError, match="Measure what is tracked"):
        offset_free(MPC, measured=[1])


def test_an_input_at_a_bound_of_zero_is_zero_rather_than_rounding() -> None:
    units = Units(np.array([60.0, 0.0]), np.array([0.66, 0.5]))
    assert units.input_to_plant([-0.66 + 7e-15, -0.4]).tolist() == [0.0, 0.5 - 0.4]
    assert units.to_plant([[-60.0 - 7e-15, 1e-300]]).tolist() == [[0.0, 1e-300]]
