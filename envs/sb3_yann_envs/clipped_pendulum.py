"""The clipped pendulum of Braniff & Tian: Gymnasium's pendulum, near upright, seen as a state."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann_envs._problem_env import (
    Array,
    Frame,
    ProblemEnv,
    ProblemVectorEnv,
    constant,
    new_figure,
    pixels,
)
from sb3_yann_envs.spaces import ProblemBox

GRAVITY = 10.0  # m/s2
MASS = 1.0  # kg
LENGTH = 1.0  # m
DT = 0.05  # s
MAX_TORQUE = 2.0  # N m
MAX_SPEED = 8.0  # rad/s

_GRAVITY_GAIN = 3 * GRAVITY / (2 * LENGTH)  # 1/s2, of sin(theta)
_TORQUE_GAIN = 3.0 / (MASS * LENGTH**2)  # 1/(kg m2)

Q = constant(np.diag([1.0, 0.1]))
"""State weights of the stage cost, for the angle in rad and the speed in rad/s."""
R = constant([[0.001]])
"""Input weight of the stage cost, for the torque in N m."""

X_SS = constant([0.0, 0.0])
"""Upright and at rest."""
U_SS = constant([0.0])
"""Torque that holds the pendulum upright."""

START_ANGLE = 0.5
"""Starts draw the angle from [-START_ANGLE, START_ANGLE] rad."""
START_SPEED = 0.8
"""Starts draw the speed from [-START_SPEED, START_SPEED] rad/s."""

PRINTED_A = constant([[1.0188, 0.0503], [0.7547, 1.0188]])
"""State matrix as printed in the paper, for one sample of 0.05 s."""
PRINTED_B = constant([[0.0038], [0.1509]])
"""Input matrix as printed in the paper, for one sample of 0.05 s."""


def dynamics(x: ArrayLike, u: ArrayLike) -> Array:
    """Return the state's time derivative (Braniff & Tian, equation of the clipped pendulum).

    `x` is the angle from upright in rad and the speed in rad/s, `u` the torque in N m, shape (1,).
    Nothing is clipped.
    """
    theta, speed = np.asarray(x, dtype=np.float64)
    (torque,) = np.asarray(u, dtype=np.float64)
    return np.array([speed, _GRAVITY_GAIN * np.sin(theta) + _TORQUE_GAIN * torque])


def stage_cost(theta: Any, speed: Any, torque: Any) -> Any:
    """Return the stage cost, of floats or arrays."""
    return wrapped(theta) ** 2 + 0.1 * speed**2 + 0.001 * torque**2


def next_speed(sine: Any, speed: Any, torque: Any) -> Any:
    """Return the speed one sample later, not yet clipped, of floats or arrays."""
    return speed + (_GRAVITY_GAIN * sine + _TORQUE_GAIN * torque) * DT


class ClippedPendulumEnv(ProblemEnv):
    """Hold a pendulum upright with a torque too weak to lift it.

    ## Description

    A rod turns about one end. The goal is to keep it upright, at rest, with little torque. The
    simulator is that of Gymnasium's `Pendulum-v1`, step for step. But the agent observes the angle
    itself, as a linear controller needs, and an episode starts near upright. From about one start
    in five 2 N m cannot hold the rod: it must swing round once and be caught from the other side.

    ## Action Space

    An array of shape `(1,)`, float32, clipped to its bounds.

    | Num | Action                             | Min  | Max | Unit |
    |-----|------------------------------------|------|-----|------|
    | 0   | Torque, positive counter-clockwise | -2.0 | 2.0 | N m  |

    ## Observation Space

    An array of shape `(2,)`, float32, in a `ProblemBox`.

    | Num | Observation                                           | Min  | Max | Unit  |
    |-----|-------------------------------------------------------|------|-----|-------|
    | 0   | Angle theta, 0 upright, positive counter-clockwise     | -pi  | pi  | rad   |
    | 1   | Angular speed theta_dot                               | -8.0 | 8.0 | rad/s |

    ## Rewards

    *r = -(theta<sup>2</sup> + 0.1 theta_dot<sup>2</sup> + 0.001 torque<sup>2</sup>)*, with the
    state before the step, the angle wrapped to [-pi, pi], and the clipped torque. It is computed
    from the state in float64. The smallest reward is -16.2736044, the largest 0.

    The `info` of a step holds `cost` (minus the reward) and `violation` (always False: the problem
    has no safety limit). That of a step and of a reset holds `state`, the observation in float64.

    ## Starting State

    Angle uniform in [-0.5, 0.5] rad, speed uniform in [-0.8, 0.8] rad/s.
    `reset(options={"state": [theta, theta_dot]})` starts from any state of the observation space.

    ## Episode End

    - Termination: never.
    - Truncation: after 200 steps (10 s) if made with `gymnasium.make`.

    ## Arguments

    - `render_mode`: None, or `"rgb_array"` for a picture of shape (400, 400, 3).

    ```python
    >>> import gymnasium
    >>> import sb3_yann_envs
    >>> env = gymnasium.make("ClippedPendulum-v0", render_mode="rgb_array")

    ```

    `docs/environments.md` lists the paper's slips, and what was chosen here.

    ## Version History

    * v0: Initial version.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}
    state_names = ("theta", "theta_dot")
    # The float32 next to pi is 3.14159274 > pi, so an angle that rounds up to it is inside.
    highest = constant(np.array([math.pi, MAX_SPEED], dtype=np.float32))
    lowest = constant(-highest)
    start_high = constant([START_ANGLE, START_SPEED])
    start_low = constant(-start_high)

    def __init__(self, render_mode: str | None = None) -> None:
        low = self.lowest.astype(np.float32)
        high = self.highest.astype(np.float32)
        states = ProblemBox(low, high, problem="sb3_yann_envs.problems:clipped_pendulum")
        super().__init__(render_mode, states, MAX_TORQUE)
        self._torque = 0.0

    def _begin(self) -> None:
        self._torque = 0.0

    def _advance(self, u: float) -> tuple[float, bool]:
        theta, speed = self._state
        cost = stage_cost(theta, speed, u)
        # numpy's sine, not math's: the two differ in the last bit on some machines, and the
        # trajectories are to be Gymnasium's bit for bit (with float64 actions).
        speed = next_speed(float(np.sin(theta)), speed, u)
        speed = min(max(speed, -MAX_SPEED), MAX_SPEED)
        # The angle is not wrapped inside, as in Gymnasium: wrapping would change its last bits.
        self._state = (theta + speed * DT, speed)
        self._torque = u
        return cost, False

    def _observed(self) -> Array:
        theta, speed = self._state
        return np.array([wrapped(theta), speed])

    def _frame(self) -> Frame:
        return pendulum_frame(self._state[0], self._torque, MAX_TORQUE)


