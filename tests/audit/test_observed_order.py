"""States that an env shows in another order than the model has are told, and nothing else is."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_yann import (
    CostAudit,
    ImprovementGuard,
    LinearModel,
    LinearMPC,
    NoActionNoise,
    headroom,
    report,
)
from sb3_yann.audit.meaning import warn_of_box, warn_of_order
from sb3_yann.improvement.simulator import of_law
from sb3_yann.rollout import rollout
from sb3_yann.wrappers import StageCost
from sb3_yann_envs import problems

A = np.array([[0.9, 0.3, 0.0], [0.0, 0.7, 0.2], [0.1, 0.0, 0.5]])
MODEL = LinearModel(A, [[0], [0], [1]], dt=1.0, state_names=["a", "b", "c"])
MPC = LinearMPC(
    MODEL, Q=np.eye(3), R=[[1]], horizon=2, theta_min=-9, theta_max=9, u_min=-1, u_max=1
)


class Shuffled(gym.Env):
    """The model, its states shown in some order, with noise of sensors and another gain."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float64)

    def __init__(self, order: list[int], noise: float = 0.0, gain: float = 1.0) -> None:
        self.order = order
        self.noise = noise
        self.gain = gain

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-3, 3, 3)
        self.t = 0
        return self.shown(), {}

    def step(self, action):
        cost = float(MPC.stage_cost(self.x, action))
        self.x = MODEL.step(self.x, self.gain * action)
        self.t += 1
        return self.shown(), -cost, False, self.t == 20, {}

    def shown(self) -> np.ndarray:
        return self.x[self.order] + self.noise * self.np_random.normal(size=3)


def told(env: gym.Env, mpc: LinearMPC = MPC, episodes: int = 3) -> list[str]:
    played = rollout(of_law(mpc), lambda: env, [0], problem=mpc)
    steps = [np.concatenate([part] * episodes) for part in played.steps()]
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        warn_of_order(mpc, *steps)
    return [str(each.message) for each in found]


@pytest.mark.parametrize("order", [[1, 0, 2], [2, 1, 0], [1, 2, 0], [2, 0, 1]])
def test_another_order_is_told_with_what_to_show(order: list[int]) -> None:
    (message,) = told(Shuffled(order))
    back = [order.index(i) for i in range(3)]
    names = [MODEL.state_names[i] for i in order]
    assert f"in the order {names}, which is not the MPC's, ['a', 'b', 'c']: so the" in message
    assert f"Show x[{back}] of what the plant shows" in message
    assert not told(
        gym.wrappers.TransformObservation(
            Shuffled(order), lambda x: x[back], Shuffled.observation_space
        )
    )


TANKS = LinearModel(
    np.diag([0.9, 0.8]), [[0.5], [0.3]], dt=1.0, x_ss=[12, 330], u_ss=[3], state_names=["h", "T"]
)
IN_PLANT_UNITS = LinearMPC(
    TANKS, Q=np.eye(2), R=[[1]], horizon=2, x_min=[0, 300], x_max=[20, 360], u_min=0, u_max=10
)


class Tanks(gym.Env):
    """The model, which shows its states as somebody writes them down."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(0, 10, (1,), np.float32)

    def __init__(self, shown) -> None:
        self.shown = shown

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform([8, 325], [16, 335])
        self.t = 0
        return self.shown(self.x), {}

    def step(self, action):
        self.x = TANKS.x_ss + TANKS.A @ (self.x - TANKS.x_ss) + TANKS.B @ (action - TANKS.u_ss)
        self.t += 1
        return self.shown(self.x), 0.0, False, self.t == 20, {}


def guarded(make) -> None:
    options = {"problem": IN_PLANT_UNITS}
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
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        guarded(lambda: StageCost(Tanks(shown), IN_PLANT_UNITS))
    told = [str(each.message) for each in found if "seems to show" in str(each.message)]
    assert len(told) == bool(words) and all(words in each for each in told)


@pytest.mark.parametrize("factor", [1, 100])
def test_the_page_to_sign_fails_where_units_are_others(factor: int, tmp_path) -> None:
    env = Tanks(lambda x: x * [factor, 1])
    model = DDPG("YannPolicy", env, policy_kwargs={"problem": IN_PLANT_UNITS}, seed=0)
    page = report(model, tmp_path / "page.html", env=env, seeds=range(4)).read_text()
    failed = [row for row in page.split("<tr>") if ">failed<" in row]
    assert any("seems to show h times 100" in row for row in failed) == (factor == 100)


def test_a_cost_audit_tells_it_too() -> None:
    options = {"problem": IN_PLANT_UNITS}
    env = StageCost(Tanks(lambda x: x * [100, 1]), IN_PLANT_UNITS)
    model = DDPG("YannPolicy", env, policy_kwargs=options, seed=0, learning_starts=10**6)
    with pytest.warns(UserWarning, match="seems to show h times 100"):
        model.learn(60, callback=[NoActionNoise(), CostAudit(steps=50)])


@pytest.mark.parametrize("noise", [0.0, 0.1, 3.0])
@pytest.mark.parametrize("gain", [1.0, -2.0])
def test_noise_and_a_wrong_model_are_no_other_order(noise: float, gain: float) -> None:
    assert not told(Shuffled([0, 1, 2], noise, gain))


def test_of_two_states_that_are_alike_neither_order_is_reported() -> None:
    twins = LinearModel(np.eye(2) / 2, [[1], [1]], dt=1.0)
    mpc = LinearMPC(twins, Q=np.eye(2), R=[[1]], horizon=1, u_min=-1, u_max=1, **BOX)
    theta = np.random.default_rng(0).normal(size=(40, 2))
    u = np.zeros((40, 1))
    warn_of_order(mpc, theta, u, theta[:, ::-1] / 2)  # a warning would be an error


BOX = {"theta_min": -9, "theta_max": 9}


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
    made = {"CSTR-v0": problems.cstr, "ClippedPendulum-v0": problems.clipped_pendulum}
    assert not told(gym.make(name), made[name]())


def test_headroom_tells_it_and_points_to_the_call() -> None:
    with pytest.warns(UserWarning) as found:
        headroom(MPC, Shuffled([1, 0, 2]), n_starts=2)
    (order,) = [each for each in found if "in the order" in str(each.message)]
    assert order.filename == __file__


def test_states_that_begin_beyond_the_box_are_named() -> None:
    mpc = problems.cstr()
    theta = np.zeros((10, mpc.n_theta))
    warn_of_box(mpc, theta)  # a warning would be an error
    theta[:6, 3] += 273.15
    with pytest.warns(UserWarning, match=r"T reads beyond theta's box, .* 60% of .* another unit"):
        warn_of_box(mpc, theta)
