"""Does a twin keep its promises where dynamics are hidden? `python -m experiments.hidden_dynamics`.

Thirty plants, drawn from seeds: order one to three, units, actuator lag, backlash, a load that
lasts, another gain than the model's. Of each two logs, the MPC's ordinary one and one with a
dither. `improve` knows the log alone; then MPC and policy play six hundred starts of the plant that
no log has. Prints a row for each log: what was promised, its interval, and what the plant gave.
With `--commission` sixty episodes of `Commissioning` take the place of the logs.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import DDPG

from experiments.markdown import table
from sb3_yann import Commissioning, LinearModel, LinearMPC, PlantTwin, Tracking, YannPolicy, improve
from sb3_yann._validation import Array, Feedback
from sb3_yann.evaluation import evaluate
from sb3_yann.twin.forecast import Forecast
from sb3_yann.wrappers import SetPoint, StageCost

SEEDS = range(1000, 1030)
LOGS = "ordinary", "dither"
STEPS = 25
TESTS = range(900_000, 900_600)
# of half the range, samples
DITHER = 0.15
HOLD = 4
KINDS = "none", "linear", "quadratic"  # a fit of networks takes half a minute
HIDDEN = "lag", "backlash", "load", "gain"


@dataclass(frozen=True)
class Hidden:
    """What a plant has that its model has not.

    Attributes
    ----------
    lag : float
        Pole of the actuator.
    backlash : float
        Half of its play, in half-ranges of the input.
    load : float
        Standard deviation of a load that lasts, as an input, in half-ranges.
    gain : float
        Times the model's.
    bend : float
        Of the gain over the first state: what an MPC cannot know.
    """

    lag: float = 0.0
    backlash: float = 0.0
    load: float = 0.0
    gain: float = 1.0
    bend: float = 0.0

    @classmethod
    def draw(cls, seed: int) -> Hidden:
        """Return one kind for certain, the others now and then."""
        rng = np.random.default_rng([seed, 1])
        sure = HIDDEN[seed % len(HIDDEN)]
        chance = {"lag": 0.3, "backlash": 0.3, "load": 0.3, "gain": 0.6}
        some = {name: name == sure or rng.uniform() < chance[name] for name in HIDDEN}
        return cls(
            rng.uniform(0.2, 0.6) * some["lag"],
            rng.uniform(0.02, 0.12) * some["backlash"],
            rng.uniform(0.03, 0.15) * some["load"],
            float(np.exp(rng.uniform(np.log(0.4), np.log(2.2)))) if some["gain"] else 1.0,
            rng.uniform(0.2, 0.8) * (rng.uniform() < 0.7),
        )


class Plant(gym.Env[Array, Array]):
    """A chain of lags, measured with noise."""

    def __init__(self, mpc: LinearMPC, hidden: Hidden, unit: Array, noise: float) -> None:
        self.mpc = mpc
        self.hidden = hidden
        self.unit = unit
        self.noise = noise
        self.action_space = gym.spaces.Box(mpc.u_min, mpc.u_max, dtype=np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, unit.shape, np.float32)

    def _shown(self) -> Array:
        noise = self.noise * self.unit * self.np_random.standard_normal(len(self.unit))
        return np.asarray(self.x + noise)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, dict]:
        """Begin around rest, the actuator at rest."""
        super().reset(seed=seed)
        self.x = self.unit * self.np_random.uniform(-1, 1, len(self.unit))
        self.held = self.driven = np.zeros(len(self.mpc.u_max))
        self.load = self.hidden.load * self.np_random.standard_normal(len(self.held))
        return self._shown(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict]:
        """Hold the inputs for a sample."""
        hidden = self.hidden
        model = self.mpc.model
        half = self.mpc.u_half
        u = np.clip(np.asarray(action, np.float64), self.mpc.u_min, self.mpc.u_max)
        play = hidden.backlash * half
        self.held = np.clip(self.held, u - play, u + play)
        self.driven = hidden.lag * self.driven + (1 - hidden.lag) * self.held
        shock = hidden.load * np.sqrt(1 - 0.95**2) * self.np_random.standard_normal(len(u))
        self.load = 0.95 * self.load + shock
        gain = hidden.gain * (1 + hidden.bend * np.tanh(self.x[0] / self.unit[0]))
        self.x = model.A @ self.x + model.B @ (gain * self.driven + half * self.load)
        return self._shown(), 0.0, False, False, {}


def draw(seed: int) -> tuple[LinearMPC, Any]:
    """Return an MPC, and what makes its plant."""
    rng = np.random.default_rng([seed, 0])
    n = int(rng.integers(1, 4))
    m = int(rng.integers(1, 3))
    unit = 10 ** rng.uniform(-2, 2, n)
    half = 10 ** rng.uniform(-1, 1, m)
    A = np.diag(rng.uniform(0.7, 0.95, n)) + np.diag(rng.uniform(0.1, 0.3, n - 1), 1)
    B = np.zeros((n, m))
    B[-1] = rng.uniform(0.1, 0.3, m)
    B[0] += rng.uniform(0.02, 0.1, m)
    A = unit[:, None] * A / unit
    B = unit[:, None] * B / half
    tracks = seed % 2 == 1
    mpc = LinearMPC(
        LinearModel(A, B, 1.0),
        Q=np.diag(rng.uniform(0.1, 1, n) / unit**2),
        R=np.diag(rng.uniform(0.02, 0.2, m) / half**2),
        horizon=3,
        gamma=0.98,
        u_min=-half,
        u_max=half,
        theta_min=-6 * unit,
        theta_max=6 * unit,
        **({"tracking": Tracking([0], -0.6 * unit[0], 0.6 * unit[0])} if tracks else {}),
    )
    hidden = Hidden.draw(seed)
    noise = float(rng.choice([0.001, 0.004, 0.01]))

    def make() -> Any:
        env: Any = Plant(mpc, hidden, unit, noise)
        if tracks:
            env = SetPoint(env, -0.6 * unit[:1], 0.6 * unit[:1], hold=12)
        return StageCost(TimeLimit(env, STEPS), mpc)

    return mpc, make


def logged(seed: int, how: str) -> tuple[LinearMPC, Any, list[tuple[Array, Array]]]:
    """Return an MPC, what makes its plant, and a log of ten to twenty episodes."""
    mpc, make = draw(seed)
    rng = np.random.default_rng([seed, 2, LOGS.index(how)])
    law = mpc.law()
    moved = {"t": 0, "by": np.zeros(len(mpc.u_max))}

    def act(theta: Array) -> Array:
        if moved["t"] % HOLD == 0:
            moved["by"] = DITHER * mpc.u_half * rng.uniform(-1, 1, len(mpc.u_max))
        moved["t"] += 1
        u = np.asarray(law(theta), np.float64)
        return np.clip(u + (moved["by"] if how == "dither" else 0), mpc.u_min, mpc.u_max)

    first = 1000 * int(rng.integers(1, 500))
    seeds = range(first, first + int(rng.integers(10, 21)))
    episodes = [evaluate(act, make(), [each]) for each in seeds]
    return mpc, make, [each.pairs[0] for each in episodes]


@dataclass(frozen=True)
class Row:
    """One log: figures in fractions of the MPC's cost."""

    seed: int
    log: str
    hidden: dict[str, float]
    episodes: int
    trusted: bool
    accepted: bool
    promised: float
    low: float
    high: float
    true: float
    seconds: float
    reason: str
    first: tuple[float, float, float] | None = None
    """Of the first candidate, accepted or not: its interval, and what it changes on the plant."""


