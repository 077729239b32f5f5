"""A VecNormalize with frozen statistics is folded into the map to theta; others are refused."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from observation_samples import MPC, STEADY, Seen, build, error, law, states
from sample_plants import LinearPlant
from sb3_yann import (
    AffineObservation,
    ControlDiagnostics,
    ImprovementGuard,
    NoActionNoise,
)
from sb3_yann.commissioning.plant import Plant


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
    evidence = guard.state.evidence
    assert evidence.starts.mpc.costs == pytest.approx(mpc_costs(evidence.starts.seeds))
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
    theta = Plant(plain, whole)._theta((states()[0] + STEADY).astype(np.float32))
    np.testing.assert_allclose(theta, states()[0], atol=1e-4)
    whole.save(tmp_path / "again")
    with pytest.warns(UserWarning, match="its env has none"):
        DDPG.load(tmp_path / "again", env=plain)


def mpc_costs(seeds) -> list[float]:
    """Return the cost of the explicit law itself, in float64."""
    costs = []
    for seed in seeds:
        plant = LinearPlant(MPC)
        cost = 0.0
        plant.reset(seed=seed)
        for _ in range(20):
            cost -= plant.step(law()(plant.x))[1]
        costs.append(cost)
    return costs


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
