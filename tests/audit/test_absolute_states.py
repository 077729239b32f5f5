"""Absolute states in a law of deviations are named, also where the reward agrees with them."""

from __future__ import annotations

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers

from audit_samples import audited
from sample_plants import LinearPlant, two_input_mpc
from sb3_yann import AffineObservation, LinearMPC
from sb3_yann.audit.absolute import absolute_observation
from sb3_yann.wrappers import StageCost

X_SS = np.array([475.0, 20.0, 0.0])


def problem() -> LinearMPC:
    plain = two_input_mpc()
    return dataclasses.replace(plain, model=dataclasses.replace(plain.model, x_ss=X_SS))


def shown(mpc: LinearMPC) -> gym.Env:
    """Return a plant that shows absolute states, with the stage cost of what it shows."""
    env = LinearPlant(mpc, 0.5)
    env = wrappers.TransformObservation(env, lambda x: x + X_SS, env.observation_space)
    return wrappers.TimeLimit(StageCost(env, mpc), 20)


def test_absolute_states_are_named_though_the_reward_agrees() -> None:
    with pytest.warns(UserWarning, match=r"state 'x\[0\]' = 47\d.* the operating point is 475"):
        finding = audited(shown(problem()), mpc=problem()).finding
    assert (finding.matches, finding.cause) == (False, "absolute observation")
    assert "wrappers.Deviations(env, mpc.model)" in finding.message
    assert "The reward is not" not in finding.message


def test_states_inside_the_box_or_far_from_both_are_left_alone() -> None:
    mpc, near = problem(), np.full((20, 3), 0.1)
    assert absolute_observation(mpc, near) is None
    assert absolute_observation(mpc, near + 1e4) is None
    assert absolute_observation(two_input_mpc(), near + X_SS) is None
    assert absolute_observation(mpc, near + X_SS) is not None


def test_a_map_that_takes_the_operating_point_off_is_no_fault() -> None:
    mpc = problem()
    seen = AffineObservation.deviation(X_SS)
    env = LinearPlant(mpc, 0.5)
    env = wrappers.TransformObservation(env, lambda x: x + X_SS, env.observation_space)
    env = wrappers.TimeLimit(StageCost(env, mpc, observation=seen), 20)
    assert audited(env, policy={"observation": seen}, mpc=mpc).finding.matches