def true_change(policy: Any, mpc: LinearMPC, make: Any) -> float:
    """Return what a policy costs on the plant, relative to the MPC."""
    ours, its = (evaluate(each, make, TESTS).costs for each in (policy, mpc.explicit()))
    return float(ours.sum() / its.sum() - 1)


def execute(seed: int, how: str) -> Row:
    """Return what came of a log."""
    mpc, make, log = logged(seed, how)
    began = time.perf_counter()
    hidden = asdict(Hidden.draw(seed))
    twin = PlantTwin.fit(mpc, log, residuals=KINDS)
    if not twin.trusted:
        said = " ".join(twin.trust.problems)
        spent = time.perf_counter() - began
        return Row(seed, how, hidden, len(log), False, False, 0, 0, 0, 0, spent, said)
    first: list[tuple[float, float, float]] = []
    ask = PlantTwin.forecast

    def asked(of: PlantTwin, act: Feedback) -> Forecast:
        said = ask(of, act)
        if not first:
            true = true_change(lambda theta: act(theta[None].astype(float))[0], mpc, make)
            first.append((said.low, said.high, true))
        return said

    with mock.patch.object(PlantTwin, "forecast", asked):
        found = improve(mpc, twin, rounds=1, n_starts=20, updates=400)
    spent = time.perf_counter() - began
    true = true_change(found.model, mpc, make) if found.accepted else 0.0
    known = [each.interval for each in found.checks if each.interval is not None]
    low, high = known[-1] if known else (-np.inf, np.inf)
    return Row(
        seed, how, hidden, len(log), True, found.accepted, found.change, low, high, true, spent,
        found.reason, *first
    )  # fmt: skip


