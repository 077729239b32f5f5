"""References are reached without offset; steady states, and which references have one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

from general_problems import servo, solved, two_tanks
from sb3_yann import (
    DisturbanceBounds,
    DisturbanceObserver,
    LinearModel,
    LinearMPC,
    OutputBounds,
    RateLimits,
    Tracking,
)

TRACKING = ["servo", "servo with all of it", "two tanks, all parts", "more inputs than outputs"]


def reachable_constants(mpc: LinearMPC, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """References (count, p) and disturbances (count, d) with a steady state inside the bounds."""
    rng, parts = np.random.default_rng(seed), mpc.layout
    theta = rng.uniform(mpc.theta_min, mpc.theta_max, (20 * count, mpc.n_theta))
    r, d = theta[:, parts.reference], theta[:, parts.disturbance]
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


def test_with_as_many_disturbances_as_measurements_a_wrong_model_leaves_no_offset() -> None:
    mpc, observer = solved("two tanks"), DisturbanceObserver(solved("two tanks").model)
    model = mpc.model
    # The plant: other gains, other poles, and a load that enters elsewhere.
    A, B = model.A * [[1.02, 1], [0.9, 0.97]], model.B * [[0.9, 1.2], [1, 1.1]]
    load, r = np.array([0.05, -0.03]), np.array([0.2, 0.3])
    x, u = np.zeros(2), np.zeros(2)
    x_hat, d_hat = observer.reset(x)
    for _ in range(400):
        u = mpc.explicit()(np.concatenate([x_hat, r, d_hat]))
        x = A @ x + B @ u + load
        x_hat, d_hat = observer.update(x, u)
    np.testing.assert_allclose(x, r, atol=1e-6)
    blind = np.zeros(2)
    for _ in range(400):  # without the estimate there is an offset
        blind = A @ blind + B @ mpc.explicit()(np.concatenate([blind, r, 0 * d_hat])) + load
    assert np.max(np.abs(blind - r)) > 0.02


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
    A, B = mpc.model.A, mpc.model.B

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


def test_units_change_no_steady_state() -> None:
    plain = two_tanks(tracking=Tracking([[1, 1]], -0.5, 0.5))
    unit = np.array([1e6, 1e-6])
    to, back = np.diag(unit), np.diag(1 / unit)
    model = LinearModel(to @ plain.model.A @ back, to @ plain.model.B, 1.0, E=to @ plain.model.E)
    other = LinearMPC(
        model, Q=back @ back, R=plain.R, horizon=1,
        tracking=Tracking(plain.tracking.C @ back, -0.5, 0.5),
        disturbances=DisturbanceBounds(-0.2, 0.2), x_min=-2 * unit, x_max=2 * unit,
        u_min=plain.u_min, u_max=plain.u_max,
    )  # fmt: skip
    np.testing.assert_allclose(other.steady_states.u, plain.steady_states.u, rtol=1e-9)
    np.testing.assert_allclose(other.steady_states.x, to @ plain.steady_states.x, rtol=1e-9)


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
    law, x, u = mpc.online(), 0.0, np.zeros(2)
    for _ in range(80):
        u = law([x, 0.3, *u])
        x = 0.8 * x + np.array([0.3, 0.2]) @ u
    np.testing.assert_allclose(x, 0.3, atol=1e-9)
