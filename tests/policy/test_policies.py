"""The policy in SB3: exact at the start, fed by problems of every kind, saved and loaded."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import subprocess
import sys
import textwrap
from functools import cache

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import LinearPlant, feasible_states, two_input_mpc
from gymnasium import spaces
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

import sb3_yann
from sb3_yann import (
    CriticOptions,
    LinearModel,
    LinearMPC,
    NoActionNoise,
    YannActor,
    YannCritic,
    YannPolicy,
)
from sb3_yann.networks import AfterstateValue, QuadraticStateActionValue, RowAdam
from sb3_yann_envs import problems
from weights import network_of

ENVS = ("CSTR-v0", "ClippedPendulum-v0")
POLICIES = pytest.mark.parametrize("algorithm", [DDPG, TD3])
CRITICS = pytest.mark.parametrize("critic", ["afterstate", "state_action"])


def named_problem() -> LinearMPC:
    return problems.clipped_pendulum()


def scalar_mpc(**changes) -> LinearMPC:
    """An unstable first-order plant: small enough to solve in a few milliseconds."""
    design = {"Q": [[1]], "R": [[1]], "horizon": 2, "x_min": -5, "x_max": 5}
    bounds = {"u_min": -1, "u_max": 1}
    return LinearMPC(LinearModel([[1.1]], [[1]], 1), **{**design, **bounds, **changes})


def build(algorithm=DDPG, mpc: LinearMPC | None = None, policy_kwargs=None, **kwargs):
    mpc = scalar_mpc() if mpc is None else mpc
    policy_kwargs = {"problem": mpc, **(policy_kwargs or {})}
    return algorithm(YannPolicy, LinearPlant(mpc), policy_kwargs=policy_kwargs, **kwargs)


def test_predict_equals_an_independent_online_qp_at_ten_thousand_feasible_states(mpc) -> None:
    model = build(mpc=mpc)
    states, expected = feasible_states(mpc, 10_000)
    actions, _ = model.predict(states.astype(np.float32))
    assert np.max(np.abs(actions - expected) / (mpc.u_max - mpc.u_min)) < 1e-5


@pytest.mark.parametrize("env_id", ENVS)
@POLICIES
def test_our_envs_need_no_policy_kwargs_and_start_as_their_mpc(algorithm, env_id) -> None:
    model = algorithm(YannPolicy, env_id)
    mpc = gym.make(env_id).observation_space.problem
    states, expected = feasible_states(mpc, 500)
    actions, _ = model.predict(states.astype(np.float32))
    assert np.max(np.abs(actions - expected) / (mpc.u_max - mpc.u_min)) < 1e-5


@POLICIES
def test_the_policy_is_known_by_name(algorithm) -> None:
    assert isinstance(algorithm("YannPolicy", "CSTR-v0").policy, YannPolicy)


@POLICIES
@CRITICS
@pytest.mark.parametrize("n_critics", [1, 2])
def test_actor_and_critic_are_those_of_sb3_with_yann_networks(algorithm, critic, n_critics) -> None:
    kwargs = {"critic": critic, "n_critics": n_critics, "critic_warmup": 0}
    model = build(algorithm, policy_kwargs=kwargs)
    assert isinstance(model.actor, YannActor)
    assert isinstance(model.critic, YannCritic)
    network = {"afterstate": AfterstateValue, "state_action": QuadraticStateActionValue}[critic]
    for each in (model.critic, model.critic_target):
        assert [type(q) for q in each.q_networks] == [network] * n_critics
    before = copy.deepcopy(model.policy)
    model.learn(60, callback=NoActionNoise())
    for name in ("actor", "actor_target", "critic", "critic_target"):
        assert changed(getattr(model.policy, name), getattr(before, name)), name


@POLICIES
def test_the_critic_is_an_afterstate_one_by_default(algorithm) -> None:
    assert isinstance(build(algorithm).critic.qf0, AfterstateValue)


def changed(one: th.nn.Module, other: th.nn.Module) -> bool:
    pairs = zip(one.parameters(), other.parameters(), strict=True)
    return any(not th.equal(a, b) for a, b in pairs)


def test_ddpg_has_one_critic_and_td3_two() -> None:
    assert build(DDPG).critic.n_critics == 1
    assert build(TD3).critic.n_critics == 2


@pytest.mark.slow
@CRITICS
@pytest.mark.parametrize("make", [problems.clipped_pendulum, problems.cstr])
@pytest.mark.parametrize("gamma", [0.9, 0.99, 1 - 1e-3])
@pytest.mark.parametrize("discounted", [False, True], ids=["paper's MPC", "discounted MPC"])
def test_sb3_s_own_critic_loss_is_zero_at_the_start(make, gamma, discounted, critic) -> None:
    mpc = dataclasses.replace(make(), gamma=gamma if discounted else 1.0, terminal=None)
    kwargs = {"critic": critic}
    model = build(mpc=mpc, gamma=gamma, buffer_size=2000, seed=0, policy_kwargs=kwargs)
    model.learn(1)  # sets up the logger
    law, rng = mpc.explicit(), np.random.default_rng(0)
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
    assert build(gamma=0.9).policy.gamma == 0.9
    assert build().policy.gamma == 0.99
    given = DDPG(
        YannPolicy,
        LinearPlant(scalar_mpc()),
        gamma=0.9,
        policy_kwargs={"problem": scalar_mpc(), "gamma": 0.95},
    )
    assert given.policy.gamma == 0.95


def test_a_subclass_of_the_policy_gets_the_discount_as_well() -> None:
    class Mine(YannPolicy):
        def __init__(self, *args, **kwargs) -> None:
            super().__init__(*args, **kwargs)

    mpc = scalar_mpc()
    model = DDPG(Mine, LinearPlant(mpc), gamma=0.8, policy_kwargs={"problem": mpc})
    assert model.policy.gamma == 0.8


def first_step(network) -> float:
    """Return the length of Adam's first step, which is the learning rate itself."""
    before = [p.clone() for p in network.parameters()]
    for p in network.parameters():
        p.grad = th.ones_like(p)
    network.optimizer.state.clear()
    network.optimizer.step()
    steps = [(a - b).detach() for a, b in zip(before, network.parameters(), strict=True)]
    np.testing.assert_allclose(steps[-1], float(steps[0].mean()), rtol=1e-2)
    return float(steps[0].mean())


