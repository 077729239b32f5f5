"""SAC, TQC and PPO: the most likely action is the MPC's, and what is drawn around it is small."""

from importlib.resources import files

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from sb3_contrib import TQC
from scipy import stats
from stable_baselines3 import DDPG, PPO, SAC

from policy_samples import scalar_mpc
from sample_plants import LinearPlant, Recorder
from sb3_yann import (
    ControlDiagnostics,
    CostAudit,
    ImprovementGuard,
    NoActionNoise,
    YannPolicy,
    export,
)
from sb3_yann.deployment.controller import Controller
from sb3_yann.policy.exploring import TruncatedNormal

EXPLORING = pytest.mark.parametrize("algorithm", [SAC, TQC, PPO])
SMALL = {PPO: {"n_steps": 32, "batch_size": 16}}


def short() -> gym.Env:
    return gym.wrappers.TimeLimit(LinearPlant(scalar_mpc()), 20)


def build(algorithm, env=None, **policy_kwargs):
    if env is None:
        env = LinearPlant(scalar_mpc())
        policy_kwargs["problem"] = scalar_mpc()
    given = {"simulator": True, **policy_kwargs}
    small = SMALL.get(algorithm, {"learning_starts": 10})
    return algorithm("YannPolicy", env, policy_kwargs=given, seed=0, device="cpu", **small)


@EXPLORING
@pytest.mark.parametrize("env_id", ["CSTR-v0", "ClippedPendulum-v0"])
def test_the_deterministic_action_is_the_law_s_at_ten_thousand_points(algorithm, env_id) -> None:
    model = build(algorithm, env_id)
    mpc = model.policy.problem
    theta = np.random.default_rng(0).uniform(mpc.theta_min, mpc.theta_max, (10_000, mpc.n_theta))
    theta = theta.astype(np.float32)
    law = mpc.explicit()(theta.astype(float))
    actions, _ = model.predict(theta, deterministic=True)
    assert np.max(np.abs(actions - law) / (mpc.u_max - mpc.u_min)) < 1e-6
    bounds = np.minimum(law - mpc.u_min, mpc.u_max - law) / (mpc.u_max - mpc.u_min)
    assert np.sum(bounds < 1e-9) > 1000  # it rides them


def test_a_truncated_normal_is_scipy_s() -> None:
    center = th.tensor([[-1.0, -0.9], [0.2, 0.99], [1.0, 0.0]])
    log_std = th.tensor([-3.0, -0.5])
    ours = TruncatedNormal(center, log_std)
    m = center.numpy().astype(float)
    s = np.exp(log_std.numpy().astype(float))
    theirs = stats.truncnorm((-1 - m) / s, (1 - m) / s, loc=m, scale=s)
    assert np.allclose(ours.entropy(), theirs.entropy().sum(1), atol=1e-5)
    for at in (center, th.full_like(center, -1.0), th.full_like(center, 1.0), -center):
        assert np.allclose(ours.log_prob(at), theirs.logpdf(at.numpy()).sum(1), rtol=1e-5)
    th.manual_seed(0)
    drawn = TruncatedNormal(center.repeat(20_000, 1), log_std).sample().reshape(-1, 3, 2)
    assert float(drawn.abs().max()) <= 1
    assert np.allclose(drawn.mean(0), theirs.mean(), atol=0.01)
    assert np.allclose(drawn.std(0), theirs.std(), atol=0.01)


def test_what_is_drawn_has_a_gradient_by_center_and_spread() -> None:
    center = th.tensor([[1.0], [0.0]], requires_grad=True)
    log_std = th.tensor([-3.0], requires_grad=True)
    actions = TruncatedNormal(center, log_std).sample()
    actions.sum().backward()
    assert bool((center.grad > 0).all())
    assert float(log_std.grad.abs()) > 0


@EXPLORING
def test_log_probabilities_are_finite_where_the_law_rides_its_bounds(algorithm) -> None:
    model = build(algorithm)
    obs = th.tensor([[-50.0], [50.0], [0.0]])
    actor = model.policy.actor
    for at in (-1.0, 1.0):
        assert bool(actor.distribution(obs).log_prob(th.full((3, 1), at)).isfinite().all())
    assert actor(obs)[:2].flatten().tolist() == [1.0, -1.0]


