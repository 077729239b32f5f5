"""Simulators and plants that fail, each in its own way, while a policy learns under the guard."""

from __future__ import annotations

import os
import signal
import threading
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_yann import ImprovementGuard, NoActionNoise

ENV = "CSTR-v0"
WAYS = (
    "raises an error",
    "shows NaN",
    "pays NaN",
    "shows infinity",
    "terminates at step 0",
    "shows another shape",
    "shows float64",
    "never ends",
    "loses a worker",
)
WHERE = "training", "the guard's trials"
PAIRS = [
    (way, where) for way in WAYS for where in WHERE if (way, where) != ("loses a worker", WHERE[1])
]
"""The guard's env is one, in the same process."""
SHOWN = 160
PATIENCE = 20
"""Seconds after which what never ends meets Ctrl-C."""


class Faulty(gym.Wrapper[Any, Any, Any, Any]):
    """A simulator that fails in its own way from some step of an episode on."""

    def __init__(self, way: str, at: int = 40) -> None:
        super().__init__(gym.make(ENV).unwrapped if way == "never ends" else gym.make(ENV))
        self.way, self.at, self.taken = way, at, 0

    def reset(self, **kwargs: Any) -> Any:
        """Begin an episode."""
        self.taken = 0
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> Any:
        """Step, and fail."""
        seen, reward, terminated, truncated, info = self.env.step(action)
        self.taken += 1
        if self.way == "terminates at step 0":
            return seen, reward, True, truncated, info
        if self.way == "never ends" or self.taken < self.at:
            return seen, reward, terminated, truncated and self.way != "never ends", info
        if self.way == "loses a worker":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.way == "raises an error":
            raise RuntimeError("the simulator has lost its licence")
        found = {
            "shows NaN": seen * np.nan,
            "shows infinity": seen + np.inf,
            "shows another shape": seen[:-1],
            "shows float64": seen.astype(np.float64),
        }
        reward = np.nan if self.way == "pays NaN" else reward
        return found.get(self.way, seen), reward, terminated, truncated, info


def met(way: str, where: str) -> tuple[str, str]:
    """Return what is said of a fault, and which policy is there afterwards."""
    makers: dict[str, Any] = dict.fromkeys(WHERE, ENV)
    makers[where] = lambda: Faulty(way)
    env = makers["training"]
    if way == "loses a worker":
        env = SubprocVecEnv([lambda: Faulty(way), lambda: Faulty(way, at=10_000)])
    said: list[str] = []
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        try:
            model = DDPG("YannPolicy", env() if callable(env) else env, device="cpu", seed=0)
            first = [each.clone() for each in model.actor.state_dict().values()]
            guard = ImprovementGuard(
                makers["the guard's trials"], n_starts=2, n_new_starts=2, n_final_starts=2
            )
            model.policy.critic_warmup = 50
            with Alarm(PATIENCE):
                model.learn(900, callback=[NoActionNoise(), guard])
            said.append("training goes on")
        except (Exception, KeyboardInterrupt) as error:
            said.append(f"{type(error).__name__}: {error}".splitlines()[0])
    told = sorted({f"{each.category.__name__}: {each.message}".splitlines()[0] for each in found})
    said += [each if len(each) < SHOWN else f"{each[:SHOWN]} ..." for each in told[:2]]
    kept, accepted = [*model.actor.state_dict().values()], getattr(model, "guard_state", None)
    same = all(torch.equal(*pair) for pair in zip(first, kept, strict=True))
    if not same and accepted is not None:
        kept = [each.clone() for each in kept]
        accepted.accepted.restore(model.policy)
        now = model.actor.state_dict().values()
        same = all(torch.equal(*pair) for pair in zip(kept, now, strict=True))
        return " / ".join(said), "the accepted one" if same else "another"
    return " / ".join(said), "the MPC" if same else "another"


class Alarm:
    """Ctrl-C after so many seconds."""

    def __init__(self, seconds: float) -> None:
        self.timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGINT))

    def __enter__(self) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
        self.timer.start()

    def __exit__(self, *_: Any) -> None:
        self.timer.cancel()
