"""The twin as an env: Gymnasium's, with the plant's spaces, and good for the learner and guard."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import DDPG

from general_problems import level, servo, solved
from sample_plants import LinearPlant
from sb3_yann import ImprovementGuard, LinearMPC, NoActionNoise, PlantTwin, SoftBounds, YannPolicy
from sb3_yann.compare import EXCESS_ROOM
from sb3_yann.evaluation import evaluate
from sb3_yann.twin.dynamics import Coordinates
from sb3_yann.twin.env import Limits, Starts
from sb3_yann.twin.log import Episode
from sb3_yann.twin.row_layout import RowLayout
from twin_samples import Cart, problem, random_episode, twin


def test_it_is_an_env_with_the_plant_s_spaces() -> None:
    env = twin().env()
    check_env(env, skip_render_check=True)
    assert env.observation_space == Cart().observation_space
    assert env.action_space == Cart().action_space
    assert env.observation_space.problem == problem()


def test_an_episode_is_its_seed_s_member_s_costs_the_stage_cost_and_is_as_long_as_logged() -> None:
    found = twin()
    env = found.env()
    steps = 0
    over = False
    np.testing.assert_array_equal(env.reset(seed=5)[0], env.reset(seed=5)[0])
    assert [env.reset(seed=k)[1]["member"] for k in range(7)] == [0, 1, 2, 3, 4, 0, 1]
    _, info = env.reset(seed=8)
    while not over:
        before = info["state"]
        u = np.float32([np.sin(steps)])
        _, reward, terminated, over, info = env.step(u)
        assert reward == -info["cost"] == -float(problem().stage_cost(before, u.astype(float)))
        expected = found.dynamics.step(np.tile(before, (5, 1, 1)), np.tile(u, (5, 1, 1)))[3, 0]
        np.testing.assert_allclose(info["state"], expected, rtol=1e-12, atol=1e-12)
        steps += 1
    assert steps == 60 and not terminated


def test_a_model_trains_in_it_under_a_guard_that_plays_every_member() -> None:
    found = twin()
    model = DDPG(YannPolicy, found.env(), seed=0, learning_starts=0, batch_size=32)
    guard = ImprovementGuard(found, n_eval_episodes=10, n_new_starts=0)
    model.learn(180, callback=[NoActionNoise(), guard])
    assert guard.state.evidence.starts.mpc.costs.shape == (10,)
    assert guard.settings.of_evidence["env"] == "PlantTwin.env"


def held() -> tuple[PlantTwin, list[Episode]]:
    """The twin of a servo whose set-point moves at each step, from episodes of two lengths."""
    mpc = solved("servo")
    logs = [random_episode(mpc, steps, seed) for seed, steps in enumerate((9, 14, 9))]
    given = [(each.thetas, each.actions) for each in logs]
    found = PlantTwin.fit(mpc, given, residuals=["none"], n_members=2)
    sure = dataclasses.replace(found.trust, problems=())
    return dataclasses.replace(found, trust=sure), logs


def test_an_episode_takes_set_points_and_length_of_a_logged_one() -> None:
    found, logs = held()
    env = found.env()
    mpc = found.problem
    seen = set()
    for seed in range(12):
        theta, info = env.reset(seed=seed)
        np.testing.assert_array_equal(theta, info["state"].astype(np.float32))
        (k,) = (i for i, each in enumerate(logs) if each.thetas[0, 2] == info["state"][2])
        seen.add(k)
        assert np.all(info["state"][:2] >= found.starts.low)
        assert np.all(info["state"][:2] <= found.starts.high)
        over = False
        steps = 0
        while not over:
            before = info["state"]
            theta, reward, _, over, info = env.step(np.float32([5.0]))  # beyond the bound of 2
            steps += 1
            assert info["state"][2] == logs[k].thetas[steps, 2]
            assert reward == -mpc.stage_cost(before, [2.0])
            expected = mpc.model.A @ before[:2] + mpc.model.B @ [2.0]
            np.testing.assert_allclose(info["state"][:2], expected, atol=1e-12)
            assert info["violation"] == found.limits.violated(info["state"])
        assert steps == len(logs[k])
    assert seen == {0, 1, 2}


def test_an_episode_may_begin_where_it_is_asked_to() -> None:
    found, logs = held()
    env = found.env()
    env.reset(seed=0)
    states = [env.reset(options={"state": [0.3, -0.2, 0.1]})[1]["state"] for _ in range(2)]
    np.testing.assert_array_equal(states, [[0.3, -0.2, 0.1]] * 2)
    _, info = env.reset(options={"state": [0.3, -0.2]})
    np.testing.assert_array_equal(info["state"][:2], [0.3, -0.2])
    assert info["state"][2] in {each.thetas[0, 2] for each in logs}
    for given, message in (
        ([0.3], r"of the shape \(2,\) or \(3,\)"),
        ([0.3, np.nan], "must be finite numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            env.reset(options={"state": given})
    for action in ([np.nan], [0.0, 0.0]):
        with pytest.raises(ValueError, match="finite numbers"):
            env.step(np.array(action))
    with pytest.raises(gym.error.ResetNeeded):
        found.env().step(np.zeros(1))


def test_a_start_is_the_rarer_the_farther_it_lies_outside_the_range_of_the_log() -> None:
    starts = twin().starts
    k = len(twin().episodes)
    middle = (starts.high + starts.low) / 2
    half = np.ptp(starts.first[:, :2], axis=0) / 2
    at = middle + half * np.array([[0.0, 0.0], [0.9, -1.0], [0.0, 2.0], [-3.0, 0.5]])
    expected = 2 / (k + 1) * np.array([1, 1, 1.5 ** (1 - k), 2.0 ** (1 - k)])
    np.testing.assert_allclose(starts.chance_beyond(at), expected)


@pytest.mark.parametrize("few", [2, 3, 4])
def test_few_episodes_show_no_more_than_five_of_the_same_range_do(few: int) -> None:
    mpc = problem()
    first = np.linspace(-0.2, 0.2, 5)[:, None] * np.ones(mpc.n_theta)
    ends = np.full((2, 2), [[-0.3], [0.3]])
    five, fewer = (
        Starts(RowLayout(mpc), *ends, each, np.zeros((1, mpc.n_theta))).shown
        for each in (first, first[[0, -1, 2, 3][:few]])
    )
    np.testing.assert_array_equal(fewer, five)
    # Of five, one in twenty lies beyond 2.2 times their range: 2 / 6 ((1 + 2.214) / 2) ** -4.
    np.testing.assert_allclose(five[1], 0.2 * 2.214, rtol=1e-3)


def limits_of(mpc: LinearMPC, **box: np.ndarray) -> Limits:
    k = mpc.model.n_states + mpc.model.n_inputs
    low = np.full(k, -0.5)
    high = np.full(k, 0.7)
    coordinates = Coordinates(low, high, np.ones(k), np.ones(2), RowLayout(mpc))
    given = {"low": np.array([-1.0, -0.1]), "high": np.array([0.2, 1.5])} | box
    row = np.zeros((2, mpc.n_theta))
    return Limits.of(coordinates, Starts(RowLayout(mpc), given["low"], given["high"], row, row))


def test_the_limits_hold_the_data_and_the_starts_with_a_quarter_of_their_width() -> None:
    found = limits_of(problem())
    np.testing.assert_allclose(found.low, [-1.0 - 0.3, -0.5], atol=1e-8)
    np.testing.assert_allclose(found.high, [0.7, 1.5 + 0.4], atol=1e-8)
    assert np.all(found.low < [-1.3, -0.5]) and np.all(found.high > [0.7, 1.9])  # by rounding
    for at, beyond in (([-1.31, 0.0], True), ([-1.29, 1.89], False), ([0.0, 1.91], True)):
        assert found.violated(np.array(at)) == beyond


def test_hard_bounds_cut_the_limits_and_soft_ones_do_not() -> None:
    own = {"tracking": None, "x_min": [-0.4, -0.3], "x_max": [0.3, 0.6], "theta_min": -5,
           "theta_max": 5}  # fmt: skip
    hard = servo(**own)
    soft = servo(**own, soft=SoftBounds([0.0, 1.0], penalty=300))
    np.testing.assert_allclose(limits_of(hard).low, [-0.4, -0.3], atol=1e-7)
    np.testing.assert_allclose(limits_of(hard).high, [0.3, 0.6], atol=1e-7)
    found = limits_of(soft)
    np.testing.assert_allclose(found.low, [-0.4, -0.5], atol=1e-7)
    np.testing.assert_allclose(found.high, [0.3, 1.9], atol=1e-7)
    tank = level()
    law = tank.explicit()
    plant = TimeLimit(LinearPlant(tank, np.array([1.0, 1.8])), 20)  # to the bound, and beyond it
    env = PlantTwin.fit(tank, evaluate(law, plant, range(6)).pairs, residuals=["none"]).env()
    for push, half_widths in ((3e-4, 5e-4), (3e-3, 5e-3)):  # of which 1e-3 are no violation
        played = evaluate(lambda theta, push=push: law(theta) + push, env, range(6))
        assert max(each[:, 0].max() for each in played.observations) > 1 + 0.9 * half_widths
        assert played.violations.any() == (half_widths > EXCESS_ROOM)
