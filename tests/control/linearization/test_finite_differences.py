"""Differences: what they give exactly, what they leave out, and where a function is not smooth."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_yann import LinearModel
from sb3_yann.control.linearization.differences import (
    Jacobian,
    NotSmoothError,
    curvature,
    differences,
    jacobian,
)
from sb3_yann.control.linearization.simulator import noise_of

EPS = np.finfo(float).eps
ONE = np.ones(1)


def of(f: Any, at: float = 0.0, longest: float = 0.1, noise: float = EPS) -> Jacobian:
    """Return the derivative of a function of one number."""
    return jacobian(lambda z: np.atleast_1d(f(z[0])), at * ONE, longest * ONE, noise * ONE)


def test_derivatives_are_exact_beside_rounding_in_every_coordinate() -> None:
    def f(z: np.ndarray) -> np.ndarray:
        a, b, c = z
        return np.array([np.sin(a) * b, a**3 + np.exp(c), 5 * b * c - 2])

    point = np.array([0.4, -1.5, 0.7])
    found = jacobian(f, point, np.array([0.1, 0.2, 0.3]), np.full(3, EPS))
    a, b, c = point
    expected = [[np.cos(a) * b, np.sin(a), 0], [3 * a**2, 0, np.exp(c)], [0, 5 * c, 5 * b]]
    np.testing.assert_allclose(found.value, expected, atol=1e-11)
    np.testing.assert_array_equal(found.value == 0, np.array(expected) == 0)
    np.testing.assert_array_equal(found.steps, [0.1, 0.2, 0.3])
    assert found.doubt < 1e-10 and found.dropped < 1e-13


def test_the_change_is_what_curvature_adds_over_the_longest_step() -> None:
    """The mean slope of z + c z^3 over a step h is 1 + c h^2."""
    for c, h in ((2.0, 0.1), (-7.0, 0.05)):
        assert of(lambda z, c=c: z + c * z**3, longest=h).change[0] == pytest.approx(abs(c) * h**2)
    assert of(lambda z: 3.0 + 0 * z).change[0] == 0.0


def test_a_slope_below_its_rounding_is_zero_and_told() -> None:
    found = of(lambda z: 1.0 + 1e-12 * z, noise=1e-10)
    assert found.value[0, 0] == 0.0 and found.dropped == pytest.approx(1e-12, rel=0.01)
    kept = of(lambda z: 1e-12 * z, noise=1e-30)
    assert kept.value[0, 0] == pytest.approx(1e-12) and kept.dropped == 0.0


def test_the_doubt_is_the_error_of_the_worst_column_relative_to_it() -> None:
    """A linear function leaves twice the rounding of the second step's difference."""
    noise = 1e-9
    found = jacobian(
        lambda z: np.array([4.0 * z[0] + 2.0 * z[1]]), np.zeros(2), np.full(2, 0.1), noise * ONE
    )
    step = 2 * (0.1 / 4)
    assert found.doubt == pytest.approx(2 * (2 * noise / step) / 2.0, rel=1e-3)


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


def test_three_steps_with_a_value_on_both_sides_are_enough_and_two_are_not() -> None:
    """The steps are 0.1, and each a quarter of the one before."""
    for edge, steps in ((0.2, 6), (0.09, 5), (0.005, 3)):
        found = of(lambda z, edge=edge: z if z < edge else np.nan)
        assert found.value[0, 0] == pytest.approx(1.0, abs=1e-11)
        assert np.isnan(found.change[0]) == (steps < 6)
    with pytest.raises(NotSmoothError, match="no finite value on one of its sides") as caught:
        of(lambda z: z if z < 0.0015 else np.nan)
    assert caught.value.no_value


def test_steps_shrink_by_sixty_four_where_there_is_no_value_and_twice_at_most() -> None:
    def bounded(edge: float) -> Jacobian:
        return differences(
            lambda z: z if z[0] < edge else np.full(1, np.nan),
            0 * ONE,
            0.1 * ONE,
            EPS * ONE,
            ["x[0]"],
        )

    assert bounded(0.2).steps[0] == 0.1
    assert bounded(1e-3).steps[0] == pytest.approx(0.1 / 64)
    assert bounded(2e-5).steps[0] == pytest.approx(0.1 / 64**2)
    with pytest.raises(ValueError, match=r"along x\[0\], it has no finite value .* up to 2.44e-05"):
        bounded(1e-8)


def test_a_point_in_float32_is_differenced_between_what_is_evaluated() -> None:
    def single(z: np.ndarray) -> np.ndarray:
        return z.astype(np.float32).astype(np.float64)

    found = jacobian(lambda z: z**2, 1.1 * ONE, 1e-2 * ONE, EPS * ONE, single)
    assert found.value[0, 0] == pytest.approx(2 * float(np.float32(1.1)), rel=1e-6)
    with pytest.raises(NotSmoothError, match="no finite value"):  # steps that rounding swallows
        jacobian(lambda z: z**2, 1.1 * ONE, 1e-8 * ONE, EPS * ONE, single)


