"""Spaces, environments and policy_kwargs that mean nothing are refused by name."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import sb3_yann
from policy_samples import actions, build, make_policy, scalar_mpc, unbounded
from sample_plants import LinearPlant
from sb3_yann import AffineObservation, LinearMPC, YannPolicy
from sb3_yann.policy.checkpoint import ActorCheckpoint
from sb3_yann_envs import problems
from weights import shake


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


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"actor_lr_mult": -1}, ValueError, "actor_lr_mult"),
        ({"critic_lr_mult": float("nan")}, ValueError, "critic_lr_mult"),
        ({"gamma": 1.5}, ValueError, "gamma"),
        ({"hidden": 3}, TypeError, "'hidden'"),
        ({"n_critics": 0}, ValueError, "n_critics = 0"),
        ({"net_arch": {"pi": [4, 4, 4], "qf": [8, 8]}}, ValueError, r"net_arch\['pi'\]"),
        ({"net_arch": {"pi": ["a"]}}, ValueError, r"net_arch\['pi'\]"),
        ({"net_arch": {"vf": [4]}}, ValueError, "net_arch"),
        ({"activation_fn": th.tanh}, TypeError, "activation_fn"),
        ({"activation_fn": th.nn.Sigmoid}, ValueError, "activation"),
        ({"critic": "quadratic"}, ValueError, "critic = 'quadratic'"),
        ({"prediction_model": None}, TypeError, "'prediction_model'.*CriticOptions"),
        ({"pin_equilibrium": 1}, TypeError, "pin_equilibrium = 1"),
        ({"critic_warmup": -1}, ValueError, "critic_warmup = -1"),
        ({"max_correction": 1.5}, ValueError, r"max_correction = 1\.5"),
        ({"critic": {"kind": "quadratic"}}, ValueError, "kind = 'quadratic'"),
        ({"critic": {"scale": 3}}, TypeError, "critic has no 'scale'.*value_scale"),
        ({"critic": {"prediction_model": 3}}, TypeError, "prediction_model = 3"),
        (
            {"critic": {"prediction_model": lambda theta, u: theta, "kind": "state_action"}},
            ValueError,
            "prediction_model is for kind='afterstate'",
        ),
        ({"critic": {"value_scale": 0}}, ValueError, "value_scale = 0"),
    ],
)
def test_policy_kwargs_that_mean_nothing_are_named(kwargs, error, message) -> None:
    with pytest.raises(error, match=message):
        make_policy(unbounded(), actions(), problem=scalar_mpc(), **kwargs)


def test_a_net_arch_may_leave_out_or_join_actor_and_critic() -> None:
    policy = make_policy(unbounded(), actions(), problem=scalar_mpc(), net_arch={"pi": [3, 5]})
    assert policy.net_arch == {"pi": [3, 5], "qf": [64, 64]}
    policy = make_policy(unbounded(), actions(), problem=scalar_mpc(), net_arch=[7, 7])
    assert policy.net_arch == {"pi": [7, 7], "qf": [7, 7]}


@pytest.mark.parametrize("normalized", ["norm_obs", "norm_reward"])
def test_a_normalizing_env_is_refused(normalized) -> None:
    switches = {"norm_obs": False, "norm_reward": False, normalized: True}
    env = VecNormalize(make_vec_env("sb3_yann:CSTR-v0"), **switches)
    with pytest.raises(ValueError, match=r"^VecNormalize.*In RL Zoo's.*normalize out"):
        DDPG(YannPolicy, env)


def test_a_policy_that_finds_no_algorithm_says_so_and_takes_a_discount() -> None:
    env = gym.make("CSTR-v0")
    spaces_of = env.observation_space, env.action_space, lambda _: 1e-3
    with pytest.raises(ValueError, match=r"does not find the DDPG or TD3.*policy_kwargs"):
        YannPolicy(*spaces_of)
    assert YannPolicy(*spaces_of, gamma=0.97).gamma == 0.97

    def in_a_thread(*args, **kwargs):
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(YannPolicy, *args, **kwargs).result()

    with pytest.raises(ValueError, match="in the same thread"):
        DDPG(in_a_thread, "CSTR-v0", gamma=0.9)


def test_a_discount_that_is_set_after_the_policy_was_built_is_refused(tmp_path) -> None:
    model = DDPG("YannPolicy", "CSTR-v0", gamma=0.95, device="cpu", learning_starts=0)
    model.save(tmp_path / "model")
    observation = np.zeros(4, np.float32)
    model.gamma = 0.8
    for act in (lambda: model.learn(2), lambda: model.predict(observation)):
        with pytest.raises(ValueError, match=r"gamma of the DDPG was set to 0\.8 after its policy"):
            act()
    for given in ({"custom_objects": {"gamma": 0.8}}, {"gamma": 0.8}):
        with pytest.warns(UserWarning, match=r"gamma = 0\.8, but the critic .* for 0\.95"):
            loaded = DDPG.load(tmp_path / "model", **given)
        assert loaded.policy.gamma == 0.8
        loaded.predict(observation)
    own = DDPG("YannPolicy", "CSTR-v0", policy_kwargs={"gamma": 0.9})
    own.gamma = 0.8  # the policy's own was chosen
    own.predict(observation)


# ---- A problem is given as an object, by a name or by a reference; what is none is named ----


@pytest.mark.parametrize(
    "reference", ["CSTR-v0", "sb3_yann_envs.problems:cstr", "my reactor", None]
)
def test_a_problem_may_be_an_object_a_name_or_a_reference(reference) -> None:
    sb3_yann.register_problem("my reactor", "sb3_yann_envs.problems:cstr")
    plant = LinearPlant(problems.cstr())
    problem = problems.cstr() if reference is None else reference
    model = DDPG(YannPolicy, plant, policy_kwargs={"problem": problem})
    assert model.policy.problem == problems.cstr()


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


def test_a_name_registered_again_means_the_new_problem() -> None:
    env = LinearPlant(scalar_mpc())
    for weight in (1, 10):
        sb3_yann.register_problem("again", scalar_mpc(R=[[weight]]))
        model = DDPG(YannPolicy, env, policy_kwargs={"problem": "again"})
        assert model.policy.problem.R == [[weight]]
    with pytest.raises(TypeError, match="problem = 3"):
        sb3_yann.register_problem("three", 3)
    with pytest.raises(ValueError, match=r'policy_kwargs=\{"problem": mpc\}'):
        DDPG(YannPolicy, "Pendulum-v1")


# ---- Parameters of another problem are refused before anything is changed; own ones load ----


KINDS: dict[str, dict[str, Any]] = {
    "a network for each region": {},
    "a shared network": {"networks": "shared"},
    "an online law": {"law": "online"},
    "the paper's critic": {"critic": "state_action"},
    "a map of observations": {"observation": AffineObservation(2 * np.eye(1), np.ones(1))},
}
OTHERS = {
    "same count": {"R": [[2]]},
    "other count": {"horizon": 3, "R": [[2]]},
    "other range": {"u_max": 2},
}


def model_of(kind: str, algorithm=DDPG, **changes) -> Any:
    """A model whose networks, and whose target's, have learnt something: noise."""
    model = build(algorithm, scalar_mpc(**changes), KINDS[kind])
    shake(model.policy, 0.01, len(changes))
    return model


