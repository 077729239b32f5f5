"""The yardsticks: what a user would pick instead of a YANN policy.

Each builder takes ``make_env``, a function without arguments that returns the plain environment
(once, so that it may record what is executed), and a seed. It returns a `Learner`, ready for
``learner.model.learn(steps, callback=learner.callbacks)``.

All learners share two hidden layers of 256, and observations that suit them. The pendulum's angle
becomes its cosine and sine. The reactor's deviations stay as they are, in mol/L and K: the
temperature then dominates the input as it dominates the cost, and DDPG learns faster and more
safely than with every deviation divided by the largest of its starts. Batches of 100 take less time
than SB3's 256 and were no worse. Inputs are scaled by SB3. Where SB3 starts from random networks it
also plays its first 100 actions at random, its default; a learner that starts from the MPC never
does.

SAC and TQC have the learning rate that rl_zoo3 publishes for Pendulum-v1, the nearest to these
plants of what it has tuned. PPO has SB3's defaults with its VecNormalize: rl_zoo3's settings for
that pendulum, without it, were better on the reactor and were not tried on the pendulum, which
only normalized PPO learnt; one seed, that no table shows.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.wrappers import RescaleAction, TransformObservation
from numpy.typing import ArrayLike, NDArray
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_yann import LinearMPC
from sb3_yann.control import lqr as formulas
from sb3_yann.rollout import evaluate
from sb3_yann_envs.clipped_pendulum import ClippedPendulumEnv

Array: TypeAlias = NDArray[Any]
Env: TypeAlias = gym.Env[Array, Array]
Law: TypeAlias = Callable[[ArrayLike], Array]
MakeEnv: TypeAlias = Callable[[], Env]

NOISE = 0.1
"""Standard deviation of the exploration, as a fraction of half the input range."""
BURN_IN = 2_000
"""Gradient steps for which an actor that starts well waits for its critic, which does not."""
CLONING_SEEDS = range(500, 540)
"""Starts from which the MPC shows the cloned actor what it does."""
CLONING_STEPS = 2_000
"""Gradient steps of the cloning, each on 256 states."""

_SETTINGS: dict[str, Any] = {
    "policy_kwargs": {"net_arch": [256, 256]},
    "batch_size": 100,
    "buffer_size": 200_000,
    "device": "cpu",
}

TUNED: dict[str, Any] = {"learning_rate": 1e-3}
"""Of SAC and TQC."""


@dataclass(frozen=True)
class Learner:
    """A model to train, and the policy that comes of it.

    Parameters
    ----------
    model : BaseAlgorithm
        It learns on a wrapped environment; use `policy` to ask it for actions.
    policy : Controller
        Acts on the observations of the plain environment, in its units, also while training.
    callbacks : list of BaseCallback
        To be passed to ``model.learn``.
    """

    model: BaseAlgorithm
    policy: Controller
    callbacks: list[BaseCallback] = field(default_factory=list)


@dataclass(frozen=True)
class Controller:
    """Maps plain observations to plain actions: a model alone, or on top of a law.

    ``features`` maps plain observations, one or a batch, to those of the model; ``combine`` maps
    plain observations and the model's actions to plain actions.
    """

    model: BaseAlgorithm | BasePolicy
    features: Law
    combine: Callable[[ArrayLike, Array], Array] | None = None

    def predict(self, observation: ArrayLike, deterministic: bool = True) -> tuple[Array, None]:
        """Return the action without noise, (m,) for (n,) or (batch, m) for (batch, n), and None."""
        action, _ = self.model.predict(self.features(observation), deterministic=deterministic)
        return (action if self.combine is None else self.combine(observation, action)), None


class Residual(gym.Wrapper[Array, Array, Array, Array]):
    """Executes the law's action plus the agent's, clipped.

    The agent's action reaches from one bound to the other, so no action is out of its reach
    wherever the law is, and 0 is the middle of its range whatever the bounds are.
    """

    def __init__(self, env: Env, law: Law) -> None:
        super().__init__(env)
        self.law = law
        reach = env.action_space.high - env.action_space.low
        self.action_space = gym.spaces.Box(-reach, reach, dtype=np.float32)

    def combine(self, observation: ArrayLike, residual: Array) -> Array:
        """Return the action that is executed, for one observation or a batch."""
        space = self.env.action_space
        u = np.clip(self.law(observation) + residual, space.low, space.high)
        return np.asarray(u, dtype=np.float32)

    def reset(self, **kwargs: Any) -> tuple[Array, dict[str, Any]]:
        """Reset the environment."""
        self._observation, info = self.env.reset(**kwargs)
        return self._observation, info

    def step(self, action: Array) -> tuple[Array, Any, bool, bool, dict[str, Any]]:
        """Add the law's action for the latest observation."""
        self._observation, *rest = self.env.step(self.combine(self._observation, action))
        return self._observation, *rest


