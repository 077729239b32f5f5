"""A quadrotor that flies to a point: twelve states, four inputs, for `quadrotor.py`."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

DT = 0.05  # s
SUBSTEPS = 2  # Runge-Kutta steps in a sample
MASS, GRAVITY = 0.8, 9.81  # kg, m/s2
INERTIA = np.array([0.008, 0.008, 0.014])  # kg m2
ARM, YAW = 0.2, 0.02  # m: of a rotor; torque about the vertical for each newton of thrust
DRAG = 0.12  # N s2/m2, of the air
MAX_THRUST = 5.0  # N, of one rotor
MAX_TILT, FLOOR = 1.2, -3.0  # rad, m: beyond them it falls, or hits the ground
CRASH = 2000.0  # added to the cost
STARTS = np.repeat([1.5, 0.4, 1.0, 0.5], 3)  # m, rad, m/s, rad/s


def derivative(x: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return dx/dt (12,) of ``x = [position, roll, pitch, yaw, velocity, body rates]``.

    Newton's and Euler's equations of a rigid body, with yaw-pitch-roll angles and a drag that grows
    with the square of the speed. ``u`` (4,) are the rotors' thrusts: front, right, back and left.
    """
    pitch, velocity, (p, q, r) = x[4], x[6:9], x[9:]
    (sr, sp, sy), (cr, cp, cy) = np.sin(x[3:6]), np.cos(x[3:6])
    up = np.array([sr * sy + cr * sp * cy, cr * sp * sy - sr * cy, cr * cp])
    drag = DRAG * np.sqrt(velocity @ velocity) * velocity
    acceleration = (u.sum() * up - drag) / MASS - [0.0, 0.0, GRAVITY]
    turning = sr * q + cr * r
    angles = [p + np.tan(pitch) * turning, cr * q - sr * r, turning / cp]
    torque = [ARM * (u[3] - u[1]), ARM * (u[2] - u[0]), YAW * (u[0] - u[1] + u[2] - u[3])]
    rates = (torque - np.cross([p, q, r], INERTIA * [p, q, r])) / INERTIA
    return np.concatenate([velocity, angles, acceleration, rates])


class Quadrotor(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """It starts somewhere, tilted and moving, and shall hover at the origin.

    Actions are the four thrusts, 0 to 5 N. Observations are the twelve states in m, rad, m/s and
    rad/s. An episode ends where it tilts by more than 1.2 rad or drops by 3 m, which is a
    violation. The reward is 0, less 2,000 for a violation: what a state is worth is not the
    plant's to say. ``reset(options={"state": x})`` starts from there.
    """

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (12,), np.float32)
        self.action_space = gymnasium.spaces.Box(0.0, MAX_THRUST, (4,), np.float32)
        self.x = np.zeros(12)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=seed)
        drawn = self.np_random.uniform(-STARTS, STARTS)
        self.x = np.array((options or {}).get("state", drawn), np.float64)
        return self.x.astype(np.float32), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold the thrusts for one sample."""
        u, h = np.clip(action, 0.0, MAX_THRUST), DT / SUBSTEPS
        for _ in range(SUBSTEPS):  # the classical Runge-Kutta method
            k1 = derivative(self.x, u)
            k2 = derivative(self.x + h / 2 * k1, u)
            k3 = derivative(self.x + h / 2 * k2, u)
            k4 = derivative(self.x + h * k3, u)
            self.x = self.x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        falls = bool(np.abs(self.x[3:5]).max() > MAX_TILT or self.x[2] < FLOOR)
        return self.x.astype(np.float32), -CRASH * falls, falls, False, {"violation": falls}
