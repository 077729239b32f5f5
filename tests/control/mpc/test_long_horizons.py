"""Unstable plants over long horizons lose no digits, and where they would, an error says so."""

import pickle
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy import linalg

from benchmarks.long_horizons import KINDS, errors, problem
from sample_problems import small_mpc
from sb3_yann import LinearModel, LinearMPC, SoftBounds, Terminal
from sb3_yann.control import OnlineLaw

BOX = {"x_min": -8, "x_max": 8, "u_min": -1.5, "u_max": 1.5}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("pole", "horizon"), [(1.03, 30), (1.4, 25), (1.7, 60), (2.8, 40)])
def test_the_online_law_is_that_of_a_program_that_keeps_all_states(pole, horizon, kind) -> None:
    error, _, compared = errors(problem(pole, horizon, kind, seed=3), 6, explicit=False)
    assert compared and error < 1e-8


@pytest.mark.parametrize(("pole", "horizon"), [(2.4, 8), (1.9, 18), (1.6, 24)])
def test_so_is_the_explicit_law(pole, horizon) -> None:
    mpc = problem(pole, horizon, seed=5)
    online, explicit, compared = errors(mpc, 12, explicit=True)
    assert compared and max(online, explicit) < 1e-8


NO_COST = Terminal(cost=np.zeros((2, 2)))
SPECIAL: dict[str, tuple[Any, Any, dict[str, Any]]] = {
    "discounted": ([[1.8, 0.3], [0, 1.1]], [[0], [1]], {"gamma": 0.9}),
    "short-sighted": ([[1.8, 0.3], [0, 1.1]], [[0], [1]], {"terminal": NO_COST}),
    # A mode on the unit circle without a weight has no Riccati gain; the law needs none.
    "no gain of its own": (
        [[1.8, 0], [0, 1]], [[1], [0.5]], {"Q": np.diag([1, 0]), "terminal": NO_COST},
    ),
    "a mode that no input reaches": ([[1.7, 0.2], [0, 1.01]], [[1], [0]], {"gamma": 0.95}),
    "a large terminal cost": (
        [[2.3, 0.3], [0, 0.5]], [[1], [1]], {"terminal": Terminal(cost=1e11 * np.eye(2))},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SPECIAL)
def test_problems_of_special_gains_and_costs_keep_their_laws(name: str) -> None:
    A, B, options = SPECIAL[name]
    given = {"Q": np.eye(2), "R": [[1]], "horizon": 60, **BOX, **options}
    error, _, compared = errors(LinearMPC(LinearModel(A, B, dt=1), **given), 8, explicit=False)
    assert compared and error < 1e-8


def test_a_law_about_a_feedback_survives_a_file_and_a_pickle(tmp_path) -> None:
    law = problem(2.2, 30, "rates").online()
    law.save(tmp_path / "law.npz")
    theta = np.random.default_rng(0).uniform(law.theta_min, law.theta_max, (20, law.n_theta)) / 3
    for other in (OnlineLaw.load(tmp_path / "law.npz"), pickle.loads(pickle.dumps(law))):
        np.testing.assert_array_equal(other(theta), law(theta))
        np.testing.assert_array_equal(other.gain(theta[0]), law.gain(theta[0]))


def test_beyond_its_reach_the_law_is_bounded_and_keeps_the_inputs_bounds() -> None:
    law = problem(2.5, 30).online()
    theta = np.random.default_rng(1).uniform(-1e3, 1e3, (30, 2))
    u = law(theta)
    assert not law.in_domain(theta).all()
    assert np.isfinite(u).all() and np.abs(u).max() <= 2.0


@pytest.mark.parametrize("kind", ["online", "explicit"])
def test_where_digits_are_lost_an_error_names_the_horizon_and_the_pole(kind) -> None:
    nearly = LinearModel([[2, 0], [0, 1.9999]], [[1], [1]], dt=1)
    mpc = LinearMPC(nearly, Q=np.eye(2), R=[[1]], horizon=90, **BOX)
    with pytest.raises(ValueError, match=r"horizon = 90 and the pole 2 of the model"):
        mpc.law(kind)


def test_a_mode_that_grows_and_costs_nothing_is_named_with_the_horizon() -> None:
    model = LinearModel([[2.1, 0], [0, 0.5]], [[1], [1]], dt=1)
    blind = Terminal(cost=np.zeros((2, 2)))
    mpc = LinearMPC(model, Q=np.diag([0, 1]), R=[[1]], horizon=55, terminal=blind, **BOX)
    with pytest.raises(ValueError, match=r"horizon = 55 and the pole 2\.1 .*a weight in Q"):
        mpc.online()


def soft_problem(pole: float, horizon: int, far: float, penalty: float = 30.0) -> LinearMPC:
    """Return a problem of two inputs, both of which act on the unstable mode, with a soft bound."""
    model = LinearModel([[pole, 0.2], [0, 0.6]], [[0.8, 0.05], [0.3, 1]], dt=1)
    return LinearMPC(
        model, Q=np.eye(2), R=np.eye(2), horizon=horizon, x_min=[-4, -30], x_max=[4, 30],
        u_min=-1.5, u_max=1.5, theta_min=[-far, -30], theta_max=[far, 30],
        soft=SoftBounds(x=[1, 0], penalty=penalty),
    )  # fmt: skip


@pytest.mark.parametrize(("pole", "horizon"), [(1.3, 40), (1.5, 24), (1.6, 18)])
def test_beyond_reach_of_a_soft_bound_the_online_law_saturates_exactly(pole, horizon) -> None:
    mpc = soft_problem(pole, horizon, 6)
    q = np.array([1.0, 0.2 / (pole - 0.6)])  # q A = pole q
    reach = 1.5 * np.abs(q @ mpc.model.B).sum() / (pole - 1)
    law = mpc.online()
    points = np.array([[far * reach - q[1] * x, x] for x in (-3.0, 2.0) for far in (1.1, 1.5)])
    assert law.in_domain(points).any()
    for theta in points[law.in_domain(points)]:  # all that moves the mode must fight its growth
        np.testing.assert_array_equal(law(theta), [-1.5, -1.5])


def test_beyond_what_float64_can_solve_one_warning_names_horizon_and_pole() -> None:
    law = soft_problem(2.0, 40, 15).online()
    with pytest.warns(UserWarning, match=r"horizon = 40 and the pole 2 of the model, no solution"):
        u = law([12.0, -3.0])
    assert np.all(np.abs(u) <= 1.5)
    law([0.3, 0.1])  # the inputs hold it, and nothing warns
    law([12.5, -3.0])  # once is enough in a closed loop


@pytest.mark.parametrize("pole", [1.05, 1.3, 1.8])
def test_a_strong_discount_over_a_long_horizon_makes_nothing_infeasible(pole) -> None:
    A = np.array([[pole, 0.3], [0, 0.9]])
    B = np.array([[0.2], [1.0]])
    own = {"x_min": -5, "x_max": 5, "u_min": -2, "u_max": 2}
    mpc = LinearMPC(LinearModel(A, B, 1.0), Q=np.eye(2), R=[[1]], horizon=80, gamma=0.5, **own)
    law = mpc.online()
    P = linalg.solve_discrete_are(A, B, np.eye(2), np.eye(1))
    K = np.linalg.solve(1 + B.T @ P @ B, B.T @ P @ A)
    for theta in np.random.default_rng(0).uniform(-5, 5, (60, 2)):
        x = theta
        kept = True
        for _ in range(80):
            x = A @ x + B @ np.clip(-K @ x, -2, 2)
            kept = kept and bool(np.all(np.abs(x) <= 5))
        assert law.in_domain(theta) or not kept


MODEL = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1)