@pytest.mark.parametrize("way", ["as built", "deep copy", "pickle", "saved and loaded"])
def test_actor_and_critic_step_at_their_own_rates(way, tmp_path) -> None:
    mpc = scalar_mpc()
    kwargs = {"problem": mpc, "actor_lr_mult": 0.1, "critic_lr_mult": 0.5, "critic_warmup": 0}
    model = DDPG(YannPolicy, LinearPlant(mpc), learning_rate=1e-2, policy_kwargs=kwargs)
    policy = model.policy
    if way == "deep copy":
        policy = copy.deepcopy(policy)
    elif way == "pickle":
        policy = cloudpickle.loads(cloudpickle.dumps(policy))
    elif way == "saved and loaded":
        model.save(tmp_path / "model")
        policy = DDPG.load(tmp_path / "model").policy
    assert first_step(policy.actor) == pytest.approx(1e-3, rel=1e-2)
    assert first_step(policy.critic) == pytest.approx(5e-3, rel=1e-2)
    assert policy.actor.optimizer.param_groups[0]["lr"] == 1e-2  # SB3's own, untouched


def test_rates_given_to_load_are_those_in_use(tmp_path) -> None:
    model = build(learning_rate=1e-2, policy_kwargs={"critic_warmup": 0})
    model.save(tmp_path / "model")
    kwargs = {**model.policy_kwargs, "actor_lr_mult": 0.5}
    loaded = DDPG.load(tmp_path / "model", custom_objects={"policy_kwargs": kwargs})
    assert first_step(loaded.actor) == pytest.approx(5e-3, rel=1e-2)


def test_the_actors_loss_leaves_the_critic_alone_which_still_learns() -> None:
    model = build(policy_kwargs={"critic_warmup": 0})
    critic, theta = model.critic, th.rand(32, model.observation_space.shape[0])
    actions = th.zeros(32, model.action_space.shape[0], requires_grad=True)
    q = critic.q1_forward(theta, actions)
    th.testing.assert_close(q, critic(theta, actions)[0], rtol=0, atol=0)
    q.sum().backward()
    assert bool((actions.grad != 0).any())
    assert all(each.grad is None and each.requires_grad for each in critic.parameters())
    critic(theta, actions)[0].sum().backward()
    assert all(each.grad is not None for each in critic.parameters())


def test_an_optimizer_of_the_users_choice_is_taken_as_it_is() -> None:
    assert build().actor.optimizer.defaults["fused"] is True
    kwargs = {"optimizer_kwargs": {"eps": 1e-5}}
    chosen = build(policy_kwargs=kwargs).actor.optimizer.defaults
    assert (chosen["fused"], chosen["eps"]) == (None, 1e-5)
    kwargs = {"optimizer_class": th.optim.SGD}
    assert type(build(policy_kwargs=kwargs).actor.optimizer) is th.optim.SGD


def test_the_mode_is_switched_for_every_module() -> None:
    policy = build().policy
    for mode in (False, True):
        policy.set_training_mode(mode)
        for part in (policy.actor, policy.critic):
            assert {module.training for module in part.modules()} == {mode}