def commission(seed: int) -> list[str]:
    """Return what sixty episodes of a commissioning ended with, as a row."""
    mpc, make = draw(seed)
    options = {"problem": mpc, "networks": "shared"}
    model = DDPG(YannPolicy, make(), policy_kwargs=options, seed=0, device="cpu")
    run = Commissioning(model, make, batch=4, rounds=1, updates=300, seed=100_000 * seed)
    last = run.run(4)[-1]
    costs = f"{last.cost:.4g}, {last.mpc:.4g}"
    alarms = sum(each.alarms for each in run.batches)
    change = f"{100 * true_change(run.model, mpc, make):+.2f}"
    return [str(seed), run.kept, costs, str(alarms), change, last.reason[:60]]


def main() -> None:
    """Do the runs, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--seeds", type=int, nargs=2, default=(SEEDS.start, SEEDS.stop))
    parser.add_argument("--out", type=Path, default=Path("hidden_dynamics.jsonl"))
    parser.add_argument("--commission", action="store_true")
    args = parser.parse_args()
    if args.commission:
        header = "plant", "kept", "cost, the MPC's", "alarms", "true, %", "last"
        rows = [commission(seed) for seed in range(*args.seeds)]
        print(table(header, rows, 3))
        return
    done = [json.loads(line) for line in args.out.open()] if args.out.exists() else []
    for seed in range(*args.seeds):
        for how in LOGS:
            if not any((each["seed"], each["log"]) == (seed, how) for each in done):
                done.append(asdict(execute(seed, how)))
                with args.out.open("a") as file:
                    file.write(json.dumps(done[-1]) + "\n")
    print(report([Row(**each) for each in done]))


def report(rows: list[Row]) -> str:
    """Return the table, and below it how many promises held."""
    header = "plant", "log", "hidden", "promised, %", "interval, %", "true, %", "why not"
    lines = []
    for each in rows:
        hidden = ", ".join(f"{k} {v:.2g}" for k, v in each.hidden.items() if v not in (0.0, 1.0))
        shown = [f"{100 * v:+.2f}" for v in (each.promised, each.low, each.high, each.true)]
        took = [shown[0], f"{shown[1]} to {shown[2]}", shown[3]] if each.accepted else [""] * 3
        lines.append([str(each.seed), each.log, hidden, *took, each.reason[:60]])
    taken = [each for each in rows if each.accepted]
    worse = sum(each.true > 0 for each in taken)
    inside = sum(each.low <= each.true <= each.high for each in taken)
    first = [each.first for each in rows if each.first is not None]
    held = sum(low <= true <= high for low, high, true in first)
    return "\n".join(
        [
            table(header, lines, 3),
            f"{len(taken)} of {len(rows)} logs: a policy accepted. Worse on the plant: {worse}. "
            f"True change within the interval: {inside}; of first candidates {held} of "
            f"{len(first)}.",
        ]
    )


if __name__ == "__main__":
    main()
