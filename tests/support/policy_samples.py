"""Small policies, and what the tests of them do to their models."""

from functools import cache

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DDPG, TD3

from sample_plants import LinearPlant, two_input_mpc
from sb3_yann import LinearModel, LinearMPC, NoActionNoise, YannPolicy

POLICIES = pytest.mark.parametrize("algorithm", [DDPG, TD3])
CRITICS = pytest.mark.parametrize("critic", ["afterstate", "state_action"])


def scalar_mpc(**changes) -> LinearMPC:
    """An unstable first-order plant: small enough to solve in a few milliseconds."""
    design = {"Q": [[1]], "R": [[1]], "horizon": 2, "x_min": -5, "x_max": 5}
    bounds = {"u_min": -1, "u_max": 1}
    return LinearMPC(LinearModel([[1.1]], [[1]], 1), **{**design, **bounds, **changes})


def build(algorithm=DDPG, mpc: LinearMPC | None = None, policy_kwargs=None, **kwargs):
    mpc = scalar_mpc() if mpc is None else mpc
    policy_kwargs = {"problem": mpc, **(policy_kwargs or {})}
    return algorithm(YannPolicy, LinearPlant(mpc), policy_kwargs=policy_kwargs, **kwargs)


def changed(one: th.nn.Module, other: th.nn.Module) -> bool:
    pairs = zip(one.parameters(), other.parameters(), strict=True)
    return any(not th.equal(a, b) for a, b in pairs)


two_inputs = cache(two_input_mpc)  # solved once


def with_full_buffer(algorithm=DDPG, mpc: LinearMPC | None = None, **policy_kwargs):
    """Return a model that has acted but not learnt, for `updates` to train."""
    kwargs = {"buffer_size": 200, "gradient_steps": 0, "seed": 0, "learning_rate": 1e-2}
    return build(algorithm, mpc, policy_kwargs, **kwargs).learn(100, callback=NoActionNoise())


def updates(model, count: int) -> None:
    model.train(gradient_steps=count, batch_size=16)


def starts(mpc: LinearMPC, count: int = 200, stretch: float = 1.0) -> np.ndarray:
    """Return states of the box, and of ever larger ones up to ``stretch`` times it."""
    box = np.random.default_rng(0).uniform(mpc.theta_min, mpc.theta_max, (count, mpc.n_theta))
    return (np.linspace(1, stretch, count)[:, None] * box).astype(np.float32)


def unbounded() -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (1,), np.float32)


def actions(low: float = -1, high: float = 1, size: int = 1) -> spaces.Box:
    return spaces.Box(low, high, (size,), np.float32)


def make_policy(observation_space, action_space, **kwargs) -> YannPolicy:
    alone = {"gamma": 0.99, **kwargs}
    return YannPolicy(observation_space, action_space, lambda _: 1e-3, **alone)
