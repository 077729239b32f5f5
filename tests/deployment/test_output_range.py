"""What an export puts out lies in the action space of the env, whatever the bounds are."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium import spaces

from deployed import Compiled, box, needs_compiler
from policy_samples import make_policy
from sb3_yann import Controller, LinearModel, LinearMPC, YannPolicy, export

# Of these 2 * half-width, or the middle, is no number of float64, or of float32.
BOUNDS = [(-1e-7, 1e7 + 0.3), (-0.1, 1 / 3), (-1e-3, 1e4 + 0.7), (-7.7e5, 0.3)]


def policy_within(low: float, high: float) -> YannPolicy:
    """Its law saturates at both ends."""
    reach = (high - low) / 2
    model = LinearModel([[1, 0.1], [0, 1]], [[0.005 / reach], [0.1 / reach]], 0.1)
    design = {"Q": np.eye(2), "R": [[0.1 / reach**2]], "horizon": 3, "x_min": -5, "x_max": 5}
    inputs = spaces.Box(np.float32([low]), np.float32([high]), dtype=np.float32)
    ends = float(inputs.low[0]), float(inputs.high[0])
    mpc = LinearMPC(model, **design, u_min=ends[0], u_max=ends[1])
    return make_policy(box(2, np.float64), inputs, problem=mpc)


def observations() -> np.ndarray:
    return np.random.default_rng(0).uniform(-50, 50, (400, 2))


def require_inside(actions: np.ndarray, space: spaces.Box) -> None:
    wide = np.asarray(actions, np.float64)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    assert np.ptp(wide) > 0.999 * (high - low)[0]
    assert np.all((wide >= low) & (wide <= high))
    assert all(space.contains(each.astype(np.float32)) for each in wide)


@pytest.mark.filterwarnings("ignore:u_m")
@pytest.mark.parametrize("bounds", BOUNDS)
def test_a_controller_stays_in_the_action_space(bounds, tmp_path) -> None:
    policy = policy_within(*bounds)
    export(policy, tmp_path / "plant.npz")
    controller = Controller.load(tmp_path / "plant.npz")
    require_inside(controller.evaluate(observations()), policy.action_space)
    require_inside(np.array([controller(each) for each in observations()]), policy.action_space)


@needs_compiler
@pytest.mark.filterwarnings("ignore:u_m")
@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize("bounds", BOUNDS)
def test_c_code_stays_in_the_action_space(bounds, precision, tmp_path) -> None:
    policy = policy_within(*bounds)
    compiled = Compiled(policy, tmp_path, precision)
    require_inside(compiled.at(observations())[0], policy.action_space)


def test_a_law_stays_within_the_bounds_of_its_problem(tmp_path) -> None:
    model = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1, u_ss=[0.1])
    design = {"Q": np.eye(2), "R": [[0.1]], "horizon": 3, "x_min": -5, "x_max": 5}
    mpc = LinearMPC(model, **design, u_min=0, u_max=0.1 + 1 / 3)
    export(mpc, tmp_path / "law.npz")
    actions = Controller.load(tmp_path / "law.npz").evaluate(observations())
    assert np.all((mpc.u_min <= actions) & (actions <= mpc.u_max))
