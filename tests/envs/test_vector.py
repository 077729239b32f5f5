"""The vectorized environments are the single ones, many at a time."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import sb3_yann_envs  # noqa: F401 (registers)

IDS = {"CSTR-v0": 400, "ClippedPendulum-v0": 200}


def inputs(env, steps: int) -> np.ndarray:
    """Random inputs, a tenth beyond the bounds, so that some are clipped."""
    space = env.single_action_space
    shape = (steps, env.num_envs, 1)
    return np.random.default_rng(0).uniform(1.1 * space.low, 1.1 * space.high, shape)


@pytest.mark.parametrize("env_id", IDS)
def test_each_copy_is_the_single_environment(env_id) -> None:
    seeds = [3, 14, 15, 9]
    many = gymnasium.make_vec(env_id, num_envs=4)
    ones = [gymnasium.make(env_id) for _ in seeds]
    observation, info = many.reset(seed=seeds)
    firsts = [env.reset(seed=seed) for env, seed in zip(ones, seeds, strict=True)]
    np.testing.assert_array_equal(observation, [first[0] for first in firsts])
    np.testing.assert_array_equal(info["state"], [first[1]["state"] for first in firsts])
    for actions in inputs(many, 50):
        observation, reward, terminated, truncated, info = many.step(actions)
        steps = [env.step(u) for env, u in zip(ones, actions, strict=True)]
        single = [np.array(each) for each in zip(*(step[:4] for step in steps), strict=True)]
        np.testing.assert_allclose(observation, single[0], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(reward, single[1], rtol=1e-10)
        np.testing.assert_array_equal(terminated, single[2])
        np.testing.assert_array_equal(truncated, single[3])
        for name in ("cost", "violation", "state"):
            expected = [step[4][name] for step in steps]
            np.testing.assert_allclose(info[name], expected, rtol=1e-9, atol=1e-12)
            assert info[f"_{name}"].all()
        if terminated.any():
            break


def test_copies_far_from_the_random_starts_are_integrated_as_the_single_environment_is() -> None:
    starts = [[0, 0, 0, 0], [2, 2, 2, 0], [0.1, 2, 0, 3], [2, 0, 2, -30]]
    many = gymnasium.make_vec("CSTR-v0", num_envs=4)
    many.reset(options={"state": starts})
    *_, info = many.step(np.zeros((4, 1), np.float32))
    for start, state in zip(starts, info["state"], strict=True):
        one = gymnasium.make("CSTR-v0")
        one.reset(options={"state": start})
        expected = one.step(np.zeros(1, np.float32))[4]["state"]
        np.testing.assert_allclose(state, expected, rtol=1e-11, atol=1e-12)


def test_a_seed_of_numpy_is_a_seed() -> None:
    env = gymnasium.make_vec("CSTR-v0", num_envs=2)
    np.testing.assert_array_equal(env.reset(seed=np.int64(7))[0], env.reset(seed=7)[0])


@pytest.mark.parametrize("env_id", IDS)
def test_observations_are_in_the_space_and_the_time_limit_is_the_registered_one(env_id) -> None:
    env = gymnasium.make_vec(env_id, num_envs=3)
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    rest = np.zeros((3, 1), np.float32)
    for step in range(1, IDS[env_id] + 1):
        observation, _, terminated, truncated, _ = env.step(rest)
        assert observation in env.observation_space and not terminated.any()
        assert truncated.all() == (step == IDS[env_id])


def test_an_episode_that_is_over_starts_again_at_the_next_step() -> None:
    env = gymnasium.make_vec("CSTR-v0", num_envs=2)
    env.reset(seed=[0, 1], options={"state": [[0, 0, 0, 4.9], [0, 0, 0, -7.0]]})
    hot = np.array([[-55.0], [0.0]])
    for _ in range(40):
        last, reward, terminated, _, info = env.step(hot)
        if terminated[0]:
            break
    assert terminated.tolist() == info["violation"].tolist() == [True, False]
    assert reward[0] < -1e5 < reward[1]
    after, reward, terminated, truncated, _ = env.step(hot)
    assert reward[0] == 0 and not terminated.any() and not truncated.any()
    fresh = gymnasium.make("CSTR-v0")
    fresh.reset(seed=0, options={"state": [0, 0, 0, 4.9]})
    np.testing.assert_array_equal(after[0], fresh.reset()[0])  # the next start of seed 0
    assert not np.array_equal(after[1], last[1]) and reward[1] != 0


def test_what_does_not_fit_is_refused() -> None:
    env = gymnasium.make_vec("CSTR-v0", num_envs=2)
    with pytest.raises(gymnasium.error.ResetNeeded, match="no episode has begun"):
        env.step(np.zeros((2, 1)))
    with pytest.raises(ValueError, match="seed has 3 entries for 2 episodes"):
        env.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match=r"state.* has 1 entries for 2 episodes"):
        env.reset(options={"state": [[0, 0, 0, 0]]})
    with pytest.raises(ValueError, match=r"T deviation must be in"):
        env.reset(options={"state": [[0, 0, 0, 0], [0, 0, 0, 9]]})
    with pytest.raises(ValueError, match="unknown keys"):
        env.reset(options={"start": [[0, 0, 0, 0]] * 2})
    for either in (env, gymnasium.make("CSTR-v0")):
        with pytest.raises(ValueError, match=r"\['state'\] is None: leave it out"):
            either.reset(options={"state": None})
    env.reset(seed=0)
    for wrong in (np.zeros(2), np.full((2, 1), np.nan)):
        with pytest.raises(ValueError, match=r"actions must be numbers of shape \(2, 1\)"):
            env.step(wrong)
