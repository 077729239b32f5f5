"""A plant that rests beside its references is named, and two lines cure it; training goes on."""

from __future__ import annotations

import warnings

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_yann import (
    CostAudit,
    LinearModel,
    LinearMPC,
    NoActionNoise,
    SteadyOffsetWarning,
    Tracking,
    YannPolicy,
    offset_free,
)
from sb3_yann.evaluation import evaluate
from sb3_yann.wrappers import ObserveDisturbance, SetPoint, StageCost

HOLD, STEPS = 25, 50


def heater() -> LinearMPC:
    design = {"Q": [[1.0]], "R": [[0.1]], "horizon": 3, "u_min": -2, "u_max": 2, "gamma": 0.95}
    box = {"theta_min": -5, "theta_max": 5, "tracking": Tracking([0], -1, 1)}
    return LinearMPC(LinearModel([[0.8]], [[0.5]], dt=1.0), **design, **box)


class Heater(gym.Env):
    """x+ = .8 x + .5 u + load + noise, without set-point or cost."""

    def __init__(self, load: float = 0.0, noise: float = 0.0) -> None:
        self.load, self.noise = load, noise
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
        self.action_space = gym.spaces.Box(-2, 2, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-1, 1, 1)
        return self.x.astype(np.float32), {}

    def step(self, action):
        u = np.asarray(action, np.float64)
        self.x = 0.8 * self.x + 0.5 * u + self.load + self.noise * self.np_random.normal(size=1)
        return self.x.astype(np.float32), 0.0, False, False, {}


def plant(**faults: float) -> gym.Env:
    return SetPoint(Heater(**faults), -1, 1, hold=HOLD)


def train(env: gym.Env, mpc: LinearMPC, steps: int = 100) -> tuple[DDPG, CostAudit]:
    env = gym.wrappers.TimeLimit(StageCost(env, mpc), STEPS)
    kwargs = {"problem": mpc, "law": "online"}
    model = DDPG(YannPolicy, env, policy_kwargs=kwargs, gamma=mpc.gamma, seed=0, device="cpu")
    audit = CostAudit()
    model.learn(steps, callback=[NoActionNoise(), audit])
    return model, audit


@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_an_offset_that_was_seen_is_named_with_its_cure(noise) -> None:
    with pytest.warns(SteadyOffsetWarning, match=r"beside r\[0\].*offset_free"):
        _, audit = train(plant(load=0.15, noise=noise), heater())
    assert audit.finding.matches and "ObserveDisturbance" in audit.finding.rest


@pytest.mark.parametrize("faults", [{}, {"noise": 0.05}])
def test_a_plant_that_is_its_model_is_not_suspected(faults) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", SteadyOffsetWarning)
        _, audit = train(plant(**faults), heater())
    assert audit.finding.matches and audit.finding.rest == ""


def test_nothing_is_said_of_what_has_not_come_to_rest() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", SteadyOffsetWarning)
        _, audit = train(SetPoint(Heater(load=0.15), -1, 1, hold=8), heater())
    assert audit.finding.rest == ""


def test_training_goes_on_from_the_mpc_without_offset() -> None:
    mpc, observer = offset_free(heater())
    low, high = mpc.disturbances.d_min, mpc.disturbances.d_max

    def env() -> gym.Env:
        seen = ObserveDisturbance(plant(load=0.15), observer, low, high)
        return gym.wrappers.TimeLimit(StageCost(seen, mpc), STEPS)

    before = evaluate(mpc.online(), env, [0, 1])
    seen = ObserveDisturbance(plant(load=0.15), observer, low, high)
    model, audit = train(seen, mpc, steps=300)
    assert model._n_updates > 0 and audit.finding.matches and audit.finding.rest == ""
    after = evaluate(model, env, [0, 1])
    assert np.all(np.isfinite(after.costs)) and after.costs.mean() < 2 * before.costs.mean()
    x, r = before.observations[0][HOLD - 1, :2]
    assert abs(x - r) < 1e-3  # and with the plain MPC it is not
    plain = evaluate(heater().online(), lambda: gym.wrappers.TimeLimit(plant(load=0.15), HOLD), [0])
    assert abs(plain.observations[0][-2] @ [1, -1]) > 0.02
