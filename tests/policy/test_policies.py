"""The policy in SB3: exact at the start, fed by problems of every kind, saved and loaded."""

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG

from policy_samples import (
    CRITICS,
    POLICIES,
    build,
    scalar_mpc,
    starts,
    two_inputs,
    updates,
    with_full_buffer,
)
from sample_plants import LinearPlant, feasible_states
from sb3_yann import LinearMPC, NoActionNoise, SoftBounds, YannPolicy
from sb3_yann.policy.checkpoint import ActorCheckpoint
from weights import last_layer, redrawn, unpin


@pytest.mark.slow
def test_predict_equals_an_independent_online_qp_at_ten_thousand_feasible_states(mpc) -> None:
    model = build(mpc=mpc)
    states, expected = feasible_states(mpc, 10_000)
    actions, _ = model.predict(states.astype(np.float32))
    assert np.max(np.abs(actions - expected) / (mpc.u_max - mpc.u_min)) < 1e-5


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


def distances(model, mpc: LinearMPC, states: np.ndarray) -> np.ndarray:
    """Distances from the MPC in float64 and from the policy that it starts as, (2, batch, m)."""
    actions, _ = model.predict(states)
    start, _ = build(mpc=mpc).predict(states)
    laws = np.array([mpc.explicit()(states), start], dtype=np.float64)
    return np.abs(actions.astype(np.float64) - laws)


@POLICIES
def test_the_bound_holds_after_training(algorithm) -> None:
    mpc = two_inputs()
    kwargs = {"max_correction": 0.1, "critic_warmup": 0, "actor_lr_mult": 100.0}
    model = with_full_buffer(algorithm, mpc, **kwargs)
    updates(model, 60)
    far = distances(model, mpc, starts(mpc, 10_000, stretch=3)) / (mpc.u_max - mpc.u_min)
    assert 0.09 < far.max()
    assert far.max() <= 0.1


@POLICIES
@pytest.mark.parametrize(("first", "then"), [(None, 0.1), (0.1, 0.3), (0.3, None)])
def test_a_bound_that_is_set_later_survives_saving_as_well(
    algorithm, first, then, tmp_path
) -> None:
    mpc = scalar_mpc()
    given = {"max_correction": first, "pin_equilibrium": False}
    model = build(algorithm, mpc, given)
    states = starts(mpc)
    redrawn(model, 1e3, 0)
    model.policy.limit_correction(then)
    for _ in range(2):  # saved again, it is still there
        model.save(tmp_path / "model")
        model.policy.save(tmp_path / "policy")
        loaded = algorithm.load(tmp_path / "model")
        for policy in (loaded.policy, YannPolicy.load(tmp_path / "policy")):
            assert policy.max_correction == policy.actor.options["max_correction"] == then
            np.testing.assert_array_equal(policy.predict(states)[0], model.predict(states)[0])
        model = loaded
    assert given == {"max_correction": first, "pin_equilibrium": False}


def test_a_bound_is_that_of_one_model_alone(tmp_path) -> None:
    options = {"problem": scalar_mpc(), "max_correction": 0.1}
    one, two = (
        DDPG(YannPolicy, LinearPlant(scalar_mpc()), policy_kwargs=options) for _ in range(2)
    )
    again = copy.deepcopy(one)
    again.policy.limit_correction(0.4)
    one.policy.limit_correction(0.2)
    assert options["max_correction"] == 0.1
    for i, (model, bound) in enumerate([(one, 0.2), (two, 0.1), (again, 0.4)]):
        model.save(tmp_path / str(i))
        assert DDPG.load(tmp_path / str(i)).policy.max_correction == bound


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


def to_zero(theta: th.Tensor, u: th.Tensor) -> th.Tensor:
    return 0 * theta + 0 * u.sum(1, keepdim=True)


def test_the_critic_learns_with_the_prediction_model_that_it_is_given() -> None:
    mpc = two_inputs()
    model = build(mpc=mpc, policy_kwargs={"critic": {"prediction_model": to_zero}})
    theta = starts(mpc)
    u = mpc.explicit()(starts(mpc))
    action = th.as_tensor(model.policy.scale_action(u.astype(np.float32)))
    with th.no_grad():
        q = model.critic.q1_forward(th.as_tensor(theta), action).numpy()[:, 0]
    stage = -mpc.stage_cost(theta, u)  # all there is, where the next state is the origin
    assert np.allclose(q, stage, rtol=1e-5)


# ---- The option of a policy to keep the hard bounds of its model, whatever it learns ----


def pushing(model, towards: float = 9.0):
    """Let the networks push the input up with all that they have."""
    for actor in (model.policy.actor, model.policy.actor_target):
        unpin(actor)
        with th.no_grad():
            last_layer(actor)[..., -1] = towards
    return model


def largest(model, start: float = 0.0) -> float:
    """Return the largest state of a plant that is the model."""
    x = np.array([start])
    found = -np.inf
    for _ in range(60):
        x = 1.1 * x + model.predict(x.astype(np.float32))[0]
        found = max(found, float(x[0]))
    return found


def test_it_is_on_where_there_are_hard_bounds_and_networks_do_not_take_over_beyond_them():
    assert build().policy.keep_bounds
    assert not build(mpc=scalar_mpc(soft=SoftBounds(x=1.0))).policy.keep_bounds
    free = scalar_mpc(x_min=None, x_max=None, theta_min=-5, theta_max=5)
    assert not build(mpc=free).policy.keep_bounds
    assert not build(mpc=scalar_mpc(infeasible="zero_input")).policy.keep_bounds
    assert not build(policy_kwargs={"keep_bounds": False}).policy.keep_bounds


def test_predictions_keep_the_bounds_that_others_break():
    kept = pushing(build())
    free = pushing(build(policy_kwargs={"keep_bounds": False}))
    assert 4.999 < largest(kept) < 5 + 5e-6
    assert largest(free) > 100


def test_a_model_that_is_saved_and_loaded_keeps_them_as_far(tmp_path):
    model = pushing(build(policy_kwargs={"bounds_margin": 0.1}))
    assert abs(largest(model) - 4.5) < 1e-3
    model.policy.set_bounds_margin(0.2)
    assert abs(largest(model) - 4.0) < 1e-3
    model.save(tmp_path / "model")
    loaded = DDPG.load(tmp_path / "model")
    assert loaded.policy.bounds_margin == 0.2 and largest(loaded) == largest(model)
    off = pushing(build(policy_kwargs={"keep_bounds": False}))
    off.save(tmp_path / "off")
    assert largest(DDPG.load(tmp_path / "off")) == largest(off)


def test_a_checkpoint_knows_how_far_inside_its_actor_stays():
    model = pushing(build())
    before = ActorCheckpoint.of(model.policy)
    model.policy.set_bounds_margin(0.2)
    assert not before.is_actor_of(model.policy)
    assert ActorCheckpoint.of(model.policy).changed_regions(before).all()
    before.restore(model.policy)
    assert largest(model) > 4.999


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match=r"bounds_margin = -1 .*half-widths"):
        build(policy_kwargs={"bounds_margin": -1})
    with pytest.raises(TypeError, match="keep_bounds = 3"):
        build(policy_kwargs={"keep_bounds": 3})
    model = build(policy_kwargs={"keep_bounds": False})
    with pytest.raises(ValueError, match="keep_bounds=False: there is no margin"):
        model.policy.set_bounds_margin(0.1)
