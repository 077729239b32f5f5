"""By how much episodes exceed the bounds of their problem, and what its soft bounds cost."""

from typing import Any

import numpy as np
import pytest

from sb3_yann import LinearModel, LinearMPC, OutputBounds, RateLimits, SoftBounds
from sb3_yann.control.mpc.bound_excess import BoundNames, bound_excess, excess_of_episodes

TANK = LinearModel(np.diag([0.9, 0.8]), np.eye(2), dt=1.0)
BOX: Any = {"theta_min": [-4, -50], "theta_max": [4, 50]}


def tank(**more: Any) -> LinearMPC:
    given: Any = {"Q": np.eye(2), "R": np.eye(2), "horizon": 2, "u_min": -2, "u_max": 2}
    return LinearMPC(TANK, **{**given, **BOX, **more})


def episode(states: Any) -> tuple[Any, Any]:
    return np.array(states, float), np.zeros((len(states) - 1, 2))


def test_an_excess_is_counted_from_the_first_step_on_in_half_widths_of_theta_s_box() -> None:
    mpc = tank(x_min=[-2, -10], x_max=[2, 10])
    found = excess_of_episodes(mpc, [episode([[9, 0], [3, 0], [2.5, -12]]), episode([[0, 0]] * 2)])
    np.testing.assert_allclose(found.largest, [1 / 4, 0], atol=1e-5)
    np.testing.assert_allclose(found.summed, [1 / 4 + 0.5 / 4 + 2 / 50, 0], atol=1e-5)
    assert not found.penalty.any()


def test_an_output_s_excess_is_that_of_its_combination_of_states() -> None:
    mpc = tank(outputs=OutputBounds([[1, 0.1]], y_min=-3, y_max=3))
    found = excess_of_episodes(mpc, [episode([[0, 0], [2, 40]])])
    np.testing.assert_allclose(found.largest, [3 / (4 + 5)], atol=1e-5)


def test_inputs_and_rates_count_from_the_previous_input_in_theta_on() -> None:
    mpc = tank(rate=RateLimits(-0.5, 0.5))
    thetas = np.array([[0, 0, 1, 0], [0, 0, 2, 0], [0, 0, 2.2, 0]], float)
    found = bound_excess(mpc, thetas, np.array([[2, 0], [2.2, 0]]))
    np.testing.assert_allclose(found.largest, 0.5 / 2, atol=1e-5)  # 1 - .5, of half the range
    np.testing.assert_allclose(found.summed, 0.5 / 2 + 0.2 / 2, atol=1e-5)


def test_a_soft_bound_is_no_hard_excess_and_costs_its_penalty_in_each_step() -> None:
    soft = SoftBounds(x=[0.5, 4], y=2, penalty=10)
    mpc = tank(x_min=[-2, -10], x_max=[2, 10], outputs=OutputBounds([[1, 1]], y_max=4), soft=soft)
    found = excess_of_episodes(mpc, [episode([[0, 0], [3, -14], [0, 5]])])
    # Of the states (3 - 2) / 0.5 counts, not (14 - 10) / 4; then the output, (5 - 4) / 2.
    np.testing.assert_allclose(found.penalty, [10 * (2 + 4) + 10 * (0.5 + 0.25)], rtol=1e-4)
    assert not found.largest.any() and found.any_bound[0] > 0


def test_the_penalty_of_a_step_is_the_mpc_s_own_for_a_horizon_of_one_step() -> None:
    model = LinearModel([[1.2]], [[1.0]], dt=1.0)
    given: Any = {"Q": [[1.0]], "R": [[1.0]], "horizon": 1, "u_min": -1, "u_max": 1}
    mpc = LinearMPC(model, **given, x_min=-2, x_max=2, soft=SoftBounds(x=0.3, penalty=50),
                    theta_min=-6, theta_max=6)  # fmt: skip
    theta = np.array([4.0])
    u = mpc.explicit()(theta)
    found = bound_excess(mpc, np.array([theta, mpc.predict(theta, u)]), u[None])
    s = (1.2 * 4 - 1 - 2) / 0.3
    np.testing.assert_allclose(found.penalty, 50 * (s + s**2), rtol=1e-4)


def test_what_is_not_finite_exceeds_by_inf() -> None:
    found = excess_of_episodes(tank(x_max=[2, 10]), [episode([[0, 0], [np.nan, 0]])])
    assert np.isinf(found.largest[0]) and np.isinf(found.summed[0])


def test_steps_that_are_not_taken_do_not_count_and_batches_are_episode_by_episode() -> None:
    mpc = tank(x_min=[-2, -10], x_max=[2, 10])
    rng = np.random.default_rng(0)
    thetas, inputs = 4 * rng.normal(size=(6, 3, 2)), rng.normal(size=(5, 3, 2))
    taken = np.arange(5)[:, None] < np.array([5, 2, 4])
    batch = bound_excess(mpc, thetas, inputs, taken)
    for i, length in enumerate((5, 2, 4)):
        one = bound_excess(mpc, thetas[: length + 1, i], inputs[:length, i])
        np.testing.assert_allclose([each[i] for each in batch], [*one])


@pytest.mark.parametrize("scale", [1.0, 1e5])
def test_a_bound_with_an_open_side_has_no_hidden_unit(scale: float) -> None:
    model = LinearModel([[0.9]], [[1.0]], dt=1.0)
    mpc = LinearMPC(model, Q=[[1]], R=[[1]], horizon=2, u_max=1, x_max=2 * scale)
    found = bound_excess(mpc, np.array([[0.0], [3 * scale]]), np.zeros((1, 1)))
    np.testing.assert_allclose(found.largest, 0.5, atol=1e-5)


def test_a_hard_bound_is_named_before_a_soft_one_that_is_exceeded_by_more() -> None:
    soft = SoftBounds(x=[1, 0], penalty=1)
    mpc = tank(x_min=[-2, -10], x_max=[2, 10], soft=soft)
    names = BoundNames.of(mpc)
    for states, words in (
        ([0, 15], "x[1] exceeds its bound by 5"),
        ([4, 15], "x[1] exceeds its bound by 5"),
        ([-4, 0], "x[0] exceeds its soft bound by 2"),
        ([0, 0], ""),
    ):
        found = excess_of_episodes(mpc, [episode([[0, 0], states])])
        size = found.largest[0] or found.any_bound[0]
        assert names.in_words(np.asarray(found.worst)[0], size) == words
