"""The set in which hard bounds can be kept: as large as it can be, and one can stay in it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

import general_problems
import sample_problems
from sb3_yann import LinearModel, LinearMPC, Terminal, Tracking
from sb3_yann.control.mpc.invariant_sets import kept_set


def test_of_an_unstable_mode_it_ends_where_inputs_no_longer_hold_it():
    model = LinearModel([[1.25]], [[1.0]], 1)
    mpc = LinearMPC(model, Q=[[1]], R=[[1]], horizon=2, x_min=-20, x_max=20, u_min=-1, u_max=1)
    kept = mpc.kept_set
    assert kept.for_ever and kept is mpc.kept_set
    np.testing.assert_allclose(np.sort(kept.g / kept.F[:, 0]), [-4, 4], atol=2e-3)


def test_of_a_cart_it_leaves_room_to_brake():
    cart = LinearModel([[1, 1], [0, 1]], [[0.5], [1]], 1)
    mpc = LinearMPC(
        cart, Q=np.eye(2), R=[[1]], horizon=8, x_min=[-10, -3], x_max=[10, 3], u_min=-1, u_max=1
    )
    kept = mpc.kept_set
    assert kept.for_ever

    def inside(x):
        return bool(np.all(kept.F @ x <= kept.g))

    assert inside([5.49, 3.0]) and not inside([5.51, 3.0])  # 3 - 1/2 + 2 - 1/2 + 1 - 1/2 to stop
    assert inside([-10, 3]) and inside([9.49, 1.0]) and not inside([9.51, 1.0])


@pytest.mark.parametrize(
    "mpc",
    [
        general_problems.PROBLEMS["servo with all of it"](),
        general_problems.PROBLEMS["two tanks, all parts"](),
        general_problems.PROBLEMS["invariant with all of it"](),
        sample_problems.PROBLEMS["unstable, part of the box infeasible"](),
        sample_problems.PROBLEMS["two inputs"](),
        sample_problems.PROBLEMS["one-sided state bounds"](),
    ],
)
def test_from_each_corner_an_input_leads_back_into_it(mpc):
    kept, (A, B) = mpc.kept_set, mpc.prediction
    n, m, parts = mpc.n_theta, mpc.model.n_inputs, mpc.layout
    low, high = np.full((2, n), None)
    low[parts.state.stop :] = mpc.theta_min[parts.state.stop :]
    high[parts.state.stop :] = mpc.theta_max[parts.state.stop :]
    box = [*zip(low, high, strict=True)]
    assert kept.for_ever
    rng = np.random.default_rng(0)
    for _ in range(40):
        corner = linprog(rng.normal(size=n), A_ub=kept.F, b_ub=kept.g, bounds=box)
        if corner.status == 3:  # a state without bounds
            continue
        theta = corner.x
        last = theta[parts.previous] if parts.n_previous else np.zeros(m)
        least = np.maximum(mpc.u_min, last + mpc.rate.du_min if parts.n_previous else -np.inf)
        most = np.minimum(mpc.u_max, last + mpc.rate.du_max if parts.n_previous else np.inf)
        rows = np.hstack([kept.F @ B, -np.ones((len(kept.g), 1))])
        found = linprog(
            np.eye(m + 1)[-1],
            A_ub=rows,
            b_ub=kept.g - kept.F @ A @ theta,
            bounds=[*zip(least - 1e-9, most + 1e-9, strict=True), (None, None)],
        )
        assert found.fun < 1e-6


def test_with_an_invariant_terminal_set_it_is_where_the_mpc_has_a_solution():
    mpc = general_problems.solved("invariant")
    kept, law = mpc.kept_set, mpc.explicit()
    theta = np.random.default_rng(0).uniform(mpc.theta_min, mpc.theta_max, (3000, mpc.n_theta))
    slack = (kept.g - theta @ kept.F.T).min(axis=1)
    clear = np.abs(slack) > 1e-6
    assert np.array_equal(law.in_domain(theta)[clear], slack[clear] > 0)
    assert kept.for_ever and 0.05 < np.mean(slack > 0) < 0.95


def test_a_terminal_set_that_cannot_be_kept_promises_nothing():
    cart = LinearModel([[1, 1], [0, 1]], [[0.5], [1]], 1)
    limits = {"x_min": [-10, -3], "x_max": [10, 3], "u_min": -1, "u_max": 1}
    end = Terminal(set=([[1, 0], [-1, 0]], [0.1, 0.1]))  # with any speed
    mpc = LinearMPC(cart, Q=np.eye(2), R=[[1]], horizon=3, terminal=end, **limits)
    found = mpc.kept_set
    assert found.for_ever
    assert np.all(found.F @ [0, 0] <= found.g) and not np.all(found.F @ [0, 3.0] <= found.g)


def test_without_hard_bounds_it_is_everything_and_a_reference_is_no_part_of_it():
    model = LinearModel([[0.9]], [[1.0]], 1)
    free = LinearMPC(model, Q=[[1]], R=[[1]], horizon=2, theta_min=-5, theta_max=5, u_max=1)
    assert len(free.kept_set.g) == 0 and not free.has_hard_bounds
    tracking = LinearMPC(
        model, Q=[[1]], R=[[1]], horizon=2, x_min=-5, x_max=5, u_min=-1, u_max=1,
        tracking=Tracking([0], -1, 1),
    )  # fmt: skip
    assert tracking.has_hard_bounds and not tracking.kept_set.F[:, 1].any()


def test_one_that_is_too_large_looks_fewer_steps_ahead():
    mpc = sample_problems.PROBLEMS["reactor, predicted states bounded"]()
    few = kept_set(mpc, most_rows=20)
    assert len(few.g) <= 20 and few.steps < 17 and not few.for_ever
