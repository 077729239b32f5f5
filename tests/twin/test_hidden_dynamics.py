"""A memory of inputs and errors shows where a plant has dynamics that nobody modelled."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_yann import LinearModel, LinearMPC, PlantTwin, improve
from sb3_yann.evaluation import evaluate

MPC = LinearMPC(
    LinearModel([[0.92]], [[0.25]], 1.0), Q=[[1]], R=[[0.08]], horizon=3,
    x_min=-2, x_max=2, u_min=-1, u_max=1,
)  # fmt: skip


class Lagging(gym.Env[Any, Any]):
    """A part of the gain behind a first-order actuator, and sensor noise."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float64)

    def __init__(self, lag: float, gain: float, noise: float = 0.006) -> None:
        self.lag, self.gain, self.noise = lag, gain, noise

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.u, self.k = self.np_random.uniform(-1.3, 1.3, 1), np.zeros(1), 0
        return self.x + self.noise * self.np_random.normal(size=1), {}

    def step(self, action):
        a, self.k = np.asarray(action, float), self.k + 1
        cost = float(MPC.stage_cost(self.x, a))
        self.u = self.lag * self.u + (1 - self.lag) * a
        self.x = 0.92 * self.x + 0.25 * self.gain * self.u
        return self.x + self.noise * self.np_random.normal(size=1), -cost, False, self.k >= 40, {}


def twin(plant: Lagging, episodes: int = 6) -> PlantTwin:
    log = evaluate(MPC.explicit(), lambda: copy.copy(plant), range(100, 100 + episodes))
    return PlantTwin.fit(MPC, [*zip(log.observations, log.actions, strict=True)])


def test_a_memory_predicts_episodes_of_a_lagging_actuator_better_than_no_memory() -> None:
    plant = Lagging(0.4, 0.5, noise=0.0)
    found = twin(plant)
    memory = found.hidden_dynamics
    assert memory is not None
    law = MPC.explicit()
    played = np.array(evaluate(law, lambda: copy.copy(plant), range(900, 920)).observations)
    given = np.zeros((40, len(played), 0))
    errors = []
    for each in (memory, found.second_opinion, found.dynamics):
        starts = np.repeat(played[None, :, 0], len(getattr(each, "members", [0])), axis=0)
        rows = each.roll_out(lambda x: law(x), starts, 40, given)[0][:, 0, :, 0]
        errors.append(np.sqrt(np.mean((rows - played[:, :, 0].T) ** 2)))
    assert errors[0] < 0.7 * min(errors[1:])


@pytest.mark.slow
@pytest.mark.parametrize(("lag", "gain"), [(0.4, 0.4), (0.3, 0.5)])
def test_a_twin_that_knows_no_lag_promises_nothing_that_the_plant_does_not_keep(
    lag: float, gain: float
) -> None:
    plant = Lagging(lag, gain)
    fitted = twin(plant)
    if not fitted.trusted:
        return
    model = DDPG("YannPolicy", fitted.env(), policy_kwargs={"problem": MPC}, device="cpu", seed=1)
    if improve(model, fitted, updates=1000, seed=1).accepted:
        seeds = range(5000, 5100)
        ours = evaluate(model, lambda: copy.copy(plant), seeds).costs
        assert ours.mean() < evaluate(MPC.explicit(), lambda: copy.copy(plant), seeds).costs.mean()
