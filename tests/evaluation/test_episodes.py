"""Seeded, paired episodes, and what is printed and drawn of them."""

import sys
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import unit_samples as units
from sb3_yann._validation import message_of
from sb3_yann.env_pool import EnvPool
from sb3_yann.evaluation import Trajectories, evaluate
from sb3_yann.policy import AffineObservation

SEEDS = range(3)


@pytest.mark.parametrize("env_id", ["CSTR-v0", "ClippedPendulum-v0"])
@pytest.mark.parametrize("start", [None, -0.9])
def test_episodes_of_a_vectorized_env_are_those_of_single_ones_to_rounding(env_id, start) -> None:
    env = gym.make(env_id)
    law = env.observation_space.problem.explicit()
    n = env.observation_space.shape[0]
    starts = None if start is None else [np.full(n, start * k / 2) * np.eye(n)[-1] for k in SEEDS]
    assert gym.spec(env_id).vector_entry_point is not None
    together = evaluate(law, env_id, SEEDS, starts)
    alone = evaluate(law, env, SEEDS, starts)
    np.testing.assert_allclose(together.costs, alone.costs, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(together.violations, alone.violations)
    np.testing.assert_array_equal(together.terminated, alone.terminated)
    for name in ("observations", "actions"):
        for a, b in zip(getattr(together, name), getattr(alone, name), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def assert_equal(one: Trajectories, other: Trajectories) -> None:
    np.testing.assert_array_equal(one.costs, other.costs)
    np.testing.assert_array_equal(one.violations, other.violations)
    for name in ("observations", "actions"):
        for a, b in zip(getattr(one, name), getattr(other, name), strict=True):
            np.testing.assert_array_equal(a, b)


class Countdown(gym.Env):
    """Starts at the state that it is given, or at its seed, and ends at 0; each step costs that."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    open = 0

    def __init__(self) -> None:
        Countdown.open += 1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = seed if options is None else int(options["state"][0])
        return np.full(1, self.left, np.float32), {}

    def step(self, action):
        reward = -float(self.left + action[0])
        if self.left == 13:
            raise ArithmeticError("thirteen")
        action[...] = 9  # an env may write into what it is given
        violation = self.left == 2
        self.left -= 1
        observation = np.full(1, self.left, np.float32)
        return observation, reward, self.left == 0, False, {"violation": violation}

    def close(self) -> None:
        Countdown.open -= 1


class Tenth:
    """A policy that remembers how many observations it saw at a time."""

    def __init__(self) -> None:
        self.batches: list[int] = []

    def predict(self, observation, *, deterministic):
        assert deterministic
        self.batches.append(len(observation))
        return observation / 10, None


def test_episodes_of_different_length_wait_for_nobody() -> None:
    policy = Tenth()
    episodes = evaluate(policy, Countdown, [3, 1, 4])
    assert policy.batches == [3, 2, 2, 1]
    np.testing.assert_allclose(episodes.costs, [1.1 * 6, 1.1, 1.1 * 10], rtol=1e-6)
    assert episodes.violations.tolist() == [1, 0, 1]
    assert [len(each) for each in episodes.observations] == [4, 2, 5]
    assert [each[:, 0].tolist() for each in episodes.observations][:2] == [[3, 2, 1, 0], [1, 0]]
    np.testing.assert_allclose(episodes.actions[0][:, 0], [0.3, 0.2, 0.1], rtol=1e-6)
    assert_equal(episodes, evaluate(Tenth(), Countdown(), [3, 1, 4]))


def test_an_answer_that_lacks_something_is_named(monkeypatch) -> None:
    whole = Countdown.step
    monkeypatch.setattr(Countdown, "step", lambda self, action: whole(self, action)[:4])
    with pytest.raises(TypeError, match=r"step returned \(ndarray, float, bool, bool\), expected"):
        evaluate(Tenth(), Countdown, [3])


@pytest.mark.parametrize("version", [(3, 10), (3, 11)])
def test_an_error_of_an_env_says_in_which_episode_and_step(version, monkeypatch) -> None:
    monkeypatch.setattr("sys.version_info", min(version, tuple(sys.version_info)))
    with pytest.raises(ArithmeticError, match="thirteen") as raised:
        evaluate(Tenth(), Countdown, [3, 15])
    assert "in step 3 of the episode from the seed 15" in message_of(raised.value)


def test_a_pool_plays_in_the_envs_that_it_has_and_makes_only_what_it_lacks() -> None:
    made: list[Countdown] = []

    def make() -> Countdown:
        made.append(Countdown())
        return made[-1]

    before = Countdown.open
    pool = EnvPool(make)
    first = evaluate(Tenth(), pool, [3, 1])
    again = evaluate(Tenth(), pool, [3, 1, 4])
    assert len(made) == 3 and Countdown.open == before + 3
    np.testing.assert_array_equal(again.costs[:2], first.costs)
    np.testing.assert_array_equal(again.costs, evaluate(Tenth(), Countdown, [3, 1, 4]).costs)
    pool.close()
    assert Countdown.open == before


def test_a_model_of_another_env_is_named() -> None:
    model = DDPG("YannPolicy", "ClippedPendulum-v0", device="cpu")
    with pytest.raises(
        ValueError, match=r"env has observations of shape \(4,\) .*the model \(2,\)"
    ):
        evaluate(model, "CSTR-v0", seeds=[0])
    tripled = lambda: gym.wrappers.RescaleAction(gym.make("ClippedPendulum-v0"), -3, 3)  # noqa: E731
    with pytest.raises(ValueError, match="in the same wrappers"):
        evaluate(model, tripled, seeds=[0])


def test_a_law_in_an_env_of_other_inputs_is_told() -> None:
    mpc = units.plant_mpc()
    make = partial(units.plant, "plant", "plant")
    scaled = lambda: gym.wrappers.RescaleAction(make(), np.float64(-1), np.float64(1))  # noqa: E731
    with pytest.warns(UserWarning, match="in other units, wrap it in gymnasium.wrappers.Rescale"):
        evaluate(mpc.explicit(), scaled, seeds=[0])


def test_a_model_that_sees_normalized_observations_is_shown_them() -> None:
    venv = VecNormalize(DummyVecEnv([lambda: gym.make("ClippedPendulum-v0")]), norm_reward=False)
    venv.obs_rms.mean[:] = 0.3, -0.2
    venv.obs_rms.var[:] = 2, 5
    venv.training = False
    seen = {"observation": AffineObservation.from_vec_normalize(venv)}
    model = DDPG("YannPolicy", venv, policy_kwargs=seen, device="cpu")
    plain = DDPG("YannPolicy", "ClippedPendulum-v0", device="cpu")
    costs = [evaluate(each, "ClippedPendulum-v0", SEEDS).costs for each in (model, plain)]
    np.testing.assert_allclose(*costs, rtol=1e-4)


def test_an_env_that_is_given_stays_open() -> None:
    env = Countdown()
    before = Countdown.open
    evaluate(Tenth(), env, [3, 1])
    assert Countdown.open == before


def test_a_law_is_played_in_plant_units() -> None:
    mpc = units.plant_mpc()
    make = partial(units.plant, "plant", "plant")
    own = partial(units.plant, "deviation", "deviation")
    expected = evaluate(mpc.deviations.explicit(), own, SEEDS).costs
    for law in (mpc.explicit(), mpc.online(), mpc.explicit().plant_input):
        np.testing.assert_allclose(evaluate(law, make, SEEDS).costs, expected, rtol=1e-9)
    with pytest.raises(ValueError, match=r"from \[-2.*which are deviations, .*u_ss = \[40.0\]"):
        evaluate(mpc.explicit(), own, SEEDS)


def short_reactor() -> gym.Env:
    return gym.make("CSTR-v0", max_episode_steps=3)


NOT_A_FUNCTION = 3


def test_a_function_that_makes_envs_may_be_named_by_its_module() -> None:
    law = gym.make("CSTR-v0").observation_space.problem.explicit()
    named = evaluate(law, f"{__name__}:short_reactor", [4, 5])
    given = evaluate(law, short_reactor, [4, 5])
    assert [len(each) for each in named.actions] == [3, 3]
    np.testing.assert_array_equal(named.costs, given.costs)
    registered = evaluate(law, "sb3_yann_envs:CSTR-v0", [4])  # as gymnasium has it
    assert [len(each) for each in registered.actions] == [400]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("no_such_module:make", "'no_such_module' cannot be imported"),
        (f"{__name__}:nothing", "has no function 'nothing' that makes an env"),
        (f"{__name__}:NOT_A_FUNCTION", "has no function 'NOT_A_FUNCTION' that makes an env"),
    ],
)
def test_a_name_that_leads_to_no_env_is_reported(name, said) -> None:
    with pytest.raises(ValueError, match=said):
        evaluate(lambda _: [0.0], name, [0])


class Goal(gym.Wrapper):
    def step(self, action):
        observation, reward, _, truncated, info = self.env.step(action)
        return observation, reward, True, truncated, {**info, "is_success": True}


def test_an_end_that_is_a_success_is_no_termination_that_counts() -> None:
    act = lambda _: [0.0]  # noqa: E731
    assert not evaluate(act, lambda: Goal(gym.make("CSTR-v0")), [0]).terminated.any()
