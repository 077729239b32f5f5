"""Simulators of strangers: adaptive integrators, MuJoCo's interface, plants that forget."""

import math
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sample_plants import Plant, Settable
from sb3_yann import LinearModel, LinearMPC
from sb3_yann.wrappers import TruncateAtTimeLimit
from sb3_yann_envs import cstr


def adaptive(rtol: float, method: str) -> Plant:
    """The reactor of the package, stepped by an adaptive integrator with tolerances of its own."""

    def step(x: Any, u: Any) -> Any:
        options: Any = {"rtol": rtol, "atol": rtol, "method": method}
        return solve_ivp(lambda t, x: cstr.dynamics(x, u), (0, cstr.DT), x, **options).y[:, -1]

    half = 0.2 * np.abs(cstr.X_SS)
    width = np.maximum(np.abs(cstr.U_SS), 1.0)
    box = cstr.X_SS - half, cstr.X_SS + half
    plant = Settable(step, box, (cstr.U_SS - width, cstr.U_SS + width), cstr.X_SS)
    plant.dt = cstr.DT
    return plant


@pytest.mark.parametrize(("rtol", "method"), [(1e-3, "RK45"), (1e-5, "LSODA")])
def test_an_adaptive_integrator_is_linearized_through_its_noise(rtol: float, method: str) -> None:
    truth = LinearModel.from_dynamics(cstr.dynamics, cstr.X_SS, cstr.U_SS, cstr.DT)
    model = LinearModel.from_env(adaptive(rtol, method), u_ss=cstr.U_SS)
    for found, exact in ((model.A, truth.A), (model.B, truth.B)):
        assert np.abs(found - exact).max() < 0.01 * np.abs(exact).max()


def rough(grid: float) -> Plant:
    """A plant of two states whose result is rounded to a grid, as a loose tolerance does."""

    def step(at: Any, u: Any) -> Any:
        x, v = at
        exact = np.array([x + 0.1 * v, 0.9 * v - 0.05 * np.sin(x) + 0.1 * u[0]])
        phase = np.array([x + 2 * v + 3 * u[0] + 0.1, 5 * x + v + u[0] + 0.2])
        return exact + grid * np.sin(1e9 * phase)

    return Settable(step, ([-1.0, -1.0], [1.0, 1.0]))


@pytest.mark.parametrize("grid", [1e-7, 1e-5, 1e-4])
def test_noise_of_a_simulator_is_measured_and_stepped_over(grid: float) -> None:
    model = LinearModel.from_env(rough(grid), u_ss=[0.0])
    np.testing.assert_allclose(model.A, [[1, 0.1], [-0.05, 0.9]], atol=5 * grid / 0.1 + 1e-6)
    np.testing.assert_allclose(model.B, [[0], [0.1]], atol=5 * grid / 0.1 + 1e-6)
    assert "as adaptive integrators do" in model.report()


class Body(gym.Env):
    """A cart with the interface of Gymnasium's MuJoCo environments; it observes other things."""

    dt = 0.1

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        self.init_qpos = np.zeros(1)
        self.init_qvel = np.zeros(1)
        self.data = SimpleNamespace(qpos=np.zeros(1), qvel=np.zeros(1))

    def set_state(self, qpos: Any, qvel: Any) -> None:
        assert qpos.shape == (1,)
        assert qvel.shape == (1,)
        self.data.qpos[:] = qpos
        self.data.qvel[:] = qvel

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        noise = self.np_random.uniform(-0.01, 0.01, 2)
        self.set_state(self.init_qpos + noise[:1], self.init_qvel + noise[1:])
        return self._observe(), {}

    def step(self, action):
        self.data.qvel += self.dt * (-np.sin(self.data.qpos) + float(np.asarray(action)[0]))
        self.data.qpos += self.dt * self.data.qvel
        return self._observe(), 0.0, False, False, {}

    def _observe(self) -> np.ndarray:
        q = self.data.qpos[0]
        return np.array([np.sin(q), np.cos(q), self.data.qvel[0]])


def test_the_interface_of_mujoco_is_taken() -> None:
    model = LinearModel.from_env(Body())
    np.testing.assert_allclose(model.x_ss, [0, 0], atol=1e-6)
    np.testing.assert_allclose(model.A, [[0.99, 0.1], [-0.1, 1]], atol=1e-8)
    np.testing.assert_allclose(model.B, [[0.01], [0.1]], atol=1e-6)
    assert "set by env.unwrapped.set_state(qpos, qvel)" in model.report()
    assert "The observation is not this state" in model.report()


def forgets(pole: float) -> Plant:
    """A plant whose next state does not depend on this one: it settles within a sample."""
    return Settable(lambda x, u: pole * x + 2 * u)


@pytest.mark.parametrize("pole", [0.0, 1e-9])
def test_a_plant_that_forgets_within_a_sample_has_a_model_and_a_law(pole: float) -> None:
    model = LinearModel.from_env(forgets(pole))
    np.testing.assert_allclose([model.A[0, 0], model.B[0, 0]], [pole, 2], atol=1e-10)
    assert "gone within one sample" in model.report()
    mpc = LinearMPC(model, Q=[[1]], R=[[1]], horizon=2, x_min=-5, x_max=5, u_min=-1, u_max=1)
    assert abs(mpc.explicit()([3.0])[0]) < 1e-6


