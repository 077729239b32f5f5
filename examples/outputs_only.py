"""From a CSV with three tags and time stamps to a page to sign and C code, no state measured.

The kettle stands for the plant: its jacket is hidden, and its valve acts three samples late.
"""

from datetime import datetime, timedelta
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3 import DDPG

import sb3_yann as yann
from sb3_yann.wrappers import EstimateState, SetPoint, StageCost

OUT = Path("out")
LOG, PAGE, CODE, ARRAYS = (OUT / f"kettle.{suffix}" for suffix in ("csv", "html", "c", "npz"))
DT, LATE = 10, 3  # seconds; samples


class Kettle(gym.Env):
    """Shows temperature (°C) and pressure (bar). The valve is in %, its characteristic bent."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(0.0, 100.0, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        """Begin at rest, with the valve at 40 %."""
        super().reset(seed=seed)
        self.jacket, self.kettle, self.on_its_way = 108.0, 80.0, [40.0] * LATE
        return self.shown(), {}

    def shown(self):
        """Return what the sensors say."""
        return self.np_random.normal([self.kettle, 0.02 * self.jacket - 1.16], [0.05, 0.005])

    def step(self, action):
        """Hold the valve for a sample."""
        *self.on_its_way, valve = [float(action[0]), *self.on_its_way]
        heat = 60 + 1.2 * valve + 0.0015 * (valve - 40) ** 2
        self.jacket += 0.15 * (heat - self.jacket) + 0.05 * (self.kettle - 80)
        self.kettle += 0.08 * (self.jacket - 28 - self.kettle)
        return self.shown(), 0.0, False, False, {}


def main() -> None:
    """Let an operator move the valve; then model, MPC, page and code; then close the loop."""
    OUT.mkdir(exist_ok=True)
    plant, rng, valve, began = Kettle(), np.random.default_rng(0), 40.0, datetime(2026, 1, 5, 8)
    y, rows = plant.reset(seed=0)[0], ["time,temperature,pressure,valve"]
    for k in range(1440):
        valve = rng.uniform(25, 55) if rng.random() < 0.1 else valve
        rows.append(f"{began + timedelta(seconds=k * DT)},{y[0]:.3f},{y[1]:.4f},{valve:.2f}")
        y = plant.step([round(valve, 2)])[0]
    LOG.write_text("\n".join(rows), encoding="utf-8")
    log = yann.Log.from_csv(LOG, ["temperature", "pressure"], ["valve"], DT, time="time")
    model = yann.identify_outputs(log).model
    print(model.report())
    half = np.array([10, 0.5, *[70] * (model.n_states - 2)])  # a valve on its way: 0 to 100
    box = {"theta_min": model.x_ss - half, "theta_max": model.x_ss + half, "u_min": 0, "u_max": 100}
    cost = {"Q": model.C.T @ np.diag([1, 0]) @ model.C, "R": [[1e-3]], "horizon": 4}
    cost["tracking"] = yann.Tracking(model.C[:1], 75, 85)
    mpc, observer = yann.offset_free(yann.LinearMPC(model, **cost, **box))
    env = EstimateState(SetPoint(Kettle(), 77, 83), observer)
    env = gym.wrappers.TimeLimit(StageCost(env, mpc), 60)
    policy = DDPG("YannPolicy", env, policy_kwargs={"problem": mpc}, device="cpu")
    yann.report(policy, PAGE, env=env, seeds=range(3))
    checks = yann.Checks([0, 0, 75], [120, 3, 85], frozen_after=30, missing=2)
    for path in (CODE, ARRAYS):
        print(yann.export(policy, path, estimator=observer, checks=checks))
    controller, y = yann.Controller.load(ARRAYS), plant.reset(seed=1)[0]
    for k in range(120):
        y = plant.step(controller([*y, 82], manual=None if k else [40]))[0]
    print(f"Set-point 82 °C: the kettle is at {plant.kettle:.2f} °C. Saved: {PAGE}, {CODE}")


if __name__ == "__main__":
    main()
