"""Other orders, units and signs of an env than the model's are told, and nothing else is."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG

from errors import told as warnings_of
from sample_plants import Sampled
from sb3_yann import (
    CostAudit,
    ImprovementGuard,
    LinearModel,
    LinearMPC,
    NoActionNoise,
    StateEstimator,
    headroom,
    improve,
    report,
)
from sb3_yann.audit.meaning import warn_of_box, warn_of_order
from sb3_yann.improvement.simulator import of_law
from sb3_yann.rollout import rollout
from sb3_yann.wrappers import EstimateState, StageCost
from sb3_yann_envs import problems

pytestmark = pytest.mark.usefixtures("brisk")
A = np.array([[0.9, 0.3, 0.0], [0.0, 0.7, 0.2], [0.1, 0.0, 0.5]])
BOX = {"theta_min": -9, "theta_max": 9}
MODEL = LinearModel(A, [[0], [0], [1]], dt=1.0, state_names=["a", "b", "c"])
MPC = LinearMPC(MODEL, Q=np.eye(3), R=[[1]], horizon=2, u_min=-1, u_max=1, **BOX)


class Shuffled(Sampled):
    """The model, its states shown in some order, with noise of sensors and another gain."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float64)
    starts = (-3, 3)
    steps = 20

    def __init__(
        self, order: list[int], noise: float = 0.0, gain: float = 1.0, load: float = 0.0
    ) -> None:
        self.load = load
        self.order = order
        self.noise = noise
        self.gain = gain

    def cost(self, u):
        return MPC.stage_cost(self.x, u)

    def moved(self, u):
        return MODEL.step(self.x, self.gain * u) + np.array([self.load, 0, 0])

    def shown(self) -> np.ndarray:
        return self.x[self.order] + self.noise * self.np_random.normal(size=3)


def said(run: Callable[[], object], words: str = "") -> list[str]:
    return [each for each in warnings_of(run) if words in each]


def told(env: gym.Env, mpc: LinearMPC = MPC, episodes: int = 3) -> list[str]:
    played = rollout(of_law(mpc), lambda: env, [0], problem=mpc)
    steps = [np.concatenate([part] * episodes) for part in played.steps()]
    return said(lambda: warn_of_order(mpc, *steps))


@pytest.mark.parametrize("order", [[1, 0, 2], [2, 1, 0], [1, 2, 0], [2, 0, 1]])
def test_another_order_is_told_with_what_to_show(order: list[int]) -> None:
    (message,) = told(Shuffled(order))
    back = [order.index(i) for i in range(3)]
    names = [MODEL.state_names[i] for i in order]
    assert f"in the order {names}, which is not the MPC's, ['a', 'b', 'c']: so the" in message
    assert f"Show x[{back}] of what the plant shows" in message
    assert not told(gym.wrappers.TransformObservation(Shuffled(order), lambda x: x[back], None))


def test_another_order_is_told_where_the_plant_rests_beside_its_model() -> None:
    as_meant, swapped = Shuffled([0, 1, 2], load=1.0), Shuffled([1, 0, 2], load=1.0)
    as_meant.steps = swapped.steps = 60
    (message,) = told(swapped)
    assert "in the order ['b', 'a', 'c']" in message
    assert "errs by 469 % of a step, and by 2987 % as it is" in message
    assert not told(as_meant)


TANKS = LinearModel(
    np.diag([0.9, 0.8]), [[0.5], [0.3]], dt=1.0, x_ss=[12, 330], u_ss=[3], state_names=["h", "T"]
)
IN_PLANT_UNITS = LinearMPC(
    TANKS, Q=np.eye(2), R=[[1]], horizon=2, x_min=[0, 300], x_max=[20, 360], u_min=0, u_max=10
)