@pytest.mark.parametrize("frozen", ["actor", "critic"])
def test_a_rate_of_zero_freezes_one_of_them(frozen) -> None:
    mpc = scalar_mpc()
    kwargs = {"problem": mpc, f"{frozen}_lr_mult": 0.0, "critic_warmup": 0}
    model = DDPG(YannPolicy, LinearPlant(mpc), policy_kwargs=kwargs, seed=0)
    before = {name: p.clone() for name, p in model.policy.named_parameters()}
    model.learn(20, callback=NoActionNoise())
    moved = {
        name.split(".")[0]
        for name, p in model.policy.named_parameters()
        if not th.equal(p, before[name])
    }
    assert frozen not in moved
    assert ("actor" in moved) != (frozen == "actor")


@pytest.mark.parametrize(
    "reference", ["CSTR-v0", "sb3_yann_envs.problems:cstr", "my reactor", None]
)
def test_a_problem_may_be_an_object_a_name_or_a_reference(reference) -> None:
    sb3_yann.register_problem("my reactor", "sb3_yann_envs.problems:cstr")
    plant = LinearPlant(problems.cstr())
    problem = problems.cstr() if reference is None else reference
    model = DDPG(YannPolicy, plant, policy_kwargs={"problem": problem})
    assert model.policy.problem == problems.cstr()


def test_the_given_problem_goes_before_the_one_in_the_space() -> None:
    mpc = dataclasses.replace(problems.clipped_pendulum(), Q=np.eye(2), terminal=None)
    model = DDPG(YannPolicy, "ClippedPendulum-v0", policy_kwargs={"problem": mpc})
    assert model.policy.problem is mpc


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
@pytest.mark.parametrize("problem", [None, "CSTR-v0", "sb3_yann_envs.problems:cstr"])
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


def test_load_accepts_the_same_policy_kwargs_again(tmp_path) -> None:
    mpc = scalar_mpc()
    model = TD3(YannPolicy, LinearPlant(mpc), policy_kwargs={"problem": mpc})
    model.save(tmp_path / "model")
    TD3.load(tmp_path / "model", policy_kwargs={"problem": scalar_mpc()})
    with pytest.raises(ValueError, match="policy kwargs"):
        TD3.load(tmp_path / "model", policy_kwargs={"problem": scalar_mpc(gamma=0.5)})


@pytest.mark.parametrize("vec_env", [DummyVecEnv, SubprocVecEnv])
def test_it_trains_on_several_envs_at_once(vec_env) -> None:
    env = make_vec_env("sb3_yann:CSTR-v0", n_envs=2, vec_env_cls=vec_env)
    try:
        model = DDPG(YannPolicy, env, policy_kwargs={"critic_warmup": 0})
        before = copy.deepcopy(model.actor)
        model.learn(20, callback=NoActionNoise())
        assert model.policy.problem == problems.cstr()
        assert changed(model.actor, before)
    finally:
        env.close()


def test_a_policy_pickles() -> None:
    model = build()
    again = pickle.loads(pickle.dumps(model.policy.problem))
    assert again == model.policy.problem
    assert again.explicit() == model.policy.problem.explicit()


def test_constants_are_no_parameters_and_target_updates_leave_them_alone() -> None:
    model = build()
    learnt = {name for name, _ in model.actor.named_parameters()}
    assert all(name.startswith("mu.network.") for name in learnt)
    learnt = {name.split(".")[1] for name, _ in model.critic.named_parameters()}
    assert learnt == {"quadratic", "network"}
    assert not any("running_" in name for name in model.policy.state_dict())


# --- critic_warmup -----------------------------------------------------------------------------


two_inputs = cache(two_input_mpc)  # solved once


def with_full_buffer(algorithm=DDPG, mpc: LinearMPC | None = None, **policy_kwargs):
    """Return a model that has acted but not learnt, for `updates` to train."""
    kwargs = {"buffer_size": 200, "gradient_steps": 0, "seed": 0, "learning_rate": 1e-2}
    model = build(algorithm, mpc, policy_kwargs, **kwargs)
    return model.learn(100, callback=NoActionNoise())


def updates(model, count: int) -> None:
    model.train(gradient_steps=count, batch_size=16)


def starts(mpc: LinearMPC, count: int = 200, stretch: float = 1.0) -> np.ndarray:
    """Return states of the box, and of ever larger ones up to ``stretch`` times it."""
    box = np.random.default_rng(0).uniform(mpc.theta_min, mpc.theta_max, (count, mpc.n_theta))
    return (np.linspace(1, stretch, count)[:, None] * box).astype(np.float32)


