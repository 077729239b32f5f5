"""Blocks, previews, mixed bounds, prices and bounds that change at run time."""

import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import linalg

from errors import Message, raises
from general_problems import PROBLEMS, servo, solved
from sample_problems import DOUBLE_INTEGRATOR as CART
from sample_problems import box_points, small_mpc
from sb3_yann import (
    DisturbanceBounds,
    LinearCost,
    LinearModel,
    LinearMPC,
    MixedBounds,
    OutputBounds,
    RateLimits,
    SoftBounds,
    Terminal,
    Tracking,
    export,
    offset_free,
)
from sb3_yann.control.mpc.bound_excess import BoundNames, Bounds, bound_excess
from sb3_yann.control.mpc.condensing import condense
from sb3_yann.deployment.controller import Controller
from sb3_yann.wrappers import PlantEnv
from sparse_qp import FEATURES, draw, online_answers, relative_error, worst_difference

cart = partial(small_mpc, horizon=6)


def test_outputs_may_be_called_by_the_names_of_their_states() -> None:
    model = CART.named(["position", "speed"], ["force"])
    by_index = cart(model, tracking=Tracking([0], -1, 1), outputs=OutputBounds([0, 1], -2, 2))
    names = {"tracking": Tracking(["position"], -1, 1)}
    names["outputs"] = OutputBounds(["position", "speed"], -2, 2)
    assert cart(model, **names) == by_index
    rows = {each.partition(" at its ")[0] for each in condense(by_index)[1]}
    assert {"position", "speed"} <= rows and not any("y[" in each for each in rows)
    assert [*BoundNames.of(by_index).names][-3:-1] == ["position", "speed"]
    with pytest.raises(ValueError, match=r"Tracking\.C has \['T'\], but .* 'speed'"):
        cart(model, tracking=Tracking(["T"], -1, 1))


@pytest.mark.parametrize(
    "seeds", [range(1, 3), pytest.param(range(200), marks=pytest.mark.nightly)]
)
@pytest.mark.parametrize("features", [*((name,) for name in FEATURES), FEATURES])
def test_laws_are_those_of_a_sparse_program_of_another_solver(features, seeds: range) -> None:
    found = [worst_difference(features, seed, points=4) for seed in seeds]
    assert max(each[0] for each in found) < 1e-8
    assert sum(each[1] for each in found) > len(seeds)


@pytest.mark.parametrize(
    "weights",
    [{}, {"rate": RateLimits(R_du=[[0.5]])}, {"terminal": Terminal(set="invariant")}],
    ids=["plain", "rates", "invariant set"],
)
def test_a_preview_of_what_stays_is_no_preview(weights: dict[str, Any]) -> None:
    model = LinearModel(CART.A, CART.B, 1.0, E=[[0.1], [0.2]])
    parts: dict[str, Any] = {"disturbances": DisturbanceBounds(-0.2, 0.2), **weights}
    mpc = cart(model, tracking=Tracking([0], -1, 1), **parts)
    parts["disturbances"] = DisturbanceBounds(-0.2, 0.2, preview=3)
    ahead = cart(model, tracking=Tracking([0], -1, 1, preview=2), **parts)
    assert ahead.layout.names[:9] == (
        "x[0]", "x[1]", "r[0]", "r_1[0]", "r_2[0]", "d[0]", "d_1[0]", "d_2[0]", "d_3[0]",
    )  # fmt: skip
    names = {"state_names": ["place", "speed"], "disturbance_names": ["wind"]}
    named = replace(ahead, model=replace(model, **names))
    assert named.labels()[2:7] == (
        "set-point of place", "set-point of place, 1 sample ahead",
        "set-point of place, 2 samples ahead", "wind", "wind, 1 sample ahead",
    )  # fmt: skip
    assert offset_free(named)[0].model.disturbance_labels == ["wind", "d[1]", "d[2]"]
    theta = np.random.default_rng(0).uniform(mpc.theta_min, mpc.theta_max, (50, mpc.n_theta)) / 3
    both = theta @ ahead.layout.lift.T
    assert np.abs(mpc.online()(theta) - ahead.online()(both)).max() < 1e-9
    costs = mpc.stage_cost(theta, theta[:, :1]), ahead.stage_cost(both, theta[:, :1])
    assert np.abs(np.subtract(*costs)).max() < 1e-9


