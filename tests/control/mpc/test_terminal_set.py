"""With the invariant terminal set no closed loop on the model ever becomes infeasible."""

from __future__ import annotations

import numpy as np
import pytest

from general_problems import INVARIANT_SET, LOADED, RATED, RATES, servo, two_tanks
from sample_problems import UNSTABLE, input_bounds_only, small_mpc
from sb3_yann import LinearModel, LinearMPC, OutputBounds, RateLimits, Terminal
from sb3_yann.control.mpc import invariant_sets as invariant

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
    law, rng, theta = mpc.explicit(), np.random.default_rng(0), np.zeros((0, mpc.n_theta))
    while len(theta) < 1000:
        points = rng.uniform(mpc.theta_min, mpc.theta_max, (1000, mpc.n_theta))
        theta = np.vstack([theta, points[law.in_domain(points)]])[:1000]
    for _ in range(100):
        theta = mpc.predict(theta, law(theta))
        assert law.in_domain(theta).all()


@pytest.mark.parametrize("name", ["unstable regulator", "unstable servo"])
def test_without_it_some_do(name: str) -> None:
    mpc = INVARIANT[name]()
    free = np.zeros((0, mpc.n_theta)), np.zeros(0)
    values = {field: getattr(mpc, field) for field in mpc.__dataclass_fields__}
    mpc = LinearMPC(**{**values, "terminal": Terminal(mpc.terminal.cost, free)})
    law, rng = mpc.explicit(), np.random.default_rng(0)
    theta = rng.uniform(mpc.theta_min, mpc.theta_max, (2000, mpc.n_theta))
    theta = theta[law.in_domain(theta)]
    for _ in range(50):
        theta = mpc.predict(theta, law(theta))
        theta = np.clip(theta, -100, 100)
    assert not law.in_domain(theta).all()


@pytest.mark.parametrize("name", INVARIANT)
def test_the_set_is_invariant_under_its_gain_which_keeps_the_bounds(name: str) -> None:
    mpc = INVARIANT[name]()
    F, g = mpc.terminal.set
    rng = np.random.default_rng(0)
    theta = rng.uniform(mpc.theta_min, mpc.theta_max, (20_000, mpc.n_theta))
    theta = theta[np.all(theta @ F.T <= g, axis=1)]
    assert len(theta) > 50
    law = mpc.explicit()
    gain = law.gains[law.locate(np.zeros(mpc.n_theta))]  # there it is that of the terminal cost
    u = theta @ gain.T
    following = mpc.predict(theta, u)
    assert np.all(following @ F.T <= g + 1e-9)
    assert np.all((u <= mpc.u_max + 1e-9) & (u >= mpc.u_min - 1e-9))
    x = following[:, mpc.layout.state]
    assert np.all((x <= mpc.x_max + 1e-9) & (x >= mpc.x_min - 1e-9))


def test_the_set_is_the_largest_one_on_a_plant_with_one_state() -> None:
    # x+ = 0.5 x under any gain near it: the set is where |x| <= 2 and |K x| <= 1.
    mpc = small_mpc(LinearModel([[0.9]], [[1]], 1.0), x_min=-2, x_max=2, u_max=0.5, **INVARIANT_SET)
    law = mpc.explicit()
    K = float(law.gains[law.locate([0.0])][0, 0])
    F, g = mpc.terminal.set
    upper, lower = min(2, 1 / -K), max(-2, 0.5 / K)
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
    [("MAX_ROWS", "more than 1 half-spaces. Give"), ("MAX_STEPS", "not determined after 1 steps")],
)
def test_a_set_that_grows_too_large_is_said_so(
    limit: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(invariant, limit, 1)
    with pytest.raises(ValueError, match=message):
        INVARIANT["unstable servo"]()