@CRITICS
@pytest.mark.parametrize("policy_delay", [1, 2])
def test_the_actor_stays_the_mpc_bit_for_bit_until_the_critic_is_warm(policy_delay, critic) -> None:
    model = with_full_buffer(TD3, two_inputs(), critic=critic, critic_warmup=6)
    model.policy_delay = policy_delay
    first, theta = copy.deepcopy(model.policy), th.as_tensor(starts(two_inputs()))
    law = first.actor(theta)
    for _ in range(5):
        updates(model, 1)
        assert not changed(model.actor, first.actor)
        assert th.equal(model.actor(theta), law)
        assert th.equal(model.actor_target(theta), law)
        assert not model.actor.optimizer.state
        assert changed(model.critic, first.critic)
    updates(model, 1)  # the sixth of the critic, and then the actor's first
    assert changed(model.actor, first.actor)
    assert not th.equal(model.actor(theta), law)
    assert {int(state["steps"].max()) for state in model.actor.optimizer.state.values()} == {1}
    updates(model, 2)  # the first step moves one layer of zeros only
    assert not th.equal(model.actor_target(theta), law)


def test_the_delay_of_td3_is_kept_after_the_warm_up() -> None:
    model = with_full_buffer(TD3, critic_warmup=5)
    first = copy.deepcopy(model.actor)
    updates(model, 5)  # TD3's actor has a turn at every second update only
    assert not changed(model.actor, first)
    updates(model, 1)
    assert changed(model.actor, first)


def test_without_a_warm_up_the_actor_steps_at_once() -> None:
    model = with_full_buffer(critic_warmup=0)
    first = copy.deepcopy(model.actor)
    updates(model, 1)
    assert changed(model.actor, first)


@pytest.mark.parametrize("way", ["deep copy", "pickle", "saved and loaded", "parameters"])
def test_a_warm_up_goes_on_where_it_was(way, tmp_path) -> None:
    model = with_full_buffer(critic_warmup=5)
    updates(model, 3)
    policy = model.policy
    if way == "deep copy":
        policy = copy.deepcopy(policy)
    elif way == "pickle":
        policy = cloudpickle.loads(cloudpickle.dumps(policy))
    elif way == "saved and loaded":
        model.save(tmp_path / "model")
        policy = DDPG.load(tmp_path / "model").policy
    else:
        other = with_full_buffer(critic_warmup=5)
        other.set_parameters(model.get_parameters())
        policy = other.policy
    assert policy.critic_updates == 3
    model.policy = policy
    model._create_aliases()
    first = copy.deepcopy(policy.actor)
    updates(model, 1)
    assert not changed(policy.actor, first)
    updates(model, 1)
    assert changed(policy.actor, first)


def test_a_policy_starts_with_no_update_counted() -> None:
    assert build().policy.critic_updates == 0


# --- max_correction ----------------------------------------------------------------------------


def distances(model, mpc: LinearMPC, states: np.ndarray) -> np.ndarray:
    """Distances from the MPC in float64 and from the policy that it starts as, (2, batch, m)."""
    actions, _ = model.predict(states)
    start, _ = build(mpc=mpc).predict(states)
    laws = np.array([mpc.explicit()(states), start], dtype=np.float64)
    return np.abs(actions.astype(np.float64) - laws)


def scramble(model) -> None:
    """Give the actor huge weights."""
    with th.random.fork_rng(devices=[]):
        th.manual_seed(0)
        for parameter in model.actor.parameters():
            th.nn.init.normal_(parameter, std=1e3)


@pytest.mark.parametrize("bound", [0.1, 0.5, 1])
def test_no_action_is_ever_further_from_the_mpc_than_the_bound(mpc, bound) -> None:
    model = build(mpc=mpc, policy_kwargs={"max_correction": bound})
    scramble(model)
    states = starts(mpc, 10_000, stretch=3)
    assert 500 < mpc.explicit().in_domain(states).sum() < 9500
    reach = mpc.u_max - mpc.u_min
    far = distances(model, mpc, states)
    assert np.all(far <= bound * reach)  # no tolerance
    assert np.all(far.max(axis=1) > 0.99 * min(bound, 0.5) * reach)  # it is the bound that acts


def test_a_bound_of_zero_is_the_mpc_bit_for_bit(mpc) -> None:
    model = build(mpc=mpc, policy_kwargs={"max_correction": 0})
    scramble(model)
    states = starts(mpc, 10_000, stretch=3)
    np.testing.assert_array_equal(model.predict(states)[0], build(mpc=mpc).predict(states)[0])


@POLICIES
def test_the_bound_holds_after_training(algorithm) -> None:
    mpc = two_inputs()
    kwargs = {"max_correction": 0.1, "critic_warmup": 0, "actor_lr_mult": 10.0}
    model = with_full_buffer(algorithm, mpc, **kwargs)
    updates(model, 60)
    far = distances(model, mpc, starts(mpc, 10_000, stretch=3)) / (mpc.u_max - mpc.u_min)
    assert 0.09 < far.max()
    assert far.max() <= 0.1