def test_a_price_moves_where_the_law_rests_and_has_no_value_without_a_discount() -> None:
    mpc = cart(price=LinearCost(x=[0.4, 0]), horizon=10)
    rest = mpc.simulate([0.0, 0.0], 60)[0][-1]
    assert rest[0] < -0.05  # a smaller first state earns
    with pytest.raises(ValueError, match="infinite without a discount"):
        mpc.value_terms(1.0)
    tank = LinearModel([[0.9]], [[0.5]], dt=1, x_ss=[12], u_ss=[3])
    level = LinearMPC(
        tank, Q=[[1]], R=[[1]], horizon=3, x_min=0, x_max=20, u_min=0, u_max=10,
        price=LinearCost(x=2, u=5),
    )  # fmt: skip
    assert float(level.stage_cost([13.0], [4.0])) == pytest.approx(1 + 1 + 2 * 13 + 5 * 4)
    assert float(level.deviations.stage_cost([1.0], [1.0])) == pytest.approx(48)


def test_a_law_takes_bounds_as_they_are_where_the_model_has_no_operating_point() -> None:
    mixed = MixedBounds(F=[[1, 1]], low=-7, high=7)
    changing = ["u_max", "u_min", "x_max[1]", "mixed_max"]
    mpc = cart(u_max=3, mixed=mixed, parametric_bounds=changing, horizon=3)
    plain = cart(u_max=1, u_min=-0.5, mixed=MixedBounds(F=[[1, 1]], low=-7, high=6), horizon=3,
                 x_max=[5, 2], theta_max=5)  # fmt: skip
    bounds = [1.0, -0.5, 2.0, 6.0]
    for state in ([-4.0, 0.5], [3.0, 1.9], [4.5, 0.0], [-4.0, 1.0]):
        theta = np.array([*state, *bounds])
        expected = plain.online()(state)
        for law in (mpc.online(), mpc.explicit()):
            assert law(theta) == pytest.approx(expected, abs=1e-9)
            assert law.plant_input(theta) == pytest.approx(expected, abs=1e-9)
    np.testing.assert_array_equal(mpc.theta_ss, np.zeros(mpc.n_theta))
    assert mpc.theta_rest.tolist() == [0, 0, 3, -1, 5, 7]


@pytest.mark.parametrize("infeasible", ["nearest_region", "zero_input"])
def test_a_bound_that_moves_in_is_reached_as_fast_as_the_rate_allows(
    infeasible: str, tmp_path: Path
) -> None:
    mpc = cart(
        parametric_bounds=["u_max"], rate=RateLimits(-0.2, 0.3), horizon=3, infeasible=infeasible,
        theta_min=[-4, -1], theta_max=[4, 1], x_min=None, x_max=None,
    )  # fmt: skip
    rng = np.random.default_rng(1)
    theta = rng.uniform(mpc.theta_min, mpc.theta_max, (400, 4))
    contradicts = theta[:, 3] - 0.2 > theta[:, 2] + 1e-9
    low, high = mpc.input_range(theta)
    assert 20 < contradicts.sum() < 300
    np.testing.assert_allclose(low[contradicts], high[contradicts])
    np.testing.assert_allclose(high[contradicts, 0], theta[contradicts, 3] - 0.2)
    env = PlantEnv(lambda x, u: mpc.model.B @ u, mpc)
    sb3 = pytest.importorskip("stable_baselines3")
    model = sb3.DDPG("YannPolicy", env, policy_kwargs={"problem": mpc})
    wanted = np.clip(mpc.online()(theta), low, high)
    mpc.explicit()
    export(mpc, tmp_path / "law.npz")
    export(mpc.online(), tmp_path / "online.npz")
    found = {
        "online": mpc.online().plant_input(theta),
        "explicit": mpc.explicit().plant_input(theta),
        "exported": Controller.load(tmp_path / "law.npz").evaluate(theta),
        "exported law": Controller.load(tmp_path / "online.npz").evaluate(theta),
        "policy": model.predict(theta.astype(np.float32))[0],
    }
    for name, u in found.items():
        assert np.abs(u - wanted)[contradicts].max() < 3e-6, name
        assert np.all((u >= low - 3e-6) & (u <= high + 3e-6)), name