def state_of(model) -> dict[str, th.Tensor]:
    return {name: each.clone() for name, each in model.policy.state_dict().items()}


def same(one: dict[str, th.Tensor], other: dict[str, th.Tensor]) -> bool:
    return one.keys() == other.keys() and all(th.equal(one[name], other[name]) for name in one)


def require_refused(model, load: Callable[[], Any], what: str = "") -> None:
    before = state_of(model)
    message = rf"with another problem, observation or networks: .*{what}.*DDPG\.load\(path\)"
    with pytest.raises(ValueError, match=message):
        load()
    assert same(state_of(model), before)


@pytest.mark.parametrize("exact_match", [True, False])
@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("kind", KINDS)
def test_parameters_of_another_problem_change_nothing(kind, other, exact_match) -> None:
    model = model_of(kind)
    foreign = model_of(kind, **OTHERS[other]).get_parameters()
    require_refused(model, lambda: model.set_parameters(foreign, exact_match), r"actor\.mu\.")


def test_a_guards_checkpoint_of_another_problem_and_a_critic_of_other_weights_are_told() -> None:
    model = build()
    foreign = ActorCheckpoint.of(build(mpc=scalar_mpc(R=[[2]])).policy)
    require_refused(model, lambda: foreign.restore(model.policy))
    given = build(mpc=scalar_mpc(Q=[[2]], R=[[2]])).get_parameters()  # the law is the same
    require_refused(model, lambda: model.set_parameters(given), r"critic\.qf0\.W")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_parameters_of_the_same_problem_are_loaded_exactly(kind, algorithm) -> None:
    learnt = model_of(kind, algorithm)
    model = build(algorithm, scalar_mpc(), KINDS[kind])
    model.set_parameters(learnt.get_parameters())
    assert same(state_of(model), state_of(learnt))


@pytest.mark.parametrize("kind", KINDS)
def test_what_another_machine_has_solved_is_loaded(kind) -> None:
    model = model_of(kind)
    state = state_of(model_of(kind))
    generator = th.Generator().manual_seed(0)
    for name, each in state.items():
        if each.dtype == th.float64 and ".network." not in name:
            noise = th.randn(each.shape, generator=generator, dtype=th.float64)
            each.mul_(1 + 1e-12 * noise).add_(1e-13 * noise.nan_to_num() * each.isfinite())
    model.policy.load_state_dict(state)
    for name, each in state_of(model).items():  # a law of one's own stays to the bit
        assert th.allclose(each, state[name], rtol=1e-9, atol=1e-9, equal_nan=True), name


def test_a_load_with_another_problem_names_it(tmp_path) -> None:
    """Stable-Baselines3 takes a plain ValueError for that of an old DQN, which is a KeyError."""
    model = build()
    model.save(tmp_path / "model")
    changed = {"policy_kwargs": {"problem": scalar_mpc(R=[[2]])}}
    with pytest.raises(ValueError, match="with another problem"):
        DDPG.load(tmp_path / "model", custom_objects=changed)


@pytest.mark.parametrize("changes", [{"x_max": 4.9}, {"u_min": -0.99}, {"R": [[1.001]]}])
def test_online_laws_of_problems_alike_are_told_apart(changes) -> None:
    model = model_of("an online law")
    other = model_of("an online law", **changes)
    require_refused(model, lambda: model.set_parameters(other.get_parameters()))