def test_critics_start_as_the_value_of_the_law() -> None:
    models = {algorithm: build(algorithm) for algorithm in (SAC, TQC, PPO)}
    plain = DDPG(YannPolicy, LinearPlant(scalar_mpc()), policy_kwargs={"problem": scalar_mpc()})
    obs = th.linspace(-3, 3, 7)[:, None]
    actions = th.linspace(-1, 1, 7)[:, None]
    with th.no_grad():
        (expected,) = plain.critic(obs, actions)
        for q in models[SAC].critic(obs, actions):
            assert th.equal(q, expected)
        quantiles = models[TQC].critic(obs, actions)
        assert quantiles.shape == (7, 2, 25)
        assert th.allclose(quantiles, expected[:, :, None].expand_as(quantiles), rtol=1e-5)
        P = scalar_mpc().value_matrix(plain.gamma)
        assert np.allclose(models[PPO].policy.predict_values(obs), -P * obs.numpy() ** 2)


@EXPLORING
def test_it_learns_and_a_saved_model_goes_on(algorithm, tmp_path) -> None:
    model = build(algorithm, actor_lr_mult=1.0, critic_warmup=0).learn(32)
    assert not model.policy.actor.mu.network.is_zero()
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=model.get_env(), device="cpu")
    obs = np.linspace(-3, 3, 9, dtype=np.float32)[:, None]
    for deterministic in (True, False):
        th.manual_seed(1)
        one = model.predict(obs, deterministic=deterministic)[0]
        th.manual_seed(1)
        assert np.array_equal(one, loaded.predict(obs, deterministic=deterministic)[0])
    loaded.learn(32, reset_num_timesteps=False)
    model.policy.save(tmp_path / "policy")
    alone = type(model.policy).load(tmp_path / "policy")
    u, whole = (each.predict(obs, deterministic=True)[0] for each in (alone, model))
    assert np.array_equal(u, whole)


@EXPLORING
def test_a_guard_keeps_what_is_no_worse_and_the_export_is_the_deterministic_policy(
    algorithm, tmp_path
) -> None:
    model = build(algorithm, short(), problem=scalar_mpc(), actor_lr_mult=1.0, critic_warmup=0)
    callbacks = [
        ImprovementGuard(short, n_eval_episodes=10, n_new_starts=5),
        ControlDiagnostics(),
        CostAudit(steps=20),
    ]
    model.learn(96, callback=callbacks)
    assert callbacks[0].decisions
    export(model, tmp_path / "law.npz")
    controller = Controller.load(tmp_path / "law.npz")
    obs = np.linspace(-3, 3, 9, dtype=np.float32)[:, None]
    actions = model.predict(obs, deterministic=True)[0]
    assert np.allclose([controller(each) for each in obs], actions, atol=1e-6)


def test_units_of_the_reward_leave_ppo_s_actor_its_share_of_the_clipped_gradient() -> None:
    weights = []
    for scale in (1.0, 1000.0):
        env = gym.wrappers.TransformReward(LinearPlant(scalar_mpc()), lambda r, k=scale: k * r)
        model = build(PPO, env, problem=scalar_mpc(), critic={"reward_scale": scale})
        model.learn(64)
        weights.append(th.cat([each.flatten() for each in model.policy.actor.parameters()]))
    start = th.cat([each.flatten() for each in build(PPO).policy.actor.parameters()])
    moved = (weights[0] - start).abs().max()
    assert moved > 1e-3
    assert (weights[1] - weights[0]).abs().max() < 0.05 * moved


@EXPLORING
def test_no_action_noise_explains_itself(algorithm) -> None:
    with pytest.warns(UserWarning, match="turns nothing off here"):
        build(algorithm).learn(32, callback=NoActionNoise())