bounded = partial(small_mpc, MODEL, R=[[0.1]], horizon=3)


def points(count: int = 200) -> np.ndarray:
    return np.random.default_rng(0).uniform(-5, 5, (count, 2))


@pytest.mark.parametrize("large", [1e3, 1e6, 1e9])
def test_input_bounds_that_are_never_met_are_the_same_law_as_none(large: float) -> None:
    law = bounded(u_min=-large, u_max=large).explicit()
    wanted = bounded(u_min=-np.inf, u_max=np.inf).explicit()
    np.testing.assert_allclose(law(points()), wanted(points()), atol=1e-10)


@pytest.mark.parametrize("kind", ["explicit", "online"])
@pytest.mark.parametrize("large", [1e11, 1e12, 1e99])
def test_input_bounds_of_absurd_size_are_named_and_not_called_infeasible(
    large: float, kind: str
) -> None:
    # explicit() called this infeasible, and online() was wrong by 62 on states that are not.
    with pytest.raises(ValueError, match=r"u_max\[0\] = 1e\+\d\d.*too large.*or inf for no bound"):
        getattr(bounded(u_min=-large, u_max=large), kind)()


def test_an_input_with_next_to_no_effect_may_have_its_bounds() -> None:
    model = LinearModel(MODEL.A, [[0.005, 1e-17], [0.1, 0]], 0.1)
    law = LinearMPC(model, Q=np.eye(2), R=np.eye(2), horizon=2, u_min=-1, u_max=1).online()
    assert abs(law([1.0, 0.0])[1]) < 1e-15