def test_rounding_is_no_slope_of_a_state_that_is_forgotten() -> None:
    rounds = Settable(lambda x, u: 2 * u + 0.5 + 4e-16 * np.sin(1e6 * x))  # as many operations do
    model = LinearModel.from_env(rounds, [0.5], [0.0])
    np.testing.assert_allclose([model.A[0, 0], model.B[0, 0]], [0, 2], atol=1e-9)


def tank(x: Any, u: Any) -> Any:
    """A tank whose outflow has no value below the outlet."""
    if x[0] < 0.1:
        raise FloatingPointError("below the outlet")
    return x + 0.5 * (1 + u - np.sqrt(x))


def test_a_plant_without_a_value_there_turns_the_search_for_a_steady_state_back() -> None:
    model = LinearModel.from_env(Settable(tank, start=1.0), u_ss=[-0.5])
    np.testing.assert_allclose(model.x_ss, [0.25], atol=1e-6)


class Careless(Settable):
    """Calls its time limit a termination."""

    def __init__(self, limit: int) -> None:
        super().__init__(lambda x, u: 0.5 * x + 2 * u)
        self.limit = limit

    def reset(self, **given: Any) -> Any:
        self.steps = 0
        return super().reset(**given)

    def step(self, action: Any) -> Any:
        self.steps += 1
        return *super().step(action)[:2], self.steps >= self.limit, False, {}


def test_a_time_limit_that_terminates_is_named_and_cured() -> None:
    with pytest.warns(UserWarning, match=r"after 30 steps whatever.*AtTimeLimit\(env, 30\)"):
        LinearModel.from_env(Careless(limit=30))
    LinearModel.from_env(TruncateAtTimeLimit(Careless(limit=30), 30))  # nothing warns

    class Earlier(Careless):
        def step(self, action):
            self.limit = 30 if action[0] < 0.1 else 20
            return super().step(action)

    LinearModel.from_env(Earlier(limit=30))  # nor of an end that inputs bring about


def cone(h: Any, u: Any) -> Any:
    """A conical tank: the higher its level, the slower, so that a search may run away upwards."""
    flow = u - 45 * np.sqrt(h)
    return np.clip(h + 5 * flow / (np.pi * (0.4 * np.maximum(h, 2)) ** 2), 0, 60)


def test_a_plant_that_a_search_runs_away_from_is_left_to_settle() -> None:
    model = LinearModel.from_env(Plant(cone, (0.0, 60.0), (0.0, 400.0), 35.0), dt=5)
    assert model.u_ss == 200
    np.testing.assert_allclose(model.x_ss, (200 / 45) ** 2, rtol=1e-6)


NAN = np.nan
A = np.array([[0.0, 1.0], [-2.0, -0.3]])
B = np.array([[0.0], [1.0]])


def flat(x: Any, u: Any) -> Any:
    return A @ x + B @ u


def ragged(x: Any, u: Any) -> Any:
    return [x[1], -2 * x[0] - 0.3 * x[1] + u]  # a number, and an array with one entry


def stacked(x: Any, u: Any) -> Any:
    return np.vstack([x[1], -2 * x[0] - 0.3 * x[1] + u[0]])  # vectors in, a column out


@pytest.mark.parametrize("f", [ragged, stacked])
def test_lists_and_columns_that_are_returned_are_taken_as_vectors_are(f: Any) -> None:
    model, same = (LinearModel.from_dynamics(each, [0, 0], [0], 0.1) for each in (f, flat))
    np.testing.assert_allclose(model.A, same.A, atol=1e-9)
    np.testing.assert_allclose(model.B, same.B, atol=1e-9)


def test_the_input_that_holds_a_level_is_solved_for() -> None:
    def tanks(x: Any, u: Any) -> Any:
        q = math.sqrt(x[0])  # raises below 0, where numpy's returns NaN
        return [u[0] - q, q - math.sqrt(x[1])]

    model = LinearModel.from_dynamics(tanks, [4, NAN], [NAN], 1.0)
    np.testing.assert_allclose([*model.x_ss, *model.u_ss], [4, 4, 2], atol=1e-6)


def test_several_steady_states_are_reported() -> None:
    model = LinearModel.from_dynamics(lambda x, u: x - x**3 + u, [NAN], [0], 0.1)
    assert "There are others, [1.0, 0.0]; [-1.0, 0.0]" in model.notes[0]


def test_more_unknowns_than_equations_are_reported() -> None:
    with pytest.warns(UserWarning, match=r"one of many\. Give more entries\. It is x_ss"):
        LinearModel.from_dynamics(lambda x, u: u - x, [NAN], [NAN], 0.1)


def test_no_steady_state_is_an_error_that_says_how_near() -> None:
    with pytest.raises(ValueError, match=r"No steady state was found\. The best is x_ss = "):
        LinearModel.from_dynamics(lambda x, u: 1 + x**2, [NAN], [0], 0.1)


def test_of_several_steady_states_one_that_the_input_holds_is_taken() -> None:
    def reactor(x: Any, u: Any) -> Any:  # washed out, or with cells that live
        rate = 0.5 * x[1] / (1 + x[1]) * x[0]
        return [rate - u[0] * x[0], u[0] * (20 - x[1]) - 2 * rate]

    model = LinearModel.from_dynamics(reactor, [NAN, 3], [NAN], 0.5)
    np.testing.assert_allclose([*model.x_ss, *model.u_ss], [8.5, 3, 0.375], rtol=1e-6)
    assert "There are others, [0.0, 3.0, 0.0]" in model.notes[0]