def test_a_bound_survives_saving(tmp_path) -> None:
    model = build(policy_kwargs={"max_correction": 0.25, "pin_equilibrium": False})
    scramble(model)
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    states = starts(scalar_mpc())
    for loaded in (DDPG.load(tmp_path / "model"), YannPolicy.load(tmp_path / "policy")):
        np.testing.assert_array_equal(loaded.predict(states)[0], model.predict(states)[0])


# --- pin_equilibrium ---------------------------------------------------------------------------


@POLICIES
@CRITICS
@pytest.mark.parametrize("pinned", [True, False])
def test_training_moves_the_equilibrium_only_where_it_is_not_pinned(
    algorithm, critic, pinned
) -> None:
    mpc = two_inputs()
    kwargs = {"critic": critic, "pin_equilibrium": pinned, "critic_warmup": 0}
    model = with_full_buffer(algorithm, mpc, **kwargs)
    origin = np.zeros((1, 3), np.float32)
    before, _ = model.predict(origin)
    updates(model, 20)
    after, _ = model.predict(origin)
    assert np.array_equal(after, before) == pinned
    at_rest = model.policy.scale_action(np.zeros((1, 2), np.float32))
    with th.no_grad():
        q = model.critic.q1_forward(th.as_tensor(origin), th.as_tensor(at_rest))
    assert (abs(float(q)) < 1e-5) == pinned  # u = 0 is an action that float32 rounds


# --- prediction_model --------------------------------------------------------------------------

A, B = (th.as_tensor(M.T.copy()) for M in (two_input_mpc().model.A, two_input_mpc().model.B))


def linear_prediction(theta: th.Tensor, u: th.Tensor) -> th.Tensor:
    return theta @ A + u @ B


