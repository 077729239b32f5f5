"""How a plant's next theta depends on theta and the input, along a trajectory."""

from __future__ import annotations

import contextlib
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_yann._validation import Array
from sb3_yann.audit.trajectory import Slopes, Trajectory
from sb3_yann.control import LinearMPC
from sb3_yann.control.linearization.connect import connect
from sb3_yann.control.linearization.simulator import Simulator, borrow
from sb3_yann.twin.plant_twin import PlantTwin

PROBES = 5
"""Steps of a trajectory that a simulator must repeat from its middle."""
CLOSE = 1e-3
"""How well, relative to how far the states move."""
NEAR_X, NEAR_U = 1e-3, 1e-2
"""Steps of differences, relative to the ranges of states and inputs: actions may be float32."""


def slopes_by_model(mpc: LinearMPC) -> Slopes:
    """Return the slopes of the MPC's own model."""
    A, B = mpc.prediction
    return lambda thetas, _: tuple(np.broadcast_to(M, (len(thetas), *M.shape)) for M in (A, B))  # type: ignore[return-value]


def slopes_by_twin(twin: PlantTwin) -> Slopes:
    """Return the slopes of a twin's first member."""

    def slopes(thetas: Array, inputs: Array) -> tuple[Array, Array]:
        members = len(twin.dynamics.members)
        rows = (np.repeat(each[None], members, axis=0) for each in (thetas, inputs))
        A, B = twin.dynamics.jacobians(*rows)
        return A[0], B[0]

    return slopes


def slopes_by_simulator(mpc: LinearMPC, env: gym.Env[Any, Any], run: Trajectory) -> Slopes | None:
    """Return the slopes of an env that can be put into a state, by differences; else None.

    Parameters
    ----------
    mpc : LinearMPC
        How references and disturbances act is its model's.
    env : gymnasium.Env
        Copied.
    run : Trajectory
        It must be repeated from states in its middle, which are theta's, or those and the
        operating point of the model.
    """
    simulator: Simulator | None = None
    with contextlib.suppress(Exception):  # whatever a stranger's env raises: it cannot be had
        simulator = Simulator(borrow(env), None, None)
        connect(simulator, None, run.inputs[0], None)
    if simulator is None:
        return None
    for shift in (np.zeros(mpc.model.n_states), mpc.model.x_ss):
        with contextlib.suppress(Exception):
            if _repeats(mpc, simulator, run, shift):
                return _Differences(mpc, simulator, run, shift)
    return None


def _repeats(mpc: LinearMPC, simulator: Simulator, run: Trajectory, shift: Array) -> bool:
    x = run.thetas[:, mpc.layout.state]
    scale = np.maximum(np.ptp(x, axis=0), 1e-9)
    for k in np.linspace(0, len(run.inputs) - 1, PROBES).astype(int):
        reached = simulator.next_state(x[k] + shift, run.inputs[k]) - shift
        if not np.all(np.abs(reached - x[k + 1]) <= CLOSE * scale):
            return False
    return True


class _Differences:
    def __init__(self, mpc: LinearMPC, simulator: Simulator, run: Trajectory, shift: Array) -> None:
        self.mpc, self.simulator, self.shift = mpc, simulator, shift
        x = run.thetas[:, mpc.layout.state]
        self.near = np.maximum(NEAR_X * np.ptp(x, axis=0), 1e-9), 2 * NEAR_U * mpc.u_half

    def __call__(self, thetas: Array, inputs: Array) -> tuple[Array, Array]:
        mpc, n = self.mpc, self.mpc.model.n_states
        A, B = (np.repeat(M[None], len(inputs), axis=0) for M in mpc.prediction)
        for t, (theta, u) in enumerate(zip(thetas, inputs, strict=True)):
            x = theta[mpc.layout.state]
            for j, h in enumerate(self.near[0]):
                A[t, :n, j] = self._slope(x, u, np.eye(n)[j] * h, 0 * u) / h
            for j, h in enumerate(self.near[1]):
                step = np.eye(len(u))[j] * (h if u[j] + h <= mpc.u_max[j] else -h)
                B[t, :n, j] = self._slope(x, u, 0 * x, step) / step[j]
        return A, B

    def _slope(self, x: Array, u: Array, dx: Array, du: Array) -> Array:
        next_state, shift = self.simulator.next_state, self.shift
        return next_state(x + dx + shift, u + du) - next_state(x + shift, u)