class BurnIn(BaseCallback):
    """Freezes the actor until the critic has had ``steps`` gradient steps."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def _on_step(self) -> bool:
        self.model.actor.requires_grad_(self.model._n_updates >= self.steps)
        return True


class KeepBest(BaseCallback):
    """Keeps a copy of the best policy so far, tried after every episode as SB3's EvalCallback does.

    On the same starts in a simulator that the guard of a YANN policy has, so that the two have the
    same choice.
    """

    def __init__(self, model: TD3, features: Law, seeds: range) -> None:
        super().__init__()
        self.features = features
        self.seeds = seeds
        self.env_id = model.get_env().envs[0].unwrapped.spec.id
        self.kept = copy.deepcopy(model.policy)
        self.cost = np.inf

    def _on_step(self) -> bool:
        if self.locals["dones"][0]:
            policy = Controller(self.model.policy, self.features)
            cost = float(evaluate(policy, self.env_id, self.seeds).costs.mean())
            if cost < self.cost:
                self.cost = cost
                self.kept.load_state_dict(self.model.policy.state_dict())
        return True


def best_of_ddpg(make_env: MakeEnv, seed: int, seeds: range) -> Learner:
    """Return `sb3_ddpg` whose policy is the best it had after any episode, on the starts given."""
    learner = sb3_ddpg(make_env, seed)
    best = KeepBest(learner.model, learner.policy.features, seeds)
    return Learner(learner.model, Controller(best.kept, learner.policy.features), [best])


def sb3_ddpg(make_env: MakeEnv, seed: int) -> Learner:
    """Return SB3's DDPG with Gaussian noise (Lillicrap et al., ICLR 2016), from random networks."""
    return _plain(DDPG, make_env, seed)


def sb3_td3(make_env: MakeEnv, seed: int) -> Learner:
    """Return SB3's TD3 with Gaussian noise (Fujimoto et al., ICML 2018), from random networks."""
    return _plain(TD3, make_env, seed)


def algorithm_named(name: str) -> Any:
    """Return SAC, TQC or PPO; TQC is sb3-contrib's."""
    if name == "TQC":
        from sb3_contrib import TQC

        return TQC
    return {"SAC": SAC, "PPO": PPO}[name]


def maximum_entropy(make_env: MakeEnv, seed: int, algorithm: str) -> Learner:
    """Return SB3's SAC or sb3-contrib's TQC, from random networks.

    References
    ----------
    T. Haarnoja et al., Soft actor-critic, ICML 2018. A. Kuznetsov et al., Controlling
    overestimation bias with truncated mixture of continuous distributional quantile critics, ICML
    2020.
    """
    return _plain(algorithm_named(algorithm), make_env, seed, noise=0.0, **TUNED)


def sb3_ppo(make_env: MakeEnv, seed: int) -> Learner:
    """Return SB3's PPO (Schulman et al., arXiv:1707.06347, 2017), from random networks."""
    env = make_env()
    seen, features = _featured(env)
    # What PPO draws is not scaled by SB3.
    normalized = VecNormalize(DummyVecEnv([lambda: Monitor(RescaleAction(seen, -1, 1))]))
    model = PPO("MlpPolicy", normalized, seed=seed, device="cpu")

    def combine(_: ArrayLike, action: Array) -> Array:
        half = (env.action_space.high - env.action_space.low) / 2
        return np.asarray(env.action_space.low + half * (action + 1), dtype=np.float32)

    return Learner(
        model, Controller(model, lambda each: normalized.normalize_obs(features(each)), combine)
    )


def residual_rl(make_env: MakeEnv, seed: int, noise: float = NOISE) -> Learner:
    """Return residual reinforcement learning: the linear MPC plus what DDPG adds to it.

    The residual is zero at first, the start is the MPC exactly. The actor waits for `BURN_IN`
    steps of its critic, as in both papers. Nothing uniformly random is ever played: the residual
    explores from zero with ``noise``, in the same units as the others.

    Parameters
    ----------
    make_env : callable
        Makes the training env.
    seed : int
        Of networks, noise and env.
    noise : float, default 0.1
        Standard deviation as a fraction of half the input range; with 0 no noise at all is played.

    References
    ----------
    T. Silver, K. Allen, J. Tenenbaum, L. Kaelbling, Residual policy learning, arXiv:1812.06298,
    2018. T. Johannink et al., Residual reinforcement learning for robot control, ICRA 2019.
    """
    env = make_env()
    wrapped = Residual(env, env.observation_space.problem.explicit())
    # The residual's range is twice the input's, so that half the fraction is the same noise.
    learner = _plain(DDPG, lambda: wrapped, seed, noise / 2, learning_starts=0)
    for parameter in learner.model.actor.mu[-2].parameters():  # the last layer; then comes tanh
        nn.init.zeros_(parameter)
    learner.model.actor_target.load_state_dict(learner.model.actor.state_dict())
    policy = Controller(learner.model, learner.policy.features, wrapped.combine)
    return Learner(learner.model, policy, [BurnIn(BURN_IN)])


