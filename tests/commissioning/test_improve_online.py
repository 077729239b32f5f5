"""A policy around a law that is solved online is improved in a twin as any other."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_yann import LinearMPC, PlantTwin, YannPolicy, improve
from sb3_yann.commissioning.grounds import settling_steps
from sb3_yann.twin.gradient import _slopes_of_actor
from twin_samples import Cart, log, problem


def policy_of(mpc: LinearMPC) -> DDPG:
    return DDPG(YannPolicy, Cart(), policy_kwargs={"problem": mpc}, seed=0, device="cpu")


def test_the_slopes_and_the_settling_time_are_those_of_the_explicit_law() -> None:
    explicit, mpc = problem(), dataclasses.replace(problem())
    mpc.law("online")
    assert settling_steps(mpc) == settling_steps(explicit)
    theta = np.random.default_rng(0).uniform(-3, 3, (200, 2))
    ours, theirs = (_slopes_of_actor(policy_of(each).actor.mu, theta) for each in (mpc, explicit))
    assert np.abs(ours - theirs).max() < 1e-6


@pytest.mark.slow
def test_improve_needs_no_explicit_law(monkeypatch) -> None:
    logged, mpc = log(4), dataclasses.replace(problem())
    mpc.law("online")
    monkeypatch.setattr(LinearMPC, "explicit", None)
    model = policy_of(mpc)
    found = improve(model, PlantTwin.fit(mpc, logged), iterations=20, check_every=10, n_starts=5)
    assert found.checks
    theta = np.random.default_rng(0).uniform(-1, 1, (20, 2)).astype(np.float32)
    moved = np.abs(model.predict(theta)[0] - mpc.online()(theta)).max()
    assert (moved > 1e-4) == found.accepted
