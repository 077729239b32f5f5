"""Linear plants with the problems they stand for, feasible states, and a record of an episode."""

import dataclasses
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_yann import LinearModel, LinearMPC
from sb3_yann_envs import problems
from sparse_qp import SparseQP


class Plant(gym.Env):
    """A plant whose step is given. It shows its state, and a reset puts it into another."""

    dt = 0.1

    def __init__(self, step=lambda x, u: 0.5 * x + u, x=(-5.0, 5.0), u=(-1.0, 1.0), start=0.0):
        low, high = np.reshape(np.array(x, float), (2, -1))
        self.observation_space = gym.spaces.Box(low, high, dtype=np.float64)
        self.action_space = gym.spaces.Box(*np.reshape(np.array(u, float), (2, -1)), dtype=float)
        self.advance = step
        self.start = start + np.zeros(len(low))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = np.array((options or {}).get("state", self.start), dtype=float)
        return self.shown(), {}

    def step(self, action):
        self.x = np.array(self.advance(self.x, np.asarray(action, float)), dtype=float)
        return self.shown(), 0.0, False, False, {}

    def shown(self):
        return self.x.copy()


def played(step, inputs, start):
    """The states (T + 1, n) from a start (n,) on, by a function of the state and an input (m,)."""
    x = [np.asarray(start, float)]
    for u in inputs:
        x.append(np.asarray(step(x[-1], u), float))
    return np.array(x)


class Settable(Plant):
    """The same, but it is put into a state by ``env.unwrapped.state`` alone."""

    state = property(lambda self: self.x, lambda self, x: setattr(self, "x", np.array(x)))

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)


class Sampled(gym.Env[Any, Any]):
    """A plant whose state x is drawn evenly at first; a subclass says how it is ``moved``.

    It shows x, costs nothing and has no end, unless a subclass says otherwise.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    starts: tuple[Any, Any] = (-1.0, 1.0)
    steps = 0
    """Of an episode."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(*self.starts, self.observation_space.shape)
        self.t = 0
        return self.shown(), self.info()

    def step(self, action):
        u = np.asarray(action, np.float64)
        cost = self.cost(u)
        self.x = self.moved(u)
        self.t += 1
        return self.shown(), -float(cost), False, self.t == self.steps, self.info()

    def info(self) -> dict[str, Any]:
        return {}

    def shown(self) -> np.ndarray:
        return self.x.astype(self.observation_space.dtype)

    def cost(self, u: np.ndarray) -> float:
        return 0.0

    def moved(self, u: np.ndarray) -> np.ndarray:
        raise NotImplementedError


class LinearPlant(Sampled):
    """The prediction model itself as the plant, with the cost of the MPC, in float64."""

    def __init__(self, mpc: LinearMPC, start: float = 1.0) -> None:
        self.mpc = mpc
        self.starts = (-start, start)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (mpc.n_theta,), np.float32)
        self.action_space = gym.spaces.Box(
            mpc.u_min.astype(np.float32), mpc.u_max.astype(np.float32)
        )

    def cost(self, u):
        return self.mpc.stage_cost(self.x, u)

    def moved(self, u):
        return self.mpc.predict(self.x, u)


def two_input_mpc(**changes) -> LinearMPC:
    """Three states, two inputs, asymmetric bounds on everything."""
    A = [[1, 0.1, 0], [0, 1, 0.1], [0, 0, 0.9]]
    B = [[0, 0.1], [0.1, 0], [0, 1]]
    design = {
        "Q": np.eye(3),
        "R": np.diag([0.1, 0.2]),
        "horizon": 2,
        "x_min": -5,
        "x_max": [5, 6, 7],
        "u_min": [-1, -0.5],
        "u_max": [2, 0.7],
    }
    return LinearMPC(LinearModel(A, B, 0.1), **{**design, **changes})


def asymmetric_pendulum_mpc() -> LinearMPC:
    """The pendulum's problem with a motor that pulls harder to one side."""
    return dataclasses.replace(problems.clipped_pendulum(), u_min=-1.0, u_max=3.0)


def feasible_states(mpc: LinearMPC, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` float32-exact states at which the online QP is feasible, and its inputs."""
    online = SparseQP(mpc)
    rng = np.random.default_rng(seed)
    states = []
    inputs = []
    while len(states) < count:
        theta = rng.uniform(mpc.theta_min, mpc.theta_max).astype(np.float32).astype(np.float64)
        u = online(theta)
        if u is not None:
            states.append(theta)
            inputs.append(u)
    return np.array(states), np.array(inputs)


class Ending(gym.Wrapper):
    """Ends its episodes after so many steps, with a violation."""

    def __init__(self, env: gym.Env, steps: int, reward: float | None = None) -> None:
        super().__init__(env)
        self.last = steps
        self.reward = reward

    def reset(self, **kwargs):
        self.t = 0
        return self.env.reset(**kwargs)

    def step(self, action):
        observation, reward, _, truncated, info = self.env.step(action)
        self.t += 1
        over = self.t == self.last
        reward = reward if self.reward is None else self.reward
        return observation, reward, over, truncated, {**info, "violation": over}


class Recorder(gym.Wrapper):
    """Keeps every observation and the action that met it."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.pairs: list[tuple[np.ndarray, np.ndarray]] = []

    def reset(self, **kwargs):
        self.last, info = self.env.reset(**kwargs)
        return self.last, info

    def step(self, action):
        self.pairs.append((self.last, np.array(action)))
        self.last, *rest = self.env.step(action)
        return self.last, *rest

    def recorded(self) -> tuple[np.ndarray, np.ndarray]:
        observations, actions = zip(*self.pairs, strict=True)
        return np.array(observations), np.array(actions)
