"""What the watchdog finds on the reactor, and when: `python -m experiments.watchdog`."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sb3_yann_envs import cstr

Act = Callable[[np.ndarray], np.ndarray]
NOISE = np.array([0.001, 0.001, 0.001, 0.03])  # mol/L and K
STEPS = 400


class Fault(NamedTuple):
    """What goes wrong from a step on: parameters times a factor, a sensor or the actuator."""

    name: str
    factors: dict[str, float] = {}  # noqa: RUF012 (is only read)
    sensor: int | None = None
    actuator: bool = False


QUIET = Fault("quiet")
PLANT = {"k1": 1.0, "k2": 1.0, "feed A": 4.3, "feed B": 5.1, "feed S": 3.0,
         "feed T": cstr.FEED_TEMPERATURE, "transfer": 1.0, "coolant T": 373.0}  # fmt: skip


def rates(x: np.ndarray, transfer: np.ndarray, factors: dict[str, np.ndarray]) -> np.ndarray:
    """Return the time derivative (runs, 4), with each parameter times its factor (runs,)."""
    at = {name: value * factors.get(name, 1.0) for name, value in PLANT.items()}
    a, b, s, t = x.T
    thermal = cstr.GAS_CONSTANT * t
    r1 = at["k1"] * np.exp(cstr.LOG_FREQUENCY_1 - cstr.ACTIVATION_1 / thermal) * a * b
    r2 = at["k2"] * np.exp(cstr.LOG_FREQUENCY_2 - cstr.ACTIVATION_2 / thermal) * s
    heat = (cstr.REACTION_HEAT_1 * r1 + cstr.REACTION_HEAT_2 * r2) / cstr.HEAT_CAPACITY
    cooling = 1000 * cstr.AREA / (cstr.HEAT_CAPACITY * cstr.VOLUME) * at["transfer"] * transfer
    flow = cstr.DILUTION
    return np.column_stack([
        flow * (at["feed A"] - a) - r1,
        flow * (at["feed B"] - b) - r1,
        flow * (at["feed S"] - s) - r2,
        flow * (at["feed T"] - t) + heat - cooling * (t - at["coolant T"]),
    ])  # fmt: skip


def step(x: np.ndarray, u: np.ndarray, factors: dict[str, np.ndarray]) -> np.ndarray:
    """Return the states (runs, 4) one sample later."""
    h, transfer = cstr.DT / 2, cstr.U_SS[0] + u[:, 0]
    x = x + cstr.X_SS
    for _ in range(2):
        k1 = rates(x, transfer, factors)
        k2 = rates(x + h / 2 * k1, transfer, factors)
        k3 = rates(x + h / 2 * k2, transfer, factors)
        k4 = rates(x + h * k3, transfer, factors)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.asarray(x - cstr.X_SS)


def play(act: Act, runs: int, seed: int, fault: Fault = QUIET, noise: float = 0.0):
    """Return readings (runs, T + 1, 4), inputs (runs, T, 1), hot (runs, T), onsets (runs,)."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(cstr.START_LOW, cstr.START_HIGH, (runs, 4))
    onset = rng.integers(5, STEPS // 2, runs)
    if fault.sensor is None and not fault.actuator:
        onset[:] = STEPS // 2
    readings, inputs = np.empty((runs, STEPS + 1, 4)), np.empty((runs, STEPS, 1))
    hot = np.zeros((runs, STEPS), bool)
    for k in range(STEPS + 1):
        y = np.float32(x + noise * NOISE * rng.standard_normal(x.shape))
        on = k >= onset
        if fault.sensor is not None and k:
            y[on, fault.sensor] = readings[on, k - 1, fault.sensor]
        readings[:, k] = y
        if k == STEPS:
            break
        inputs[:, k] = np.clip(act(readings[:, k]), -cstr.MAX_INPUT, cstr.MAX_INPUT)
        u = inputs[:, k].copy()
        if fault.actuator:
            u[on] = inputs[np.arange(runs), np.minimum(onset, k)][on]
        with np.errstate(all="ignore"):
            x = step(x, u, {n: np.where(on, f, 1.0) for n, f in fault.factors.items()})
            x = np.clip(np.nan_to_num(x, nan=1e3), [-3, -3, -3, -70], [3, 3, 3, 25])
        hot[:, k] = x[:, 3] > cstr.TEMPERATURE_LIMIT - cstr.X_SS[3]
    return readings, inputs, hot, onset