def test_states_between_a_bound_in_theta_and_another_exceed_the_nearer_one() -> None:
    mpc = cart(parametric_bounds=["x_max[0]"])
    thetas = np.array([[0, 0, 5.0], [4.0, 0, 3.0], [4.0, 0, 5.0]])
    inputs = np.zeros((2, 1))
    assert bound_excess(mpc, thetas, inputs).largest == pytest.approx(1 / 5)
    near = Bounds.of(mpc, high=[2, np.inf])
    assert bound_excess(mpc, thetas, inputs, bounds=near).largest == pytest.approx(2 / 5)


def test_mixed_bounds_hold_in_closed_loop() -> None:
    two = LinearModel([[0.9, 0.1], [0, 0.8]], np.eye(2), 1.0, x_ss=[5, 5], u_ss=[1, 2])
    mpc = LinearMPC(
        two, Q=np.eye(2), R=0.1 * np.eye(2), horizon=4, x_min=0, x_max=10, u_min=0, u_max=4,
        mixed=MixedBounds(G=[[1, 1]], high=3.5),
    )  # fmt: skip
    inputs = mpc.simulate([2.0, 3.0], 20)[1]
    assert inputs.sum(axis=1).max() == pytest.approx(3.5) and mpc.is_reachable()
    assert not replace(mpc, mixed=MixedBounds(G=[1, 1], high=2)).is_reachable()


def test_problems_are_copied_pickled_and_changed_with_all_their_parts() -> None:
    mpc = draw(np.random.default_rng(4), FEATURES)
    copied = pickle.loads(pickle.dumps(mpc))
    assert copied == mpc == replace(mpc) and hash(copied) == hash(mpc)
    assert cart(control_horizon=3).blocks == (1, 1, 4)
    other = replace(mpc, Q=2 * mpc.Q)
    assert (other.control_horizon, other.layout) == (mpc.control_horizon, mpc.layout)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"control_horizon": 7}, "must be at most the horizon, 6"),
        ({"control_horizon": [1, 2]}, "make 3 samples, and the horizon is 6"),
        ({"control_horizon": "3"}, TypeError("must be a number of samples, or a list")),
        ({"tracking": Tracking([0], -1, 1, preview=7)}, "looks no further"),
        ({"parametric_bounds": ["v_max"]}, "known are x_min"),
        ({"parametric_bounds": ["u_max[1]"]}, r"the entries of u are \[0\]"),
        ({"parametric_bounds": ["u_max[x]"]}, "single entries such as 'u_max"),
        ({"mixed": MixedBounds(G=[[1]])}, "Row 0 of MixedBounds has no bound"),
        ({"mixed": MixedBounds(G=[[1]], high=[1, 2])}, "MixedBounds.high has shape"),
        ({"parametric_bounds": "u_max"}, TypeError(r"a list such as \['u_max'\]")),
        ({"x_min": None, "theta_min": -5, "parametric_bounds": ["x_max"]}, "how far"),
        ({"mixed": MixedBounds(F=[[0, 0]], high=1)}, "bounds nothing"),
        ({"mixed": MixedBounds(high=1)}, "there is no row in F or G"),
        ({"price": LinearCost(u=[1, 2])}, "LinearCost.u has shape"),
        ({"outputs": OutputBounds([0], y_max=1), "parametric_bounds": ["y_min"]}, "widest"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_named(changes: dict[str, Any], message: Message) -> None:
    with raises(message):
        cart(**changes)


def test_four_states_and_a_horizon_of_twenty_have_few_regions_with_a_control_horizon() -> None:
    A = linalg.expm(
        np.array([[0, 1, 0, 0], [-1, -0.2, 1, 0.1], [0, 0, 0, 1], [1, 0.1, -1, -0.2]]) * 0.3
    )
    B = np.array([[0.05, 0], [0.3, 0], [0, 0.05], [0, 0.3]])
    mpc = LinearMPC(
        LinearModel(A, B, 0.3), Q=np.diag([1, 0.1, 1, 0.1]), R=0.1 * np.eye(2), horizon=20,
        u_min=-1, u_max=1, theta_min=-2, theta_max=2, control_horizon=3,
        tracking=Tracking([0, 2], -0.5, 0.5),
    )  # fmt: skip
    regions = mpc.explicit().n_regions
    assert regions < 2000, regions


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e4])
def test_a_soft_bound_without_a_penalty_is_kept_too_whatever_the_units(seed, unit) -> None:
    rng = np.random.default_rng(seed)
    units = np.array([1.0, unit])
    A = rng.normal(size=(2, 2))
    A *= rng.uniform(0.7, 1.2) / np.max(np.abs(np.linalg.eigvals(A)))
    model = LinearModel(units[:, None] * A / units, units[:, None] * rng.normal(size=(2, 1)), 1.0)
    given: dict[str, Any] = {"Q": np.diag(1 / units**2), "R": [[0.3]], "horizon": 3}
    given |= {"u_min": -1, "u_max": 1, "x_min": -2 * units, "x_max": 3 * units}
    hard = LinearMPC(model, **given)
    soft = LinearMPC(model, **given, soft=SoftBounds(x=0.5 * units))
    assert soft.soft.penalty == pytest.approx(100 * soft_cost(soft, units))
    assert replace(soft) == soft
    points = box_points(hard, 500)
    inside = points[hard.online().in_domain(points)]
    off = np.abs(soft.explicit()(inside) - hard.online()(inside)).max(axis=1)
    assert np.mean(off < 1e-9) > 0.99  # next to where the hard one ends multipliers have no bound
    expected, _ = online_answers(soft, points)
    assert relative_error(soft, soft.explicit()(points), expected) < 1e-8