@EXPLORING
def test_from_the_first_step_on_actions_are_near_the_mpc_s(algorithm) -> None:
    env = Recorder(LinearPlant(scalar_mpc()))
    small = SMALL.get(algorithm, {})
    with pytest.warns(UserWarning, match="That belongs into a simulator"):
        model = algorithm("YannPolicy", env, policy_kwargs={"problem": scalar_mpc()}, **small)
        model.learn(32)
    observations, actions = env.recorded()
    law = scalar_mpc().explicit()(observations)
    assert np.abs(actions[:32] - law[:32]).max() < 6 * model.policy.initial_std * 2


@EXPLORING
def test_exploring_without_a_guard_on_what_may_be_a_plant_warns_once(algorithm) -> None:
    with pytest.warns(UserWarning, match="That belongs into a simulator") as said:
        build(algorithm, simulator=False).learn(20)
    assert sum("That belongs" in str(each.message) for each in said) == 1
    build(algorithm).learn(20)  # a warning would be an error


def test_a_guard_of_before_does_not_silence_that_nobody_confirms_now() -> None:
    model = build(SAC, short(), problem=scalar_mpc(), simulator=False)
    model.learn(32, callback=ImprovementGuard(short, n_eval_episodes=5, n_new_starts=2))
    with pytest.warns(UserWarning, match="That belongs into a simulator"):
        model.learn(8)


def test_a_warmup_of_ppo_does_nothing_and_says_so(tmp_path) -> None:
    with pytest.warns(UserWarning, match="critic_warmup = 5 does nothing here: PPO"):
        policy = build(PPO, critic_warmup=5).policy
    policy.save(tmp_path / "policy")
    type(policy).load(tmp_path / "policy")  # a warning would be an error


def test_entropy_starts_in_balance_and_what_the_user_gives_stays() -> None:
    model = build(SAC, initial_std=0.05)
    entropy = model.policy.actor.distribution(th.zeros(1, 1)).entropy()
    assert model.target_entropy == pytest.approx(entropy.item(), abs=1e-3)
    mpc = model.policy.problem
    std = 0.1
    curvature = mpc.state_action_terms(model.gamma).P[1, 1]
    assert model.log_ent_coef.exp().item() == pytest.approx(2 * curvature * std**2, rel=1e-4)
    own = {"policy_kwargs": {"problem": mpc}, "ent_coef": 0.3, "target_entropy": -2.0}
    given = SAC("YannPolicy", LinearPlant(mpc), **own)
    assert given.ent_coef_tensor.item() == pytest.approx(0.3)
    assert given.target_entropy == -2


@EXPLORING
def test_the_policy_of_td3_and_state_dependent_noise_are_refused(algorithm) -> None:
    env = LinearPlant(scalar_mpc())
    kwargs = {"problem": scalar_mpc()}
    with pytest.raises(TypeError, match=f'{algorithm.__name__}\\("YannPolicy", env\\)'):
        algorithm(YannPolicy, env, policy_kwargs=kwargs)
    with pytest.raises(ValueError, match="use_sde = True"):
        algorithm("YannPolicy", env, policy_kwargs=kwargs, use_sde=True)
    with pytest.raises(ValueError, match="initial_std = 0"):
        build(algorithm, initial_std=0.0)
    if algorithm is PPO:
        with pytest.raises(TypeError, match="YannPolicy takes no 'n_critics'"):
            build(PPO, n_critics=2)


@pytest.mark.parametrize("env_id", ["CSTR-v0", "ClippedPendulum-v0"])
@EXPLORING
def test_rl_zoo_s_entries_build_a_model(algorithm, env_id) -> None:
    name = f"{algorithm.__name__.lower()}.yml"
    text = (files("sb3_yann") / "hyperparams" / name).read_text(encoding="utf-8")
    entry = yaml.safe_load(text)[env_id]
    steps = entry.pop("n_timesteps")
    callbacks = entry.pop("callback")
    model = algorithm(env=env_id, device="cpu", **entry)
    assert steps == 50 * model.env.get_attr("spec")[0].max_episode_steps
    names = [next(iter(each)) if isinstance(each, dict) else each for each in callbacks]
    assert names == ["sb3_yann.ImprovementGuard", "sb3_yann.ControlDiagnostics"]
    law = model.policy.problem.explicit()
    theta = np.zeros(law.n_theta, np.float32)
    assert np.allclose(model.predict(theta, deterministic=True)[0], law(theta.astype(float)))