def test_a_slope_beside_large_noise_is_none_rather_than_a_jump() -> None:
    rng = np.random.default_rng(0)
    noisy = of(lambda z: 1e-9 * rng.standard_normal(), noise=1e-9)
    assert abs(noisy.value[0, 0]) < 1e-6
    with pytest.raises(NotSmoothError, match="no limit"):
        of(lambda z: 1e-5 * rng.standard_normal(), noise=1e-9)


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


def test_the_noise_of_a_function_is_its_standard_deviation() -> None:
    rng = np.random.default_rng(0)
    sizes = np.array([1e-6, 3e-8])
    found = noise_of(
        lambda z: np.array([np.sin(z[0]), z[0] ** 3]) + sizes * rng.standard_normal(2), ONE, ONE
    )
    assert np.all((found > 0.4 * sizes) & (found < 2.5 * sizes))
    smooth = noise_of(lambda z: np.array([np.sin(z[0]), np.nan]), ONE, ONE)
    np.testing.assert_array_equal(smooth, 0)  # where it has no value nothing is known


def test_noise_is_the_root_mean_square_of_sixth_differences() -> None:
    """Of ten points on a line, scaled as those of independent numbers (Hamming)."""
    seen: list[np.ndarray] = []
    values = np.random.default_rng(0).choice([-1.0, 1.0], 30)

    def f(z: np.ndarray) -> np.ndarray:
        seen.append(z.copy())
        return values[len(seen) - 1 : len(seen)]

    found = noise_of(f, np.array([2.0, 5.0]), np.array([1.0, 0.5]))
    tables = [np.diff(values[10 * i : 10 * i + 10], 6) for i in range(3)]
    sizes = [np.sqrt(np.mean(each**2) * 720**2 / 479001600) for each in tables]
    assert found[0] == pytest.approx(max(sizes))
    moves = np.array(seen) - [2.0, 5.0]
    for i, spacing in enumerate((1e-3, 1e-4, 1e-5)):
        steps = np.diff(moves[10 * i : 10 * i + 10], axis=0)
        np.testing.assert_allclose(np.abs(steps), [[spacing, 0.5 * spacing]] * 9, rtol=1e-6)
        np.testing.assert_allclose(moves[10 * i : 10 * i + 10].mean(axis=0), 0, atol=1e-12)


def rate(x: Any, u: Any) -> Any:
    return np.array([x[1], -x[0] + u[0]])


@pytest.mark.parametrize(("moves", "steady"), [(0.9e-3, True), (1.1e-3, False)])
def test_a_state_moves_by_a_thousandth_of_its_scale_in_a_sample_at_most(moves, steady) -> None:
    for scale, point in ((None, [0.0, moves / 0.1]), ([3.0, 2.0], [0.0, 3 * moves / 0.1])):
        given = {} if scale is None else {"scale": scale}
        if steady:
            model = LinearModel.from_dynamics(rate, point, [0.0], 0.1, **given)
            assert model.x_ss.tolist() == point
        else:
            with pytest.raises(ValueError, match=r"is no steady state: in one sample of 0\.1"):
                LinearModel.from_dynamics(rate, point, [0.0], 0.1, **given)


@pytest.mark.parametrize(("share", "warned"), [(0.0099, False), (0.0101, True)])
def test_a_small_state_that_moves_by_a_hundredth_of_itself_is_warned_of(share, warned) -> None:
    moves = 0.5e-3
    x = moves / share

    def f(at: Any, u: Any) -> Any:
        return (at - x) + u + moves / 0.1

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        LinearModel.from_dynamics(f, [x], [0.0], 0.1)
        LinearModel.from_dynamics(f, [x], [0.0], 0.1, scale=[1.0])  # the user knows
    assert len(caught) == warned
    assert all("moves by [0.0005], much beside itself" in str(each.message) for each in caught)


class Steps(gym.Env[Any, Any]):
    """A plant of one state whose motion at its operating point and whose pole are given."""

    def __init__(self, pole: float = 0.5, drift: float = 0.0, wide: float = 1.0) -> None:
        self.observation_space = gym.spaces.Box(-wide, wide, (1,), np.float64)
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float64)
        self.pole, self.drift, self.dt = pole, drift, 0.1

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.x = np.array((options or {}).get("state", [0.0]), float)
        return self.x.copy(), {}

    def step(self, action: Any) -> Any:
        self.x = self.pole * self.x + 0.5 * action + self.drift
        return self.x.copy(), 0.0, False, False, {}


@pytest.mark.parametrize("wide", [1.0, 4.0])
def test_a_simulator_s_steady_state_lies_a_hundredth_of_a_scale_away_at_most(wide) -> None:
    """With inputs that move it as well, the nearest steady state counts."""
    slopes = np.array([[(0.5 - 1), 0.5 / wide]])
    way = np.linalg.lstsq(slopes, -np.ones(1), rcond=None)[0]
    edge = 0.01 / np.abs(way).max() * wide
    for share, accepted in ((0.98, True), (1.02, False)):
        env = Steps(drift=share * edge, wide=wide)
        if accepted:
            model = LinearModel.from_env(env, x_ss=[0.0], u_ss=[0.0])
            np.testing.assert_allclose([model.A, model.B], [[[0.5]], [[0.5]]], atol=1e-9)
        else:
            with pytest.raises(ValueError, match="is no steady state: one step moves it by"):
                LinearModel.from_env(env, x_ss=[0.0], u_ss=[0.0])