def cloned(make_env: MakeEnv, seed: int) -> Learner:
    """Return DDPG from an actor that was fitted to the linear MPC before.

    Behavior cloning minimizes the squared error of the input, with Adam, on states that the MPC
    visits from the environment's own starts, and on as many around them. The root mean squared
    error at states from other starts is below 1 % of the input range wherever the MPC has a
    solution; outside, where the pendulum's law jumps, it is larger. As in `residual_rl` the actor
    then waits for its critic, and nothing uniformly random is played.

    References
    ----------
    D. Pomerleau, Efficient training of artificial neural networks for autonomous navigation,
    Neural Computation 3(1), 1991.
    """
    learner = _plain(DDPG, make_env, seed, learning_starts=0)
    env = learner.model.get_env().envs[0].unwrapped
    law = env.observation_space.problem.explicit()
    space = env.action_space
    rng = np.random.default_rng(seed)
    # On an environment of its own: the caller's may record.
    states = np.concatenate(evaluate(law, env.spec.id, CLONING_SEEDS).observations)
    spread = np.abs(states).max(axis=0)
    states = np.concatenate([states, states + rng.normal(0, 0.1, states.shape) * spread])
    inputs = 2 * (law(states) - space.low) / (space.high - space.low) - 1
    features = th.as_tensor(learner.policy.features(states), dtype=th.float32)
    _regress(learner.model.actor, features, th.as_tensor(inputs, dtype=th.float32), rng)
    learner.model.actor_target.load_state_dict(learner.model.actor.state_dict())
    return Learner(learner.model, learner.policy, [BurnIn(BURN_IN)])


def lqr(problem: LinearMPC) -> Law:
    """Return the unconstrained LQR of the problem, clipped to its bounds of the input.

    Returns
    -------
    callable
        From observations (n,) or (batch, n) to float32 actions (m,) or (batch, m).
    """
    P = formulas.riccati(problem.model, problem.Q, problem.R, problem.gamma)
    K = formulas.gain(problem.model, problem.R, P, problem.gamma)

    def law(observation: ArrayLike) -> Array:
        u = -np.asarray(observation, dtype=np.float64) @ K.T
        return np.clip(u, problem.u_min, problem.u_max).astype(np.float32)

    return law


def _plain(
    algorithm: Any, make_env: MakeEnv, seed: int, noise: float = NOISE, **settings: Any
) -> Learner:
    """Return the algorithm on ``make_env()``, seen through the features."""
    env = make_env()
    seen, features = _featured(env)
    zero = np.zeros(env.action_space.shape)
    model = algorithm(
        "MlpPolicy",
        seen,
        action_noise=NormalActionNoise(zero, zero + noise) if noise > 0 else None,
        seed=seed,
        **{**copy.deepcopy(_SETTINGS), **settings},  # algorithms write into policy_kwargs
    )
    return Learner(model, Controller(model, features))


def _featured(env: Env) -> tuple[Env, Law]:
    """Return an env that shows its features, and what makes them of its observations."""
    features = _circle if isinstance(env.unwrapped, ClippedPendulumEnv) else np.asarray
    shape = features(env.observation_space.low).shape
    space = gym.spaces.Box(-np.inf, np.inf, shape, np.float32)
    return TransformObservation(env, features, space), features


def _circle(observation: ArrayLike) -> Array:
    """Return cosine and sine of the angle, and the speed, as Gymnasium's pendulum does."""
    angle, speed = np.moveaxis(np.asarray(observation, dtype=np.float32), -1, 0)
    return np.stack([np.cos(angle), np.sin(angle), speed], axis=-1)


def _regress(
    actor: nn.Module, features: th.Tensor, targets: th.Tensor, rng: np.random.Generator
) -> None:
    """Fit the actor's outputs, in [-1, 1], to the targets by least squares."""
    optimizer = th.optim.Adam(actor.parameters(), 2e-3)
    schedule = th.optim.lr_scheduler.CosineAnnealingLR(optimizer, CLONING_STEPS)
    for _ in range(CLONING_STEPS):
        rows = th.as_tensor(rng.integers(len(features), size=256))
        loss = nn.functional.mse_loss(actor(features[rows]), targets[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
