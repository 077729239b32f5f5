"""A plant whose best input in each region is known, and what the guard's tests do to its actor."""

import copy
import random
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from sb3_yann import ImprovementGuard, LinearModel, LinearMPC, NoActionNoise, YannPolicy
from weights import last_layer

LEFT, CENTER, RIGHT = range(3)
STEPS = 4
"""Steps of an episode."""
FIRST = 1_000_000
"""The first of the guard's own seeds."""


def slide_mpc() -> LinearMPC:
    """Three regions: the input is saturated to the left and to the right of |x| = about 1.4."""
    return LinearMPC(
        LinearModel([[1.1]], [[1]], 1),
        Q=[[1]],
        R=[[1]],
        horizon=1,
        u_min=-1,
        u_max=1,
        theta_min=-5,
        theta_max=5,
    )


MPC = slide_mpc()
LAW = MPC.explicit()
_SIDES = [int(LAW.locate(np.array([x]))) for x in (-4.0, 0.0, 4.0)]
REGION = dict(zip((LEFT, CENTER, RIGHT), _SIDES, strict=True))


class Slide(gym.Env):
    """x halves at each step whatever the input is; a step costs 1 + (u - best input)^2.

    The best input is half the MPC's where that is saturated, and the MPC's own near the origin.
    A step with ``u`` beyond the limits given is a violation. Starts are uniform in [low, high].
    """

    def __init__(
        self, limits: tuple[float, float] = (-1.1, 1.1), low: float = -4.0, high: float = 4.0
    ) -> None:
        self.limits = limits
        self.low = low
        self.high = high
        self.observation_space = gym.spaces.Box(-5, 5, (1,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        self.played = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(self.low, self.high, 1)
        self.t = 0
        return self.x.astype(np.float32), {}

    def step(self, action):
        u = float(np.asarray(action)[0])
        if np.isnan(u):
            raise ValueError("nan is not an input")
        best = float(LAW(self.x)[0])
        cost = 1 + (u - (best / 2 if abs(best) > 0.999 else best)) ** 2
        info = {"violation": not self.limits[0] <= u <= self.limits[1]}
        self.x = self.x / 2
        self.t += 1
        self.played += 1
        return self.x.astype(np.float32), -cost, False, self.t == STEPS, info


class CutOff(Slide):
    """Does something when an episode begins from one of the seeds."""

    def __init__(self, at: int, act: Callable[[], Any]) -> None:
        super().__init__()
        self.at = at
        self.act = act

    def reset(self, *, seed=None, options=None):
        if seed == self.at:
            self.act()
        return super().reset(seed=seed, options=options)


if "Slide-v0" not in gym.registry:
    gym.register("Slide-v0", entry_point="guard_samples:Slide")


def build(algorithm=DDPG, env: Any = None, actor: dict[str, Any] | None = None, **kwargs):
    """Return a small model that learns from its first step on."""
    policy = {"net_arch": {"pi": [3], "qf": [4]}, "critic_warmup": 0, "problem": MPC}
    options = {"seed": 0, "batch_size": 8, "learning_starts": 0, "learning_rate": 1e-2}
    options |= {"buffer_size": 1000, "device": "cpu"}
    env = Slide() if env is None else env
    return algorithm(YannPolicy, env, policy_kwargs=policy | (actor or {}), **(options | kwargs))


STRICT = {"cvar_alpha": 0, "backtrack": False}
"""No single start may lose, and nothing but regions of a candidate is tried."""


def make_guard(env: Any = Slide, *, rule: Any = {}, **kwargs) -> ImprovementGuard:  # noqa: B006
    """Return a strict guard of ten known starts, and of few new ones unless it is said how many."""
    if isinstance(rule, dict):
        rule = STRICT | rule
    options = {"n_eval_episodes": 10, "patience": 1}
    if "n_new_starts" not in kwargs:
        options |= {"n_new_starts": 5, "n_final_starts": 10}
    return ImprovementGuard(env, rule=rule, **(options | kwargs))


def tried(*acts: Callable[[YannPolicy], Any], env: Any = Slide, actor: Any = None, **options):
    """Return a model and its guard, after an episode for each act, which makes a candidate."""
    model = build(gradient_steps=0, actor=actor)
    guard = make_guard(env, **options)
    moves = [At([(i + 1) * STEPS], act) for i, act in enumerate(acts)]
    train(model, len(acts) * STEPS, *moves, guard)
    return model, guard


@th.no_grad()
def correct(policy: YannPolicy, region: int, value: float) -> None:
    """Make the actor's input in a region (not the center) the MPC's plus a constant."""
    last_layer(policy)[REGION[region]] = 0.0
    last_layer(policy)[REGION[region], :, -1] = value


def better(policy: YannPolicy) -> None:
    """Make the actor the best one in both saturated regions."""
    correct(policy, LEFT, -0.5)
    correct(policy, RIGHT, 0.5)


def worse(policy: YannPolicy) -> None:
    correct(policy, LEFT, -2.0)
    correct(policy, RIGHT, 2.0)


@th.no_grad()
def overwrite(policy: YannPolicy, value: float) -> None:
    for parameter in policy.actor.parameters():
        parameter.fill_(value)


@th.no_grad()
def randomize(policy: YannPolicy, size: float = 5.0) -> None:
    generator = th.Generator().manual_seed(1)
    for parameter in policy.actor.parameters():
        parameter.copy_(size * th.randn(parameter.shape, generator=generator))


@th.no_grad()
def blow_up(policy: YannPolicy) -> None:
    """Give opposite weights that overflow: inf - inf in the first layer."""
    overwrite(policy, 3e38)


class At(BaseCallback):
    """Does something to the policy at some of the steps, counted from 1."""

    def __init__(self, steps: Any, act: Callable[[YannPolicy], Any]) -> None:
        super().__init__()
        self.steps = steps
        self.act = act

    def _on_step(self) -> bool:
        if self.n_calls in self.steps:
            self.act(self.model.policy)
        return True


def train(model, steps: int, *callbacks: BaseCallback, **kwargs) -> None:
    model.learn(steps, callback=CallbackList([NoActionNoise(), *callbacks]), **kwargs)


def bits(value: Any) -> Any:
    """Return a copy of tensors, arrays and containers that compares bit for bit."""
    if isinstance(value, th.Tensor):
        return value.detach().cpu().numpy().tobytes(), str(value.dtype)
    if isinstance(value, np.ndarray):
        return value.tobytes(), str(value.dtype)
    if isinstance(value, dict):
        return {key: bits(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [bits(each) for each in value]
    return copy.deepcopy(value)


def actor_bits(policy: YannPolicy) -> dict[str, Any]:
    """Return all that is restored, but the rate, which SB3 sets before every step."""
    return {
        "actor": bits(policy.actor.state_dict()),
        "target": bits(policy.actor_target.state_dict()),
        "optimizer": bits(policy.actor.optimizer.state_dict()["state"]),
    }


def critic_bits(policy: YannPolicy) -> dict[str, Any]:
    return {
        "critic": bits(policy.critic.state_dict()),
        "target": bits(policy.critic_target.state_dict()),
        "optimizer": bits(policy.critic.optimizer.state_dict()),
        "updates": bits(policy.critic_updates),
    }


def accepted_bits(owner: Any) -> dict[str, Any]:
    """Return the same of what a guard, or the guard of a model, has accepted."""
    accepted = (owner.guard_state if hasattr(owner, "guard_state") else owner.state).accepted
    return {
        "actor": bits(accepted.actor),
        "target": bits(accepted.target),
        "optimizer": bits(accepted.optimizer["state"]),
    }


def buffer_bits(model) -> list[Any]:
    buffer = model.replay_buffer
    parts = (buffer.observations, buffer.next_observations, buffer.actions, buffer.rewards)
    return [buffer.pos, *map(bits, parts), bits(buffer.dones), bits(buffer.timeouts)]


def random_states() -> list[Any]:
    legacy = np.random.get_state()  # noqa: NPY002
    return [random.getstate(), bits(legacy[1]), legacy[2], bits(th.get_rng_state())]


def env_random_states(model) -> list[Any]:
    return [each.unwrapped.np_random.bit_generator.state for each in model.get_env().envs]


def verdicts(guard: ImprovementGuard) -> list[str]:
    return [each.verdict for each in guard.decisions]
