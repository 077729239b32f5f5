"""A slow simulator, 5 ms a step, played by one process and by two."""

from __future__ import annotations

import time
from typing import Any

import joblib
import numpy as np
from stable_baselines3.common.vec_env import SubprocVecEnv

from benchmarks.records import Bench, timed
from sb3_yann.improvement.simulator import Simulator, of_law
from sb3_yann_envs import problems
from sb3_yann_envs.cstr import CSTREnv

SECTION = "processes"
COLUMN = "8 episodes of 100 steps"
ONE = "ours, one process"
TWO = "two workers of joblib"
VECTOR = "a SubprocVecEnv of two"
EPISODES = 8
STEPS = 100


class Slow(CSTREnv):
    """The reactor, whose steps take 5 ms, and whose episodes are short."""

    taken = 0

    def reset(self, **kwargs: Any) -> Any:
        """Start an episode."""
        self.taken = 0
        return super().reset(**kwargs)

    def step(self, action: Any) -> Any:
        """Wait, then step."""
        time.sleep(0.005)
        self.taken += 1
        observation, reward, terminated, _, info = super().step(action)
        return observation, reward, terminated, self.taken == STEPS, info


def processes(bench: Bench) -> None:
    """Measure the same episodes; the workers have begun, as they have in all but the first lot."""
    mpc = problems.cstr()
    envs = SubprocVecEnv([Slow] * 2)
    simulators = Simulator(mpc, Slow, 0), Simulator(mpc, Slow, 0), Simulator(mpc, envs, 0)

    def play(simulator: Simulator, jobs: int) -> float:
        with joblib.parallel_config("loky", n_jobs=jobs):
            simulator.play(of_law(mpc), range(EPISODES))  # all of it is there now
            began = time.perf_counter()
            simulator.play(of_law(mpc), range(EPISODES))
        return time.perf_counter() - began

    jobs = zip((ONE, TWO, VECTOR), simulators, (1, 2, 1), strict=True)
    found = {name: np.array([play(simulator, number)]) for name, simulator, number in jobs}
    envs.close()
    bench.figures.add(timed(SECTION, COLUMN, found))
