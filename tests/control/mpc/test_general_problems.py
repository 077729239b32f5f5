"""Laws of problems with references, disturbances, rates and soft bounds, against an online QP."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from general_problems import PROBLEMS, THERMAL, servo, solved
from reference_answers import online_answers, relative_error
from sample_problems import box_points
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
from sb3_yann.control import lqr


@pytest.mark.parametrize("name", PROBLEMS)
def test_law_and_domain_are_those_of_an_online_qp(name: str) -> None:
    mpc = solved(name)
    points = box_points(mpc, 1000, seed=1)
    inputs, feasible = online_answers(mpc, points)
    assert feasible.sum() > 50
    np.testing.assert_array_equal(mpc.explicit().in_domain(points), feasible)
    assert relative_error(mpc, mpc.explicit()(points[feasible]), inputs) <= 1e-9


def test_rates_are_kept_on_every_step_of_a_closed_loop() -> None:
    mpc = servo(rate=RateLimits(-0.1, 0.2))
    theta = np.array([0.0, 0.0, 0.9, 0.0])
    for _ in range(40):
        u = mpc.explicit()(theta)
        assert -0.1 - 1e-9 <= u[0] - theta[-1] <= 0.2 + 1e-9
        theta = mpc.predict(theta, u)
    np.testing.assert_allclose(theta[0], 0.9, atol=1e-3)


def test_a_soft_bound_is_kept_where_the_hard_one_can_be() -> None:
    hard = servo(x_max=[1.5, 0.3], x_min=[-1.5, -0.3], theta_min=-3, theta_max=3)
    soft = dataclasses.replace(hard, soft=SoftBounds([0.0, 1.0], penalty=1e3))
    points = box_points(hard, 2000)
    inside = points[hard.explicit().in_domain(points)]
    error = relative_error(hard, soft.explicit()(inside), hard.explicit()(inside))
    assert error <= 1e-9  # exact, not nearly: the penalty has a linear part


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
    assert dataclasses.replace(soft) == soft
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


def test_the_law_reaches_beyond_a_soft_bound_without_a_note() -> None:
    soft = {"x_min": -1.2, "x_max": 1.2, "soft": SoftBounds(1, penalty=300)}
    law = servo(**soft).explicit()
    assert law.in_domain([2.0, 0.0, 0.5])
    with pytest.warns(UserWarning, match=r"bounds -1.2 to 1.2 of x\[0\], .* the law ends there"):
        servo(**soft, theta_min=-1.2, theta_max=1.2)


@pytest.mark.parametrize("gamma", [1.0, 0.9])
@pytest.mark.parametrize("name", PROBLEMS)
def test_value_is_the_cost_of_the_law_on_the_model(name: str, gamma: float) -> None:
    mpc = solved(name)
    law = mpc.explicit()
    P = mpc.value_matrix(gamma)
    theta = 1e-3 * box_points(mpc, 5, seed=2)
    at_rest = law.locate(np.zeros(mpc.n_theta))
    value = np.einsum("bi,ij,bj->b", theta, P, theta)
    cost = np.zeros(5)
    for k in range(400):
        assert np.all(law.locate(theta) == at_rest)
        u = law(theta)
        cost += gamma**k * mpc.stage_cost(theta, u)
        theta = mpc.predict(theta, u)
    np.testing.assert_allclose(cost, value, rtol=1e-6)


@pytest.mark.parametrize("name", PROBLEMS)
def test_stage_matrix_is_the_stage_cost_as_a_form(name: str) -> None:
    mpc = solved(name)
    rng = np.random.default_rng(0)
    theta = box_points(mpc, 50)
    u = rng.normal(size=(50, mpc.model.n_inputs))
    z = np.hstack([theta, u])
    form = np.einsum("bi,ij,bj->b", z, mpc.stage_matrix, z)
    np.testing.assert_allclose(mpc.stage_cost(theta, u), form, rtol=1e-9, atol=1e-9)
    M = mpc.state_action_matrix(0.9)
    following = mpc.predict(theta, u)
    value = np.einsum("bi,ij,bj->b", following, mpc.value_matrix(0.9), following)
    np.testing.assert_allclose(
        np.einsum("bi,ij,bj->b", z, M, z), form + 0.9 * value, rtol=1e-9, atol=1e-9
    )


def test_stage_cost_is_the_formula() -> None:
    mpc = servo(rate=RateLimits(R_du=[[2.0]]))
    theta = np.array([0.3, -0.1, 0.5, 0.2])
    u = np.array([0.4])
    x_s, u_s = mpc.steady_state([0.5])
    e = theta[:2] - x_s
    expected = e @ mpc.Q @ e + 0.1 * (u - u_s) ** 2 + 2.0 * (0.4 - 0.2) ** 2
    assert mpc.stage_cost(theta, u) == pytest.approx(float(expected[0]))


def test_a_weight_on_the_rate_has_the_gain_of_the_augmented_lqr() -> None:
    box = {"x_min": None, "x_max": None, "theta_min": -9, "theta_max": 9}
    mpc = servo(rate=RateLimits(R_du=[[2.0]]), **box, u_min=-90, u_max=90)
    A = THERMAL.A
    B = THERMAL.B
    bigger = LinearModel(
        np.block([[A, np.zeros((2, 1))], [np.zeros((1, 3))]]), np.vstack([B, [[1.0]]]), 1.0
    )
    Q = np.diag([1, 1, 2.0])
    R = np.array([[0.1 + 2.0]])
    N = np.array([[0], [0], [-2.0]])
    P = lqr.riccati(bigger, Q, R, cross=N)
    K = lqr.gain(bigger, R, P, cross=N)
    law = mpc.explicit()
    gain = law.gains[law.locate(np.zeros(4))]
    np.testing.assert_allclose(gain[:, [0, 1, 3]], -K, rtol=1e-9, atol=1e-12)


BAD: list[tuple[Callable[[], dict[str, Any]], type[Exception], str]] = [
    (
        lambda: {"tracking": Tracking([0, 1])},
        ValueError,
        r"no steady state for r\[0\], r\[1\]: .* rank 3.* \(1\) can",
    ),
    (
        lambda: {"tracking": Tracking([2])},
        ValueError,
        r"Tracking.C = \[2\] must be indices of states, .* 0 to 1",
    ),
    (lambda: Tracking([0.5]), ValueError, r"Tracking.C = \[0.5\] must be indices of states"),
    (lambda: Tracking([-1]), ValueError, r"Tracking.C = \[-1\] must be indices .* from 0 on"),
    (
        lambda: {"tracking": Tracking([[1, 2, 3]])},
        ValueError,
        r"Tracking.C has shape \(1, 3\), expected \(q, 2\)",
    ),
    (
        lambda: Tracking([[0, 1e308]]),
        ValueError,
        r"Tracking.C\[0, 1\] = 1e\+308 must be at most 1e\+1",
    ),
    (lambda: Tracking([0], r_min=2, r_max=1), ValueError, "r_min must lie below r_max"),
    (lambda: Tracking(r_max=1), ValueError, "there is no output in Tracking.C"),
    (
        lambda: {"tracking": [0]},
        TypeError,
        r"tracking = \[0\] must be of the class Tracking: tracking=Tr",
    ),
    (
        lambda: {"disturbances": DisturbanceBounds(d_max=2)},
        ValueError,
        "d_min or d_max is given, but there is no E of the model",
    ),
    (lambda: RateLimits(0, 0), ValueError, "du_min must lie below du_max"),
    (lambda: RateLimits(R_du=[[-1]]), ValueError, "R_du must be positive semi-definite"),
    (
        lambda: {"rate": RateLimits(R_du=np.eye(2))},
        ValueError,
        r"R_du has shape \(2, 2\), expected \(1, 1\)",
    ),
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
        ValueError,
        "SoftBounds.penalty is missing, and it is not known",
    ),
    (lambda: Terminal(set="invariants"), TypeError, "a pair .* or 'invariant', got 'invariants'"),
    (lambda: Tracking(0), ValueError, r"Tracking.C = 0 must be a list of indices of states: \[0\]"),
]


@pytest.mark.parametrize(("make", "error", "message"), BAD)
def test_bad_argument_is_named(
    make: Callable[[], Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        servo(**make())


def test_a_disturbance_that_no_input_can_hold_is_named() -> None:
    model = LinearModel([[1, 0], [0, 0.5]], [[0], [1]], 1.0, E=[[1], [0]])
    with pytest.raises(ValueError, match=r"no steady state for d\[0\]"):
        LinearMPC(model, Q=np.eye(2), R=[[1]], horizon=1, terminal=Terminal(np.eye(2)))


def test_references_without_a_box_are_named_when_the_law_is_asked_for() -> None:
    with pytest.raises(ValueError, match="where theta holds them, r_min and r_max"):
        servo(tracking=Tracking([0], r_max=1)).explicit()
