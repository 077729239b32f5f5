"""Maps from observations to theta: exact through SB3, saved with a model, refused where wrong."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import RescaleObservation, TimeLimit
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from observation_samples import FAR, HIGH, LOW, MPC, RANDOM, STEADY, Seen, build, error, law, states
from sample_plants import LinearPlant
from sb3_yann import (
    AffineObservation,
    ControlDiagnostics,
    CriticOptions,
    NoActionNoise,
    YannPolicy,
)

# What an env may show of x = theta, and the map that undoes it.
SHOWN = {
    "normalized": (
        lambda x: (x - [1, 2, 3]) / [4, 5, 0.1],
        AffineObservation.normalized([1, 2, 3], [4, 5, 0.1]),
        3,
    ),
    "rescaled": (
        lambda x: 2 * (x - LOW) / (HIGH - LOW) - 1,
        AffineObservation.rescaled(LOW, HIGH),
        3,
    ),
    "absolute": (lambda x: x + STEADY, AffineObservation.deviation(STEADY), 3),
    "reordered, with others between": (
        lambda x: np.stack([x[..., 2], 9 + 0 * x[..., 0], x[..., 0], x[..., 1]], -1),
        AffineObservation.pick([2, 3, 0], 4),
        4,
    ),
    "a set-point and what is to follow it": (
        lambda x: np.stack([3 + 0 * x[..., 0], x[..., 2], x[..., 0] + 3, x[..., 1]], -1),
        AffineObservation.minus_set_point([2, 3, 1], [0, None, None], 4),
        4,
    ),
    "normalized deviations of what is absolute": (
        lambda x: (x - [5, -2, -1]) / [10, 20, 30],
        AffineObservation.deviation([300, 2, 1])
        @ AffineObservation.normalized([305, 0, 0], [10, 20, 30]),
        3,
    ),
}


@pytest.mark.parametrize("shown", SHOWN)
def test_predict_equals_the_law_whatever_the_env_shows(shown) -> None:
    show, observation, size = SHOWN[shown]
    model = build(Seen(show, size), observation)
    assert error(model, show(states()).astype(np.float32), states()) < 1e-5
    for each in (model, copy.deepcopy(model.policy)):
        assert error(each, show(states(1)[0]).astype(np.float32), states(1)[0]) < 1e-5


def test_a_float64_observation_keeps_its_digits() -> None:
    def show(x):
        return x + FAR

    far = AffineObservation.deviation(FAR)
    model = build(Seen(show, 3, dtype=np.float64), far)
    assert error(model, show(states()), states()) < 1e-6
    rounded = build(Seen(show, 3), far)
    assert error(rounded, show(states()).astype(np.float32), states()) > 1e-5
    # SB3's buffer keeps them too, and the critic sees them.
    model.learn(5, callback=NoActionNoise())
    theta = model.policy.theta(model.replay_buffer.observations[:5, 0])
    assert theta.dtype == th.float64
    x = TimeLimit(LinearPlant(MPC), 20)
    x.reset(seed=0)
    np.testing.assert_allclose(theta[0], x.unwrapped.x, atol=1e-10, rtol=0)


def test_frames_stacked_by_sb3_start_as_the_law_and_train() -> None:
    env = VecFrameStack(DummyVecEnv([lambda: Seen(lambda x: x, 3)] * 2), 4)
    model = build(env, AffineObservation.newest_frame(3, 4))
    env.seed(0)
    observations = env.reset()
    for _ in range(6):
        theta = np.array([each.unwrapped.x for each in env.unwrapped.envs])
        assert error(model, observations, theta) < 1e-5
        observations, *_ = env.step(model.predict(observations)[0])
    model.learn(50, callback=[NoActionNoise(), ControlDiagnostics()])


def test_the_map_of_gymnasium_s_rescaling_is_the_one_that_undoes_it() -> None:
    plant = LinearPlant(MPC)
    plant.observation_space = spaces.Box(LOW.astype(np.float32), HIGH.astype(np.float32))
    env = RescaleObservation(plant, np.float32(0), np.float32(3))
    model = build(env, AffineObservation.rescaled(LOW, HIGH, to=(0, 3)))
    observation, _ = env.reset(seed=0)
    assert error(model, observation, plant.x) < 1e-5


# --- the critic ----------------------------------------------------------------------------------


@pytest.mark.parametrize("critic", ["afterstate", "state_action"])
@pytest.mark.parametrize("reward", [(1.0, 0.0), (0.01, 0.0), (3.0, -20.0), (250.0, 7.0)])
def test_sb3_s_own_critic_loss_is_zero_at_the_start(critic, reward) -> None:
    scale, offset = reward
    show, observation, size = SHOWN["normalized"]
    kwargs = {"critic": CriticOptions(critic, reward_scale=scale, reward_offset=offset)}
    model = build(Seen(show, size), observation, policy_kwargs=kwargs)
    model.learn(1)  # sets up the logger
    model.replay_buffer.reset()
    origin = law().locate(np.zeros(3))
    rng = np.random.default_rng(0)
    while model.replay_buffer.size() < 500:
        x = rng.uniform(LOW, HIGH) / 10
        obs = show(x).astype(np.float32)
        x = observation(obs)  # what the observation says, to float64
        u = law()(x)
        following = MPC.model.step(x, u)
        if law().locate(x) != origin or law().locate(following) != origin:
            continue
        gain = -scale * float(MPC.stage_cost(x, u)) + offset
        action = model.policy.scale_action(u.astype(np.float32))
        model.replay_buffer.add(obs, show(following), action, np.array([gain]), np.zeros(1), [{}])
    sample = model.replay_buffer.sample(500)
    with th.no_grad():
        q = model.critic.q1_forward(sample.observations, sample.actions)
    model.train(gradient_steps=1, batch_size=500)
    size_of_q = float((q**2).mean())
    assert model.logger.name_to_value["train/critic_loss"] < 1e-12 * size_of_q
    if offset:
        at_rest = model.critic.q1_forward(
            th.as_tensor(show(np.zeros((1, 3))).astype(np.float32)),
            th.as_tensor(model.policy.scale_action(np.zeros((1, 2), np.float32))),
        )
        assert float(at_rest.detach()) == pytest.approx(offset / (1 - 0.99), rel=1e-6)


def test_both_of_td3_s_critics_are_in_units_of_the_reward() -> None:
    show, observation, size = SHOWN["absolute"]
    kwargs = {"critic": {"reward_scale": 2.0, "reward_offset": -1.0}}
    model = build(Seen(show, size), observation, TD3, policy_kwargs=kwargs)
    plain = build(Seen(show, size), observation, TD3)
    obs = th.as_tensor(show(states(50)).astype(np.float32))
    with th.no_grad():
        actions = model.actor(obs)
        for ours, theirs in zip(
            model.critic(obs, actions), plain.critic(obs, actions), strict=True
        ):
            th.testing.assert_close(ours, 2 * theirs - 100)


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"critic": {"reward_scale": 0}}, ValueError, "reward_scale = 0"),
        ({"critic": {"reward_scale": -1.0}}, ValueError, r"reward_scale = -1\.0"),
        ({"critic": {"reward_scale": None}}, TypeError, "reward_scale = None"),
        ({"critic": {"reward_offset": "a"}}, TypeError, "reward_offset = 'a'"),
        ({"critic": {"reward_offset": np.inf}}, ValueError, "reward_offset = inf"),
        ({"critic": {"reward_offset": 1.0}, "gamma": 1.0}, ValueError, "a discount below 1"),
    ],
)
def test_a_reward_that_means_nothing_is_named(kwargs, error, message) -> None:
    with pytest.raises(error, match=message):
        build(LinearPlant(MPC), None, policy_kwargs=kwargs)


# --- saved and loaded -----------------------------------------------------------------------------


def test_a_map_is_part_of_what_is_saved(tmp_path) -> None:
    show, observation, size = SHOWN["normalized"]
    kwargs = {"critic": CriticOptions(reward_scale=2.0, reward_offset=3.0)}
    model = build(Seen(show, size), observation, policy_kwargs=kwargs)
    model.learn(50, callback=NoActionNoise())
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    obs = show(states(100)).astype(np.float32)
    again = DDPG.load(tmp_path / "model", policy_kwargs=copy.deepcopy(model.policy_kwargs))
    for policy in (again.policy, YannPolicy.load(tmp_path / "policy")):
        assert policy.observation == observation
        np.testing.assert_array_equal(policy.predict(obs)[0], model.predict(obs)[0])
        tensor = th.as_tensor(obs)
        expected = model.critic(tensor, model.actor(tensor))[0]
        assert th.equal(policy.critic(tensor, policy.actor(tensor))[0], expected)
    other = {**model.policy_kwargs, "observation": AffineObservation.identity(3)}
    with pytest.raises(ValueError, match="policy kwargs"):
        DDPG.load(tmp_path / "model", policy_kwargs=other)


def test_maps_compose_like_functions() -> None:
    outer = AffineObservation(np.random.default_rng(1).normal(size=(2, 3)), [5, 6])
    obs = np.random.default_rng(2).normal(size=(7, 5))
    np.testing.assert_allclose((outer @ RANDOM)(obs), outer(RANDOM(obs)), atol=1e-12)
    np.testing.assert_array_equal((outer @ RANDOM)(obs)[0], (outer @ RANDOM)(obs[0]))
    with pytest.raises(ValueError, match="puts out 2 entries, the outer one takes 5"):
        RANDOM @ outer
    with pytest.raises(TypeError):
        RANDOM @ 3


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("observation", "error", "message"),
    [
        (None, ValueError, r"observation has shape \(4,\).*takes theta of shape \(3,\)"),
        (AffineObservation.identity(3), ValueError, r"matrix of shape \(3, 3\).*has shape \(4,\)"),
        (AffineObservation.identity(4), ValueError, r"takes theta of shape \(3,\).*3 rows"),
        (np.eye(3, 4), TypeError, "must be an AffineObservation"),
    ],
)
def test_a_map_that_does_not_fit_is_named(observation, error, message) -> None:
    with pytest.raises(error, match=message):
        build(Seen(lambda x: [*x, 0], 4), observation)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: AffineObservation([1, 2]), ValueError, r"matrix has shape \(2,\)"),
        (lambda: AffineObservation([[1]], [1, 2]), ValueError, "offset has shape"),
        (lambda: AffineObservation([["a"]]), TypeError, "matrix = "),
        (lambda: AffineObservation([[np.nan]]), ValueError, "matrix holds NaN"),
        (lambda: AffineObservation.normalized([0], [0]), ValueError, "std"),
        (lambda: AffineObservation.rescaled([1], [0]), ValueError, "must lie below"),
        (lambda: AffineObservation.rescaled([0], [1], to=3), ValueError, r"to has shape \(\)"),
        (lambda: AffineObservation.identity(-1), ValueError, "size = -1 must be a whole number"),
        (lambda: AffineObservation.pick(["a"], 3), ValueError, r"entries = \['a'\] must be a list"),
        (lambda: AffineObservation.pick(0, 3), ValueError, "entries = 0 must be a list of ind"),
        (
            lambda: AffineObservation.minus_set_point([0], 3, 3),
            ValueError,
            "set_points = 3 must ha",
        ),
        (lambda: AffineObservation.pick([3], 3), ValueError, "indices from 0 to 2"),
        (lambda: AffineObservation.newest_frame(3, 0), ValueError, "frames = 0"),
    ],
)
def test_a_map_that_means_nothing_is_named(make, error, message) -> None:
    with pytest.raises(error, match=message):
        make()