class Tanks(Sampled):
    """The model, which shows its states as somebody writes them down."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(0, 10, (1,), np.float32)
    starts = ([8, 325], [16, 335])
    steps = 20

    def __init__(self, shown) -> None:
        self.shows = shown

    def shown(self) -> np.ndarray:
        return self.shows(self.x)

    def moved(self, u):
        return TANKS.x_ss + TANKS.A @ (self.x - TANKS.x_ss) + TANKS.B @ (u - TANKS.u_ss)


def guarded(mpc: LinearMPC, make: Callable[[], gym.Env]) -> None:
    options = {"problem": mpc}
    model = DDPG("YannPolicy", make(), policy_kwargs=options, seed=0, learning_starts=10**6)
    guard = ImprovementGuard(make, n_eval_episodes=4, n_new_starts=2, n_final_starts=2)
    model.learn(20, callback=[NoActionNoise(), guard])


@pytest.mark.parametrize(
    ("shown", "words"),
    [
        (lambda x: x - TANKS.x_ss, "deviations from the operating point"),
        (lambda x: x * [100, 1], "h times 100:"),
        (lambda x: x - [0, 273.15], "T plus -273.15:"),
        (lambda x: 1.8 * (x - [0, 273.15]) + [0, 32], ""),
        (lambda x: x[::-1], "['T', 'h']"),
        (lambda x: x * 1.1 + 0.1, ""),
        (lambda x: x, ""),
    ],
)
def test_a_guard_tells_other_units_of_an_env(shown, words: str) -> None:
    def run() -> None:
        guarded(IN_PLANT_UNITS, lambda: StageCost(Tanks(shown), IN_PLANT_UNITS))

    found = said(run, "seems to show")
    assert len(found) == bool(words) and all(words in each for each in found)


@pytest.mark.parametrize("factor", [1, 100])
def test_the_page_to_sign_fails_where_units_are_others(factor: int, tmp_path) -> None:
    env = Tanks(lambda x: x * [factor, 1])
    model = DDPG("YannPolicy", env, policy_kwargs={"problem": IN_PLANT_UNITS}, seed=0)
    page = report(model, tmp_path / "page.html", env=env, seeds=range(4)).read_text()
    failed = [row for row in page.split("<tr>") if ">failed<" in row]
    assert any("seems to show h times 100" in row for row in failed) == (factor == 100)


@pytest.mark.parametrize("factor", [1, 100])
@pytest.mark.parametrize("audit", [[], [CostAudit(steps=50)]])
def test_learning_alone_and_a_cost_audit_tell_it_once(audit: list[Any], factor: int) -> None:
    env = StageCost(Tanks(lambda x: x * [factor, 1]), IN_PLANT_UNITS)
    options = {"problem": IN_PLANT_UNITS}
    model = DDPG("YannPolicy", env, policy_kwargs=options, seed=0, learning_starts=10**6)
    found = said(lambda: model.learn(220, callback=[NoActionNoise(), *audit]), "seems to show")
    assert ["show h times 100:" in each for each in found] == [True] * (factor == 100)


@pytest.mark.parametrize(("factor", "assumed"), [(1, 1), (0.1, 1), (-1, 1), (0.1, 0.1)])
def test_learning_alone_names_rewards_that_are_not_the_cost(factor: float, assumed: float) -> None:
    plant = StageCost(Tanks(lambda x: x), IN_PLANT_UNITS)
    env = gym.wrappers.TransformReward(plant, lambda reward: factor * reward)
    options = {"problem": IN_PLANT_UNITS, "critic": {"reward_scale": assumed}}
    model = DDPG("YannPolicy", env, policy_kwargs=options, seed=0, learning_starts=10**6)
    found = said(lambda: model.learn(220, callback=NoActionNoise()), "are not the MPC's cost")
    assert len(found) == (factor != assumed)


def test_a_factor_that_explains_more_than_the_order_is_named() -> None:
    model = LinearModel([[0.5, 0.5], [0.1, 0.9]], [[1], [1]], dt=1.0)
    mpc = LinearMPC(model, Q=np.eye(2), R=[[1]], horizon=1, u_min=-1, u_max=1, **BOX)
    theta, u = np.split(np.random.default_rng(0).normal(size=(40, 3)), [2], axis=1)
    after = 0.6 * mpc.predict(theta, u)  # no such plant: the factor alone leaves too much
    with pytest.warns(UserWarning, match=r"show x\[1\] times 1e\+03"):
        warn_of_order(mpc, theta * [1, 1e3], u, after * [1, 1e3])


@pytest.mark.parametrize("noise", [0.0, 0.1, 3.0])
@pytest.mark.parametrize("gain", [1.0, -2.0])
def test_noise_and_a_wrong_model_are_no_other_order(noise: float, gain: float) -> None:
    assert not told(Shuffled([0, 1, 2], noise, gain))


def test_of_two_states_that_are_alike_neither_order_is_reported() -> None:
    model = LinearModel(np.eye(2) / 2, [[1], [1]], dt=1.0)
    mpc = LinearMPC(model, Q=np.eye(2), R=[[1]], horizon=1, u_min=-1, u_max=1, **BOX)
    theta = np.random.default_rng(0).normal(size=(40, 2))
    warn_of_order(mpc, theta, np.zeros((40, 1)), theta[:, ::-1] / 2)  # a warning is an error


def test_of_six_states_two_that_are_exchanged_are_reported() -> None:
    rng = np.random.default_rng(0)
    model = LinearModel(0.3 * rng.normal(size=(6, 6)), np.ones((6, 1)), dt=1.0)
    mpc = LinearMPC(model, Q=np.eye(6), R=[[1]], horizon=1, u_min=-1, u_max=1, **BOX)
    theta = rng.normal(size=(80, 6))
    u = rng.uniform(-1, 1, (80, 1))
    order = [0, 4, 2, 3, 1, 5]
    after = mpc.predict(theta, u)
    with pytest.warns(UserWarning, match=r"Show x\[\[0, 4, 2, 3, 1, 5\]\]"):
        warn_of_order(mpc, theta[:, order], u, after[:, order])
    few = slice(59)
    warn_of_order(mpc, theta[few, order], u[few], after[few, order])


@pytest.mark.parametrize("name", ["CSTR-v0", "ClippedPendulum-v0"])
def test_the_built_in_plants_show_theirs(name: str) -> None:
    assert not told(gym.make(name), gym.make(name).observation_space.problem)


def test_states_that_begin_beyond_the_box_are_named() -> None:
    mpc = problems.cstr()
    theta = np.zeros((10, mpc.n_theta))
    warn_of_box(mpc, theta)  # a warning would be an error
    theta[:6, 3] += 273.15
    with pytest.warns(UserWarning, match=r"T reads beyond theta's box, .* 60% of .* another unit"):
        warn_of_box(mpc, theta)


# ---- Inputs that move the env against the model ----

COUPLED = LinearModel(
    [[0.9, 0.2], [0.0, 0.7]], [[0.3, 0.0], [0.1, 0.5]], dt=1.0, input_names=["valve", "heater"]
)
STEERED = LinearMPC(
    COUPLED, Q=np.eye(2), R=np.eye(2), horizon=2, theta_min=-4, theta_max=4, u_min=-1, u_max=1
)


class Plant(Sampled):
    """The model with other gains, a noise that the seed repeats, and a curve."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    starts = (-3, 3)
    steps = 12

    def __init__(self, gains: Any, late: bool = False, band: float = 0) -> None:
        self.gains = np.array(gains)
        self.band = band
        self.late = late

    def moved(self, u: Any) -> Any:
        before = self.before if self.t else np.zeros(2)
        self.before = u
        acts = self.gains * (before if self.late else u * (abs(u) > self.band))
        noise = 0.3 * self.np_random.normal(size=2)
        return COUPLED.step(self.x, acts) - 0.1 * self.x**3 / 9 + noise


