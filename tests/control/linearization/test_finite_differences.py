"""Differences: what they give exactly, what they leave out, and where a function is not smooth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sb3_yann.control.linearization.differences import (
    Jacobian,
    NotSmoothError,
    curvature,
    jacobian,
)

EPS = np.finfo(float).eps
ONE = np.ones(1)


def of(f: Any, at: float = 0.0, longest: float = 0.1, noise: float = EPS) -> Jacobian:
    """Return the derivative of a function of one number."""
    return jacobian(lambda z: np.atleast_1d(f(z[0])), at * ONE, longest * ONE, noise * ONE)


@pytest.mark.parametrize(("k", "smooth"), [(0.0049, True), (0.0052, False), (-0.0052, False)])
def test_slopes_that_differ_by_a_hundredth_of_the_steepest_are_a_kink(k, smooth) -> None:
    """Of z + k |z|: they differ by 2 k, and the steepest is 1 + k."""
    if smooth:
        of(lambda z: z + k * abs(z))
    else:
        with pytest.raises(NotSmoothError, match="slopes to the two sides differ") as caught:
            of(lambda z: z + k * abs(z))
        assert caught.value.column == 0 and not caught.value.no_value


def test_a_jump_has_no_slope() -> None:
    with pytest.raises(NotSmoothError, match="no limit for short steps"):
        of(lambda z: z + 0.01 * np.sin(1e5 * z), at=0.3)
    with pytest.raises(NotSmoothError, match=r"differ|no limit"):
        of(lambda z: z + (z > 0))


def test_a_point_in_float32_is_differenced_between_what_is_evaluated() -> None:
    def single(z: np.ndarray) -> np.ndarray:
        return z.astype(np.float32).astype(np.float64)

    found = jacobian(lambda z: z**2, 1.1 * ONE, 1e-2 * ONE, EPS * ONE, single)
    assert found.value[0, 0] == pytest.approx(2 * float(np.float32(1.1)), rel=1e-6)
    with pytest.raises(NotSmoothError, match="no finite value"):  # steps that rounding swallows
        jacobian(lambda z: z**2, 1.1 * ONE, 1e-8 * ONE, EPS * ONE, single)


def test_the_notes_tell_what_is_dropped_what_bends_and_what_has_no_effect() -> None:
    def told(change: list[float], value: Any, dropped: float = 0.0) -> list[str]:
        steps = np.array([0.5, 0.25])
        return curvature(Jacobian(np.array(value), dropped, steps, np.array(change), 0.0), LABELS)

    LABELS, plain = ["x[0]", "u[0]"], [[1.0, 1.0]]
    assert told([0.1, 0.0], plain) == []
    (note,) = told([0.0, 0.101], plain)
    assert note == (
        "The plant is not smooth within 0.25 of the operating point along u[0]: slopes differ by "
        "10%."
    )
    assert (
        "within 0.5 of the operating point along x[0]: it has no value"
        in told([np.nan, 0.0], plain)[0]
    )
    assert told([0.0, 0.0], [[0.0, 0.0]]) == ["x[0] has no effect on the next state."]
    assert "(at most 1.5e-09) were set to zero" in told([0.0, 0.0], plain, 1.5e-9)[0]
