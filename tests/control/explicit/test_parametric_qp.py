"""The program that an MPC is: in other units, at one theta, and what its active sets say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sb3_yann.control.explicit.parametric_qp import (
    MILD,
    ParametricQP,
    SteepQP,
    as_bits,
    optimality,
    slack_costs,
    solvable,
)


def program(seed: int = 0, rows: int = 7, **changes: Any) -> ParametricQP:
    """Return a random program of four variables and two parameters in the unit box."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, 4))
    given: dict[str, Any] = {
        "H": root @ root.T + np.eye(4), "F": rng.normal(size=(4, 2)), "c": rng.normal(size=4),
        "G": rng.normal(size=(rows, 4)), "w": rng.uniform(0.2, 1, rows),
        "S": 0.1 * rng.normal(size=(rows, 2)), "theta_min": -np.ones(2), "theta_max": np.ones(2),
    }  # fmt: skip
    return ParametricQP(**(given | changes))


def test_a_solution_and_its_multipliers_meet_the_conditions() -> None:
    given, rng, active = program(), np.random.default_rng(1), 0
    for theta in rng.uniform(-1, 1, (40, 2)):
        U, multipliers = given.solve_with_multipliers(theta)
        assert U is not None
        np.testing.assert_array_equal(given.solve(theta), U)
        slope = given.H @ U + given.F @ theta + given.c + given.G.T @ multipliers
        np.testing.assert_allclose(slope, 0, atol=1e-8)
        slack = given.w + given.S @ theta - given.G @ U
        assert np.all(slack > -1e-9) and np.all(multipliers > -1e-9)
        np.testing.assert_allclose(slack * multipliers, 0, atol=1e-8)
        active += np.count_nonzero(multipliers > 1e-9)
    assert active > 20


def test_a_program_in_other_units_has_the_same_solution() -> None:
    given = program(theta_min=np.array([1.0, -6.0]), theta_max=np.array([3.0, 2.0]))
    center, half = np.array([2.0, -2.0]), np.array([1.0, 4.0])
    reach = np.array([2.0, 0.5, 10.0, 1.0])
    scaled = given.scaled(center, half, reach)
    np.testing.assert_array_equal([scaled.theta_min, scaled.theta_max], [[-1, -1], [1, 1]])
    length = np.linalg.norm(np.hstack([scaled.G, scaled.S]), axis=1)
    np.testing.assert_allclose(length, 1.0)
    assert np.mean(np.diag(scaled.H)) == pytest.approx(1.0)
    for z in np.random.default_rng(0).uniform(-1, 1, (20, 2)):
        U, own = given.solve(center + half * z), scaled.solve(z)
        assert (U is None) == (own is None)
        if U is not None:
            np.testing.assert_allclose(reach * own, U, atol=1e-7)
    nothing = program(G=np.zeros((7, 4)), S=np.zeros((7, 2)))
    np.testing.assert_array_equal(nothing.scaled(center, half, reach).w, nothing.w)


@pytest.mark.parametrize("active", [(), (1, 4)])
def test_the_conditions_of_an_active_set_are_those_of_its_equations(
    active: tuple[int, ...],
) -> None:
    given = program()
    (found,) = optimality(given, [active], everywhere=True)
    size, index = len(active), [*active]
    K = np.zeros((4 + size, 4 + size))
    K[:4, :4], K[4:, :4], K[:4, 4:] = given.H, given.G[index], given.G[index].T
    right = np.zeros((4 + size, 3))
    right[:4] = -np.column_stack([given.F, given.c])
    right[4:] = np.column_stack([given.S, given.w])[index]
    both = np.linalg.solve(K, right)
    np.testing.assert_allclose(found.law, both[:4], atol=1e-9)
    assert found.active == active and found.labels.tolist() == [*range(7)]
    needed = np.column_stack([given.S, given.w]) - given.G @ both[:4]
    needed[index] = both[4:]  # slacks, and multipliers, that must not be negative
    length = np.linalg.norm(needed[:, :2], axis=1, keepdims=True)
    expected = np.column_stack([-needed[:, :2], needed[:, 2]]) / length
    np.testing.assert_allclose(found.rows, expected, atol=1e-8)
    inside = [row for row in range(7) if expected[row, 2] < np.abs(expected[row, :2]).sum()]
    (some,) = optimality(given, [active])
    assert some.labels.tolist() == inside  # those that hold in all of the box are left out
    np.testing.assert_array_equal(some.rows, found.rows[inside])
    for row in range(7):
        assert found.across(row) == (as_bits(active) ^ (1 << row),)


def test_a_constraint_that_depends_takes_the_place_of_one_that_it_contains() -> None:
    G = program().G.copy()
    G[3] = 2 * G[0] + 0.5 * G[1]
    G[4] = G[0] - G[1]
    G[5] = -G[0] - 3 * G[1]
    (found,) = optimality(program(G=G), [(0, 1)], everywhere=True)
    assert found.depends.tolist() == [False, False, False, True, True, True, False]
    unit = G / np.linalg.norm(G, axis=1, keepdims=True)
    for row in (3, 4, 5):
        np.testing.assert_allclose(found.factors[row] @ unit[:2], unit[row], atol=1e-12)
    one_and_two = as_bits([0, 1])
    assert found.across(3) == (one_and_two ^ 1 ^ 8, one_and_two ^ 2 ^ 8)
    assert found.across(4) == (one_and_two ^ 1 ^ 16,)
    assert found.across(5) == ()  # nothing feasible lies beyond
    assert found.across(2) == (one_and_two ^ 4,)


def steep(cost: float) -> ParametricQP:
    """Return a program of one input and one slack that softens its bound of theta."""
    return ParametricQP(
        H=np.diag([2.0, 2 * cost]), F=np.array([[1.0], [0.0]]), c=np.array([0.0, cost]),
        G=np.array([[1.0, -0.5], [-1.0, 0.0], [0.0, -1.0]]), w=np.array([0.1, 1.0, 0.0]),
        S=np.array([[1.0], [0.0], [0.0]]), theta_min=-np.ones(1), theta_max=np.ones(1), n_slacks=1,
    )  # fmt: skip


def test_a_slack_costs_at_most_what_its_largest_violation_does() -> None:
    ratio, largest = slack_costs(steep(3.0))
    assert largest.tolist() == [4.0]  # both theta and the input move the bound by one, in halves
    assert ratio.tolist() == [6.0 * 16 / 2]
    edge = MILD * 2 / (2 * 16)
    assert not isinstance(solvable(steep(0.99 * edge)), SteepQP)
    assert isinstance(solvable(steep(1.01 * edge)), SteepQP)
    none = program()
    assert solvable(none) is none and len(slack_costs(none)[0]) == 0
