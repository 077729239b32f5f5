"""Several envs at once, in this process or in others: callbacks, time limits, ends of episodes."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize

from sample_plants import Ending, LinearPlant, two_input_mpc
from sb3_yann import (
    AffineObservation,
    ControlDiagnostics,
    CostAudit,
    ImprovementGuard,
    NoActionNoise,
    YannPolicy,
)

MPC = two_input_mpc()
STEPS = 6


def plant(start: float = 1.0) -> gym.Env:
    return TimeLimit(LinearPlant(MPC, start), STEPS)


def build(env, algorithm=DDPG, policy=None, **kwargs):
    options = {"problem": MPC, "critic_warmup": 0, **(policy or {})}
    kwargs = {"seed": 0, "buffer_size": 1000, "learning_rate": 1e-2, **kwargs}
    return algorithm(YannPolicy, env, policy_kwargs=options, **kwargs)


def transitions(model, name: str) -> np.ndarray:
    return getattr(model.replay_buffer, name)[: model.replay_buffer.pos]


def assert_every_action_is_the_law_s(model) -> None:
    theta = transitions(model, "observations").reshape(-1, 3)
    u = model.policy.unscale_action(transitions(model, "actions").reshape(-1, 2))
    far = np.abs(u - MPC.explicit()(theta)) / (MPC.u_max - MPC.u_min)
    assert far.max() < 1e-5


# One start method after the other: each starts two processes that import PyTorch.
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # Python 3.12 on, if threads run
@pytest.mark.parametrize("start_method", ["fork", "spawn"])
def test_all_callbacks_work_with_envs_in_other_processes(start_method) -> None:
    env = SubprocVecEnv([plant, plant], start_method=start_method)
    try:
        noise = NormalActionNoise(np.zeros(2), np.ones(2))
        model = build(env, gradient_steps=0, action_noise=noise)
        guard = ImprovementGuard(plant, n_eval_episodes=3)
        audit = CostAudit(steps=40, strict=True)
        diagnostics = ControlDiagnostics()
        model.learn(60, callback=[NoActionNoise(), guard, diagnostics, audit])
        assert_every_action_is_the_law_s(model)
        assert model.replay_buffer.pos == 30
        assert audit.finding.matches
        assert guard.state.episodes == 2 * 30 // STEPS
        assert diagnostics._distances
        assert max(diagnostics._distances) < 1e-6
        starts = transitions(model, "observations")[::STEPS]
        assert len(np.unique(starts, axis=0)) == 5
        assert np.all(starts[:, 0] != starts[:, 1])  # each env has a seed of its own
    finally:
        env.close()


def test_our_envs_start_in_other_processes_by_an_id_that_names_the_package() -> None:
    env = make_vec_env("sb3_yann:CSTR-v0", n_envs=2, vec_env_cls=SubprocVecEnv)
    try:
        model = DDPG(YannPolicy, env, seed=0)
        observations = env.reset()
        law = model.policy.problem.explicit()
        far = np.abs(model.predict(observations)[0] - law(observations))
        assert far.max() < 1e-5 * float(law.u_max[0] - law.u_min[0])
    finally:
        env.close()


def stacked(n: int):
    return VecFrameStack(DummyVecEnv([lambda: plant(0.05)] * n), 3)


def normalized(n: int):
    env = VecNormalize(
        DummyVecEnv([lambda: plant(0.05)] * n), norm_reward=False, clip_obs=np.inf, training=False
    )
    env.obs_rms.mean = np.array([0.1, 0, -0.2])
    env.obs_rms.var = np.array([4, 1, 0.04])
    return env


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("kind", ["plain", "stacked", "normalized"])
@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_a_time_limit_is_no_end_to_the_critic(algorithm, kind, n_envs) -> None:
    if kind == "plain":
        env = DummyVecEnv([lambda: plant(0.05)] * n_envs)
        observation = None
    elif kind == "stacked":
        env = stacked(n_envs)
        observation = AffineObservation.newest_frame(3, 3)
    else:
        env = normalized(n_envs)
        observation = AffineObservation.from_vec_normalize(env)
    quiet = {"target_policy_noise": 0.0} if algorithm is TD3 else {}
    policy = {"observation": observation, "critic": {"reward_scale": 1.0}}
    model = build(env, algorithm, policy, gradient_steps=0, **quiet)
    model.learn(10 * n_envs * STEPS, callback=NoActionNoise())
    ends = transitions(model, "timeouts")
    assert ends.sum() == 10 * n_envs
    assert np.array_equal(ends, transitions(model, "dones"))
    # The buffer holds the last state of the episode, not the first of the next.
    jumps = np.abs(transitions(model, "next_observations") - transitions(model, "observations"))
    assert jumps.max() < 0.2
    sample = model.replay_buffer.sample(500, env=model.get_vec_normalize_env())
    assert float(sample.dones.sum()) == 0
    with th.no_grad():
        size = float((model.critic.q1_forward(sample.observations, sample.actions) ** 2).mean())
    model.train(gradient_steps=1, batch_size=500)
    assert model.logger.name_to_value["train/critic_loss"] < 1e-10 * size


def test_an_end_by_the_env_is_one_to_the_critic() -> None:
    model = build(DummyVecEnv([lambda: Ending(plant(), STEPS)] * 2), gradient_steps=0)
    model.learn(4 * STEPS, callback=NoActionNoise())
    assert transitions(model, "timeouts").sum() == 0  # also where the limit comes at the same step
    assert transitions(model, "dones").sum() == 4