def against(run: Callable[[], object]) -> list[str]:
    return said(run, "against the sign")


@pytest.mark.parametrize("gains", [(1, -0.6), (-2, 1)])
def test_a_guard_names_an_input_of_the_other_sign(gains: Any) -> None:
    make = lambda: StageCost(Plant(gains), STEERED)  # noqa: E731
    (message,) = against(lambda: guarded(STEERED, make))
    name = ["valve", "heater"][int(np.argmin(gains))]
    assert message.startswith(f"{name} moves the env against the sign of the model's B: ")
    assert f"{min(gains):.2g} times as far in a step, from 4 starts" in message


@pytest.mark.parametrize("gains", [(3, 0.2), (5, 1), (1, 1)])
def test_another_gain_is_no_other_sign_and_far_ones_and_dead_time_are_told(gains: Any) -> None:
    make = lambda: StageCost(Plant(gains, late=gains == (1, 1)), STEERED)  # noqa: E731
    told = said(lambda: guarded(STEERED, make), "moves the env otherwise")
    far = {(3, 0.2): ["heater"], (5, 1): ["valve"], (1, 1): ["valve", "heater"]}
    assert [each.split()[0] for each in told] == far[gains]
    assert all("0 times as far" in each for each in told) == (gains == (1, 1))
    assert not said(lambda: guarded(STEERED, lambda: StageCost(Plant((1, 1), band=0.9), STEERED)))


def test_inputs_in_another_order_are_told() -> None:
    space = Plant.action_space
    turned = lambda: gym.wrappers.TransformAction(Plant((1, 1)), lambda u: u[::-1], space)  # noqa: E731
    told = said(lambda: guarded(STEERED, lambda: StageCost(turned(), STEERED)), "answers pushes")
    assert len(told) == 1 and "states in the order [0, 1], and to take its inputs in" in told[0]


def test_headroom_tells_it_too_and_improve_though_its_steps_are_few() -> None:
    assert len(against(lambda: headroom(STEERED, lambda: Plant((-1, -1)), n_starts=3))) == 2
    assert len(against(lambda: improve(STEERED, lambda: Plant((-1, -1)), max_steps=60))) == 2


@pytest.mark.parametrize(
    ("gains", "turn", "words", "count"),
    [
        ((1, -0.6), 1, "in 10 steps, from 3 starts. The MPC steers the wrong way", 1),
        ((3, 0.2), 1, "against the sign", 0),
        ((1, 1), -1, "outputs in the order [1, 0], and to take its inputs in the order [0, 1]", 1),
    ],
)
def test_an_estimator_that_goes_where_its_model_goes_hides_no_sign_and_no_order(
    gains: Any, turn: int, words: str, count: int
) -> None:
    def make() -> EstimateState:
        seen = gym.wrappers.TransformObservation(Plant(gains), lambda y: y[::turn], None)
        return EstimateState(seen, StateEstimator(COUPLED, measurement_noise=5))

    assert len(said(lambda: headroom(STEERED, make, n_starts=3, max_steps=150), words)) == count


def test_a_plant_that_is_not_linear_has_the_signs_of_its_model() -> None:
    make = lambda: gym.make("ClippedPendulum-v0")  # noqa: E731
    assert not against(lambda: guarded(problems.clipped_pendulum(), make))
