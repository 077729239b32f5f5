"""From a log in the plant's own units to a policy that acts in them."""

from __future__ import annotations

from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_yann import LinearModel, LinearMPC, PlantTwin, improve
from sb3_yann.evaluation import evaluate
from twin_samples import DT, Cart, problem

X_SS, U_SS = np.array([20.0, 3.0]), np.array([7.0])


@cache
def plant_problem() -> LinearMPC:
    cart = problem()
    return LinearMPC(
        LinearModel(cart.model.A, cart.model.B, DT, x_ss=X_SS, u_ss=U_SS),
        Q=cart.Q, R=cart.R, horizon=3, u_min=6, u_max=8,
        theta_min=X_SS - 3, theta_max=X_SS + 3,
    )  # fmt: skip


class OwnCart(gym.Env):
    """The cart of the other tests, about another origin."""

    def __init__(self) -> None:
        self.cart = Cart()
        self.observation_space = gym.spaces.Box(np.float32(X_SS - 3), np.float32(X_SS + 3))
        self.action_space = gym.spaces.Box(6, 8, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        _, info = self.cart.reset(seed=seed)
        return np.float32(self.cart.x + X_SS), info

    def step(self, action):
        _, *rest = self.cart.step(np.asarray(action) - U_SS)
        return np.float32(self.cart.x + X_SS), *rest


@pytest.mark.slow
def test_a_log_in_the_plants_units_improves_a_policy_that_acts_in_them(tmp_path) -> None:
    mpc = plant_problem()
    law = mpc.explicit()
    log = evaluate(law, OwnCart, range(5))
    twin = PlantTwin.fit(mpc, [*zip(log.observations, log.actions, strict=True)])
    assert twin.trusted
    model = DDPG("YannPolicy", OwnCart(), policy_kwargs={"problem": mpc}, seed=0)
    found = improve(model, twin, updates=1000, n_starts=10)
    assert found.accepted and str(found).startswith("Accepted: a better policy.")
    model.save(tmp_path / "model")
    again = DDPG.load(tmp_path / "model", env=OwnCart())
    ours, before = (evaluate(each, OwnCart, range(100, 120)) for each in (again, law))
    assert ours.costs.mean() < 0.97 * before.costs.mean()
    assert np.all(ours.costs < before.costs)
