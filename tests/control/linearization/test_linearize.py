"""A simulator is linearized where it rests; what cannot be is refused with the reason."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sample_plants import Plant
from sb3_yann import LinearModel
from sb3_yann.control.simulator import sample_time
from sb3_yann_envs import cstr

# theta+ = theta + dt speed+, speed+ = speed + dt (15 sin(theta) + 3 u), at dt = 0.05 (Gymnasium's
# Pendulum-v1, g = 10, m = l = 1), by hand:
UPRIGHT_A = [[1.0375, 0.05], [0.75, 1.0]]
UPRIGHT_B = [[0.0075], [0.15]]
HANGING_A = [[0.9625, 0.05], [-0.75, 1.0]]


def test_reactor_is_linearized_as_its_equations_are() -> None:
    truth = LinearModel.from_dynamics(cstr.dynamics, cstr.X_SS, cstr.U_SS, cstr.DT)
    model = LinearModel.from_env("CSTR-v0", np.zeros(4), [0.0])
    # the environment integrates with two Runge-Kutta steps
    np.testing.assert_allclose(model.A, truth.A, atol=1e-8)
    np.testing.assert_allclose(model.B, truth.B, atol=1e-11)
    assert model.dt == cstr.DT


def test_steady_state_of_the_reactor_is_found() -> None:
    model = LinearModel.from_env("CSTR-v0")
    np.testing.assert_allclose(model.x_ss, np.zeros(4), atol=1e-6)
    assert model.u_ss == [0]


def test_a_plant_that_rests_anywhere_asks_for_the_state_to_hold() -> None:
    tank = Plant(lambda x, u: x + u)
    with pytest.warns(UserWarning, match=r"rests at other states too: x_ss = \[0.0\]"):
        LinearModel.from_env(tank)
    assert LinearModel.from_env(tank, x_ss=[2.0]).x_ss == [2]


def test_what_is_solved_for_is_zero_rather_than_rounding() -> None:
    tanks = LinearModel.from_dynamics(
        lambda x, u: [u[0] - u[1], 0.1 * (x[0] - x[1])], [4, np.nan], [np.nan, 0], dt=0.5
    )
    assert tanks.u_ss.tolist() == [0.0, 0.0]


def test_entries_that_are_nan_are_solved_for() -> None:
    nan = np.nan
    model = LinearModel.from_env("CSTR-v0", [nan, nan, nan, 2.0])
    f = cstr.dynamics(cstr.X_SS + model.x_ss, cstr.U_SS + model.u_ss)
    assert model.x_ss[3] == 2.0
    np.testing.assert_allclose(f, 0, atol=1e-5)


def test_input_that_holds_a_tilted_pendulum_is_found() -> None:
    model = LinearModel.from_env("ClippedPendulum-v0", [0.3, 0.0])
    np.testing.assert_allclose(model.u_ss, -5 * np.sin(0.3), atol=1e-6)
    np.testing.assert_allclose(model.A[1, 0], 0.05 * 15 * np.cos(0.3), atol=1e-9)


@pytest.mark.parametrize(("angle", "A"), [(0.0, UPRIGHT_A), (np.pi, HANGING_A)])
def test_gymnasiums_pendulum_is_linearized_in_the_state_it_does_not_observe(
    angle: float, A: Any
) -> None:
    model = LinearModel.from_env("Pendulum-v1", [angle, 0.0])
    np.testing.assert_allclose(model.A, A, atol=1e-9)
    np.testing.assert_allclose(model.B, UPRIGHT_B, atol=1e-9)
    assert "The observation is not this state" in model.report()


def test_gymnasiums_mountain_car_rests_in_its_valley_in_float32() -> None:
    model = LinearModel.from_env("MountainCarContinuous-v0", dt=1.0)
    np.testing.assert_allclose(model.x_ss, [-np.pi / 6, 0], atol=1e-5)  # cos(3 x) = 0
    # speed+ = speed + .0015 u - .0025 cos(3 x), x+ = x + speed+, by hand; float32 allows no more
    np.testing.assert_allclose(model.A, [[0.9925, 1], [-0.0075, 1]], atol=1e-4)
    np.testing.assert_allclose(model.B, [[0.0015], [0.0015]], atol=1e-5)


def test_state_is_set_and_read_by_functions_of_the_user() -> None:
    def put(env: Any, x: Any) -> None:
        env.unwrapped.state = np.array([x[1], x[0]])

    def get(env: Any) -> Any:
        return env.unwrapped.state[::-1]

    model = LinearModel.from_env("Pendulum-v1", [0, 0], set_state=put, get_state=get)
    np.testing.assert_allclose(model.A, np.array(UPRIGHT_A)[::-1, ::-1], atol=1e-9)


def test_wrappers_are_part_of_the_plant() -> None:
    env = gym.wrappers.RescaleAction(gym.make("ClippedPendulum-v0"), np.float32(-1), np.float32(1))
    model = LinearModel.from_env(env, [0.0, 0.0])
    np.testing.assert_allclose(model.B, 2 * np.array(UPRIGHT_B), atol=1e-7)


def test_the_users_environment_goes_on_as_if_nothing_had_been() -> None:
    def play(disturb: bool) -> list[Any]:
        env = gym.make("CSTR-v0")
        env.reset(seed=0)
        seen = [env.step([1.0])[0]]
        if disturb:
            LinearModel.from_env(env)
        seen += [env.step([1.0])[0], env.reset()[0]]
        return [s.tolist() for s in seen]

    assert play(True) == play(False)


def test_an_environment_that_cannot_be_copied_is_used_itself_and_said_so() -> None:
    env = Plant()
    env.lock = (i for i in ())  # generators are not copied
    model = LinearModel.from_env(env)
    np.testing.assert_allclose(model.A, [[0.5]], atol=1e-12)
    assert "env itself, which cannot be copied: reset it before" in model.report()


def test_an_environment_made_by_a_function_is_closed() -> None:
    closed = []

    class Closing(Plant):
        def close(self) -> None:
            closed.append(self)

    LinearModel.from_env(Closing)
    assert len(closed) == 1


def test_curvature_does_not_reach_the_derivative() -> None:
    plant = Plant(lambda x, u: np.sin(x) + 0.3 * x**2 + np.exp(u) - 1)
    model = LinearModel.from_env(plant, [0.0], [0.0])
    np.testing.assert_allclose([model.A[0, 0], model.B[0, 0]], 1, atol=1e-9)


def test_clipping_close_to_the_operating_point_is_reported_and_avoided() -> None:
    plant = Plant(lambda x, u: 0.5 * np.clip(x, -0.003, 1) + u)
    model = LinearModel.from_env(plant, [0.0], [0.0])
    np.testing.assert_allclose(model.A, [[0.5]], atol=1e-9)
    assert "not smooth within 0.05 of the operating point along x[0]" in model.report()


def test_an_input_without_effect_is_reported() -> None:
    with pytest.warns(UserWarning, match=r"u\[0\] has no effect on the next state.*delay"):
        model = LinearModel.from_env(Plant(lambda x, u: 0.5 * x), [0.0], [0.0])
    assert "u[0] has no effect on the next state" in model.notes[0]


def random_walk(x: Any, u: Any) -> Any:
    return 0.5 * x + u + NOISE.normal(size=1)


NOISE = np.random.default_rng(0)
CLOCK = iter(range(10**6))
BAD_PLANTS: list[tuple[Any, dict[str, Any], str]] = [
    (lambda x, u: np.clip(x + u, 0, 1), {}, r"along x\[0\], .* \(a kink\), .*Clipping"),
    (lambda x, u: 0.5 * x + np.maximum(u, 0), {}, r"along u\[0\], .* \(a kink\)"),
    (lambda x, u: 0.5 * x + np.floor(x) + u, {}, r"along x\[0\], .* \(a (kink|jump or noise)\)"),
    (random_walk, {}, "two steps from the same state.*the plant is random or has states besides"),
    (lambda x, u: 0.5 * x + u + next(CLOCK), {}, "has states besides these"),
    (lambda x, u: 0.5 * x + u, {"u_ss": [1.0]}, r"u_ss = \[1\.0\]: entry 0 lies on its bound"),
    (lambda x, u: 0.5 * x + u + 2, {"x_ss": [0]}, "No steady state was found.*moves in one step"),
    (lambda x, u: 0.5 * x + u + 2, {"x_ss": [0]}, r"u\[0\] is at its lower bound, -1: the inputs"),
    (lambda x, u: x + u + 2, {"x_ss": [0], "u_ss": [0]}, "no steady state: one step moves it"),
    (lambda x, u: 0.999 * x, {"x_ss": [1], "u_ss": [0]}, "no steady state: one step moves it"),
    (lambda x, u: x, {"x_ss": [[0]]}, "expected a vector of finite numbers, or NaN"),
    (lambda x, u: x, {"x_ss": [0, 0]}, r"x_ss has shape \(2,\), and no state that is read has"),
    (lambda x, u: x, {"u_ss": [0, 0]}, r"u_ss has shape \(2,\), expected \(1,\)"),
    (lambda x, u: x, {"scale": [0]}, r"scale = \[0\.0\] must be above 0"),
    (lambda x, u: x, {"dt": -1}, "dt = -1 must be a finite number above 0"),
]


@pytest.mark.parametrize(("step", "arguments", "message"), BAD_PLANTS)
def test_plant_that_cannot_be_linearized_is_refused_with_the_reason(
    step: Any, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=f"(?s){message}"):
        LinearModel.from_env(Plant(step), **(arguments or {"x_ss": [0], "u_ss": [0]}))


def test_the_input_with_the_least_room_of_its_own_range_is_named() -> None:
    plant = Plant(lambda x, u: 0.5 * x + u[:1] + u[1:])
    plant.action_space = gym.spaces.Box(np.array([-0.1, -100]), np.array([0.1, 100]), dtype=float)
    with pytest.raises(ValueError, match="entry 1 lies on its bound"):
        LinearModel.from_env(plant, x_ss=[0], u_ss=[0.09, 100.0])


def test_a_reset_that_ignores_the_state_is_noticed() -> None:
    class Deaf(Plant):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=seed)

    with pytest.raises(ValueError, match=r"(?s)could not be put into a state.*ignored.*set_state="):
        LinearModel.from_env(Deaf())


def test_an_attribute_that_is_not_the_state_is_noticed() -> None:
    class Deaf(Plant):
        def reset(self, *, seed=None, options=None):
            self.state = np.array([0.0])
            return super().reset(seed=seed)

    with pytest.raises(ValueError, match="no step changes it"):
        LinearModel.from_env(Deaf())


def test_setting_a_state_without_effect_is_noticed() -> None:
    with pytest.raises(ValueError, match=r"the next state is \[0\.0\] from \[0\.0\] and .* alike"):
        LinearModel.from_env(Plant(), set_state=lambda env, x: None)


class Delayed(Plant):
    """The input acts some steps late; a reset to a state keeps the inputs on their way, or not."""

    def __init__(self, delay: int, keeps: bool) -> None:
        super().__init__()
        self.line = [0.0] * delay
        self.delay = delay
        self.keeps = keeps

    def reset(self, **given: Any) -> Any:
        if not self.keeps:
            self.line = [0.0] * self.delay
        return super().reset(**given)

    def step(self, action):
        self.line.append(float(action[0]))
        return super().step(np.array([self.line.pop(0)]))


@pytest.mark.parametrize("delay", [1, 2, 3])
@pytest.mark.parametrize("keeps", [True, False])
@pytest.mark.parametrize("point", [{}, {"x_ss": [0.0]}, {"x_ss": [0.0], "u_ss": [0.0]}])
def test_inputs_on_their_way_are_noticed(delay: int, keeps: bool, point: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="the plant has states besides these"):
        LinearModel.from_env(Delayed(delay, keeps), **point)


def test_hanging_pendulum_whose_angle_wraps_there_is_refused() -> None:
    with pytest.raises(ValueError, match="an angle that wraps"):
        LinearModel.from_env("ClippedPendulum-v0", [np.pi, 0])


def test_missing_sampling_time_is_asked_for_and_render_fps_is_none() -> None:
    assert gym.make("MountainCarContinuous-v0").metadata["render_fps"]
    with pytest.raises(ValueError, match=r"dt is not given, .* Pass dt="):
        LinearModel.from_env("MountainCarContinuous-v0")


@pytest.mark.parametrize(
    ("env", "message"),
    [
        ("CartPole-v1", r"Discrete\(2\): a linear model needs a Box"),
        (3, "env = 3 must be a single gymnasium.Env"),
        (lambda: 3, "returned 3, expected a single"),
        (gym.make_vec("CSTR-v0", num_envs=2), "of a vectorized environment, pass one of its parts"),
    ],
    ids=["discrete", "number", "function", "vectorized"],
)
def test_what_is_no_environment_of_a_plant_is_named(env: Any, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        LinearModel.from_env(env)


def settling(u: Any = (-1.0, 1.0)) -> Plant:
    return Plant(lambda x, u: 0.5 * x + 0.25 * u, (-4.0, 4.0), u)


class Clock(Plant):
    """A plant that is pushed at one sample after a reset."""

    def __init__(self, at: int) -> None:
        super().__init__(self.pushed)
        self.at = at

    def pushed(self, x: Any, u: Any) -> Any:
        self.t += 1
        return 0.5 * x + 0.25 * u + 0.1 * (self.t == self.at + 1)

    def reset(self, **given: Any) -> Any:
        self.t = 0
        return super().reset(**given)


@pytest.mark.parametrize("at", [1, 2, 19])
def test_a_clock_is_noticed_whichever_of_twenty_samples_it_strikes_at(at: int) -> None:
    with pytest.raises(ValueError, match=r"starts anew \(a delay of the input, an actuator"):
        LinearModel.from_env(Clock(at), x_ss=[0.0], u_ss=[0.0])
    LinearModel.from_env(Clock(20), x_ss=[0.0], u_ss=[0.0])


class Strict(Plant):
    """A plant that is cut, or ends, after each step, and takes none until it is reset."""

    def __init__(self, ends: bool) -> None:
        super().__init__(lambda x, u: 0.5 * x + 0.25 * u)
        self.ends = ends

    def reset(self, **given: Any) -> Any:
        self.done = False
        return super().reset(**given)

    def step(self, action: Any) -> Any:
        if self.done:
            raise RuntimeError("step after the end")
        self.done = True
        return *super().step(action)[:2], self.ends, not self.ends, {}


@pytest.mark.parametrize("ends", [True, False])
def test_an_episode_that_is_over_is_begun_anew_before_its_state_is_set(ends: bool) -> None:
    def put(env: Strict, x: Any) -> None:
        env.x = np.array(x)

    model = LinearModel.from_env(
        Strict(ends), x_ss=[0.0], u_ss=[0.0], set_state=put, get_state=lambda env: env.x
    )
    np.testing.assert_allclose([model.A, model.B], [[[0.5]], [[0.25]]], atol=1e-9)
    assert any("terminates the episode" in note for note in model.notes) == ends


def test_the_notes_tell_what_was_solved_for_and_what_is_observed() -> None:
    model = LinearModel.from_env(settling(), x_ss=[np.nan], u_ss=[0.4])
    assert model.x_ss == pytest.approx([0.2])
    said = "Of the 2 entries of the operating point, 1 were solved for"
    assert any(said in n for n in model.notes)
    assert not any("observation is not this state" in n or "terminates" in n for n in model.notes)
    assert model.dt == 0.1 and model.n_disturbances == 0


def test_without_a_state_the_input_in_the_middle_is_held_and_with_one_that_which_holds_it() -> None:
    plant = settling((-1.0, 3.0))
    model = LinearModel.from_env(plant)
    assert model.u_ss == pytest.approx([1.0]) and model.x_ss == pytest.approx([0.5])
    held = LinearModel.from_env(plant, x_ss=[0.25])
    assert held.u_ss == pytest.approx([0.5]) and held.x_ss == pytest.approx([0.25])


def test_the_time_of_a_step_is_given_or_the_plant_s_own() -> None:
    assert sample_time(settling(), None) == 0.1 and sample_time(settling(), 2) == 2.0
    for name, value in (("tau", 0.25), ("DT", np.float32(0.125))):
        plant = settling()
        plant.dt = 0.0  # none
        setattr(plant, name, value)
        assert sample_time(plant, None) == value
    plant = settling()
    plant.dt = np.inf
    with pytest.raises(ValueError, match="Plant has no dt, tau or DT to take it from"):
        sample_time(plant, None)
