"""The policy in SB3: exact at the start, fed by problems of every kind, saved and loaded."""

from __future__ import annotations

import copy
import dataclasses
import subprocess
import sys
import textwrap

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DDPG
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from policy_samples import (
    CRITICS,
    POLICIES,
    build,
    changed,
    scalar_mpc,
)
from sample_plants import LinearPlant, feasible_states, two_input_mpc
from sb3_yann import NoActionNoise, YannPolicy
from sb3_yann_envs import problems

ENVS = ("CSTR-v0", "ClippedPendulum-v0")


@pytest.mark.slow
def test_predict_equals_an_independent_online_qp_at_ten_thousand_feasible_states(mpc) -> None:
    model = build(mpc=mpc)
    states, expected = feasible_states(mpc, 10_000)
    actions, _ = model.predict(states.astype(np.float32))
    assert np.max(np.abs(actions - expected) / (mpc.u_max - mpc.u_min)) < 1e-5


@pytest.mark.slow
@CRITICS
@pytest.mark.parametrize("make", [problems.clipped_pendulum, problems.cstr])
@pytest.mark.parametrize(("gamma", "discounted"), [(0.9, True), (1 - 1e-3, False)])
def test_sb3_s_own_critic_loss_is_zero_at_the_start(make, gamma, discounted, critic) -> None:
    mpc = dataclasses.replace(make(), gamma=gamma if discounted else 1.0, terminal=None)
    kwargs = {"critic": critic}
    model = build(mpc=mpc, gamma=gamma, buffer_size=2000, seed=0, policy_kwargs=kwargs)
    model.learn(1)  # sets up the logger
    law = mpc.explicit()
    rng = np.random.default_rng(0)
    origin = law.locate(np.zeros(mpc.n_theta))
    stored = 0
    model.replay_buffer.reset()
    while stored < 2000:
        # A third of the box around the origin: the next state is in the same region mostly.
        theta = rng.uniform(mpc.theta_min, mpc.theta_max) / 3
        theta = theta.astype(np.float32).astype(np.float64)
        u = law(theta)
        following = mpc.model.step(theta, u)
        if law.locate(theta) != origin or law.locate(following) != origin:
            continue
        action = model.policy.scale_action(u.astype(np.float32))
        reward = -mpc.stage_cost(theta, u)
        model.replay_buffer.add(theta, following, action, reward, np.zeros(1), [{}])
        stored += 1
    sample = model.replay_buffer.sample(2000)
    with th.no_grad():
        q = model.critic.q1_forward(sample.observations, sample.actions)
    model.train(gradient_steps=1, batch_size=2000)
    loss = model.logger.name_to_value["train/critic_loss"]
    assert loss < 1e-12 * float((q**2).mean())
    assert float((q**2).mean()) > 0


def test_the_critic_takes_the_discount_of_the_algorithm() -> None:
    class Mine(YannPolicy):
        def __init__(self, *args, **kwargs) -> None:
            super().__init__(*args, **kwargs)

    own = DDPG(Mine, LinearPlant(scalar_mpc()), gamma=0.8, policy_kwargs={"problem": scalar_mpc()})
    assert own.policy.gamma == 0.8
    assert build(gamma=0.9).policy.gamma == 0.9
    assert build().policy.gamma == 0.99
    given = DDPG(
        YannPolicy,
        LinearPlant(scalar_mpc()),
        gamma=0.9,
        policy_kwargs={"problem": scalar_mpc(), "gamma": 0.95},
    )
    assert given.policy.gamma == 0.95


@pytest.mark.slow
@POLICIES
@CRITICS
def test_a_saved_model_goes_on_as_if_it_had_never_been_saved(algorithm, critic, tmp_path) -> None:
    kwargs = {"critic": critic, "critic_warmup": 0}
    model = algorithm(YannPolicy, "ClippedPendulum-v0", seed=0, policy_kwargs=kwargs)
    model.learn(50, callback=NoActionNoise())
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = algorithm.load(tmp_path / "model", env=gym.make("ClippedPendulum-v0"))
    loaded.load_replay_buffer(tmp_path / "buffer")
    for name, value in model.policy.state_dict().items():
        assert th.equal(value, loaded.policy.state_dict()[name]), name
    for each in (model, loaded):
        each.set_random_seed(1)
        each.set_logger(model.logger)
        each.train(gradient_steps=3, batch_size=32)
    for name, value in model.policy.state_dict().items():
        assert th.equal(value, loaded.policy.state_dict()[name]), name


@pytest.mark.slow
@pytest.mark.parametrize("problem", [None, "sb3_yann_envs.problems:cstr"])
def test_a_fresh_process_predicts_without_any_solver(problem, tmp_path) -> None:
    kwargs = {"critic_warmup": 0} if problem is None else {"critic_warmup": 0, "problem": problem}
    env = "CSTR-v0" if problem is None else plain_cstr()
    model = DDPG(YannPolicy, env, policy_kwargs=kwargs)
    model.learn(20, callback=NoActionNoise())
    model.save(tmp_path / "model")
    state = np.array([0.01, 0.1, -0.1, -2], dtype=np.float32)
    script = """
        import sys
        for solver in ("ppopt", "cvxopt", "daqp", "gurobipy", "quadprog", "control"):
            sys.modules[solver] = None  # an import of it now fails
        import numpy as np
        from stable_baselines3 import DDPG
        model = DDPG.load(sys.argv[1])
        print(repr(float(model.predict(np.array([0.01, 0.1, -0.1, -2], dtype=np.float32))[0][0])))
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script), str(tmp_path / "model")],
        capture_output=True,
        text=True,
        check=True,
        env={"PYTHONPATH": ":".join(sys.path)},
    )
    assert float(done.stdout) == float(model.predict(state)[0][0])


def plain_cstr() -> gym.Env:
    """The reactor under a wrapper that loses the space's problem."""
    env = gym.make("CSTR-v0")
    env.observation_space = spaces.Box(env.observation_space.low, env.observation_space.high)
    return env


def test_the_policy_alone_saves_and_loads(tmp_path) -> None:
    model = build(mpc=two_input_mpc(), gamma=0.9)
    model.policy.save(tmp_path / "policy")
    loaded = YannPolicy.load(tmp_path / "policy")
    assert loaded.gamma == 0.9
    states = np.random.default_rng(0).uniform(-5, 5, (50, 3)).astype(np.float32)
    np.testing.assert_array_equal(loaded.predict(states)[0], model.predict(states)[0])


@pytest.mark.parametrize(
    "vec_env", [DummyVecEnv, pytest.param(SubprocVecEnv, marks=pytest.mark.slow)]
)
def test_it_trains_on_several_envs_at_once(vec_env) -> None:
    # From many starts the first inputs are saturated, and nothing is learnt in twenty steps.
    env = make_vec_env("sb3_yann:CSTR-v0", n_envs=2, vec_env_cls=vec_env, seed=2)
    try:
        model = DDPG(YannPolicy, env, policy_kwargs={"critic_warmup": 0})
        before = copy.deepcopy(model.actor)
        model.learn(20, callback=NoActionNoise())
        assert model.policy.problem == problems.cstr()
        assert changed(model.actor, before)
    finally:
        env.close()
