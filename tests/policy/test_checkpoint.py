"""Checkpoints of an actor: copies, mixtures, shares, and when one has diverged."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC
from stable_baselines3 import DDPG, PPO, SAC, TD3

from guard_samples import RIGHT, build, correct, randomize
from sample_plants import LinearPlant
from sb3_yann import LinearModel, LinearMPC, Tracking, retarget
from sb3_yann.policy.checkpoint import ActorCheckpoint
from weights import network_of, shake


def pair() -> tuple[Any, ActorCheckpoint, ActorCheckpoint]:
    """Return a policy, and a checkpoint before and after it was corrected to the right."""
    policy = build().policy
    before = ActorCheckpoint.of(policy)
    correct(policy, RIGHT, 0.5)
    return policy, before, ActorCheckpoint.of(policy)


def test_a_shrunk_correction_is_a_share_of_what_the_networks_add() -> None:
    policy, before, _ = pair()
    randomize(policy, 0.3)
    whole = ActorCheckpoint.of(policy)
    theta = th.linspace(-4, 4, 9)[:, None]
    layer = policy.actor.mu

    def added(checkpoint: ActorCheckpoint) -> np.ndarray:
        checkpoint.restore(policy)
        region = th.as_tensor(layer.regions(theta))
        z = (theta / layer.theta_half).to(layer.theta_half)
        return layer.network(z, region).detach().numpy()

    all_of_it = added(whole)
    assert np.abs(all_of_it).max() > 0.1
    np.testing.assert_allclose(added(whole.shrunk(0.25)), 0.25 * all_of_it, rtol=1e-4, atol=1e-6)
    assert not added(whole.shrunk(0.0)).any()
    for side in ("actor", "target"):
        changed = [
            key
            for key, value in getattr(whole, side).items()
            if not th.equal(value, getattr(whole.shrunk(0.5), side)[key])
        ]
        assert len(changed) == 1
    assert whole.is_confined_as(before)


def learnt(algorithm: Any = DDPG, **options: Any) -> Any:
    """A model whose network has moved, without learning."""
    options = {"networks": "shared", "pin_equilibrium": False, **options}
    given = {"gamma": 0.98, "batch_size": 32} | ({"n_steps": 64} if algorithm is PPO else {})
    model = algorithm("YannPolicy", "CSTR-v0", policy_kwargs=options, device="cpu", **given)
    model.learning_starts = 0  # PPO has none, and does not ask
    shake(network_of(model), 0.1)
    return model


def explores(algorithm: Any) -> dict[str, Any]:
    """Options of an algorithm whose policy draws its actions."""
    return {} if issubclass(algorithm, TD3) else {"initial_std": 0.1, "simulator": True}


def correction(model: Any, theta: Any) -> Any:
    """What the policy adds to its law, in units of the input."""
    u = model.predict(theta, deterministic=True)[0]
    law = model.policy.problem.online()(theta)
    inside = np.abs(u) < model.policy.problem.u_max - 1e-3
    return u - law, inside & (np.abs(law) < model.policy.problem.u_max - 1e-3)


@pytest.mark.parametrize("algorithm", [DDPG, TD3, SAC, TQC, PPO])
def test_a_shared_correction_stays_under_other_weights_and_bounds(algorithm: Any) -> None:
    model = learnt(algorithm, **explores(algorithm))
    old = model.policy.problem
    states = old.theta_max * np.array([0.5, 1, 2, 1])
    bounds = {"x_min": -states, "x_max": states, "theta_min": -states, "theta_max": states}
    mpc = replace(old, R=5 * old.R, **bounds)
    other = retarget(model, mpc)  # a warning would be an error
    assert type(other) is type(model) and (other.gamma, other.batch_size) == (0.98, 32)
    theta = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 4)) * old.theta_max
    theta = theta.astype(np.float32)
    one, inside = correction(model, theta)
    two, also = correction(other, theta)
    both = (inside & also).all(axis=1)
    assert both.sum() > 20 and np.abs(one[both]).max() > 1e-3
    assert np.abs(one - two)[both].max() < 1e-4
    other.learn(20)


@pytest.mark.parametrize("algorithm", [SAC, PPO])
def test_the_spread_stays_in_units_of_the_inputs(algorithm: Any) -> None:
    model = learnt(algorithm, **explores(algorithm))
    old = model.policy.problem
    with th.no_grad():
        model.policy.actor.log_std.sub_(1.0)
        if algorithm is SAC:
            model.log_ent_coef.add_(2.0)
    env = gym.make("CSTR-v0")
    env.action_space = gym.spaces.Box(-old.u_max[0] / 2, old.u_max[0] / 2, (1,), np.float32)
    other = retarget(model, replace(old, u_min=old.u_min / 2, u_max=old.u_max / 2), env)
    wider = model.policy.actor.log_std + np.log(2)
    assert th.allclose(other.policy.actor.log_std, wider, atol=1e-6)
    if algorithm is SAC:
        assert th.equal(other.log_ent_coef, model.log_ent_coef)


def test_what_is_not_kept_is_named() -> None:
    model = learnt(networks="per_region")
    model.learn(150)
    model.guard_state = object()
    problem = model.policy.problem
    with pytest.warns(UserWarning, match="not kept: the networks of single regions") as found:
        other = retarget(model, replace(problem, R=3 * problem.R))
    text = str(found[0].message)
    assert all(word in text for word in ("the critic", "replay buffer", "guard's accepted"))
    assert other.policy.actor.mu.network.is_zero() and not hasattr(other, "guard_state")
    with pytest.raises(ValueError, match="a correction needs the same entries"):
        retarget(model, replace(problem, parametric_bounds=["u_max"]))
    moved = replace(problem.model, x_ss=np.ones(4))
    bounds = {"x_min": problem.x_min + 1, "x_max": problem.x_max + 1}
    bounds |= {"theta_min": problem.theta_min + 1, "theta_max": problem.theta_max + 1}
    with pytest.raises(ValueError, match="Keep x_ss, u_ss and d_ss"):
        retarget(model, replace(problem, model=moved, **bounds))


def test_a_correction_of_other_set_points_is_refused() -> None:
    tank = LinearModel([[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]], dt=1.0)
    bounds = {"x_min": -5, "x_max": 5, "u_min": -1, "u_max": 1}
    old, new = (
        LinearMPC(tank, Q=np.eye(2), R=[[1]], horizon=3, tracking=Tracking([i], -1, 1), **bounds)
        for i in range(2)
    )
    model = DDPG("YannPolicy", LinearPlant(old), policy_kwargs={"problem": old}, device="cpu")
    with pytest.raises(ValueError, match=r"tracks the outputs \[\[0.0, 1.0\]\] x, the model"):
        retarget(model, new)