class LinearModule(th.nn.Module):
    """The linear model with parameters of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.A, self.B = th.nn.Parameter(A.clone()), th.nn.Parameter(B.clone())

    def forward(self, theta: th.Tensor, u: th.Tensor) -> th.Tensor:
        return theta @ self.A + u @ self.B


MODELS = pytest.mark.parametrize("make", [lambda: linear_prediction, LinearModule])


@POLICIES
@MODELS
def test_the_linear_model_given_as_prediction_model_changes_no_more_than_rounding(
    algorithm, make
) -> None:
    mine = with_full_buffer(
        algorithm, two_inputs(), critic={"prediction_model": make()}, critic_warmup=3
    )
    default = with_full_buffer(algorithm, two_inputs(), critic_warmup=3)
    updates(default, 10)
    mine.critic.load_state_dict(default.critic.state_dict(), strict=False)
    found, data = [], default.replay_buffer.sample(64)
    for model in (mine, default):
        (q,) = model.critic(data.observations, data.actions)[:1]
        model.critic.optimizer.zero_grad()
        q.square().sum().backward()
        found.append([q.detach(), *(each.grad for each in model.critic.q_networks[0].parameters())])
    for one, other in zip(*found, strict=True):
        assert th.allclose(one, other, rtol=1e-3, atol=1e-4 * float(other.abs().max()))


def test_a_module_that_predicts_is_not_trained() -> None:
    module = LinearModule()
    model = with_full_buffer(mpc=two_inputs(), critic={"prediction_model": module}, critic_warmup=0)
    updates(model, 20)
    for each in (module, model.critic.qf0.model, model.critic_target.qf0.model):
        assert th.equal(each.A, A)
        assert th.equal(each.B, B)


@CRITICS
def test_the_critic_learns_with_the_prediction_model_that_it_is_given(critic) -> None:
    if critic == "state_action":
        kwargs = {"critic": critic}
    else:
        options = {"prediction_model": lambda theta, u: 0 * theta + 0 * u.sum(1, keepdim=True)}
        kwargs = {"critic": options}
    mpc = two_inputs()
    model = build(mpc=mpc, policy_kwargs=kwargs)
    theta, u = starts(mpc), mpc.explicit()(starts(mpc))
    action = th.as_tensor(model.policy.scale_action(u.astype(np.float32)))
    with th.no_grad():
        q = model.critic.q1_forward(th.as_tensor(theta), action).numpy()[:, 0]
    stage = -mpc.stage_cost(theta, u)  # all there is, where the next state is the origin
    assert np.allclose(q, stage, rtol=1e-5) == (critic == "afterstate")


@pytest.mark.parametrize("make", [lambda: linear_prediction, LinearModule, lambda: bent])
def test_a_saved_model_brings_its_prediction_model_with_it(make, tmp_path) -> None:
    model = with_full_buffer(mpc=two_inputs(), critic={"prediction_model": make()}, critic_warmup=0)
    updates(model, 5)
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    theta = th.as_tensor(starts(two_inputs()))
    expected = model.critic(theta, model.actor(theta))[0]
    for policy in (DDPG.load(tmp_path / "model").policy, YannPolicy.load(tmp_path / "policy")):
        assert th.equal(policy.critic(theta, policy.actor(theta))[0], expected)


def bent(theta: th.Tensor, u: th.Tensor) -> th.Tensor:
    return th.sin(linear_prediction(theta, u))


def test_a_saved_model_may_predict_with_a_lambda(tmp_path) -> None:
    options = CriticOptions(prediction_model=lambda theta, u: th.sin(1.1 * theta + u))
    model = build(policy_kwargs={"critic": options})
    model.save(tmp_path / "model")
    theta = th.as_tensor(starts(scalar_mpc()))
    critic = DDPG.load(tmp_path / "model").critic
    expected = model.critic(theta, model.actor(theta))[0]
    assert th.equal(critic(theta, model.actor(theta))[0], expected)


def test_value_scale_is_that_of_the_critic_s_network() -> None:
    assert build().critic.qf0.scale == 30
    assert build(policy_kwargs={"critic": {"value_scale": 7.0}}).critic.qf0.scale == 7


# --- what is refused ---------------------------------------------------------------------------


def unbounded() -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (1,), np.float32)


def actions(low: float = -1, high: float = 1, size: int = 1) -> spaces.Box:
    return spaces.Box(low, high, (size,), np.float32)


def make_policy(observation_space, action_space, **kwargs) -> YannPolicy:
    return YannPolicy(observation_space, action_space, lambda _: 1e-3, **kwargs)


@pytest.mark.parametrize(
    ("observation_space", "action_space", "error", "message"),
    [
        (spaces.Dict({"x": unbounded()}), actions(), TypeError, "observation_space is a Dict"),
        (spaces.Discrete(3), actions(), TypeError, "observation_space is a Discrete"),
        (spaces.Box(0, 255, (3, 36, 36), np.uint8), actions(), ValueError, "one dimension"),
        (unbounded(), spaces.Discrete(2), TypeError, "action_space is a Discrete"),
        (unbounded(), spaces.MultiDiscrete([2]), TypeError, "action_space is a MultiDiscrete"),
        (unbounded(), unbounded(), ValueError, "must have finite bounds"),
        (unbounded(), spaces.Box(-1, 1, (1, 1), np.float32), ValueError, "one dimension"),
        (unbounded(), actions(-2, 1), ValueError, r"u_min = \[-1.0\]"),
        (unbounded(), actions(size=2), ValueError, "They must be the same"),
        (spaces.Box(-1, 1, (2,), np.float32), actions(), ValueError, r"theta of shape \(1,\)"),
    ],
)
def test_spaces_that_do_not_fit_are_named(observation_space, action_space, error, message) -> None:
    with pytest.raises(error, match=message):
        make_policy(observation_space, action_space, problem=scalar_mpc())


class Heater(gym.Env):
    """A temperature about its steady state, heated with 0 to 10 V, of which 3 hold it."""

    def __init__(self) -> None:
        self.observation_space = unbounded()
        self.action_space = spaces.Box(0, 10, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-1, 1, 1)
        return self.x.astype(np.float32), {}

    def step(self, action):
        reward = -float(self.x @ self.x + 0.1 * (action - 3) @ (action - 3))
        self.x = 0.9 * self.x + 0.2 * (np.asarray(action, np.float64) - 3)
        return self.x.astype(np.float32), reward, False, False, {}


def heater_mpc(u_min: float, u_max: float) -> LinearMPC:
    model = LinearModel([[0.9]], [[0.2]], 1.0, u_ss=[3])
    weights = {"Q": [[1]], "R": [[0.1]], "horizon": 1, "theta_min": -5, "theta_max": 5}
    return LinearMPC(model, u_min=u_min, u_max=u_max, **weights)


def test_an_env_with_absolute_inputs_is_told_the_wrapper_that_fits() -> None:
    kwargs = {"problem": heater_mpc(-3, 7)}
    with pytest.raises(ValueError, match=r"takes absolute inputs.*RescaleAction") as caught:
        DDPG(YannPolicy, Heater(), policy_kwargs=kwargs)
    line = str(caught.value).partition("env = ")[2].removesuffix(".")
    env = eval(line, {"gymnasium": gym, "numpy": np, "env": Heater()})
    model = DDPG(YannPolicy, env, policy_kwargs=kwargs)
    theta, _ = env.reset(options={})
    reached = env.step(model.predict(theta)[0])[0]
    expected = 0.9 * theta + 0.2 * kwargs["problem"].explicit()(theta)
    assert reached == pytest.approx(expected, abs=1e-6)


def test_bounds_that_are_not_deviations_are_warned_of() -> None:
    kwargs = {"problem": heater_mpc(0, 10)}
    with pytest.warns(UserWarning, match=r"u_min = \[-3.0\] and u_max = \[7.0\], and wrap"):
        DDPG(YannPolicy, Heater(), policy_kwargs=kwargs)


def test_a_policy_without_a_problem_says_how_to_give_one() -> None:
    with pytest.raises(ValueError, match=r'policy_kwargs=\{"problem": mpc\}'):
        DDPG(YannPolicy, "Pendulum-v1")


@pytest.mark.parametrize(
    ("problem", "error", "message"),
    [
        ("no such name", ValueError, "'no such name'"),
        ("no_such_module:mpc", ValueError, "no_such_module"),
        ("sb3_yann_envs.problems:nothing", ValueError, "nothing"),
        ("math:pi", TypeError, "expected a LinearMPC"),
        (42, TypeError, "expected a LinearMPC"),
        (LinearMPC, TypeError, "expected a LinearMPC"),
        ("sb3_yann:LinearMPC", TypeError, "expected a LinearMPC"),
        (scalar_mpc().explicit(), TypeError, "is PiecewiseAffine.*expected a LinearMPC"),
    ],
)
def test_a_problem_that_cannot_be_found_is_named(problem, error, message) -> None:
    with pytest.raises(error, match=message):
        make_policy(unbounded(), actions(), problem=problem)


def test_a_law_without_input_bounds_is_no_policy() -> None:
    with pytest.raises(ValueError, match="u_min"):
        make_policy(unbounded(), actions(), problem=scalar_mpc(u_min=None, u_max=None))


@pytest.mark.parametrize("algorithm", [SAC, PPO])
def test_stochastic_algorithms_are_refused_by_name(algorithm) -> None:
    mpc = scalar_mpc()
    with pytest.raises(TypeError, match=algorithm.__name__):
        algorithm(YannPolicy, LinearPlant(mpc), policy_kwargs={"problem": mpc})


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"actor_lr_mult": -1}, ValueError, "actor_lr_mult"),
        ({"critic_lr_mult": float("nan")}, ValueError, "critic_lr_mult"),
        ({"gamma": 1.5}, ValueError, "gamma"),
        ({"hidden": 3}, TypeError, "'hidden'"),
        ({"actor_lr_mult": "a"}, TypeError, "actor_lr_mult = 'a'"),
        ({"actor_lr_mult": None}, TypeError, "actor_lr_mult = None"),
        ({"n_critics": 0}, ValueError, "n_critics = 0"),
        ({"net_arch": {"pi": [4, 4, 4], "qf": [8, 8]}}, ValueError, r"net_arch\['pi'\]"),
        ({"net_arch": {"pi": ["a"]}}, ValueError, r"net_arch\['pi'\]"),
        ({"net_arch": {"vf": [4]}}, ValueError, "net_arch"),
        ({"activation_fn": th.tanh}, TypeError, "activation_fn"),
        ({"activation_fn": th.nn.Sigmoid}, ValueError, "activation"),
        ({"critic": "quadratic"}, ValueError, "critic = 'quadratic'"),
        ({"critic": None}, ValueError, "critic = None"),
        ({"prediction_model": None}, TypeError, "'prediction_model'.*CriticOptions"),
        ({"pin_equilibrium": 1}, TypeError, "pin_equilibrium = 1"),
        ({"critic_warmup": -1}, ValueError, "critic_warmup = -1"),
        ({"critic_warmup": 1.5}, ValueError, r"critic_warmup = 1\.5"),
        ({"critic_warmup": True}, ValueError, "critic_warmup = True"),
        ({"max_correction": -0.1}, ValueError, r"max_correction = -0\.1"),
        ({"max_correction": 1.5}, ValueError, r"max_correction = 1\.5"),
        ({"max_correction": float("nan")}, ValueError, "max_correction = nan"),
        ({"max_correction": "x"}, TypeError, "max_correction = 'x'"),
    ],
)
def test_policy_kwargs_that_mean_nothing_are_named(kwargs, error, message) -> None:
    with pytest.raises(error, match=message):
        make_policy(unbounded(), actions(), problem=scalar_mpc(), **kwargs)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"kind": "quadratic"}, ValueError, "kind = 'quadratic'"),
        ({"scale": 3}, TypeError, "critic has no 'scale'.*value_scale"),
        ({"prediction_model": 3}, TypeError, "prediction_model = 3"),
        ({"prediction_model": "f", "kind": "state_action"}, TypeError, "prediction_model = 'f'"),
        (
            {"prediction_model": lambda theta, u: theta, "kind": "state_action"},
            ValueError,
            "prediction_model is for kind='afterstate'",
        ),
        ({"value_scale": 0}, ValueError, "value_scale = 0"),
        ({"value_scale": -30.0}, ValueError, "value_scale = -30.0"),
        ({"value_scale": float("nan")}, ValueError, "value_scale = nan"),
        ({"value_scale": "big"}, TypeError, "value_scale = 'big'"),
    ],
)
def test_options_of_a_critic_that_mean_nothing_are_named(options, error, message) -> None:
    with pytest.raises(error, match=message):
        make_policy(unbounded(), actions(), problem=scalar_mpc(), critic=options)


@pytest.mark.parametrize("critic", [{"reward_scale": 2.0}, CriticOptions(reward_scale=2.0)])
def test_options_of_a_critic_compare_by_value_when_a_model_is_loaded(critic, tmp_path) -> None:
    build(policy_kwargs={"critic": critic}).save(tmp_path / "model")
    for changes in ({}, {"critic": copy.deepcopy(critic)}):
        kwargs = {"problem": scalar_mpc(), "critic": critic, "n_critics": 1, **changes}
        loaded = DDPG.load(tmp_path / "model", policy_kwargs=kwargs)
        assert loaded.policy.critic_options == CriticOptions(reward_scale=2.0)
    with pytest.raises(ValueError, match="policy kwargs"):
        DDPG.load(tmp_path / "model", policy_kwargs={**kwargs, "critic": CriticOptions()})


def test_a_net_arch_may_leave_out_or_join_actor_and_critic() -> None:
    policy = make_policy(unbounded(), actions(), problem=scalar_mpc(), net_arch={"pi": [3, 5]})
    assert policy.net_arch == {"pi": [3, 5], "qf": [64, 64]}
    policy = make_policy(unbounded(), actions(), problem=scalar_mpc(), net_arch=[7, 7])
    assert policy.net_arch == {"pi": [7, 7], "qf": [7, 7]}


def test_integer_actions_are_refused() -> None:
    with pytest.raises(TypeError, match="int32"):
        make_policy(unbounded(), spaces.Box(-1, 1, (1,), np.int32), problem=scalar_mpc())


@pytest.mark.parametrize("normalized", ["norm_obs", "norm_reward"])
def test_a_normalizing_env_is_refused(normalized) -> None:
    switches = {"norm_obs": False, "norm_reward": False, normalized: True}
    env = VecNormalize(make_vec_env("sb3_yann:CSTR-v0"), **switches)
    with pytest.raises(ValueError, match="VecNormalize"):
        DDPG(YannPolicy, env)


def test_a_name_registered_again_means_the_new_problem() -> None:
    env = LinearPlant(scalar_mpc())
    for weight in (1, 10):
        sb3_yann.register_problem("again", scalar_mpc(R=[[weight]]))
        model = DDPG(YannPolicy, env, policy_kwargs={"problem": "again"})
        assert model.policy.problem.R == [[weight]]


def test_only_problems_can_be_registered() -> None:
    with pytest.raises(TypeError, match="problem = 3"):
        sb3_yann.register_problem("three", 3)


def test_a_name_for_a_problem_must_be_a_name() -> None:
    with pytest.raises(ValueError, match="'a:b'"):
        sb3_yann.register_problem("a:b", problems.cstr)


def test_beyond_32_regions_those_without_data_do_not_move_not_even_by_momentum() -> None:
    model = with_full_buffer(DDPG, two_inputs(), critic_warmup=0)
    assert isinstance(model.actor.optimizer, RowAdam)
    assert two_inputs().explicit().n_regions > 32
    updates(model, 5)
    before = copy.deepcopy(network_of(model))
    data = model.replay_buffer.sample(3)
    model.replay_buffer.sample = lambda *_, **__: data
    updates(model, 1)
    seen = set(two_inputs().explicit().locate(data.observations.double().numpy()).tolist())
    for old, new in zip(before.parameters(), network_of(model).parameters(), strict=True):
        moved = (old != new).flatten(1).any(1).nonzero()[:, 0].tolist()
        assert moved and set(moved) <= seen


def test_an_optimizer_of_ones_own_gets_dense_gradients() -> None:
    kwargs = {"optimizer_class": th.optim.SGD, "optimizer_kwargs": {}, "critic_warmup": 0}
    model = with_full_buffer(DDPG, two_inputs(), **kwargs)
    updates(model, 2)
    assert not any(each.grad.is_sparse for each in model.actor.parameters())


@POLICIES
@CRITICS
def test_actor_and_critic_yield_all_their_parameters_in_the_order_of_their_names(
    algorithm, critic
) -> None:
    model = build(algorithm, policy_kwargs={"critic": critic})
    for module in (model.actor, model.actor_target, model.critic, model.critic_target):
        named = [each for _, each in module.named_parameters()]
        found = [*module.parameters()]
        assert len(found) == len(named) > 2
        assert all(one is other for one, other in zip(found, named, strict=True))
