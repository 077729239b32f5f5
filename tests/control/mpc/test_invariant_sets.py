"""No closed loop leaves an invariant terminal set; hard bounds can be kept in the kept set."""

import numpy as np
import pytest

import general_problems
import sample_problems
from general_problems import INVARIANT_SET, LOADED, RATED, RATES, servo, two_tanks
from sample_problems import UNSTABLE, input_bounds_only, small_mpc
from sb3_yann import LinearModel, LinearMPC, OutputBounds, RateLimits, Terminal, Tracking
from sb3_yann.control.mpc import invariant_sets as invariant
from sb3_yann.control.mpc.invariant_sets import kept_set

INVARIANT = {
    "regulator": lambda: small_mpc(**INVARIANT_SET),
    "unstable regulator": lambda: small_mpc(UNSTABLE, **INVARIANT_SET),
    "servo": lambda: servo(**INVARIANT_SET),
    "tight servo": lambda: servo(x_min=-1.2, x_max=1.2, u_min=-0.3, u_max=0.25, **INVARIANT_SET),
    "unstable servo": lambda: servo(
        LinearModel([[1.3, 1], [0, 1.1]], [[0], [1]], 1.0), **INVARIANT_SET
    ),
    "disturbance and rates": lambda: servo(LOADED, **RATED, **INVARIANT_SET),
    "weight on the rate": lambda: servo(rate=RateLimits(**RATES, R_du=[[2.0]]), **INVARIANT_SET),
    "bounded output": lambda: servo(outputs=OutputBounds([[1, 1]], y_max=1.1), **INVARIANT_SET),
    "two tanks": lambda: two_tanks(**INVARIANT_SET),
}


@pytest.mark.parametrize("name", INVARIANT)
def test_none_of_a_thousand_closed_loops_becomes_infeasible(name: str) -> None:
    mpc = INVARIANT[name]()
    law = mpc.explicit()
    rng = np.random.default_rng(0)
    theta = np.zeros((0, mpc.n_theta))
    while len(theta) < 1000:
        points = rng.uniform(mpc.theta_min, mpc.theta_max, (1000, mpc.n_theta))
        theta = np.vstack([theta, points[law.in_domain(points)]])[:1000]
    for _ in range(100):
        theta = mpc.predict(theta, law(theta))
        assert law.in_domain(theta).all()


def test_the_set_is_the_largest_one_on_a_plant_with_one_state() -> None:
    # x+ = 0.5 x under any gain near it: the set is where |x| <= 2 and |K x| <= 1.
    mpc = small_mpc(LinearModel([[0.9]], [[1]], 1.0), x_min=-2, x_max=2, u_max=0.5, **INVARIANT_SET)
    law = mpc.explicit()
    K = float(law.gains[law.locate([0.0])][0, 0])
    F, g = mpc.terminal.set
    upper = min(2, 1 / -K)
    lower = max(-2, 0.5 / K)
    ends = sorted((g / F[:, 0]).tolist())
    assert ends == pytest.approx([lower, upper])


def test_steady_states_in_the_set_lie_inside_the_bounds_by_a_hundredth() -> None:
    mpc = INVARIANT["tight servo"]()
    F, g = mpc.terminal.set
    reference = np.linspace(-1, 1, 2001)
    at_rest = np.array([[*mpc.steady_states.x @ [r], r] for r in reference])
    inside = reference[np.all(at_rest @ F.T <= g + 1e-12, axis=1)]
    u = mpc.steady_states.u[0, 0] * inside
    assert u.max() <= 0.99 * 0.25 + 1e-9
    assert u.max() > 0.98 * 0.25 or inside.max() == 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: small_mpc(u_min=0, **INVARIANT_SET), "room to every bound"),
        (
            lambda: input_bounds_only(UNSTABLE, gamma=0.3, **INVARIANT_SET),
            "spectral radius of A - BK",
        ),
    ],
)
def test_why_there_is_no_set_is_said(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        ("MAX_FACETS", "more than 1 half-spaces. Give"),
        ("MAX_STEPS", "not determined after 1 steps"),
    ],
)
def test_a_set_that_grows_too_large_is_said_so(
    limit: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(invariant, limit, 1)
    with pytest.raises(ValueError, match=message):
        INVARIANT["unstable servo"]()


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


def test_with_an_invariant_terminal_set_it_is_where_the_mpc_has_a_solution():
    mpc = general_problems.solved("invariant")
    kept = mpc.kept_set
    law = mpc.explicit()
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