def soft_cost(mpc: LinearMPC, units: np.ndarray) -> float:
    """What x = 3, u = 1 costs at most, and to come back from there."""
    x = 3 * units
    return float(x @ np.abs(mpc.Q) @ x + x @ np.abs(mpc.terminal.cost) @ x + 0.3)


@pytest.mark.parametrize("name", PROBLEMS)
def test_stage_matrix_is_the_stage_cost_as_a_form(name: str) -> None:
    mpc = solved(name)
    rng = np.random.default_rng(0)
    theta = box_points(mpc, 50)
    u = rng.normal(size=(50, mpc.model.n_inputs))
    z = np.hstack([theta, u])
    form = np.einsum("bi,ij,bj->b", z, mpc.stage_matrix, z)
    np.testing.assert_allclose(mpc.stage_cost(theta, u), form, rtol=1e-9, atol=1e-9)
    M = mpc.state_action_terms(0.9).P
    following = mpc.predict(theta, u)
    value = np.einsum("bi,ij,bj->b", following, mpc.value_matrix(0.9), following)
    found = np.einsum("bi,ij,bj->b", z, M, z)
    np.testing.assert_allclose(found, form + 0.9 * value, rtol=1e-9, atol=1e-9)


def test_stage_cost_is_the_formula() -> None:
    mpc = servo(rate=RateLimits(R_du=[[2.0]]))
    theta = np.array([0.3, -0.1, 0.5, 0.2])
    u = np.array([0.4])
    x_s, u_s = mpc.steady_state([0.5])
    e = theta[:2] - x_s
    expected = e @ mpc.Q @ e + 0.1 * (u - u_s) ** 2 + 2.0 * (0.4 - 0.2) ** 2
    assert mpc.stage_cost(theta, u) == pytest.approx(float(expected[0]))


