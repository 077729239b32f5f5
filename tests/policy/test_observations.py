"""Maps from observations to theta: exact through SB3, saved with a model, refused where wrong."""

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import wrappers
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from observation_samples import FAR, HIGH, LOW, MPC, RANDOM, STEADY, Seen, build, error, law, states
from sample_plants import LinearPlant
from sb3_yann import (
    AffineObservation,
    ControlDiagnostics,
    CriticOptions,
    ImprovementGuard,
    NoActionNoise,
    YannPolicy,
    export,
    headroom,
)
from sb3_yann.commissioning.plant import Plant
from sb3_yann.control.wrapper_stack import require_state_shown
from sb3_yann.evaluation import evaluate

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


@pytest.mark.parametrize("critic", ["afterstate", "state_action"])
@pytest.mark.parametrize("reward", [(1.0, 0.0), (0.01, 0.0), (3.0, -20.0), (250.0, 7.0)])
def test_sb3_s_own_critic_loss_is_zero_at_the_start(critic, reward) -> None:
    scale, offset = reward
    show, observation, size = SHOWN["normalized"]
    kwargs = {"critic": CriticOptions(critic, reward_scale=scale, reward_offset=offset)}
    model = build(Seen(show, size), observation, policy_kwargs=kwargs)
    model.learn(0)  # sets up the logger
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
        ({"critic": {"reward_offset": "a"}}, TypeError, "reward_offset = 'a'"),
        ({"critic": {"reward_offset": 1.0}, "gamma": 1.0}, ValueError, "a discount below 1"),
    ],
)
def test_a_reward_that_means_nothing_is_named(kwargs, error, message) -> None:
    with pytest.raises(error, match=message):
        build(LinearPlant(MPC), None, policy_kwargs=kwargs)


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
        (lambda: AffineObservation.minus_set_point([0], 3, 3), ValueError, "set_points = 3 must"),
        (lambda: AffineObservation.pick([3], 3), ValueError, "indices from 0 to 2"),
        (lambda: AffineObservation.newest_frame(3, 0), ValueError, "frames = 0"),
    ],
)
def test_a_map_that_means_nothing_is_named(make, error, message) -> None:
    with pytest.raises(error, match=message):
        make()


def normalize(frozen: bool = True, n_envs: int = 1, **kwargs) -> VecNormalize:
    """Return an env of absolute values, normalized by the statistics of a few steps."""
    plants = [lambda: Seen(lambda x: x + STEADY, 3)] * n_envs
    env = VecNormalize(DummyVecEnv(plants), **{"norm_reward": False, "clip_obs": np.inf} | kwargs)
    env.seed(0)
    env.reset()
    for _ in range(30):
        env.step(np.array([env.action_space.sample() for _ in range(n_envs)]))
    env.training = not frozen
    return env


ABSOLUTE = AffineObservation.deviation(STEADY)


@pytest.mark.slow
def test_the_frozen_statistics_of_a_vec_normalize_are_folded_in(tmp_path) -> None:
    env = normalize(n_envs=2)
    model = build(env, ABSOLUTE @ AffineObservation.from_vec_normalize(env))
    obs = env.normalize_obs((states() + STEADY).astype(np.float32))
    assert error(model, obs, states()) < 1e-5
    # The guard's own env is one without a VecNormalize, as the training env is below its own.
    guard = ImprovementGuard(lambda: Seen(lambda x: x + STEADY, 3), n_eval_episodes=5)
    model.learn(120, callback=[NoActionNoise(), ControlDiagnostics(), guard])
    seen = law().locate(model.policy.theta(env.normalize_obs(env.get_original_obs())).numpy())
    assert guard.state.evidence.scores.visits[:, seen].any()
    starts = guard.state.evidence.starts
    costs = evaluate(law(), TimeLimit(LinearPlant(MPC), 20), starts.seeds).costs
    assert starts.mpc.costs == pytest.approx(costs)
    model.save(tmp_path / "model")
    loaded = DDPG.load(tmp_path / "model", env=env)
    np.testing.assert_array_equal(loaded.predict(obs)[0], model.predict(obs)[0])