def wrapped(angle: Any) -> Any:
    """Return the angle in [-pi, pi), of a float or an array."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


class ClippedPendulumVectorEnv(ProblemVectorEnv):
    """Many :class:`ClippedPendulumEnv`."""

    single = ClippedPendulumEnv

    def _advance(self, u: Array) -> tuple[Array, NDArray[np.bool_]]:
        theta, speed = self._state
        cost = stage_cost(theta, speed, u)
        speed = next_speed(np.sin(theta), speed, u)
        speed = np.clip(speed, -MAX_SPEED, MAX_SPEED)
        self._state = np.array([theta + speed * DT, speed])
        return cost, np.zeros(self.num_envs, dtype=bool)

    def _observed(self) -> Array:
        return np.column_stack([wrapped(self._state[0]), self._state[1]])


def pendulum_frame(theta: float, torque: float, max_torque: float) -> Frame:
    """Return the picture of a pendulum, shape (400, 400, 3).

    The angle from upright is positive counter-clockwise. The arrow points the way the torque turns,
    and sweeps a right angle at the largest torque.
    """
    figure = new_figure(4.0, 4.0)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), aspect="equal", xlim=(-1.3, 1.3), ylim=(-1.3, 1.3))
    axes.set_axis_off()
    rod = ([0.0, -math.sin(theta)], [0.0, math.cos(theta)])
    axes.plot(*rod, color="tab:red", lw=14, solid_capstyle="round")
    axes.plot([0.0], [0.0], "o", color="black", markersize=7)
    if torque:
        sweep = np.linspace(0.0, torque / max_torque * math.pi / 2, 30) + math.pi / 2
        x = 0.45 * np.cos(sweep)
        y = 0.45 * np.sin(sweep)
        axes.plot(x, y, color="tab:blue", lw=3)
        ahead = math.copysign(0.15, torque)
        tip = (x[-1] - ahead * math.sin(sweep[-1]), y[-1] + ahead * math.cos(sweep[-1]))
        head = {"arrowstyle": "-|>", "color": "tab:blue", "mutation_scale": 25, "shrinkA": 0}
        axes.annotate("", tip, (x[-1], y[-1]), arrowprops=head)
    return pixels(figure)
