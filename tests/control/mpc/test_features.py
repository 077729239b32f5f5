"""Blocks, previews, mixed bounds, prices and bounds that change at run time."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import linalg
from stable_baselines3 import DDPG

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
    YannPolicy,
    export,
)
from sb3_yann.control.mpc.bound_excess import Bounds, bound_excess
from sb3_yann.deployment.controller import Controller
from sb3_yann.wrappers import PlantEnv
from sparse_qp import FEATURES, SparseQP, Spec, draw, problem, worst_difference

CART = LinearModel([[1, 1], [0, 1]], [[0], [1]], dt=1.0)
BOUNDS: dict[str, Any] = {"x_min": -5, "x_max": 5, "u_min": -1, "u_max": 1}


def cart(model: LinearModel = CART, **changes: Any) -> LinearMPC:
    values: dict[str, Any] = {"Q": np.eye(2), "R": [[1]], "horizon": 6, **BOUNDS}
    return LinearMPC(model, **{**values, **changes})


@pytest.mark.parametrize("features", [*((name,) for name in FEATURES), FEATURES])
def test_laws_are_those_of_a_sparse_program_of_another_solver(features: tuple[str, ...]) -> None:
    found = [worst_difference(features, seed, points=4) for seed in (1, 2)]
    assert max(each[0] for each in found) < 1e-8
    assert sum(each[1] for each in found) >= 3


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
    named = replace(ahead, model=replace(model, state_names=["place", "speed"]))
    assert named.labels()[2:5] == (
        "set-point of place", "set-point of place, 1 sample ahead",
        "set-point of place, 2 samples ahead",
    )  # fmt: skip
    theta = np.random.default_rng(0).uniform(mpc.theta_min, mpc.theta_max, (50, mpc.n_theta)) / 3
    both = theta @ ahead.layout.lift.T
    assert np.abs(mpc.online()(theta) - ahead.online()(both)).max() < 1e-9
    assert (
        np.abs(mpc.stage_cost(theta, theta[:, :1]) - ahead.stage_cost(both, theta[:, :1])).max()
        < 1e-9
    )


def _bellman(mpc: LinearMPC, gamma: float) -> float:
    """Return the largest residual of the value near where the law rests, relative to costs."""
    own = mpc.deviations
    law = mpc.law("online")
    value = mpc.value_terms(gamma)
    A, B = own.prediction
    theta = own.theta_rest
    for _ in range(3000):
        theta = A @ theta + B @ law(theta)
    rng = np.random.default_rng(1)
    points = theta + 1e-4 * rng.uniform(-1, 1, (40, mpc.n_theta)) * own.theta_half
    limits = own.layout.limits
    points[:, limits] = np.clip(points, own.theta_min, own.theta_max)[:, limits]
    u = law(points)
    following = points @ A.T + u @ B.T
    stage = own.stage_cost(points, u)
    residual = value.at(points) - stage - gamma * value.at(following)
    return float(np.abs(residual).max() / max(np.abs(value.at(points)).max(), 1e-12))


@pytest.mark.parametrize("features", [*((name,) for name in FEATURES), FEATURES])
def test_the_value_satisfies_bellmans_equation(features: tuple[str, ...]) -> None:
    for seed in (3, 5):
        assert _bellman(problem(draw(np.random.default_rng(seed), features)), 0.95) < 1e-6


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


def test_bounds_that_change_hold_at_each_theta() -> None:
    mpc = cart(parametric_bounds=["u_max", "x_min[1]"], rate=RateLimits(-0.7, 0.7))
    assert mpc.layout.names == ("x[0]", "x[1]", "u_max[0]", "x_min[1]", "u_prev[0]")
    assert mpc.theta_min[2:4].tolist() == [-1, -5] and mpc.theta_max[2:4].tolist() == [1, 5]
    law = mpc.online()
    for limit in (1.0, 0.4, 0.1):
        plain = cart(u_max=limit, rate=RateLimits(-0.7, 0.7), theta_min=-5, theta_max=5)
        theta = np.array([-2.0, 0.3, limit, -5.0, 0.0])
        assert law.plant_input(theta) == pytest.approx(plain.online()(theta[[0, 1, 4]]), abs=1e-9)


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
    model = DDPG(YannPolicy, env, policy_kwargs={"problem": mpc}, device="cpu")
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


def test_an_operating_point_moves_bounds_that_change_as_all_else() -> None:
    x = np.array([10.0, 20.0])
    u = np.array([4.0])
    parts: dict[str, Any] = {"parametric_bounds": ["u_max", "x_min", "du_max", "mixed_max"]}
    parts |= {"rate": RateLimits(-0.9, 0.9)}
    own = cart(mixed=MixedBounds([[1, 0]], [[1]], -4, 4), **parts)
    shown = cart(
        LinearModel(CART.A, CART.B, 1.0, x_ss=x, u_ss=u), x_min=x - 5, x_max=x + 5, u_min=3,
        u_max=5, mixed=MixedBounds([[1, 0]], [[1]], 10, 18), **parts,
    )  # fmt: skip
    assert shown.deviations == own
    assert shown.theta_ss.tolist() == [10, 20, 4, 10, 20, 0, 14, 4]
    rng = np.random.default_rng(0)
    theta = rng.uniform(own.theta_min, own.theta_max, (50, own.n_theta))
    at = shown.units.to_plant(theta)
    np.testing.assert_allclose(shown.online()(theta), own.online()(theta), atol=1e-12)
    np.testing.assert_allclose(shown.online().plant_input(at), own.online()(theta) + 4, atol=1e-12)
    for kind in ("x", "u", "du", "mixed"):
        middle = {"x": x, "u": u, "du": 0, "mixed": 14}[kind]
        for one, two in zip(shown.limits_at(kind, at), own.limits_at(kind, theta), strict=True):
            np.testing.assert_allclose(one - middle, two, atol=1e-12)


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
    assert not LinearMPC(
        **{**_arguments(mpc), "mixed": MixedBounds(G=[1, 1], high=2)}
    ).is_reachable()


def _arguments(mpc: LinearMPC) -> dict[str, Any]:
    return {name: getattr(mpc, name) for name in mpc.__dataclass_fields__}


def test_problems_are_copied_pickled_and_changed_with_all_their_parts() -> None:
    mpc = problem(draw(np.random.default_rng(4), FEATURES))
    copied = pickle.loads(pickle.dumps(mpc))
    assert copied == mpc == replace(mpc) and hash(copied) == hash(mpc)
    assert cart(control_horizon=3).blocks == (1, 1, 4)
    other = replace(mpc, Q=2 * mpc.Q)
    assert (other.control_horizon, other.layout) == (mpc.control_horizon, mpc.layout)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"control_horizon": 7}, ValueError, "must be at most the horizon, 6"),
        ({"control_horizon": [1, 2]}, ValueError, "make 3 samples, and the horizon is 6"),
        ({"control_horizon": "3"}, TypeError, "must be a number of samples, or a list"),
        ({"tracking": Tracking([0], -1, 1, preview=7)}, ValueError, "looks no further"),
        ({"parametric_bounds": ["v_max"]}, ValueError, "known are x_min"),
        ({"parametric_bounds": ["u_max[1]"]}, ValueError, r"the entries of u are \[0\]"),
        ({"parametric_bounds": ["u_max[x]"]}, ValueError, "single entries such as 'u_max"),
        ({"mixed": MixedBounds(G=[[1]])}, ValueError, "Row 0 of MixedBounds has no bound"),
        ({"mixed": MixedBounds(G=[[1]], high=[1, 2])}, ValueError, "MixedBounds.high has shape"),
        ({"parametric_bounds": "u_max"}, TypeError, r"a list such as \['u_max'\]"),
        ({"x_min": None, "theta_min": -5, "parametric_bounds": ["x_max"]}, ValueError, "how far"),
        ({"mixed": MixedBounds(F=[[0, 0]], high=1)}, ValueError, "bounds nothing"),
        ({"mixed": MixedBounds(high=1)}, ValueError, "there is no row in F or G"),
        ({"price": LinearCost(u=[1, 2])}, ValueError, "LinearCost.u has shape"),
        ({"soft": SoftBounds(penalty=3)}, ValueError, "nothing is soft"),
        ({"outputs": OutputBounds([0], y_max=1), "parametric_bounds": ["y_min"]}, ValueError,
         "widest"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_named(
    changes: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
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


def test_a_preview_makes_up_for_a_dead_time_as_well_as_a_sparse_program() -> None:
    n = 6
    A = np.eye(n, k=-1)
    B = np.eye(n, 1, k=-1)
    # the input acts five samples later
    A[0, 0] = 0.9
    A[1, 0] = 0
    A[0, 5] = 0.1
    wide = np.full(n, 4.0)
    spec = Spec(
        A, B, np.zeros((n, 0)), np.zeros(n), np.zeros(1), np.zeros(0), Q=np.diag([1.0] + [0] * 5),
        R=np.array([[0.01]]), N=12, gamma=1.0, x=(-wide, wide), u=(-wide[:1], wide[:1]),
        C=np.eye(1, n), r=(-wide[:1], wide[:1]), d=(np.zeros(0), np.zeros(0)),
        R_du=np.zeros((1, 1)), du=(-wide[:1], wide[:1]), blocks=[1] * 12, ahead=(12, 0),
    )  # fmt: skip
    references = np.repeat([0.0, 1.0, -0.5], 12)

    def cost(act: Any, preview: int) -> float:
        x = np.zeros(n)
        total = 0.0
        for k in range(len(references)):
            known = references[np.minimum(np.arange(k, k + preview + 1), len(references) - 1)]
            u = act(np.concatenate([x, known]))
            total += (x[0] - references[k]) ** 2 + 0.01 * (u[0] - references[k]) ** 2
            x = A @ x + B @ u
        return total

    best = cost(SparseQP(spec), 12)
    costs = []
    for preview in (9, 0):
        tracking = Tracking([0], -4, 4, preview=preview)
        costs.append(cost(problem(spec, tracking=tracking).online(), preview))
    assert costs[0] < 1.02 * best < 0.3 * costs[1]