def test_statistics_that_change_after_the_model_was_made_are_refused(tmp_path) -> None:
    env = normalize()
    model = build(env, ABSOLUTE @ AffineObservation.from_vec_normalize(env))
    model.learn(2, callback=NoActionNoise())
    kept = copy.deepcopy(env.obs_rms)
    env.training = True
    with pytest.raises(ValueError, match="still moves its statistics"):
        model.learn(2, callback=NoActionNoise())  # the reset has moved them already
    env.training = False
    for guard in (NoActionNoise(), ImprovementGuard(lambda: Seen(lambda x: x + STEADY, 3))):
        with pytest.raises(ValueError, match="others than when the model was made"):
            model.learn(2, callback=guard)
    env.obs_rms = kept
    model.learn(2, callback=NoActionNoise())
    model.save(tmp_path / "model")
    DDPG.load(tmp_path / "model", env=env).learn(2, callback=NoActionNoise())
    env.obs_rms.mean = env.obs_rms.mean + 0.1
    with pytest.raises(ValueError, match="others than when the model was made"):
        DDPG.load(tmp_path / "model", env=env).learn(2, callback=NoActionNoise())


def test_a_loaded_model_whose_statistics_are_lost_is_named(tmp_path) -> None:
    env = normalize()
    plain = Seen(lambda x: x + STEADY, 3)
    build(env, ABSOLUTE @ AffineObservation.from_vec_normalize(env)).save(tmp_path / "model")
    env.save(tmp_path / "statistics")
    with pytest.warns(UserWarning, match=r"its env has none.*VecNormalize\.load"):
        DDPG.load(tmp_path / "model", env=plain)
    loaded = DDPG.load(tmp_path / "model")
    with pytest.raises(ValueError, match=r"its env has none.*VecNormalize\.load"):
        Plant(plain, loaded)
    venv = VecNormalize.load(tmp_path / "statistics", DummyVecEnv([lambda: plain]))
    whole = DDPG.load(tmp_path / "model", env=venv)
    obs = env.normalize_obs((states() + STEADY).astype(np.float32))
    assert error(whole, obs, states()) < 1e-5
    assert "as VecNormalize shows them" in export(whole, tmp_path / "plant.npz").note
    theta = Plant(plain, whole)._theta((states()[0] + STEADY).astype(np.float32))
    np.testing.assert_allclose(theta, states()[0], atol=1e-4)
    whole.save(tmp_path / "again")
    with pytest.warns(UserWarning, match="its env has none"):
        DDPG.load(tmp_path / "again", env=plain)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: normalize(frozen=False), "still moves its statistics"),
        (lambda: normalize(norm_reward=True), "normalizes rewards"),
        (lambda: VecFrameStack(normalize(), 2), "Make VecNormalize the last wrapper"),
        (lambda: DummyVecEnv([lambda: LinearPlant(MPC)]), "holds no VecNormalize"),
    ],
)
def test_a_vec_normalize_that_cannot_be_undone_is_refused(make, message) -> None:
    with pytest.raises(ValueError, match=message):
        AffineObservation.from_vec_normalize(make())


def plant(wrap=lambda env: env) -> gym.Env:
    return wrap(wrappers.TimeLimit(LinearPlant(MPC, 2.0), 20))


def built(env, **policy) -> DDPG:
    options = {"problem": MPC, **policy}
    return DDPG("YannPolicy", env, policy_kwargs=options, device="cpu", buffer_size=100)


class Welford(gym.ObservationWrapper):
    """Keeps a running mean and variance in arrays of its own."""

    def __init__(self, env) -> None:
        super().__init__(env)
        self.mean = np.zeros(3)
        self.m2 = np.ones(3)
        self.count = 1

    def observation(self, observation):
        self.count += 1
        before = observation - self.mean
        self.mean = self.mean + before / self.count
        self.m2 = self.m2 + before * (observation - self.mean)
        shown = (observation - self.mean) / np.sqrt(self.m2 / self.count)
        return shown.astype(self.observation_space.dtype)


class ScaledActions(gym.ActionWrapper):
    """Divides actions by their own running size."""

    def __init__(self, env) -> None:
        super().__init__(env)
        self.running_size = np.ones(env.action_space.shape)

    def action(self, action):
        self.running_size = 0.9 * self.running_size + 0.1 * np.abs(action)
        return action / self.running_size


class Fixed(gym.ObservationWrapper):
    """Shows normalized observations by fixed numbers, and counts its steps."""

    def __init__(self, env) -> None:
        super().__init__(env)
        self.mean = np.array([0.5, 0, -1])
        self.std = np.array([2.0, 1, 3])
        self.steps = 0

    def observation(self, observation):
        self.steps += 1
        return ((observation - self.mean) / self.std).astype(np.float32)


MOVING = [wrappers.NormalizeObservation, Welford, ScaledActions]


def below_another(env):
    return wrappers.TransformReward(wrappers.NormalizeObservation(env), lambda reward: reward)


