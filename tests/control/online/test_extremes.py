"""What an online law makes of numbers that float64 cannot hold or tell apart."""

from __future__ import annotations

from fractions import Fraction
from operator import mul

import daqp
import numpy as np
import pytest

from sb3_yann.control import LinearModel, LinearMPC, SoftBounds
from sb3_yann.control._kernels.online import SOLVED

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
    model = LinearModel([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], 0.1)
    mpc = LinearMPC(
        model, Q=np.eye(2), R=[[0.03]], horizon=12, u_min=-1, u_max=1, x_min=[-5, -2], x_max=[5, 2]
    )
    law, rng = mpc.online(), np.random.default_rng(0)
    dual = law.dual
    eye, bounds = np.eye(len(dual.d0)), np.full(len(dual.d0), -1e30)
    values, vectors = np.linalg.eigh(dual.gram + np.diag(dual.softness))
    rows = np.ascontiguousarray(-vectors * np.sqrt(np.maximum(values, 0.0)))
    points = 100 * rng.uniform(mpc.theta_min, mpc.theta_max, (40, 2))
    found = law._answers(points)[3]
    assert found is not None and np.all(found.status == SOLVED)
    for theta in points[~law.in_domain(points)]:
        d = dual.d0 + theta @ dual.D
        size, sense = 1 + np.abs(d).max(), np.zeros(len(d), dtype=np.intc)
        _, _, status, info = daqp.solve(eye, 0 * d, rows, d / size, bounds, sense, primal_tol=1e-11)
        assert status == 1
        u = dual.k0 + dual.K @ theta - dual.E.T @ (np.asarray(info["lam"]) * size)
        np.testing.assert_allclose(law(theta), np.clip(u, -1, 1), atol=1e-6)


@pytest.mark.parametrize("unit", [1e2, 1e6])
def test_steep_penalties_of_states_in_small_units_are_solved(unit: float) -> None:
    mpc = cart(unit)
    law, explicit = mpc.online(), mpc.explicit()
    points = unit * np.random.default_rng(0).uniform(-1.4, 1.4, (100, 2)) * [1, 0.5]
    assert explicit.in_domain(points).all() and law.in_domain(points).all()
    solved, reach = law.scaled
    given = law.program.scaled(np.zeros(2), law.half, reach)  # at the whole penalty
    for theta, u in zip(points, law(points), strict=True):
        _, multipliers = solved.solve_with_multipliers(theta / law.half)
        exact = solved_in_fractions(given, theta / law.half, np.flatnonzero(multipliers > 0))
        assert abs(u[0] - reach[0] * exact[0]) < 1e-9
    np.testing.assert_allclose(explicit(points), law(points), rtol=0, atol=1e-9)
    step = np.array([1e-4 * unit, 0.0])
    slope = (law(points + step) - law(points - step)) / (2 * step[0])
    gains = law.gain(points)[:, 0, 0] * (np.abs(law(points)[:, 0]) < 1)
    assert np.mean(np.abs(slope[:, 0] - gains) < 1e-6 / unit) > 0.95  # all but at a facet


@pytest.mark.parametrize("unit", [1e8, 1e15])
def test_a_penalty_beyond_all_digits_of_float64_gives_the_law_of_one_that_is_within(unit) -> None:
    points = np.random.default_rng(0).uniform(-1.4, 1.4, (200, 2)) * [1, 0.5]
    expected = cart(1e6).explicit()(1e6 * points)
    for solve in (LinearMPC.online, LinearMPC.explicit):
        np.testing.assert_allclose(solve(cart(unit))(unit * points), expected, rtol=0, atol=1e-9)


def solved_in_fractions(program, theta: np.ndarray, active: np.ndarray) -> list[float]:
    """Return U of the KKT equations without rounding, once their signs are found right."""
    H, F, G, S = (
        [[Fraction(x) for x in row] for row in getattr(program, name).tolist()] for name in "HFGS"
    )
    c, w = ([Fraction(x) for x in getattr(program, name).tolist()] for name in "cw")
    place, v = [Fraction(x) for x in theta.tolist()], len(c)
    linear = [a + sum(map(mul, row, place)) for a, row in zip(c, F, strict=True)]
    limit = [a + sum(map(mul, row, place)) for a, row in zip(w, S, strict=True)]
    rows = [[*H[i], *(G[k][i] for k in active), -linear[i]] for i in range(v)]
    rows += [[*G[k], *(Fraction(0) for _ in active), limit[k]] for k in active]
    for i in range(len(rows)):  # Gauss and Jordan
        pivot = next(k for k in range(i, len(rows)) if rows[k][i])
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for k in range(len(rows)):
            if k != i and rows[k][i]:
                rows[k] = [x - rows[k][i] * y for x, y in zip(rows[k], rows[i], strict=True)]
    U = [row[-1] for row in rows[:v]]
    assert all(row[-1] >= 0 for row in rows[v:])
    slack = [b - sum(map(mul, row, U)) for b, row in zip(limit, G, strict=True)]
    assert all(float(x) >= 0 for k, x in enumerate(slack) if k not in active)
    return [float(x) for x in U]


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_a_law_is_the_same_whatever_the_unit_of_the_states(unit: float) -> None:
    points = np.random.default_rng(0).uniform(-1.4, 1.4, (200, 2)) * [1, 0.5]
    one, other = cart(), cart(unit, soft=SoftBounds(x=unit, penalty=1e3))
    for solve in (LinearMPC.online, LinearMPC.explicit):
        expected = solve(one)(points)
        np.testing.assert_allclose(solve(other)(unit * points), expected, rtol=0, atol=1e-9)
