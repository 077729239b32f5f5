"""The clipped pendulum of Braniff & Tian: Gymnasium's pendulum, near upright, seen as a state."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann_envs._checks import (
    check_render_mode,
    clipped_input,
    constant,
    not_reset,
    start_option,
    warn_no_render_mode,
)
from sb3_yann_envs.rendering import Frame, pendulum_frame
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

_STATE_NAMES = ("theta", "theta_dot")


def dynamics(x: ArrayLike, u: ArrayLike) -> NDArray[np.float64]:
    """Return the time derivative of the state in continuous time, without the clipping.

    Parameters
    ----------
    x : array_like, shape (2,)
        Angle from upright in rad, angular speed in rad/s.
    u : array_like, shape (1,)
        Torque in N m.

    Returns
    -------
    ndarray, shape (2,)
        Derivatives in rad/s and rad/s2 (Braniff & Tian, equation of the clipped pendulum).
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


class ClippedPendulumEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Hold a pendulum upright with a torque too weak to lift it.

    ## Description

    A rod turns about one end. The goal is to keep it upright, at rest, with little torque. The
    simulator is that of Gymnasium's `Pendulum-v1`, step for step. Two things differ: the agent
    observes the state itself instead of cosine and sine of the angle, as a linear controller
    needs, and an episode starts near upright. From about one start in five the torque of 2 N m
    cannot hold the rod: it must let go, swing round once and catch the rod from the other side.

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

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = check_render_mode(render_mode, self)
        # The float32 next to pi is 3.14159274 > pi, so an angle that rounds up to it is inside.
        self._bounds = np.array([math.pi, MAX_SPEED], dtype=np.float32)
        self.observation_space = ProblemBox(
            -self._bounds, self._bounds, problem="sb3_yann_envs.problems:clipped_pendulum"
        )
        self.action_space = gymnasium.spaces.Box(-MAX_TORQUE, MAX_TORQUE, (1,), np.float32)
        self._torque = 0.0
        # The angle is not wrapped inside, as in Gymnasium: wrapping would change its last bits.
        self._state: tuple[float, float] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode, from a random state or from ``options["state"]``, shape (2,)."""
        super().reset(seed=seed)
        start = start_option(options, -self._bounds, self._bounds, _STATE_NAMES)
        if start is None:
            reach = np.array([START_ANGLE, START_SPEED])
            start = tuple(self.np_random.uniform(-reach, reach).tolist())
        theta, speed = start
        self._state = (theta, speed)
        self._torque = 0.0
        state = np.array([wrapped(theta), speed])
        return state.astype(np.float32), {"state": state}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Apply a torque for one sample of 0.05 s."""
        if self._state is None:
            raise not_reset("step", "the pendulum has no state yet")
        theta, speed = self._state
        torque = clipped_input(action, MAX_TORQUE)
        cost = stage_cost(theta, speed, torque)
        # numpy's sine, not math's: the two differ in the last bit on some machines, and the
        # trajectories are to be Gymnasium's bit for bit (with float64 actions).
        speed = next_speed(float(np.sin(theta)), speed, torque)
        speed = min(max(speed, -MAX_SPEED), MAX_SPEED)
        theta += speed * DT
        self._state = (theta, speed)
        self._torque = torque
        state = np.array([wrapped(theta), speed])
        info = {"cost": cost, "violation": False, "state": state}
        return state.astype(np.float32), -cost, False, False, info

    def render(self) -> Frame | None:
        """Return a picture of shape (400, 400, 3), or None without a render mode."""
        if self.render_mode is None:
            warn_no_render_mode(self)
            return None
        if self._state is None:
            raise not_reset("render", "the pendulum has no state yet")
        return pendulum_frame(self._state[0], self._torque, MAX_TORQUE)


def wrapped(angle: Any) -> Any:
    """Return the angle in [-pi, pi), of a float or an array."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
