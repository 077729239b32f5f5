"""What an online law makes of numbers that float64 cannot hold or tell apart."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann.control import LinearModel, LinearMPC, SoftBounds


def cart(unit: float = 1.0, infeasible: str = "nearest_region") -> LinearMPC:
    """Return a cart with soft bounds, its states in a unit so many times smaller."""
    bound = unit * np.array([1.0, 0.5])
    return LinearMPC(
        LinearModel([[1, 0.1], [0, 1]], unit * np.array([[0.005], [0.1]]), dt=0.1),
        Q=np.eye(2) / unit**2, R=[[0.1]], horizon=4, u_min=-1, u_max=1, infeasible=infeasible,
        x_min=-bound, x_max=bound, soft=SoftBounds(x=True, penalty=1e3),
    )  # fmt: skip


@pytest.mark.parametrize("infeasible", ["nearest_region", "zero_input"])
def test_numbers_that_overflow_give_an_input_within_its_bounds(infeasible: str) -> None:
    law = cart(infeasible=infeasible).online()
    for theta in ([1e308, -1e308], [1.7e308, 1.7e308]):
        u = law(theta)
        assert np.all(np.isfinite(u)) and np.all(np.abs(u) <= 1)


def test_a_penalty_too_steep_for_float64_is_refused_and_a_larger_unit_helps() -> None:
    with pytest.raises(ValueError, match=r"penalty of soft bounds is too steep.* larger units"):
        cart(unit=1e5).online()
    reference, points = cart().online(), np.random.default_rng(0).uniform(-1.5, 1.5, (200, 2))
    units = SoftBounds(x=1e5, penalty=1e3)
    rough = cart(unit=1e5)
    helped = LinearMPC(
        rough.model, Q=rough.Q, R=rough.R, horizon=4, u_min=-1, u_max=1,
        x_min=rough.x_min, x_max=rough.x_max, soft=units,
    ).online()  # fmt: skip
    np.testing.assert_allclose(helped(1e5 * points), reference(points), atol=1e-9)
