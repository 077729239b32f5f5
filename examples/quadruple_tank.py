"""The quadruple tank of Johansson (2000), and an experiment on it with a log, for `own_plant.py`.

It stands for a plant of yours: nothing here knows of a linear model, an MPC or a set-point.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

DT = 10.0  # s
SUBSTEPS = 2  # Runge-Kutta steps in a sample
FULL = 20.0  # cm, height of each tank
MAX_VOLTAGE = 10.0  # V
MAX_DISTURBANCE = 1.0  # cm3/s

AREA = (28.0, 32.0, 28.0, 32.0)  # cm2, cross-sections A1 to A4
OUTLET = (0.071, 0.057, 0.071, 0.057)  # cm2, a1 to a4
PUMP_GAIN = (3.33, 3.35)  # cm3/(V s), k1 and k2
SPLIT = (0.70, 0.60)  # gamma1 and gamma2, the share of each pump that goes to a lower tank
GRAVITY = 981.0  # cm/s2

LEVELS_SS = (12.4, 12.7, 1.8, 1.4)  # cm, as printed: measured, so the equations rest 0.2 cm away
VOLTAGES_SS = (3.0, 3.0)  # V


def derivative(levels: Any, voltages: Any, d: float = 0.0, wear: float = 0.0) -> tuple[float, ...]:
    """Return how fast the four levels (4,) rise, in cm/s: the paper's equations, with d and wear.

    ``voltages`` is (2,); for the flow d and the wear of the pumps see :class:`QuadrupleTank`.
    """
    h1, h2, h3, h4 = levels
    v1, v2 = voltages
    out1, out2, out3, out4 = (
        a * math.sqrt(2 * GRAVITY * h) if h > 0 else 0.0
        for a, h in zip(OUTLET, (h1, h2, h3, h4), strict=True)
    )
    pump1, pump2 = (1 - wear) * PUMP_GAIN[0] * v1, (1 - wear) * PUMP_GAIN[1] * v2
    return (
        (SPLIT[0] * pump1 + out3 - out1) / AREA[0],
        (SPLIT[1] * pump2 + out4 - out2) / AREA[1],
        ((1 - SPLIT[1]) * pump2 + d - out3) / AREA[2],
        ((1 - SPLIT[0]) * pump1 - out4) / AREA[3],
    )


def advance(levels: Any, voltages: Any, d: float = 0.0, wear: float = 0.0) -> tuple[float, ...]:
    """Return the levels one sample later, by the classical Runge-Kutta method; none is below 0."""
    h, step = tuple(levels), DT / SUBSTEPS
    for _ in range(SUBSTEPS):
        k1 = derivative(h, voltages, d, wear)
        k2 = derivative(_moved(h, k1, step / 2), voltages, d, wear)
        k3 = derivative(_moved(h, k2, step / 2), voltages, d, wear)
        k4 = derivative(_moved(h, k3, step), voltages, d, wear)
        slope = ((a + 2 * b + 2 * c + e) / 6 for a, b, c, e in zip(k1, k2, k3, k4, strict=True))
        h = tuple(max(x, 0.0) for x in _moved(h, slope, step))
    return h


def _moved(levels: Any, slope: Any, step: float) -> tuple[float, ...]:
    return tuple(h + step * dh for h, dh in zip(levels, slope, strict=True))


class QuadrupleTank(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Four tanks of water and two pumps, each of which fills one lower and one upper tank.

    ## Description

    The laboratory plant of K. H. Johansson, *The quadruple-tank process: a multivariable
    laboratory process with an adjustable zero*, IEEE Trans. Control Syst. Technol. 8(3), 2000, with
    its parameters at the minimum-phase operating point P-. Pump 1 fills the tanks 1 and 4, pump 2
    the tanks 2 and 3; tank 3 empties into 1, and 4 into 2. Chosen here: a side pipe with a flow
    meter, which brings water to tank 3 or takes it away, the wear of the pumps, the sample time of
    10 s, and the episodes.

    ## Action Space

    An array of shape `(2,)`, float32: the voltages of the pumps, 0 to 10 V, clipped to that.

    ## Observation Space

    An array of shape `(4,)`, float32: the levels of the tanks, 0 to 20 cm. (The paper's
    sensors give 0.5 V for each cm.)

    ## Rewards

    -1 for a step in which a tank overflows, 0 for others: what the levels should be is not the
    plant's to say.

    The `info` of a step and of a reset holds `disturbance`, the flow of the side pipe in cm3/s, and
    `state`, the levels in float64; that of a step also `violation` (whether a tank overflowed; its
    level stays at 20 cm).

    ## Starting State

    Lower levels uniform within 2 cm, upper ones within 0.5 cm of the operating point (12.4, 12.7,
    1.8, 1.4) cm. The side pipe's flow is uniform in [-1, 1] cm3/s, and changes to another one in
    each step with probability 1/60. `reset(options={"state": [h1, h2, h3, h4]})` starts from
    these levels, with a closed side pipe.

    ## Episode End

    Never: add a time limit.

    ## Arguments

    - `noise`: standard deviation of what waves and air in the pipes add to each level in a step,
      in cm; 0 by default.
    - `wear`: the share of their flow that the pumps have lost; 0 by default.
    """

    metadata = {"render_modes": []}

    def __init__(self, noise: float = 0.0, wear: float = 0.0) -> None:
        self.observation_space = gymnasium.spaces.Box(0, FULL, (4,), np.float32)
        self.action_space = gymnasium.spaces.Box(0, MAX_VOLTAGE, (2,), np.float32)
        self.noise, self.wear = noise, wear
        self.levels: tuple[float, ...] = LEVELS_SS
        self.d, self.fixed = 0.0, False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode, from random levels or from ``options["state"]``, shape (4,)."""
        super().reset(seed=seed)
        self.fixed = bool(options) and "state" in options
        if self.fixed:
            self.levels, self.d = tuple(map(float, options["state"])), 0.0
            if not all(0 <= h <= FULL for h in self.levels) or len(self.levels) != 4:
                raise ValueError(f"state = {self.levels} must be four levels from 0 to 20 cm.")
        else:
            spread = self.np_random.uniform([-2, -2, -0.5, -0.5], [2, 2, 0.5, 0.5])
            self.levels = tuple((np.array(LEVELS_SS) + spread).tolist())
            self._draw_disturbance()
        return self._seen(), self._info()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold the voltages of both pumps for one sample of 10 s."""
        voltages = [min(max(float(v), 0.0), MAX_VOLTAGE) for v in action]
        levels = advance(self.levels, voltages, self.d, self.wear)
        if self.noise:
            levels = np.maximum(levels + self.noise * self.np_random.standard_normal(4), 0).tolist()
        overflow = max(levels) > FULL
        self.levels = tuple(min(h, FULL) for h in levels)
        if not self.fixed and self.np_random.random() < 1 / 60:
            self._draw_disturbance()
        return self._seen(), -float(overflow), False, False, {**self._info(), "violation": overflow}

    def _draw_disturbance(self) -> None:
        self.d = float(self.np_random.uniform(-MAX_DISTURBANCE, MAX_DISTURBANCE))

    def _seen(self) -> NDArray[np.float32]:
        return np.array(self.levels, dtype=np.float32)

    def _info(self) -> dict[str, Any]:
        return {"disturbance": self.d, "state": np.array(self.levels)}


def write_log(path: str | Path, steps: int = 360, seed: int = 0) -> None:
    """Write a CSV of an hour's experiment: each pump steps about 3 V, at random times."""
    env = QuadrupleTank(noise=0.02)
    rng = np.random.default_rng(seed)
    levels, info = env.reset(seed=seed)
    voltages = np.array(VOLTAGES_SS)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="", encoding="utf-8") as file:
        log = csv.writer(file)
        log.writerow(["time", "h1", "h2", "h3", "h4", "v1", "v2", "d"])
        for k in range(steps):
            steps_now = rng.random(2) < 1 / 8
            voltages = np.where(steps_now, VOLTAGES_SS + rng.uniform(-0.8, 0.8, 2), voltages)
            row = [k * DT, *levels.tolist(), *voltages.tolist(), info["disturbance"]]
            log.writerow([f"{value:.4f}" for value in row])
            levels, _, _, _, info = env.step(voltages)
