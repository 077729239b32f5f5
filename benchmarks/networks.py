"""Actors and whole training steps, against Stable-Baselines3's own of 256-256."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3 import DDPG
from stable_baselines3.common.logger import Logger
from torch import nn

from benchmarks import peers
from benchmarks.online_problems import OnlineProblem
from benchmarks.problems import Array, Problem
from benchmarks.records import Bench, timed
from benchmarks.timing import Task
from sb3_yann import YannPolicy
from sb3_yann.control import LinearMPC

FORWARD_ONE = "actor, batch of 1"
PREDICT = "predict, one observation"
TRAIN = "training step, batch of 256"
OURS = "ours"
BATCH = 256
STORED = 5000


class Plant(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """The spaces of a problem; nobody steps it, its transitions are drawn."""

    def __init__(self, mpc: LinearMPC) -> None:
        low, high = (each.astype(np.float32) for each in (mpc.theta_min, mpc.theta_max))
        self.observation_space = gym.spaces.Box(low, high)
        self.action_space = gym.spaces.Box(
            mpc.u_min.astype(np.float32), mpc.u_max.astype(np.float32)
        )


def actor(bench: Bench, problem: Problem) -> None:
    """Measure the actors, float32 tensors in and out, and predict, numpy in and out."""
    models = {OURS: learner(problem, YannPolicy), peers.MLP: learner(problem, "MlpPolicy")}
    points = problem.points(4 * BATCH).astype(np.float32)
    one = [th.as_tensor(point[None]) for point in points]
    tasks = {name: Task(model.actor, one) for name, model in models.items()}
    with th.no_grad():
        bench.figures.add(timed(FORWARD_ONE, problem.regions, bench.watch.compare(tasks)))
    tasks = {name: Task(predictor(model), [*points]) for name, model in models.items()}
    bench.figures.add(timed(PREDICT, problem.regions, bench.watch.compare(tasks)))


def training(bench: Bench, problem: Problem) -> None:
    """Measure `model.train` for one gradient step: critic, actor and both targets."""
    tasks = {}
    for name, policy in ((OURS, YannPolicy), (peers.MLP, "MlpPolicy")):
        model = learner(problem, policy)
        fill(model, problem)
        tasks[name] = Task(lambda steps, model=model: model.train(steps, BATCH), [1])
    bench.figures.add(timed(TRAIN, problem.regions, bench.watch.compare(tasks)))


def learner(problem: Problem | OnlineProblem, policy: Any) -> DDPG:
    """Return DDPG with one of the policies, as after some training: no network is zero."""
    ours = policy is YannPolicy
    options = {"problem": problem.mpc, "critic_warmup": 0} if ours else {"net_arch": [256, 256]}
    model = DDPG(
        policy, Plant(problem.mpc), policy_kwargs=options, buffer_size=STORED, batch_size=BATCH,
        learning_rate=1e-4, seed=0, device="cpu",
    )  # fmt: skip
    model.set_logger(Logger(folder=None, output_formats=[]))
    if ours:
        for module in (model.actor, model.actor_target, model.critic, model.critic_target):
            disturb(module)
    model.policy.set_training_mode(False)
    return model


@th.no_grad()
def disturb(module: nn.Module) -> None:
    """Move all parameters a little, as training does."""
    generator = th.Generator().manual_seed(0)
    for parameter in module.parameters():
        parameter.add_(0.01 * th.randn(parameter.shape, generator=generator))


def fill(model: DDPG, problem: Problem | OnlineProblem) -> None:
    """Fill the replay buffer with transitions of the linear model from anywhere in the domain."""
    mpc = problem.mpc
    rng = np.random.default_rng(1)
    theta = problem.points(STORED, seed=1)
    u = rng.uniform(mpc.u_min, mpc.u_max, (STORED, len(mpc.u_min)))
    following = np.clip(mpc.predict(theta, u), mpc.theta_min, mpc.theta_max)
    rewards = -np.asarray(mpc.stage_cost(theta, u))
    actions: Array = model.policy.scale_action(u.astype(np.float32))
    buffer = model.replay_buffer
    assert buffer is not None
    for k in range(STORED):
        buffer.add(theta[k], following[k], actions[k], rewards[k], np.zeros(1), [{}])


def predictor(model: DDPG) -> Any:
    """Return a function of one observation."""
    return lambda observation: model.predict(observation, deterministic=True)
