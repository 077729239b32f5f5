"""What an export puts out lies in the action space of the env, whatever the bounds are."""

from collections.abc import Callable

import numpy as np
import pytest
from gymnasium import spaces

import general_problems
from deployed import COMPILERS, Compiled, box, disturbed, needs_compiler
from policy_samples import make_policy
from sb3_yann import Controller, LinearModel, LinearMPC, YannPolicy, export
from sb3_yann.control.mpc.bound_excess import Bounds
from structured_text import FunctionBlock

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
    low = space.low.astype(np.float64)
    high = space.high.astype(np.float64)
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
    require_inside(Compiled(policy, tmp_path, precision).at(observations())[0], policy.action_space)


def test_a_law_stays_within_the_bounds_of_its_problem(tmp_path) -> None:
    model = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1, x_ss=[0, 0], u_ss=[0.1])
    design = {"Q": np.eye(2), "R": [[0.1]], "horizon": 3, "x_min": -5, "x_max": 5}
    mpc = LinearMPC(model, **design, u_min=0, u_max=0.1 + 1 / 3)
    export(mpc, tmp_path / "law.npz")
    actions = Controller.load(tmp_path / "law.npz").evaluate(observations())
    assert np.all((mpc.u_min <= actions) & (actions <= mpc.u_max))


def largest_excess(mpc, act: Callable[[np.ndarray], np.ndarray], steps: int = 50) -> float:
    """Return the largest excess, in half-widths, of plants that are the model."""
    rng = np.random.default_rng(0)
    kept = mpc.kept_set
    bounds = Bounds.of(mpc)
    A, B = mpc.prediction
    theta = rng.uniform(mpc.theta_min, mpc.theta_max, (400, mpc.n_theta))
    theta = theta[(theta @ kept.F.T <= kept.g).all(axis=1)][:8]
    found = 0.0
    for _ in range(steps):
        theta = theta @ A.T + np.array([act(each) for each in theta]) @ B.T
        found = max(found, float(np.abs(bounds.beyond(theta)).max()))
    return found


@needs_compiler
@pytest.mark.parametrize("name", ["servo with a disturbance", "two tanks, all parts"])
def test_numpy_c_and_structured_text_keep_them_with_any_weights(name, tmp_path):
    mpc = general_problems.solved(name)
    policy = disturbed(mpc, size=5.0, networks="shared", pin_equilibrium=False)
    code = Compiled(policy, tmp_path, compiler=COMPILERS[0])
    export(policy, tmp_path / "plant.st")
    block = FunctionBlock((tmp_path / "plant.st").read_text())
    assert largest_excess(mpc, code.controller.evaluate) < 2e-6  # 1e-6 of the range
    assert largest_excess(mpc, lambda obs: code.at(obs[None])[0][0]) < 2e-6
    assert largest_excess(mpc, lambda obs: np.array(block.step(obs=list(obs), request=0)[0])) < 2e-6
    without = {**code.controller.data, "kept": code.controller.data["kept"][:0]}
    assert largest_excess(mpc, Controller(without).evaluate) > 0.01
