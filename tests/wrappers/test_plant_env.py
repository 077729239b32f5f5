"""An env from equations is a plant in its own units, with all that the MPC's theta holds."""

import random
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.random.mtrand import get_bit_generator
from stable_baselines3 import DDPG

from errors import told
from sample_problems import small_mpc
from sb3_yann import (
    CostAudit,
    DisturbanceBounds,
    LinearModel,
    LinearMPC,
    NoActionNoise,
    NonFiniteWarning,
    PlantEnv,
    RateLimits,
    Tracking,
    headroom,
    improve,
    offset_free,
)
from sb3_yann.env_pool import name_of
from sb3_yann.evaluation import evaluate
from sb3_yann.improvement.simulator import Simulator
from sb3_yann.wrappers import SeededGlobals, TruncateAtTimeLimit


def slope(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return how a tank of 350 cm fills: its outflow goes with the root of the level."""
    return (u - 2 * np.sqrt(np.maximum(x, 0) / 350)) * 5


TANK = LinearModel.from_dynamics(slope, x_ss=[350], u_ss=[2], dt=1.0).named(["level"], ["flow"])
BOX: dict[str, Any] = {"u_min": 0, "u_max": 5, "theta_min": 300, "theta_max": 400}
WEIGHTS: dict[str, Any] = {"Q": [[1]], "R": [[1]], "horizon": 3, "gamma": 0.99}


def full() -> LinearMPC:
    return LinearMPC(
        TANK, **WEIGHTS, **BOX, tracking=Tracking([0], 340, 360), rate=RateLimits(-1, 1)
    )


def test_it_rests_where_the_model_does_and_begins_in_its_box() -> None:
    mpc = LinearMPC(TANK, **WEIGHTS, **BOX)
    env = PlantEnv(slope, mpc)
    env.reset(options={"state": [350.0]})
    x, reward, *ends, info = env.step(np.array([2.0]))
    assert x == pytest.approx([350]) and reward == pytest.approx(0) and ends == [False, False]
    assert info["state"].tolist() == x.tolist()
    starts = np.array([env.reset(seed=k)[0] for k in range(50)])
    assert 325 <= starts.min() < 335 and 365 < starts.max() <= 375
    assert PlantEnv(slope, mpc, start_low=340, start_high=340).reset()[0] == 340


def test_its_name_is_that_of_its_function_and_none_is_a_lambda_s() -> None:
    mpc = LinearMPC(TANK, **WEIGHTS, **BOX)
    make = lambda: PlantEnv(slope, mpc)  # noqa: E731
    assert (name_of(make()), name_of(make)) == ("slope", "plant")
    assert name_of(PlantEnv(lambda x, u: slope(x, u), mpc)) == "plant"
    assert Simulator(mpc, make, 0).name == "slope"


@pytest.mark.parametrize(("faster", "words"), [
    (60, "60 times as fast as the model of the MPC, whose dt = 1. "), (1 / 3600, "* 3600."),
    (5, ""), (-60, ""),
])  # fmt: skip
def test_equations_in_another_unit_of_time_are_named(faster, words) -> None:
    mpc = LinearMPC(TANK, **WEIGHTS, **BOX)
    found = told(lambda: PlantEnv(lambda x, u: faster * 1.1 * slope(x, u), mpc))
    assert len(found) == bool(words) and all(words in each for each in found)


@pytest.mark.parametrize(("lag", "error"), [(7, 1e-8), (1e-3, 1e-2), (1e-6, None)])
def test_it_is_integrated_exactly_or_ends(lag: float, error: float | None) -> None:
    env = PlantEnv(lambda x, u: (u - x) / lag, LinearMPC(
        LinearModel.from_dynamics(lambda x, u: (u - x) / lag, [3], [3], dt=2.0), **WEIGHTS,
        u_min=0, u_max=9, theta_min=0, theta_max=9,
    ))  # fmt: skip
    env.reset(options={"state": [5.0]})
    found = []
    words = told(lambda: found.extend(env.step(np.array([1.0]))))
    assert found[2] == (error is None) == any("f(x, u) changes too fast for" in x for x in words)
    at = 5.0 if error is None else 1 + 4 * np.exp(-2 / lag)
    assert found[0] == pytest.approx([at], abs=error)


def test_a_map_that_is_taken_for_a_slope_is_named() -> None:
    mpc = LinearMPC(TANK, **WEIGHTS, **BOX)
    (words,) = told(lambda: PlantEnv(lambda x, u: mpc.model.step(x, u), mpc))
    assert words.startswith("f(x, u) looks like the next state")


def test_a_policy_on_it_is_the_mpc_and_its_reward_minus_the_cost() -> None:
    mpc = full()
    env = PlantEnv(slope, mpc, hold=20)
    assert env.reset(seed=0)[0].shape == (3,) and env.reset(seed=0)[0][2] == 2
    model = DDPG("YannPolicy", env, policy_kwargs={"problem": mpc})
    audit = CostAudit()
    ours, law = (evaluate(each, lambda: PlantEnv(slope, mpc), range(4)) for each in (
        model, mpc.explicit()))  # fmt: skip
    np.testing.assert_allclose(ours.costs, law.costs, rtol=1e-4)
    assert law.lengths.tolist() == [100] * 4
    model.learn(120, callback=[NoActionNoise(), audit])
    assert audit.finding.matches


def test_an_observer_takes_the_offset_of_another_plant() -> None:
    """Here the pump gives a tenth more than the model says."""
    mpc, observer = offset_free(full())
    worn = lambda x, u: slope(x, 1.1 * u)  # noqa: E731
    apart = []
    for each, options in ((full(), {}), (mpc, {"observer": observer})):
        env = PlantEnv(worn, each, **options)
        theta, _ = env.reset(seed=2)
        assert theta.shape == (each.n_theta,)
        for _ in range(60):
            theta = env.step(each.explicit().plant_input(theta))[0]
        apart.append(abs(theta[0] - theta[1]))
    assert apart[1] < 0.1 * apart[0]


def test_an_observer_of_some_states_reads_these_alone() -> None:
    chain = lambda x, u: np.append(u[0] - x[0], x[0] - x[1]) / [4, 5]  # noqa: E731
    model = LinearModel.from_dynamics(chain, x_ss=[2, 2], u_ss=[2], dt=1)
    box = BOX | {"theta_min": 0, "theta_max": 9, "tracking": Tracking([1], 1, 3)}
    mpc, observer = offset_free(LinearMPC(model, **WEIGHTS | {"Q": np.eye(2)}, **box), measured=[1])
    env = PlantEnv(lambda x, u: chain(x, 0.9 * u), mpc, observer=observer)
    theta, _ = env.reset(seed=0)
    for _ in range(100):
        theta, *_, info = env.step(mpc.law().plant_input(theta))
    assert abs(info["state"][1] - theta[2]) < 1e-3


def test_equations_that_fail_are_named_with_state_input_and_time() -> None:
    model = LinearModel.from_dynamics(slope, x_ss=[350], u_ss=[2], dt=2.0)
    model = model.named(["level"], ["flow"], units={"level": "cm"}, time_unit="min")
    mpc = LinearMPC(model, **WEIGHTS, **BOX)
    env = PlantEnv(lambda x, u: slope(x, u) * np.where(x < 349, np.nan, 1), mpc)
    env.reset(options={"state": [349.5]})
    x = env.step(np.array([2.0]))[0]
    said = r"nan for the slope of level \(cm\) at level \(cm\) = 34\d.*, flow = 0, t = 2 min"
    with pytest.warns(NonFiniteWarning, match=said):
        reached, _, terminated, _, info = env.step(np.array([0.0]))
    assert reached.tolist() == x.tolist() and terminated and info["violation"]
    with pytest.warns(NonFiniteWarning) as caught:
        for k in range(9):  # other envs, other states, the same function
            other = PlantEnv(env.unwrapped.f, mpc)
            other.reset(options={"state": [349.1 + k / 100]})
            other.step(np.array([0.0]))
    assert len(caught) == 1 and "So did 10 episodes." in str(caught[0].message)
    with pytest.raises(ValueError, match=r"slope of level .* = 350, flow = 2, the operating point"):
        PlantEnv(lambda x, u: x * np.inf, mpc)
    with pytest.raises(ValueError, match=r"shape \(1, 2\).* dx/dt \(1,\). x is level \(cm\)"):
        PlantEnv(lambda x, u: np.ones((1, 2)), mpc)


def test_what_is_of_no_use_is_named() -> None:
    plain = LinearMPC(TANK, **WEIGHTS, **BOX)
    with pytest.raises(TypeError, match="f = 3 must be a function"):
        PlantEnv(3, plain)  # type: ignore[arg-type]
    called = r"f\(x, u\), in this order, with x \(2,\), u \(1,\), and returns dx/dt \(2,\)"
    for swapped in (
        lambda u, x: [x[1], u[0] - x[0]],
        lambda u, x: np.eye(2) @ x + np.ones((2, 1)) @ u,
    ):
        with pytest.raises(TypeError, match=f"f ended in .*Error .* It is called as {called}"):
            PlantEnv(swapped, small_mpc())
        with pytest.raises(TypeError, match=f"f ended in .*Error .* It is called as {called}"):
            LinearModel.from_dynamics(swapped, [0, np.nan], [0], dt=1)
    as_many = lambda u, x: slope(x, u)  # noqa: E731
    for use in (PlantEnv, lambda f, _: LinearModel.from_dynamics(f, [350], [2], dt=1)):
        with pytest.raises(TypeError, match=r"rests at the operating point. It is called as f"):
            use(as_many, plain)
    with pytest.raises(ValueError, match=r"f returned the shape \(2,\). It is called as f\(x, u\)"):
        env = PlantEnv(lambda x, u: [1, 2], plain)
        env.reset()
        env.step(np.array([2.0]))
    loaded = LinearModel(TANK.A, TANK.B, 1.0, TANK.x_ss, TANK.u_ss, E=[[1.0]])
    with pytest.raises(ValueError, match="The MPC has disturbances"):
        PlantEnv(slope, LinearMPC(loaded, **WEIGHTS, **BOX, disturbances=DisturbanceBounds(-1, 1)))
    with pytest.raises(ValueError, match="pass start_low and start_high"):
        PlantEnv(slope, LinearMPC(TANK, **WEIGHTS, u_min=0, u_max=5))
    with pytest.raises(ValueError, match=r"options\['state'\] = \[1, 2\] must be 1 finite"):
        PlantEnv(slope, plain).reset(options={"state": [1, 2]})
    with pytest.raises(ValueError, match=r"action has shape \(2,\), expected \(1,\): flow"):
        PlantEnv(slope, plain).step(np.array([2.0, 2.0]))
    with pytest.raises(ValueError, match="start_low must lie below start_high, but entry 0 has"):
        PlantEnv(slope, plain, start_low=[360], start_high=[350])


def test_an_mpc_from_it_has_the_bounds_of_its_own() -> None:
    mpc = LinearMPC(TANK, **WEIGHTS, **BOX, x_max=380)
    found = LinearMPC.from_env(PlantEnv(slope, mpc), **WEIGHTS, x_ss=[350], u_ss=[2])
    for name in ("x_min", "x_max", "theta_min", "theta_max", "u_min", "u_max"):
        np.testing.assert_array_equal(getattr(found, name), getattr(mpc, name))


@pytest.mark.parametrize("bad", ["CSTR-v9", "CSTRv0", PlantEnv])
@pytest.mark.parametrize("use", [headroom, improve, LinearMPC.from_env])
def test_an_id_that_is_not_there_or_a_class_without_its_arguments_is_named(use, bad) -> None:
    message = "cannot be made" if isinstance(bad, str) else "cannot be called without arguments"
    with pytest.raises((ValueError, TypeError), match=message):
        if use == LinearMPC.from_env:
            use(bad, **WEIGHTS)
        else:
            use(LinearMPC(TANK, **WEIGHTS, **BOX), bad)


# ---- Faults of episodes are cured, and nothing else is changed ----


class Walk(gym.Env):
    """Draws each step from the global generators, and terminates after some."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float64)

    def __init__(self, last: int = 5) -> None:
        self.last = last

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return self._draw(), {}

    def step(self, action):
        self.steps += 1
        return self._draw(), 0.0, self.steps == self.last, False, {}

    def _draw(self) -> np.ndarray:
        return np.array([np.random.normal() + random.random()])  # noqa: NPY002 (the fault)


def walk(env: gym.Env, seed: int | None) -> list[float]:
    return [env.reset(seed=seed)[0][0]] + [env.step(np.zeros(1))[0][0] for _ in range(4)]


def test_a_seed_repeats_an_episode_and_another_does_not() -> None:
    env = SeededGlobals(Walk())
    first = walk(env, 1)
    later = walk(env, None)  # goes on in the stream
    assert walk(env, 1) == first
    assert walk(env, None) == later != first
    assert walk(env, 2) != first
    # The global generators are left alone.
    np.random.seed(3), random.seed(3)  # noqa: NPY002 (what is to be left alone)
    before = np.random.normal(), random.random()  # noqa: NPY002
    np.random.seed(3), random.seed(3)  # noqa: NPY002
    walk(env, 7)
    assert before == (np.random.normal(), random.random())  # noqa: NPY002


def test_a_step_that_fails_leaves_the_global_generators_alone() -> None:
    env = SeededGlobals(Walk())
    env.reset(seed=0)
    del env.unwrapped.steps
    before = random.getstate()
    generator = get_bit_generator()
    with pytest.raises(AttributeError, match="steps"):
        env.step(np.zeros(1))
    assert random.getstate() == before and get_bit_generator() is generator


def ends(env: gym.Env) -> list[tuple[bool, bool]]:
    env.reset(seed=0)
    return [env.step(np.zeros(1))[2:4] for _ in range(5)]


def test_the_end_at_the_limit_is_truncation_and_an_earlier_one_is_not() -> None:
    late, early = (TruncateAtTimeLimit(Walk(last), 5) for last in (5, 3))
    assert ends(late) == ends(late) == [(False, False)] * 4 + [(False, True)]
    assert ends(early)[2] == (True, False)
    with pytest.raises(ValueError, match="steps = 0 must be a whole number of at least 1"):
        TruncateAtTimeLimit(Walk(), 0)
