"""Rewards and observations that do not mean what the problem says, and what an audit finds."""

import dataclasses
import warnings

import gymnasium as gym
import numpy as np
from gymnasium import spaces, wrappers
from stable_baselines3 import DDPG

from sample_plants import LinearPlant, two_input_mpc
from sb3_yann import (
    ActionRepeat,
    AffineObservation,
    CostAudit,
    CostMismatchWarning,
    NoActionNoise,
    YannPolicy,
)

MPC = two_input_mpc()


class Changed(gym.Wrapper):
    """Passes each step through a function (env, theta, action, outcome) -> outcome."""

    def __init__(self, env: gym.Env, change) -> None:
        super().__init__(env)
        self.change = change

    def step(self, action):
        theta = self.unwrapped.x
        return self.change(self.unwrapped, theta, action, self.env.step(action))


def plant(mpc=MPC, steps: int = 20) -> gym.Env:
    return wrappers.TimeLimit(LinearPlant(mpc, 2.0), steps)


def audited(env, mpc=MPC, steps: int = 100, policy=None, learn: int = 110, **kwargs) -> CostAudit:
    """Return what an audit finds in an env, with any warning that is not its own an error.

    What the env shows is said: else the policy itself would object to some wrappers.
    """
    given = AffineObservation.identity(mpc.n_theta)
    options = {"problem": mpc, "observation": given, **(policy or {})}
    model = DDPG(YannPolicy, env, policy_kwargs=options, seed=0, gradient_steps=0, buffer_size=500)
    audit = CostAudit(steps, **kwargs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CostMismatchWarning)
        model.learn(learn, callback=[NoActionNoise(), audit])
    return audit


def boxed() -> gym.Env:
    env = LinearPlant(MPC, 2.0)
    env.observation_space = spaces.Box(np.float32([-5, -5, -5]), np.float32([5, 6, 7]))
    return wrappers.TimeLimit(env, 20)


def with_other_inputs() -> gym.Env:
    env = LinearPlant(MPC, 2.0)
    env.action_space = spaces.Box(np.float32([-3, -1]), np.float32([1, 2]))
    return wrappers.TimeLimit(env, 20)


def at_the_next_state(env, theta, action, outcome):
    observation, _, *rest = outcome
    return observation, -float(MPC.stage_cost(observation, action)), *rest


def shifted(observation):
    return (observation + np.float32([0.3, 0.6, -0.9])).astype(np.float32)


def show_shifted(env: gym.Env) -> gym.Env:
    return wrappers.TransformObservation(env, shifted, env.observation_space)


OTHER = dataclasses.replace(MPC, Q=np.diag([1, 2, 3]), R=MPC.R / 2, terminal=None)
LOW = MPC.u_min.astype(np.float32)
HIGH = MPC.u_max.astype(np.float32)

# What is done to the env; of those below also what it is taken for, and what else is said.
UNKNOWN = {
    "NormalizeReward": lambda: wrappers.NormalizeReward(plant()),
    "ClipReward": lambda: wrappers.ClipReward(plant(), -1.0),
    "DelayObservation by two": lambda: wrappers.DelayObservation(plant(), 2),
    "StickyAction": lambda: wrappers.StickyAction(plant(), 0.3),
    "ActionRepeat": lambda: ActionRepeat(plant(), 2),
    "RescaleAction": lambda: wrappers.RescaleAction(with_other_inputs(), LOW, HIGH),
    "RescaleObservation": lambda: wrappers.RescaleObservation(
        boxed(), np.float32(-1), np.float32(1)
    ),
    "other weights": lambda: plant(OTHER),
}
WRONG = {
    **{kind: (make, "unknown", "step by step: weights, units") for kind, make in UNKNOWN.items()},
    "TransformReward: sign": (
        lambda: wrappers.TransformReward(plant(), lambda reward: -reward),
        "sign flipped",
        "The learner would maximize it",
    ),
    "TransformReward: scale": (
        lambda: wrappers.TransformReward(plant(), lambda reward: 0.01 * reward),
        "scaled",
        'policy_kwargs={"critic": {"reward_scale": 0.01, "reward_offset": 0}}',
    ),
    "TransformReward: scale and offset": (
        lambda: wrappers.TransformReward(plant(), lambda reward: 0.5 * reward + 10),
        "scaled and shifted",
        '"reward_scale": 0.5',
    ),
    "TransformReward: constant": (
        lambda: wrappers.TransformReward(plant(), lambda reward: 1.0),
        "constant",
        "every reward is 1",
    ),
    "TransformReward: bent": (
        lambda: wrappers.TransformReward(plant(), lambda reward: -np.sqrt(-reward)),
        "unknown",
        "R² = 0.9",
    ),
    "the next state": (lambda: Changed(plant(), at_the_next_state), "next state", "c(s', u)"),
}
