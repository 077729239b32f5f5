"""Infinity is the word for no bound; a number that only looks like it is named, never used."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann.control import LinearModel, LinearMPC, Terminal

MODEL = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1)


def problem(**changes) -> LinearMPC:
    design = {"Q": np.eye(2), "R": [[0.1]], "horizon": 3, "u_min": -1, "u_max": 1}
    return LinearMPC(MODEL, **{**design, "x_min": -5, "x_max": 5, **changes})


def points(count: int = 200) -> np.ndarray:
    return np.random.default_rng(0).uniform(-5, 5, (count, 2))


@pytest.mark.parametrize("large", [1e3, 1e6, 1e9])
def test_input_bounds_that_are_never_met_are_the_same_law_as_none(large: float) -> None:
    law = problem(u_min=-large, u_max=large).explicit()
    wanted = problem(u_min=-np.inf, u_max=np.inf).explicit()
    np.testing.assert_allclose(law(points()), wanted(points()), atol=1e-10)


@pytest.mark.parametrize("kind", ["explicit", "online"])
@pytest.mark.parametrize("large", [1e11, 1e12, 1e99])
def test_input_bounds_of_absurd_size_are_named_and_not_called_infeasible(
    large: float, kind: str
) -> None:
    # explicit() called this infeasible, and online() was wrong by 62 on states that are not.
    with pytest.raises(ValueError, match=r"u_max\[0\] = 1e\+\d\d.*too large.*or inf for no bound"):
        getattr(problem(u_min=-large, u_max=large), kind)()


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
        getattr(problem(x_min=-box, x_max=box), kind)()


@pytest.mark.parametrize("large", [1e4, 1e6])
def test_a_box_that_is_only_large_has_the_right_law(large: float) -> None:
    mpc = problem(x_min=[-5, -large], x_max=[5, large])
    law, online = mpc.explicit(), mpc.online()
    assert np.array_equal(law.in_domain(points()), online.in_domain(points()))
    inside = points()[online.in_domain(points())]
    np.testing.assert_allclose(law(inside), online(inside), atol=1e-9)


@pytest.mark.parametrize("name", ["x_max", "u_max", "theta_max"])
def test_what_would_overflow_is_named(name: str) -> None:
    with pytest.raises(ValueError, match=rf"{name}\[0\] = 1e\+200 must be .* Use inf"):
        problem(**{name: 1e200})


@pytest.mark.parametrize("kind", ["explicit", "online"])
def test_weights_that_make_the_program_singular_to_rounding_are_named(kind: str) -> None:
    model = LinearModel([[0.5, 0], [0, 0.5]], [[1e3, 1e3], [1e3, 1e3]], 1.0)
    weights = {"Q": np.eye(2), "R": 1e-14 * np.eye(2), "terminal": Terminal(np.eye(2))}
    box = {"u_min": -1, "u_max": 1, "x_min": -5, "x_max": 5}
    mpc = LinearMPC(model, **weights, horizon=1, **box)
    with pytest.raises(ValueError, match=r"no unique solution to rounding.*larger R"):
        getattr(mpc, kind)()


def test_an_infinite_box_has_an_online_law() -> None:
    law = problem(x_min=-np.inf, x_max=np.inf).online()
    np.testing.assert_allclose(law(points()), problem(x_min=-100, x_max=100).online()(points()))