BAD: list[tuple[Callable[[], dict[str, Any]], Message]] = [
    (
        lambda: {"tracking": Tracking([0, 1])},
        r"no steady state for r\[0\], r\[1\]: .* rank 3.* \(1\) can",
    ),
    (
        lambda: {"tracking": Tracking([2])},
        r"Tracking.C = \[2\] must be indices of states, .* 0 to 1",
    ),
    (lambda: Tracking([0.5]), r"Tracking.C = \[0.5\] must be indices of states"),
    (lambda: Tracking([-1]), r"Tracking.C = \[-1\] must be indices .* from 0 on"),
    (
        lambda: {"tracking": Tracking([[1, 2, 3]])},
        r"Tracking.C has shape \(1, 3\), expected \(q, 2\)",
    ),
    (lambda: Tracking([[0, 1e308]]), r"Tracking.C\[0, 1\] = 1e\+308 must be at most 1e\+1"),
    (lambda: Tracking([0], r_min=2, r_max=1), "r_min must lie below r_max"),
    (lambda: Tracking(r_max=1), "there is no output in Tracking.C"),
    (
        lambda: {"tracking": [0]},
        TypeError(r"tracking = \[0\] must be of the class Tracking: tracking=Tr"),
    ),
    (
        lambda: {"disturbances": DisturbanceBounds(d_max=2)},
        "d_min or d_max is given, but there is no E of the model",
    ),
    (lambda: RateLimits(0, 0), "du_min must lie below du_max"),
    (lambda: RateLimits(R_du=[[-1]]), "R_du must be positive semi-definite"),
    (lambda: {"rate": RateLimits(R_du=np.eye(2))}, r"R_du has shape \(2, 2\), expected \(1, 1\)"),
    (
        lambda: {
            "soft": SoftBounds(y=1),
            "outputs": OutputBounds([0], -0.5, 0.5),
            "tracking": None,
            "x_min": None,
            "x_max": None,
            "u_min": None,
            "u_max": None,
        },
        "SoftBounds.penalty is missing, and it is not known",
    ),
    (lambda: Terminal(set="invariants"), TypeError("a pair .* or 'invariant', got 'invariants'")),
    (lambda: Tracking(0), r"Tracking.C = 0 must be a list of indices of states: \[0\]"),
]


@pytest.mark.parametrize(("make", "message"), BAD)
def test_bad_argument_is_named(make: Callable[[], Any], message: Message) -> None:
    with raises(message):
        servo(**make())


def test_a_disturbance_that_no_input_can_hold_is_named() -> None:
    model = LinearModel([[1, 0], [0, 0.5]], [[0], [1]], 1.0, E=[[1], [0]])
    with pytest.raises(ValueError, match=r"no steady state for d\[0\]"):
        LinearMPC(model, Q=np.eye(2), R=[[1]], horizon=1, terminal=Terminal(np.eye(2)))


def test_references_without_a_box_are_named_when_the_law_is_asked_for() -> None:
    with pytest.raises(ValueError, match="where theta holds them, r_min and r_max"):
        servo(tracking=Tracking([0], r_max=1)).explicit()


def test_offset_free_keeps_a_terminal_set_of_the_user_s_and_makes_the_invariant_one_anew() -> None:
    tank = LinearModel([[0.9, 0.2], [0.0, 0.8]], [[0.0], [1.0]], 1.0, x_ss=[10, 5], u_ss=[2])
    box = {"u_min": 1, "u_max": 3, "theta_min": [5, 2], "theta_max": [15, 8]}
    near = Terminal(set=([[1, 0], [-1, 0]], [10.05, -9.95]))
    own, invariant = (
        LinearMPC(tank, Q=np.eye(2), R=[[0.1]], horizon=4, terminal=each, **box)
        for each in (near, Terminal(set="invariant"))
    )
    found, _ = offset_free(own)
    for x in ([10.3, 5.2], [9.8, 4.9]):
        given = own.online().plant_input(x)
        np.testing.assert_allclose(found.online().plant_input([*x, 0, 0]), given, atol=1e-9)
    anew = offset_free(invariant)[0].terminal.set[0]
    assert anew.shape[1] == 4 and np.any(anew[:, 2:])  # the room depends on the disturbance
    stale = replace(invariant, R=[[3.0]])
    assert np.any(offset_free(stale)[0].terminal.set[0][:, 2:])


def test_replace_adds_to_theta_what_it_had_not() -> None:
    tank = LinearModel([[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]], dt=1.0)
    bounds = {"x_min": -5, "x_max": 5, "u_min": -1, "u_max": 1}
    follows = {"tracking": Tracking([0], -1, 1)}
    plain = LinearMPC(tank, Q=np.eye(2), R=[[1]], horizon=3, **follows, **bounds)
    more = {"tracking": Tracking([0], -1, 1, preview=2), "rate": RateLimits(-1, 1)}
    found = replace(plain, **more, terminal=None)
    assert found.n_theta == 2 + 3 + 1
