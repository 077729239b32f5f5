"""What ppopt gets in place of the solver that it ships."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

from sample_problems import small_mpc
from sb3_yann.control.explicit.solve import _solve_lp

BOX = np.vstack([np.eye(2), -np.eye(2)])


@pytest.mark.parametrize("seed", range(3))
def test_linear_programs_have_the_value_of_another_solver(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = np.vstack([rng.normal(size=(6, 3)), np.eye(3), -np.eye(3)])
    b, c = np.append(rng.uniform(0.2, 1, 6), np.full(6, 2.0)), rng.normal(size=3)
    best = optimize.linprog(c, A_ub=A, b_ub=b, bounds=(None, None))
    found = _solve_lp(c[:, None], A, b[:, None], None)
    np.testing.assert_allclose(found.sol, best.x, atol=1e-6)
    assert found.obj == pytest.approx(best.fun, abs=1e-6)
    tied = optimize.linprog(c, A_ub=A, b_ub=b, A_eq=A[[1]], b_eq=b[[1]], bounds=(None, None))
    found = _solve_lp(c, A, b, [1])
    if tied.status != 0:  # a row that does not touch the rest
        assert found is None
        return
    np.testing.assert_allclose(found.sol, tied.x, atol=1e-6)
    assert A[1] @ found.sol == pytest.approx(b[1], abs=1e-7)


@pytest.mark.parametrize("cost", [None, np.zeros(2)])
def test_without_a_cost_the_shortest_point_is_found(cost: np.ndarray | None) -> None:
    found = _solve_lp(cost, BOX, np.array([3.0, 3.0, -1.0, 1.0]), None)
    np.testing.assert_allclose(found.sol, [1.0, 0.0], atol=1e-8)
    found = _solve_lp(cost, BOX, np.array([3.0, 3.0, 1.0, 1.0]), [0, 3])
    np.testing.assert_allclose(found.sol, [3.0, -1.0], atol=1e-8)


@pytest.mark.parametrize("cost", [None, np.array([1.0, 0.0])])
def test_where_nothing_is_feasible_there_is_no_answer(cost: np.ndarray | None) -> None:
    assert _solve_lp(cost, BOX, np.array([1.0, 1.0, -1.1, 1.0]), None) is None
    assert _solve_lp(cost, BOX, np.array([1.0, 1.0, -0.9, 1.0]), None) is not None


def test_without_a_constraint_the_law_is_the_minimum_in_all_of_the_box() -> None:
    mpc = small_mpc(u_min=None, u_max=None, x_min=None, x_max=None, theta_min=-1, theta_max=1)
    law, theta = mpc.explicit("ppopt"), np.array([0.3, -0.7])
    assert law.n_regions == 1 and law.in_domain([[1.0, -1.0], [1.1, 0.0]]).tolist() == [True, False]
    np.testing.assert_allclose(law(theta), mpc.explicit()(theta), atol=1e-12)
