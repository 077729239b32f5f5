"""A reward that is not the stage cost is reported where that cost counts, and no other."""

from __future__ import annotations

import dataclasses
import warnings
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_yann import CostMismatchWarning, LinearModel, LinearMPC, Tracking, headroom, improve
from sb3_yann.audit.meaning import below_set_points, warn_of_own_reward
from sb3_yann.improvement.simulator import of_law
from sb3_yann.rollout import Trajectories, rollout
from sb3_yann.wrappers import SetPoint, StageCost

PLANT = LinearModel([[0.9, 0.2], [0, 0.7]], [[0], [1]], 1.0)


def mpc() -> LinearMPC:
    bounds = {"theta_min": -9, "theta_max": 9, "u_min": -2, "u_max": 2}
    return LinearMPC(PLANT, Q=np.diag([1, 0.1]), R=[[0.1]], horizon=3, **bounds)


class Rewarded(gym.Env):
    """A linear plant, and a reward that is a function of state, input and next state."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-2, 2, (1,), np.float64)

    def __init__(self, reward) -> None:
        self.reward = reward

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.t = self.np_random.uniform(-3, 3, 2), 0
        if options is not None:
            self.state = np.array(options["state"])
        return self.state.copy(), {}

    def step(self, action):
        before, self.t = self.state, self.t + 1
        self.state = PLANT.step(before, action)
        reward = self.reward(before, action, self.state)
        return self.state.copy(), reward, False, self.t == 25, {}


def stage(x, u, after) -> float:
    return -float(mpc().stage_cost(x, u))


OTHER = {
    "another weight": lambda x, u, after: -float(x[1] ** 2),
    "the cost itself": lambda x, u, after: float(mpc().stage_cost(x, u)),
    "a profit": lambda x, u, after: float(x[0]),
    "one for each step": lambda x, u, after: 1.0,
}
SAME = {
    "minus the cost": stage,
    "in other units": lambda x, u, after: 7 * stage(x, u, after) + 3,
    "of the next state": lambda x, u, after: stage(after, u, after),
    "none": lambda x, u, after: 0.0,
    "no number": lambda x, u, after: None,
}


def told(env, problem: LinearMPC, seeds: int = 4) -> list[str]:
    played = rollout(of_law(problem), env, range(seeds), problem=problem)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        warn_of_own_reward(problem, played)
    return [str(each.message) for each in found]


@pytest.mark.parametrize("kind", OTHER)
def test_a_reward_of_its_own_is_reported(kind: str) -> None:
    (message,) = told(partial(Rewarded, OTHER[kind]), mpc())
    assert "The env has a reward of its own, and it is ignored" in message
    assert "over 100 steps" in message and "state it in Q and R" in message


@pytest.mark.parametrize("kind", SAME)
def test_minus_the_stage_cost_is_none_in_any_units(kind: str) -> None:
    assert not told(partial(Rewarded, SAME[kind]), mpc())


@pytest.mark.parametrize("kind", OTHER)
def test_the_reward_of_the_wrapper_is_none(kind: str) -> None:
    assert not told(lambda: StageCost(Rewarded(OTHER[kind]), mpc()), mpc())


def test_what_a_violation_or_a_termination_costs_does_not_count() -> None:
    class Ends(gym.Wrapper):
        def step(self, action):
            seen, reward, *_ = self.env.step(action)
            t = self.unwrapped.t
            return seen, reward - 1e4 * (t in (3, 20)), t == 20, False, {"violation": t == 3}

    assert not told(lambda: Ends(Rewarded(stage)), mpc())


def test_a_reward_that_knows_nothing_of_the_set_points_is_none() -> None:
    plain, held = Rewarded(stage), SetPoint(Rewarded(stage), -1, 1)
    assert below_set_points(gym.wrappers.TimeLimit(held, 9)) and not below_set_points(plain)
    tracking = dataclasses.replace(mpc(), tracking=Tracking([0], -1, 1))
    headroom(tracking, held, n_starts=2)  # a warning would be an error


def test_a_few_steps_and_a_plant_at_rest_say_nothing() -> None:
    problem = mpc()
    for steps, theta in ((9, 1.0), (30, 0.0)):
        thetas, inputs = np.full((steps + 1, 2), theta), np.zeros((steps, 1))
        none, rewards = np.zeros(1, dtype=int), np.arange(float(steps))
        played = Trajectories(
            none.astype(float),
            none,
            (thetas,),
            (inputs,),
            none.astype(bool),
            own_rewards=(rewards,),
        )
        warn_of_own_reward(problem, played)


def test_headroom_and_improve_tell_once_and_point_to_the_call() -> None:
    env, problem = Rewarded(OTHER["a profit"]), mpc()
    with pytest.warns(CostMismatchWarning, match="it is ignored") as found:
        assert "By its own stage cost" in str(headroom(problem, env, n_starts=2))
    assert [each.filename for each in found] == [__file__]
    model = DDPG("YannPolicy", env, policy_kwargs={"problem": problem}, device="cpu")
    with pytest.warns(CostMismatchWarning, match="it is ignored") as found:
        improve(model, env, updates=1, n_starts=2, rounds=1)
    assert [each.filename for each in found] == [__file__]
