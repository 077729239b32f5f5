"""Steps of the environments, and the temperature of the reactor against a stiff solver."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.problems import SMALLEST, Array
from benchmarks.records import Bench, Figure, timed
from benchmarks.timing import Task
from sb3_yann.rollout import evaluate
from sb3_yann_envs import cstr
from sb3_yann_envs.clipped_pendulum import ClippedPendulumEnv
from sb3_yann_envs.cstr import CSTREnv

SECTION = "environments"
CSTR = "reactor, env.step"
TIME, ERROR = "time of a step", "largest error of T in K"
WHOLE = "400 steps of each, under the law"
EPISODES = "reactor, make_vec, one step of each episode"


def simulators(bench: Bench) -> None:
    """Measure the envs."""
    endless = {"disable_env_checker": True, "max_episode_steps": 10**9}
    many = 100 if bench.quick else 2000
    envs: dict[str, tuple[Any, Any]] = {
        CSTR: (CSTREnv(), 3.0),
        "reactor, gymnasium.make": (gym.make("CSTR-v0", **endless), 3.0),
        "pendulum, env.step": (ClippedPendulumEnv(), 0.3),
        "pendulum, gymnasium.make": (gym.make("ClippedPendulum-v0", **endless), 0.3),
    }
    tasks = {name: _task(env, u) for name, (env, u) in envs.items()}
    found = bench.watch.compare(tasks)
    vector = gym.make_vec("CSTR-v0", num_envs=many)
    vector.reset(seed=0)
    calls = {"vector": Task(vector.step, [np.full((many, 1), 3.0, np.float32)])}
    found[f"{EPISODES} of {many:,}"] = bench.watch.compare(calls)["vector"] / many
    bench.figures.add(timed(SECTION, TIME, found))
    evaluate(SMALLEST.law, "CSTR-v0", range(2))
    seconds = bench.watch.once(lambda: evaluate(SMALLEST.law, "CSTR-v0", range(many)))
    bench.figures.add(timed(SECTION, WHOLE, {f"reactor, {many:,} episodes side by side": seconds}))
    random, farthest = errors(1 if bench.quick else 5)
    bench.figures.add(
        [
            Figure(SECTION, CSTR, f"{ERROR}, random starts to 480 K", np.array([random]), "error"),
            Figure(SECTION, CSTR, f"{ERROR}, any start to 480 K", np.array([farthest]), "error"),
        ]
    )


def _task(env: gym.Env[Any, Any], u: float) -> Task:
    env.reset(seed=0)
    step: Callable[[Any], object] = env.step
    return Task(step, [np.array([u], dtype=np.float32)])


def errors(episodes: int) -> tuple[float, float]:
    """Return the largest error of the temperature in episodes without cooling, up to the limit.

    First from random starts, then from those at the corners that `reset` accepts.
    """
    rng = np.random.default_rng(0)
    low, high = np.array([-0.08, -0.5, -2.0, -10.0]), cstr.STATE_HIGH
    drawn = [rng.uniform(cstr.START_LOW, cstr.START_HIGH) for _ in range(episodes)]
    drawn[0] = np.array(cstr.START_HIGH)  # the shortest way to the limit
    corners = [high, np.append(high[:3], 0.0), np.array([0.15, 2.0, 0.0, 3.3])]
    corners += [np.where(rng.random(4) < 0.5, high, low) for _ in range(4 * episodes)]
    return max(map(_error, drawn)), max(map(_error, corners))


def _error(start: Array) -> float:
    """Return the largest error on the way from a start to the limit, or for an hour."""
    env = CSTREnv()
    env.reset(options={"state": start})
    exact, largest, terminated, steps = cstr.X_SS + start, 0.0, False, 0
    while not terminated and steps < 60:
        *_, terminated, _, info = env.step(np.array([-55.0], dtype=np.float32))
        exact = solve_ivp(
            lambda _, x: cstr.dynamics(x, cstr.U_SS - 55.0), (0.0, cstr.DT), exact,
            method="Radau", rtol=1e-12, atol=1e-13,
        ).y[:, -1]  # fmt: skip
        largest = max(largest, abs(float(info["state"][3] + cstr.X_SS[3] - exact[3])))
        steps += 1
    return largest
