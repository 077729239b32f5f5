"""What holds for the policy of any problem, with any weights, and through whole trainings."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from policy_samples import make_policy
from random_problems import examples, in_box, problems
from sb3_yann import LinearMPC, NonFiniteWarning, YannPolicy
from weights import network_of

SEEDS = st.integers(0, 2**32 - 1)
KINDS = st.sampled_from([{"networks": "per_region"}, {"networks": "shared"}, {"law": "online"}])
ARCHITECTURES = st.sampled_from([{"pi": [4, 3], "qf": [4, 3]}, {"pi": [4], "qf": [4]}])
LARGEST = float(np.finfo(np.float32).max)


def policy_of(mpc: LinearMPC, dtype: Any = np.float32, **kwargs: Any) -> YannPolicy:
    seen = spaces.Box(-np.inf, np.inf, (mpc.n_theta,), dtype)
    low = mpc.u_min.astype(dtype)
    high = mpc.u_max.astype(dtype)
    return make_policy(seen, spaces.Box(low, high, dtype=dtype), problem=mpc, **kwargs)


def shaken(policy: YannPolicy, size: float, seed: int, poison: float | None = None) -> YannPolicy:
    """Give the actor weights of this size, and some that are ``poison``."""
    rng = np.random.default_rng(seed)
    with th.no_grad():
        for weight in network_of(policy).parameters():
            drawn = np.clip(size * rng.normal(size=weight.shape), -LARGEST, LARGEST)
            if poison is not None:
                drawn[rng.random(weight.shape) < 0.1] = poison
            weight.copy_(th.as_tensor(drawn, dtype=th.float32))
    return policy


def predicted(policy: YannPolicy, observations: np.ndarray) -> np.ndarray:
    """Return the actions in float64, each of which lies in the action space."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of states that look like absolute ones
        actions, _ = policy.predict(observations)
    assert all(policy.action_space.contains(each) for each in actions)
    return np.asarray(actions, np.float64)


# --- what is no number --------------------------------------------------------------------------


@examples(30)
@given(problems(), st.data(), KINDS, ARCHITECTURES, st.sampled_from([None, np.nan]))
def test_every_observation_of_float32_has_an_action_of_the_space(
    mpc: LinearMPC, data: Any, kind: dict, net_arch: dict, poison: float | None
) -> None:
    policy = shaken(policy_of(mpc, net_arch=net_arch, **kind), 0.3, 0, poison)
    rows = st.lists(st.floats(width=32), min_size=mpc.n_theta, max_size=mpc.n_theta)
    seen = np.float32(data.draw(st.lists(rows, min_size=1, max_size=5)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        actions = predicted(policy, seen)
    said = {each.category for each in caught}
    with np.errstate(over="ignore"):  # the networks' own entries, in half-widths of the box
        held = np.isfinite(seen / policy.actor.mu.theta_half.numpy()).all()
    assert NonFiniteWarning in said or np.isfinite(seen).all()
    assert NonFiniteWarning not in said or not held or poison is not None
    for row, action in zip(seen, actions, strict=True):
        if not np.isfinite(row).all():  # the law, at the operating point in what is lost
            known = np.where(np.isfinite(row), row, 0).astype(np.float64)
            u = policy.problem.law(kind.get("law", "explicit"))(known)
            if not mpc.has_rate_bounds:
                assert np.all(np.abs(action - u) <= 1e-6 * (mpc.u_max - mpc.u_min))


# --- the critic, and targets --------------------------------------------------------------------


@examples(25)
@given(
    problems(), SEEDS, st.sampled_from(["afterstate", "state_action"]),
    st.sampled_from([0.9, 0.99]), ARCHITECTURES,
)  # fmt: skip
def test_critic_is_the_value_of_the_problem_at_first(
    mpc: LinearMPC, seed: int, kind: str, gamma: float, net_arch: dict
) -> None:
    try:
        M = mpc.state_action_matrix(gamma)
    except ValueError as error:  # of problems whose law does not rest at the origin
        assert "law" in str(error)
        return
    policy = policy_of(mpc, critic=kind, gamma=gamma, net_arch=net_arch, n_critics=2)
    theta = in_box(mpc, 50, 2.0, seed).astype(np.float32)
    action = np.random.default_rng(seed).uniform(-1, 1, (50, mpc.model.n_inputs))
    action = action.astype(np.float32)
    middle = (mpc.u_max + mpc.u_min) / 2
    half = (mpc.u_max - mpc.u_min) / 2
    # What is asked for counts within its range.
    seen = theta if mpc.clamped is None else np.clip(theta, *mpc.clamped)
    z = np.hstack([seen, middle + half * action])
    terms = z[:, :, None] * M * z[:, None]
    with th.no_grad():
        found = policy.critic(th.as_tensor(theta), th.as_tensor(action))
    rounding = 1e-7 * np.abs(terms.sum((1, 2))) + 1e-11 * np.abs(terms).sum((1, 2))
    for q in found:
        assert np.all(np.abs(q.numpy()[:, 0] + terms.sum((1, 2))) <= rounding + 1e-30)