@pytest.mark.parametrize("large", [1e9, 1e12, 1e99])
@pytest.mark.parametrize("kind", ["explicit", "online"])
@pytest.mark.parametrize("entry", [0, 1])
def test_a_box_of_absurd_size_is_named(large: float, kind: str, entry: int) -> None:
    box = np.array([5.0, 5.0])
    box[entry] = large
    # With 1e9 this was a law of two regions, wrong by the whole range.
    with pytest.raises(ValueError, match=rf"theta_max\[{entry}\] = 1e\+\d\d lie too far .*inf"):
        getattr(bounded(x_min=-box, x_max=box), kind)()


@pytest.mark.parametrize("large", [1e4, 1e6])
def test_a_box_that_is_only_large_has_the_right_law(large: float) -> None:
    mpc = bounded(x_min=[-5, -large], x_max=[5, large])
    law = mpc.explicit()
    online = mpc.online()
    assert np.array_equal(law.in_domain(points()), online.in_domain(points()))
    inside = points()[online.in_domain(points())]
    np.testing.assert_allclose(law(inside), online(inside), atol=1e-9)


@pytest.mark.parametrize("name", ["x_max", "u_max", "theta_max"])
def test_what_would_overflow_is_named(name: str) -> None:
    with pytest.raises(ValueError, match=rf"{name}\[0\] = 1e\+200 must be .* Use inf"):
        bounded(**{name: 1e200})


@pytest.mark.parametrize("kind", ["explicit", "online"])
def test_weights_that_make_the_program_singular_to_rounding_are_named(kind: str) -> None:
    model = LinearModel([[0.5, 0], [0, 0.5]], [[1e3, 1e3], [1e3, 1e3]], 1.0)
    weights = {"Q": np.eye(2), "R": 1e-14 * np.eye(2), "terminal": Terminal(np.eye(2))}
    box = {"u_min": -1, "u_max": 1, "x_min": -5, "x_max": 5}
    mpc = LinearMPC(model, **weights, horizon=1, **box)
    with pytest.raises(ValueError, match=r"no unique solution to rounding.*larger R"):
        getattr(mpc, kind)()


def test_an_infinite_box_has_an_online_law() -> None:
    law = bounded(x_min=-np.inf, x_max=np.inf).online()
    np.testing.assert_allclose(law(points()), bounded(x_min=-100, x_max=100).online()(points()))
