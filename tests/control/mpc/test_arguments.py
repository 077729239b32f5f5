"""What the arguments of a problem mean together, and where the warnings about them begin."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from general_problems import servo
from sb3_yann import LinearModel, LinearMPC, OutputBounds, RateLimits, SoftBounds

WEIGHTS: dict[str, Any] = {"Q": np.eye(2), "R": [[1]], "horizon": 1, "u_min": -1, "u_max": 1}
PLANT = LinearModel([[0.9, 0.1], [0.0, 0.8]], [[0], [1]], 1)


def said(**given: Any) -> list[str]:
    """Return the warnings about a problem."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        LinearMPC(
            given.pop("model", PLANT), **(WEIGHTS | {"theta_min": -5, "theta_max": 5} | given)
        )
    return [str(each.message) for each in caught]


def test_a_soft_bound_reaches_half_its_width_beyond_and_a_hard_one_nowhere() -> None:
    mpc = LinearMPC(
        PLANT, **WEIGHTS, x_min=[-1, -4], x_max=[3, 4], soft=SoftBounds([1, 0], penalty=10)
    )
    assert mpc.theta_min.tolist() == [-3, -4] and mpc.theta_max.tolist() == [5, 4]
    one_sided = {"x_min": [-1, -4], "x_max": [np.inf, 4], "theta_max": [9, 4]}
    (note,) = said(**one_sided, theta_min=None, soft=SoftBounds([1, 0], penalty=10))
    assert "theta_min = -1 and theta_max = 9 do not exceed them" in note


def test_softness_of_a_single_number_is_for_all_that_have_a_bound() -> None:
    mpc = LinearMPC(
        PLANT, **WEIGHTS, x_min=[-1, -np.inf], theta_min=-5, theta_max=5,
        outputs=OutputBounds([[1, 0], [0, 1]], y_max=[np.inf, 2]), soft=SoftBounds(2, 3, 10),
    )  # fmt: skip
    assert mpc.soft.x.tolist() == [2, 0] and mpc.soft.y.tolist() == [0, 3]
    for soft, message in (
        (SoftBounds([1, 1], penalty=10), r"softens entry 1, which has no bound: make it 0"),
        (SoftBounds(y=1, penalty=10), "but there is no bound to soften: pass y_min or y_max"),
    ):
        with pytest.raises(ValueError, match=message):
            LinearMPC(PLANT, **WEIGHTS, x_min=[-1, -np.inf], theta_min=-5, theta_max=5, soft=soft)
    with pytest.raises(ValueError, match=r"nothing is soft"):
        LinearMPC(PLANT, **WEIGHTS, x_min=-1, theta_min=-5, theta_max=5, soft=SoftBounds(0, 0, 5))
    assert SoftBounds(1).penalty is None  # the problem chooses it
    with pytest.raises(ValueError, match="no entry may be negative"):
        SoftBounds([0, -1e-9], penalty=1)
    assert SoftBounds().penalty == 0.0


def test_a_soft_bound_that_the_box_does_not_exceed_is_reported() -> None:
    bounds = {"x_min": [-1, -2], "x_max": [1, 2], "soft": SoftBounds([1, 0], penalty=10)}
    (note,) = said(**bounds, theta_min=[-1, -2], theta_max=[1, 2])
    assert "softens the bounds -1 to 1 of x[0], but theta_min = -1 and theta_max = 1" in note
    for box in ({"theta_min": [-1.1, -2], "theta_max": [1, 2]},
                {"theta_min": [-1, -2], "theta_max": [1.1, 2]}):  # fmt: skip
        assert said(**bounds, **box) == []


@pytest.mark.parametrize("side", ["theta_min", "theta_max"])
def test_a_box_of_all_of_theta_must_agree_with_the_bounds_of_its_parts(side: str) -> None:
    plain = servo(rate=RateLimits(-0.5, 0.5))
    given = {name: [*getattr(plain, name)] for name in ("theta_min", "theta_max")}
    same = servo(rate=RateLimits(-0.5, 0.5), **given)
    np.testing.assert_array_equal(same.theta_min, plain.theta_min)
    given[side][0] *= 0.5  # of a state
    assert getattr(servo(rate=RateLimits(-0.5, 0.5), **given), side)[0] == given[side][0]
    given[side][3] *= 0.5
    part = rf"{side} has .* for u_prev\[0\], but u_{side[-3:]} is"
    with pytest.raises(ValueError, match=part + r".* of the 2 states only"):
        servo(rate=RateLimits(-0.5, 0.5), **given)


def test_a_rate_must_let_the_input_rest() -> None:
    assert RateLimits(0, 1).bounded and not RateLimits().bounded and RateLimits(du_max=1).bounded
    for low, high in ((0.1, 1), (-1, -0.1)):
        with pytest.raises(ValueError, match=r"make u\[0\] change in every sample"):
            RateLimits(low, high)