@pytest.mark.parametrize("wrap", [*MOVING, below_another])
def test_statistics_that_move_are_refused_wherever_an_env_is_met(wrap) -> None:
    match = "by statistics of its own"
    for env in (plant(wrap), DummyVecEnv([lambda: plant(wrap)] * 2)):
        with pytest.raises(ValueError, match=match):
            built(env)
        with pytest.raises(ValueError, match=match):
            built(env, observation=AffineObservation.identity(3))
    model = built(plant())
    law = MPC.explicit()
    for policy in (model, model.policy, law, law.plant_input):
        with pytest.raises(ValueError, match=match):
            evaluate(policy, lambda: plant(wrap), [0])
        with pytest.raises(ValueError, match=match):
            evaluate(policy, plant(wrap), [0])
    evaluate(lambda observation: np.zeros(2), plant(wrap), [0])  # others may act on what they like
    with pytest.raises(ValueError, match=match):
        headroom(MPC, lambda: plant(wrap))
    with pytest.raises(ValueError, match=match):
        model.learn(1, callback=[NoActionNoise(), ImprovementGuard(lambda: plant(wrap))])


def test_an_env_that_is_set_later_is_looked_at_before_the_policy_acts_on_it() -> None:
    model = built(plant())
    model.set_env(plant())
    model.predict(np.zeros(3, np.float32))
    other = plant(Welford)
    model.set_env(other)
    with pytest.raises(ValueError, match="Welford scales"):
        model.learn(5, callback=NoActionNoise())


def boxed() -> gym.Env:
    env = LinearPlant(MPC, 2.0)
    env.observation_space = gym.spaces.Box(np.float32([-4, -5, -6]), np.float32([4, 7, 8]))
    return wrappers.TimeLimit(env, 20)


def test_fixed_scales_are_refused_with_the_map_that_undoes_them() -> None:
    def rescaled() -> gym.Env:
        return wrappers.RescaleObservation(boxed(), np.float32(0), np.float32(1))

    with pytest.raises(ValueError, match="policy_kwargs=") as refused:
        built(rescaled())
    undo = str(refused.value).split("'observation': ")[1].split("}")[0]
    undo = eval(undo, {"AffineObservation": AffineObservation})
    model = built(rescaled(), observation=undo)
    theta = model.policy.theta(rescaled().reset(seed=3)[0][None]).ravel()
    np.testing.assert_allclose(theta, boxed().reset(seed=3)[0], atol=1e-5)
    expected = evaluate(MPC.explicit(), boxed, [3]).costs
    assert np.isclose(evaluate(model, rescaled, [3]).costs, expected, rtol=1e-4)
    with pytest.raises(ValueError, match="RescaleObservation shows other numbers"):
        evaluate(built(boxed()), rescaled, [3])


def test_a_frozen_normalization_is_refused_with_the_map_that_undoes_it() -> None:
    env = wrappers.NormalizeObservation(plant())
    env.reset(seed=0)
    for _ in range(10):
        env.step(env.action_space.sample())
    env.update_running_mean = False
    with pytest.raises(ValueError, match=r"AffineObservation\.normalized\(\["):
        built(env)
    built(env, observation=AffineObservation.identity(3))


def test_stacked_and_late_observations_are_named_unless_they_are_meant() -> None:
    stacked = VecFrameStack(DummyVecEnv([plant]), 3)
    with pytest.raises(ValueError, match=r"newest_frame\(3, 3\)"):
        built(stacked)  # its size alone would be refused, with other advice
    require_state_shown(stacked, observation_given=True)
    require_state_shown(VecFrameStack(DummyVecEnv([plant]), 1), observation_given=False)
    with pytest.warns(UserWarning, match="DelayObservation shows past states"):
        built(wrappers.DelayObservation(plant(), 2))
    with pytest.warns(UserWarning, match="StickyAction repeats past inputs"):
        built(wrappers.StickyAction(plant(), 0.1))


def test_wrappers_of_rewards_and_of_fixed_numbers_pass() -> None:
    rewards = wrappers.NormalizeReward(plant())
    require_state_shown(rewards, observation_given=False)
    with pytest.warns(UserWarning, match="NormalizeReward divides .* for which the critic stands"):
        built(rewards)
    rewards.update_running_mean = False
    built(rewards)  # a warning would be an error
    require_state_shown(wrappers.RecordEpisodeStatistics(plant()), observation_given=False)
    require_state_shown(Fixed(plant()), observation_given=False)
