"""What the watchdog finds on the reactor, and when: `python -m experiments.watchdog`, ten minutes.

Prints the table of docs/commissioning.md. Its factors were set on other logs and other starts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3 import DDPG

from sb3_yann import PlantTwin, improve
from sb3_yann.commissioning.watchdog import Alarm, Watchdog
from sb3_yann_envs import cstr, problems

Act = Callable[[np.ndarray], np.ndarray]
NOISE = np.array([0.001, 0.001, 0.001, 0.03])  # mol/L and K
STEPS = 400


class Fault(NamedTuple):
    """What goes wrong from a step on: parameters times a factor, a sensor or the actuator."""

    name: str
    factors: dict[str, float] = {}
    sensor: int | None = None
    actuator: bool = False


QUIET = Fault("quiet")
FAULTS = (
    Fault("wanted reaction 10 % faster", {"k1": 1.1}),
    Fault("wanted reaction 10 % slower", {"k1": 0.9}),
    Fault("feed of B 10 % lower", {"feed B": 0.9}),
    Fault("heat transfer 10 % better", {"transfer": 1.1}),
    Fault("heat transfer 10 % worse", {"transfer": 0.9}),
    Fault("C_A sensor frozen", sensor=0),
    Fault("C_B sensor frozen", sensor=1),
    Fault("C_S sensor frozen", sensor=2),
    Fault("T sensor frozen", sensor=3),
    Fault("actuator stuck", actuator=True),
)
LOGS = {4: (600, 601), 10: (610, 611), 20: (620, 621)}
"""Seeds of logs of so many episodes."""
QUIET_EPISODES, FAULTY_EPISODES, RUNS = 17, 2, 200
BATCHES = {4: 6, 10: 10, 20: 14}
"""A run: how many episodes follow which log before the watchdog is calibrated anew."""
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


class Played(NamedTuple):
    """Episodes side by side."""

    readings: np.ndarray  # (runs, T + 1, 4)
    inputs: np.ndarray  # (runs, T, 1)
    hot: np.ndarray  # (runs, T), beyond the limit
    onsets: np.ndarray  # (runs,), of the fault


def play(act: Act, runs: int, seed: int, fault: Fault = QUIET, noise: float = 0.0) -> Played:
    """Return episodes of a policy on the plant, with a fault from some step on."""
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
    return Played(readings, inputs, hot, onset)


def watch(dog: Watchdog, act: Act, played: Played) -> list[tuple[int, Alarm] | None]:
    """Return the first alarm of each episode, with its step."""
    found: list[tuple[int, Alarm] | None] = []
    for x, u, hot in zip(played.readings, played.inputs, played.hot, strict=True):
        dog.start(x[0], act)
        rows = enumerate(zip(x, u, x[1:], hot, strict=False))
        alarms = ((k, dog.watch(*row)) for k, row in rows)
        found.append(next(((k, alarm) for k, alarm in alarms if alarm is not None), None))
    return found


def summary(delays: list[float]) -> str:
    """Return how many faults were found, and the median delay of those."""
    found = [each for each in delays if np.isfinite(each)]
    middle = f", {np.median(found):.0f}" if found else ""
    return f"{len(found)} of {len(delays)}{middle}"


def late(found: list[tuple[int, Alarm] | None], onsets: np.ndarray) -> list[float]:
    """Return samples from the onset to the alarm, infinite without one.

    A sample earlier than the onset is a false alarm; such episodes are left out.
    """
    pairs = zip(found, onsets, strict=True)
    steps = [np.inf if each is None else each[0] + 1.0 - at for each, at in pairs]
    return [each for each in steps if each >= 0]


def improved(problem: Any, twin: PlantTwin) -> Act:
    """Return a policy that is better than the MPC in a twin."""
    options = {"policy_kwargs": {"problem": problem}, "device": "cpu"}
    model = DDPG("YannPolicy", "CSTR-v0", **options)
    improve(model, twin)
    return lambda rows: np.asarray(model.predict(np.float32(rows), deterministic=True)[0])


def main() -> None:
    """Print the tables."""
    problem = problems.cstr()
    law = problem.explicit()
    log = play(law, 10, seed=299)
    better = improved(
        problem, PlantTwin.fit(problem, [*zip(log.readings, log.inputs, strict=True)])
    )
    cases = [(noise, n) for noise in (0.0, 1.0) for n in LOGS]
    quiet: dict[tuple[float, int], list[bool]] = {}
    table: dict[tuple[str, str], list[str]] = {}
    for noise, n in cases:
        alarms: list[bool] = []
        found: dict[tuple[str, str], list[float]] = {}
        for seed in LOGS[n]:
            log = play(law, n, seed, noise=noise)
            dog = Watchdog.of(PlantTwin.fit(problem, [*zip(log.readings, log.inputs, strict=True)]))
            for k, (name, act) in enumerate((("MPC", law), ("improved", better))):
                calm = play(act, QUIET_EPISODES, seed + 1000 + 500 * k, noise=noise)
                alarms += [each is not None for each in watch(dog, act, calm)]
                for i, fault in enumerate(FAULTS):
                    hurt = play(act, FAULTY_EPISODES, seed + 2000 + 10 * i, fault, noise)
                    delays = late(watch(dog, act, hurt), hurt.onsets)
                    found.setdefault((fault.name, name), []).extend(delays)
        quiet[noise, n] = alarms
        for row, delays in found.items():
            table.setdefault(row, []).append(summary(delays))
        table.setdefault(("false alarms", "both"), []).append(f"{sum(alarms)} of {len(alarms)}")
    heads = [f"{'noise' if noise else 'no noise'}, {n} episodes" for noise, n in cases]
    print("| fault | policy |", " | ".join(heads), "|")
    print("| --- | --- |", " | ".join("---:" for _ in heads), "|")
    for (fault_name, name), cells in table.items():
        print(f"| {fault_name} | {name} |", " | ".join(cells), "|")
    rng = np.random.default_rng(0)
    for noise in (0.0, 1.0):
        loud = sum(
            any(rng.choice(quiet[noise, n], size).any() for n, size in BATCHES.items())
            for _ in range(RUNS)
        )
        print(f"noise {noise:g}: {loud} of {RUNS} runs of {sum(BATCHES.values())} quiet episodes "
              "have an alarm")  # fmt: skip


if __name__ == "__main__":
    main()
