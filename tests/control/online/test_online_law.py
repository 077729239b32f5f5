"""The law that is solved at each point: right, total, the same whatever was asked before."""

import copy
import pickle
from dataclasses import replace

import daqp
import numpy as np
import pytest

from benchmarks.online_problems import points, six_masses, three_masses, wide_plant, worst_condition
from general_problems import PROBLEMS, solved
from sample_problems import braking
from sb3_yann import Controller, export
from sb3_yann.control import LinearModel, LinearMPC, OnlineLaw, OutputBounds, RateLimits, SoftBounds
from sb3_yann.control._kernels import online as _kernels
from sb3_yann.control._kernels.online import SOLVED
from sb3_yann.control.online import DualProgram, KnownPoints
from sparse_qp import online_answers, relative_error


def drawn(mpc: LinearMPC, count: int, stretch: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(0)
    return stretch * rng.uniform(mpc.theta_min, mpc.theta_max, (count, mpc.n_theta))


@pytest.mark.parametrize("name", PROBLEMS)
def test_it_is_the_explicit_law_where_there_is_a_solution(name) -> None:
    mpc = solved(name)
    explicit = mpc.explicit()
    online = mpc.online()
    theta = drawn(mpc, 150)
    feasible = explicit.in_domain(theta)
    assert np.array_equal(online.in_domain(theta), feasible)
    assert relative_error(mpc, online(theta)[feasible], explicit(theta)[feasible]) < 1e-9
    ours = online.gain(theta)[feasible]
    theirs = explicit.gain(theta)[feasible]
    assert np.abs(ours - theirs).max() <= 1e-9 * max(1.0, np.abs(theirs).max())


@pytest.mark.parametrize("make", [three_masses, six_masses, wide_plant])
def test_all_optimality_conditions_hold_where_no_regions_can_be_counted(make) -> None:
    mpc = make()
    assert max(worst_condition(mpc.online(), points(mpc, 8))) < 1e-8


def test_what_is_feasible_by_a_hair_is_solved_too() -> None:
    mpc = three_masses()
    law = mpc.online()
    inside = np.zeros((60, mpc.n_theta))
    outside = drawn(mpc, 60, 3.0)
    assert not law.in_domain(outside).any()
    for _ in range(60):
        middle = (inside + outside) / 2
        feasible = law.in_domain(middle)[:, None]
        inside = np.where(feasible, middle, inside)
        outside = np.where(feasible, outside, middle)
    assert max(worst_condition(law, (1 - 1e-7) * inside)) < 1e-6
    apart = np.abs(law(inside) - law((1 - 1e-7) * inside))
    assert np.max(apart) < 1e-2  # it is steep there


def test_infeasible_constraints_give_way_and_the_input_does_not_jump_at_the_border() -> None:
    law = braking().online()
    inside = np.array([4.9, 0.0])
    outside = np.array([4.9, 2.0])
    assert law.in_domain(inside)
    assert not law.in_domain(outside)
    for _ in range(50):
        middle = (inside + outside) / 2
        inside, outside = (middle, outside) if law.in_domain(middle) else (inside, middle)
    assert abs(law(inside) - law(outside)) < 1e-4
    assert law([4.9, 2.0]) == pytest.approx(-1)  # it brakes


def test_zero_input_is_none_where_there_is_no_solution() -> None:
    mpc = braking(infeasible="zero_input")
    assert mpc.online()([4.9, 2.0]) == 0
    assert np.all(mpc.online().gain([4.9, 2.0]) == 0)
    assert mpc.online()([4.9, 0.0]) == pytest.approx(mpc.explicit()([4.9, 0.0]))


def test_its_gain_is_its_slope_softened_or_not() -> None:
    law = braking().online()
    for theta in ([0.1, 0.1], [4.9, 0.2], [4.9, 0.8], [0.5, 1.95], [-5.1, 0.3]):
        step = 1e-6 * np.eye(2)
        slopes = []
        for each in step:
            slopes.append((law(theta + each) - law(theta - each)) / 2e-6)
        assert law.gain(theta) == pytest.approx(np.transpose(slopes), abs=1e-4)


def test_constraints_that_depend_on_each_other_are_no_obstacle() -> None:
    law = braking().online()
    double = replace(
        law,
        G=np.vstack([law.G] * 2 + [law.G[:1]]),
        w=np.concatenate([law.w, law.w, law.w[:1]]),
        S=np.vstack([law.S] * 2 + [law.S[:1]]),
    )
    theta = drawn(braking(), 500)
    assert np.array_equal(law.in_domain(theta), double.in_domain(theta))
    feasible = law.in_domain(theta)
    assert np.abs(law(theta) - double(theta))[feasible].max() < 1e-9


def test_daqp_is_asked_where_there_is_no_certificate(monkeypatch) -> None:
    mpc = braking()
    theta = drawn(mpc, 60)
    solve = DualProgram.solve
    expected = mpc.online()(theta)
    feasible = mpc.online().in_domain(theta)
    gains = mpc.online().gain(theta)

    def unsure(self: DualProgram, rows: np.ndarray, soft: bool = False) -> object:
        found = solve(self, rows, soft)
        if not soft:
            found.status[:] = _kernels.UNCERTIFIED
            found.sizes[:] = 0
        return found

    monkeypatch.setattr(DualProgram, "solve", unsure)
    fresh = braking().online()
    assert np.array_equal(fresh.in_domain(theta), feasible)
    assert np.abs(fresh(theta) - expected).max() < 1e-8
    assert np.abs(fresh.gain(theta) - gains)[feasible].max() < 1e-6


def test_it_is_saved_pickled_and_copied(tmp_path) -> None:
    mpc = solved("one of two states soft, soft outputs")
    law = mpc.online()
    theta = drawn(mpc, 50)
    law.save(tmp_path / "law.npz")
    for other in (OnlineLaw.load(tmp_path / "law.npz"), pickle.loads(pickle.dumps(law))):
        assert other == law
        assert hash(other) == hash(law)
        assert np.array_equal(other(theta), law(theta))
    assert copy.deepcopy(law) is law
    assert replace(law, infeasible="zero_input") != law
    assert "theta=3, inputs=1" in repr(law)
    assert law.n_constraints == len(mpc.condensed().w)


def test_a_file_without_a_law_is_named(tmp_path) -> None:
    solved("servo").explicit().save(tmp_path / "other.npz")
    with pytest.raises(ValueError, match="does not hold an OnlineLaw"):
        OnlineLaw.load(tmp_path / "other.npz")


def test_a_program_that_has_no_unique_solution_is_refused() -> None:
    law = braking().online()
    skew = law.H.copy()
    skew[0, 1] += 0.25
    for H, fault in ((skew, r"H\[0, 1\] = .*, H\[1, 0\] = "), (-law.H, "smallest eigenvalue is -")):
        with pytest.raises(
            ValueError, match=f"H must be symmetric and positive definite .*{fault}"
        ):
            replace(law, H=H)
    with pytest.raises(ValueError, match="inputs of each step"):
        replace(law, u_min=-np.ones(4), u_max=np.ones(4))


class Counted:
    """Returns two sums of each row, and counts the rows it was asked for."""

    def __init__(self) -> None:
        self.rows = 0

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        self.rows += len(rows)
        return np.column_stack([rows.sum(1), rows[:, 0]])


def test_a_full_table_forgets_and_stays_right() -> None:
    counted = Counted()
    rows = np.random.default_rng(0).normal(size=(1000, 2))
    known = KnownPoints(counted, 2, size=64)
    for _ in range(3):
        assert np.array_equal(known(rows), Counted()(rows))
    assert counted.rows > 2000


def test_what_a_law_remembers_does_not_travel() -> None:
    law = solved("servo").online()
    law([[0.1, 0.2, 0.3]])
    assert np.any(law.known._keys) and not np.any(pickle.loads(pickle.dumps(law)).known._keys)


STEEP = SoftBounds(x=True, penalty=1e3)


def cart(unit: float = 1.0, infeasible: str = "nearest_region", soft=STEEP) -> LinearMPC:
    """Return a cart with soft bounds, its states in a unit so many times smaller."""
    bound = unit * np.array([1.0, 0.5])
    return LinearMPC(
        LinearModel([[1, 0.1], [0, 1]], unit * np.array([[0.005], [0.1]]), dt=0.1),
        Q=np.eye(2) / unit**2, R=[[0.1]], horizon=4, u_min=-1, u_max=1, infeasible=infeasible,
        x_min=-bound, x_max=bound, soft=soft,
    )  # fmt: skip


def test_far_outside_a_softened_program_is_solved() -> None:
    mpc = braking(horizon=12)
    law = mpc.online()
    rng = np.random.default_rng(0)
    dual = law.dual
    eye = np.eye(len(dual.d0))
    bounds = np.full(len(dual.d0), -1e30)
    values, vectors = np.linalg.eigh(dual.gram + np.diag(dual.softness))
    rows = np.ascontiguousarray(-vectors * np.sqrt(np.maximum(values, 0.0)))
    points = 100 * rng.uniform(mpc.theta_min, mpc.theta_max, (40, 2))
    found = law._answers(points)[3]
    assert found is not None and np.all(found.status == SOLVED)
    for theta in points[~law.in_domain(points)]:
        d = dual.d0 + theta @ dual.D
        size = 1 + np.abs(d).max()
        sense = np.zeros(len(d), dtype=np.intc)
        _, _, status, info = daqp.solve(eye, 0 * d, rows, d / size, bounds, sense, primal_tol=1e-11)
        assert status == 1
        u = dual.k0 + dual.K @ theta - dual.E.T @ (np.asarray(info["lam"]) * size)
        np.testing.assert_allclose(law(theta), np.clip(u, -1, 1), atol=1e-6)


@pytest.mark.parametrize("unit", [1e2, 1e6])
def test_steep_penalties_of_states_in_small_units_are_solved(unit: float) -> None:
    mpc = cart(unit)
    law = mpc.online()
    explicit = mpc.explicit()
    points = unit * np.random.default_rng(0).uniform(-1.4, 1.4, (100, 2)) * [1, 0.5]
    assert explicit.in_domain(points).all() and law.in_domain(points).all()
    expected, found = online_answers(mpc, points)
    assert found.sum() > 40 and np.abs(law(points)[found] - expected).max() < 1e-9
    np.testing.assert_allclose(explicit(points), law(points), rtol=0, atol=1e-8)
    step = np.array([2e-3 * unit, 0.0])
    slope = (law(points + step) - law(points - step)) / (2 * step[0])
    gains = law.gain(points)[:, 0, 0] * (np.abs(law(points)[:, 0]) < 1)
    assert np.mean(np.abs(slope[:, 0] - gains) < 1e-6 / unit) > 0.95  # all but at a facet


@pytest.mark.parametrize("unit", [1e8, 1e15])
def test_a_penalty_beyond_all_digits_of_float64_gives_the_law_of_one_that_is_within(unit) -> None:
    points = np.random.default_rng(0).uniform(-1.4, 1.4, (200, 2)) * [1, 0.5]
    expected = cart(1e6).explicit()(1e6 * points)
    for solve in (LinearMPC.online, LinearMPC.explicit):
        np.testing.assert_allclose(solve(cart(unit))(unit * points), expected, rtol=0, atol=1e-8)


def test_steep_bounds_that_cannot_all_hold_give_way_by_their_sizes() -> None:
    mpc = LinearMPC(
        LinearModel(0.9 * np.eye(2), [[1], [-1]], dt=1), Q=np.eye(2), R=[[0.1]], horizon=1,
        u_min=-5, u_max=5, x_min=-9, x_max=[1, 9], outputs=OutputBounds([[0, 1]], [-9], [1]),
        soft=SoftBounds(x=[0.5, 0], y=[1], penalty=1e9),
    )  # fmt: skip
    for law in (mpc.online(), mpc.explicit()):  # least s + s^2 of s = 2 (1.7 + u) and 1.7 - u
        assert law([3, 3]) == pytest.approx(-1.12, abs=1e-6)


def test_where_constraints_give_way_rounding_enters_no_active_set(tmp_path) -> None:
    model = LinearModel([[0.8, 0.3], [-0.2, 0.9]], [[1.0, 0.2], [0.1, 0.7]], 1.0)
    limits = {"u_min": -1, "u_max": 1, "theta_min": -5, "theta_max": 5}
    soft = {"outputs": OutputBounds([0], -2, 2), "soft": SoftBounds(y=1.0)}
    more = {"rate": RateLimits(-0.2, 0.2), "parametric_bounds": ["u_min"], **soft, **limits}
    mpc = LinearMPC(model, Q=np.eye(2), R=0.1 * np.eye(2), horizon=4, **more)
    mpc.law("online")
    export(mpc, tmp_path / "law.npz")
    law = mpc.online()
    rng = np.random.default_rng(0)
    theta = rng.uniform(mpc.theta_min, mpc.theta_max, (300, mpc.n_theta))
    outside = theta[~law.in_domain(theta)]
    assert len(outside) > 50
    found = Controller.load(tmp_path / "law.npz").evaluate(outside)
    np.testing.assert_allclose(law.plant_input(outside), found, atol=1e-6)


def test_a_given_penalty_that_a_wide_box_lessens_is_named() -> None:
    outputs = {"outputs": OutputBounds([[-0.762]], -1, 186), "soft": SoftBounds(y=1.0, penalty=125)}
    for box in (1e3, 1e6):
        limits = {"u_min": -4, "u_max": 4, "theta_min": -box, "theta_max": box, **outputs}
        model = LinearModel([[0.5677]], [[-0.5161, 0.0532]], 1.0)
        mpc = LinearMPC(model, Q=[[1]], R=0.8 * np.eye(2), horizon=2, **limits)
        if box == 1e3:
            np.testing.assert_allclose(mpc.online()([8.0]), [4, -4], atol=1e-6)
        else:
            with pytest.warns(UserWarning, match="the penalty asks for"):
                mpc.online()


def test_soft_bounds_that_cost_more_than_digits_hold_are_named() -> None:
    model = LinearModel([[0.9, 0.3], [-0.2, 0.8]], [[0.1, 0.5], [0.6, 0.2]], 1.0)
    box = {"u_min": -10, "u_max": 10, "theta_min": -100, "theta_max": 100, "horizon": 2}
    bounds = {"x_min": [-np.inf, -30], "x_max": [np.inf, 30], "outputs": OutputBounds([0], -30, 20)}
    soft = SoftBounds(y=0.013, x=0.5, penalty=1e5)
    law = LinearMPC(model, Q=np.eye(2), R=0.1 * np.eye(2), **box, **bounds, soft=soft).online()
    with pytest.warns(UserWarning, match="All bounds but the inputs' are soft"):
        law([-83.2, 66.5])
