"""Episodes of a twin that step as one array are those of its env."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_yann import NoActionNoise, PlantTwin
from twin_samples import log, problem, twin


def uneven() -> PlantTwin:
    """A twin of episodes that do not end together."""
    cut = [(x[: 61 - 10 * i], u[: 60 - 10 * i]) for i, (x, u) in enumerate(log(5))]
    return PlantTwin.fit(problem(), cut, residuals=["quadratic"])


def act(observations):
    return np.clip(-observations[:, :1] - observations[:, 1:2], -1, 1)


@pytest.mark.parametrize("member", [None, 2])
def test_a_copy_plays_the_episodes_of_the_env_from_the_same_seed(member) -> None:
    found, n, steps = uneven(), 6, 130
    env = found.vector_env(n, member)
    seen, info = env.reset(seed=20)
    singles = [found.env(member) for _ in range(n)]
    single = [each.reset(seed=20 + i) for i, each in enumerate(singles)]
    assert info["member"].tolist() == [each[1]["member"] for each in single]
    expected, ended = np.array([each[0] for each in single]), 0
    for _ in range(steps):
        np.testing.assert_allclose(seen, expected, rtol=1e-5, atol=1e-7)
        actions = act(expected)
        seen, rewards, terminated, truncated, info = env.step(actions)
        for i, each in enumerate(singles):
            expected[i], reward, _, over, own = each.step(actions[i])
            np.testing.assert_allclose([rewards[i], -info["cost"][i]], reward, rtol=1e-9)
            assert info["violation"][i] == own["violation"] and truncated[i] == over
            if over:
                np.testing.assert_allclose(info["final_obs"][i], expected[i], rtol=1e-5)
                expected[i], ended = each.reset()[0], ended + 1
        assert not terminated.any()
    assert ended > 2 * n


def test_the_vec_env_does_what_stable_baselines3_makes_of_the_envs() -> None:
    found = uneven()
    ours, theirs = found.vec_env(4), DummyVecEnv([found.env] * 4)
    for each in (ours, theirs):
        each.seed(7)
    seen, expected, ended = ours.reset(), theirs.reset(), 0
    for _ in range(100):
        np.testing.assert_allclose(seen, expected, rtol=1e-5, atol=1e-7)
        actions = act(expected)
        seen, rewards, dones, infos = ours.step(actions)
        expected, expected_rewards, expected_dones, expected_infos = theirs.step(actions)
        np.testing.assert_allclose(rewards, expected_rewards, rtol=1e-6)
        np.testing.assert_array_equal(dones, expected_dones)
        for info, other in zip(infos, expected_infos, strict=True):
            assert info.keys() == other.keys()
            assert info["TimeLimit.truncated"] == other["TimeLimit.truncated"]
            if "terminal_observation" in info:
                last = other["terminal_observation"]
                np.testing.assert_allclose(info["terminal_observation"], last, rtol=1e-5)
                ended += 1
    assert ended > 4 and ours.observation_space.problem == problem()


def test_a_model_trains_in_it() -> None:
    model = DDPG("YannPolicy", twin().vec_env(8), seed=0, learning_starts=0, train_freq=1)
    model.learn(560, callback=NoActionNoise())
    assert model.num_timesteps == 560 and len(model.ep_info_buffer) == 0  # no monitor
    assert [len(each) for each in PlantTwin.from_buffer(model).episodes] == [60, 10] * 8


def test_spaces_starts_and_what_is_no_action() -> None:
    env = twin().vector_env(3)
    assert env.observation_space.shape == (3, 2) and env.action_space.shape == (3, 1)
    assert env.single_observation_space == twin().env().observation_space
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((3, 1)))
    starts = np.array([[0.1, 0.0], [0.2, 0.1], [2.9, 2.9]])
    np.testing.assert_allclose(env.reset(options={"state": starts})[0], starts, rtol=1e-6)
    assert env.step(np.zeros((3, 1)))[-1]["violation"].tolist() == [False, False, True]
    for actions in (np.zeros((2, 1)), np.full((3, 1), np.nan)):
        with pytest.raises(ValueError, match=r"must be \(3, 1\) finite numbers"):
            env.step(actions)
    with pytest.raises(ValueError, match="seed has 2 entries for 3 episodes"):
        env.reset(seed=[1, 2])
    with pytest.raises(ValueError, match="n_envs"):
        twin().vector_env(0)
