"""The twin as an env: Gymnasium's, with the plant's spaces, and good for the learner and guard."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import DDPG

from sb3_yann import ImprovementGuard, NoActionNoise, YannPolicy
from twin_samples import Cart, problem, twin


def test_it_is_an_env_with_the_plant_s_spaces() -> None:
    env = twin().env()
    check_env(env, skip_render_check=True)
    assert env.observation_space == Cart().observation_space
    assert env.action_space == Cart().action_space
    assert env.observation_space.problem == problem()


def test_an_episode_is_that_of_a_member_costs_the_stage_cost_and_is_as_long_as_the_log_s() -> None:
    found = twin()
    env, steps, over = found.env(member=3), 0, False
    _, info = env.reset(seed=7)
    assert info["member"] == 3
    while not over:
        before, u = info["state"], np.float32([np.sin(steps)])
        _, reward, terminated, over, info = env.step(u)
        assert reward == -info["cost"] == -float(problem().stage_cost(before, u.astype(float)))
        expected = found.dynamics.step(np.tile(before, (5, 1, 1)), np.tile(u, (5, 1, 1)))[3, 0]
        np.testing.assert_allclose(info["state"], expected, rtol=1e-12, atol=1e-12)
        steps += 1
    assert steps == 60 and not terminated


def test_seeds_name_the_members_and_repeat_an_episode() -> None:
    env = twin().env()
    assert [env.reset(seed=k)[1]["member"] for k in range(7)] == [0, 1, 2, 3, 4, 0, 1]
    np.testing.assert_array_equal(env.reset(seed=5)[0], env.reset(seed=5)[0])
    given = env.reset(options={"state": [0.3, -0.2]})[0]
    np.testing.assert_allclose(given, [0.3, -0.2], rtol=1e-6)


def test_leaving_what_the_log_shows_is_a_violation() -> None:
    env = twin().env()
    env.reset(seed=0, options={"state": [2.9, 2.9]})
    assert env.step(np.zeros(1))[-1]["violation"]
    env.reset(seed=0, options={"state": [0.1, 0.0]})
    assert not env.step(np.zeros(1))[-1]["violation"]


@pytest.mark.parametrize("action", [[np.nan], [0.0, 0.0]])
def test_an_action_that_is_none_is_refused(action) -> None:
    env = twin().env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="finite numbers"):
        env.step(np.array(action))
    with pytest.raises(ValueError, match="member = 9 must be below 5"):
        twin().env(member=9)


def test_a_model_trains_in_it_under_a_guard_that_plays_every_member() -> None:
    found = twin()
    model = DDPG(YannPolicy, found.env(), seed=0, learning_starts=0, batch_size=32)
    guard = ImprovementGuard(found, n_starts=10, n_new_starts=0)
    model.learn(180, callback=[NoActionNoise(), guard])
    assert guard.state.evidence.mpc.costs.shape == (10,)
    assert guard.acceptance.settings["env"] == "PlantTwin.env"


def test_a_start_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match=r"options\['state'\] = \[nan, 0.0\] must be finite"):
        twin().env().reset(options={"state": [np.nan, 0.0]})
    with pytest.raises(ValueError, match=r"options = \{'start': 0\} must be \{'state': starts\}"):
        twin().vector_env(2).reset(options={"start": 0})
