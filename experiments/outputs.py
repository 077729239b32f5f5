"""How well are plants that show outputs identified? `python -m experiments.outputs --count 200`.

Random linear plants of orders 1 to 8, some with an integrator or dead times of 0 to 10 samples, 1
to 3 inputs and outputs, 10 to 40 dB of signal to noise: 2,000 samples to fit, 1,000 others to
judge. The yardstick is the plant's own Kalman filter, twenty samples ahead. With ``--sets FOLDER``
of DaISy's files, ARX models of six lags on the last 30 % of each set instead.

With ``--learn`` and plants: what `improve` gains where the policy sees estimates, in a simulator
and from a log of outputs. Costs are those of the true outputs, on unseen starts. The oracle is
`headroom` on the same starts: its plans were played from each start before, so they know the hidden
state and disturbance that no reading tells yet. "feed" is a bioreactor whose measured feed the
model leaves out: with and without extra signals. "column" is that of R. Wood and M. Berry (Chem.
Eng. Sci. 28, 1973): its model is identified from its outputs, its own feed rate is hidden.

With ``--settle``: how many of thirty set-points, held for 400 samples, a plant reaches from its
outputs.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from scipy import linalg

from experiments.plants import TextbookEnv, TextbookPlant, bioreactor, ph, van_de_vusse
from sb3_yann import (
    DisturbanceObserver,
    LinearModel,
    LinearMPC,
    PlantTwin,
    StateEstimator,
    Tracking,
    headroom,
    identify_outputs,
    improve,
    offset_free,
    with_extra,
)
from sb3_yann._validation import Array
from sb3_yann.wrappers import EstimateState, MeasuredDisturbance, SetPoint

AHEAD = 20
TESTS = range(2000, 2030)
LOGGED = range(500, 530)
SETS = {  # columns of inputs and of outputs
    "exchanger": ([1], [2]),
    "evaporator": ([0, 1, 2], [3, 4, 5]),
    "glassfurnace": ([1, 2, 3], [4, 5, 6, 7, 8, 9]),
    "cstr": ([1], [2, 3]),
    "ballbeam": ([0], [1]),
    "heating_system": ([1], [2]),
    "dryer2": ([1, 2, 3], [4, 5, 6]),
    "steamgen": ([1, 2, 3, 4], [5, 6, 7, 8]),
}


@dataclass(frozen=True)
class Plant:
    """``x+ = A x + B v + w``, ``y = C x + e``, where v is the input some samples before."""

    A: Array
    B: Array
    C: Array
    delays: Array
    process: float
    sensor: Array

    def record(self, u: Array, rng: np.random.Generator) -> Array:
        """Return the outputs (T + 1, q) of a run from zero."""
        w = self.process * rng.normal(size=(len(u), len(self.A)))
        x = states(self.A, self.late(u) @ self.B.T + w)
        return x @ self.C.T + self.sensor * rng.normal(size=(len(u) + 1, len(self.C)))

    def late(self, u: Array) -> Array:
        """Return the inputs (T, m) that act."""
        columns = [
            np.concatenate([np.zeros(lag), u[: len(u) - lag, j]])
            for j, lag in enumerate(self.delays)
        ]
        return np.column_stack(columns)

    def predict(self, y: Array, u: Array) -> Array:
        """Return what the plant's Kalman filter predicts, (T + 1 - AHEAD, q)."""
        A = self.A
        C = self.C
        noise = np.diag(self.sensor**2)
        P = linalg.solve_discrete_are(A.T, C.T, (self.process**2 + 1e-14) * np.eye(len(A)), noise)
        gain = np.linalg.solve(C @ P @ C.T + noise, C @ P @ A.T).T
        moved = self.late(u) @ self.B.T
        x = states(A - gain @ C, moved + y[:-1] @ gain.T)[1:]
        rows = len(u) + 1 - AHEAD
        x = x[:rows]
        for step in range(1, AHEAD):
            x = x @ A.T + moved[step : step + rows]
        return np.asarray(x @ C.T)


def states(A: Array, moved: Array) -> Array:
    """Return the states (T + 1, n) from zero."""
    x = np.zeros((len(moved) + 1, len(A)))
    for k, each in enumerate(moved):
        x[k + 1] = A @ x[k] + each
    return x


def random_plant(rng: np.random.Generator) -> tuple[Plant, str]:
    """Return a plant and what it is."""
    n = int(rng.integers(1, 9))
    m = int(rng.integers(1, 4))
    q = int(rng.integers(1, 4))
    integrates = bool(rng.random() < 0.2)
    blocks = [np.ones((1, 1))] if integrates else []
    while (left := n - sum(map(len, blocks))) > 0:
        if left > 1 and rng.random() < 0.5:
            size = rng.uniform(0.7, 0.97)
            angle = rng.uniform(0.1, 1.5)
            cos = np.cos(angle)
            sin = np.sin(angle)
            blocks.append(size * np.array([[cos, sin], [-sin, cos]]))
        else:
            blocks.append(np.array([[rng.uniform(0.3, 0.97)]]))
    A = linalg.block_diag(*blocks)
    B = rng.normal(size=(n, m))
    C = rng.normal(size=(q, n))
    B[0] *= 0.2 if integrates else 1.0
    delays = rng.integers(0, 11, m) if rng.random() < 0.5 else np.zeros(m, int)
    decibels = rng.uniform(10, 40)
    share = rng.random()
    quiet = Plant(A, B, C, delays, 0.0, np.zeros(q))
    size = np.std(quiet.record(inputs(2000, m, rng), rng), axis=0) * 10 ** (-decibels / 20)
    loud = np.std(states(A, rng.normal(size=(2000, n))) @ C.T, axis=0)
    process = float(np.sqrt(share) * np.min(size / loud))
    sensor = np.sqrt(1 - 0.99 * share) * size
    words = f"{n} {[*map(int, delays)]}{' integrates' * integrates}, {q} out, {decibels:.0f} dB"
    return Plant(A, B, C, delays, process, sensor), words


def inputs(count: int, m: int, rng: np.random.Generator) -> Array:
    """Return inputs (count, m) that are held, each for its own number of samples."""
    found = np.zeros((count, m))
    for j in range(m):
        hold = int(rng.integers(2, 15))
        k = 0
        while k < count:
            length = int(rng.integers(1, 2 * hold))
            found[k : k + length, j] = rng.uniform(-1, 1)
            k += length
    return found


def judge_plants(seeds: range) -> None:
    """Print one row for each plant, and how many reach what was asked for."""
    close = near = 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        plant, words = random_plant(rng)
        u, fresh = (inputs(count, plant.B.shape[1], rng) for count in (2000, 1000))
        y = plant.record(u, rng)
        z = plant.record(fresh, rng)
        began = time.process_time()
        found = identify_outputs(y, u, dt=1.0)
        took = time.process_time() - began
        errors = [
            np.sqrt(np.mean((guess - z[AHEAD:]) ** 2, axis=0))
            for guess in (found.predict(z, fresh, AHEAD), plant.predict(z, fresh))
        ]
        ratio = float(np.sqrt(np.mean((errors[0] / errors[1]) ** 2)))
        close += ratio <= 1.1
        near += abs(found.order - len(plant.A)) <= 1
        print(
            f"{seed:4d} | {words} | order {found.order}, {[*found.delays]} | error {ratio:.3f} of "
            f"the best possible | {took:.1f} s",
            flush=True,
        )
    print(f"Of {len(seeds)}: within 10 % {close}, order within one {near}.")


def judge_sets(folder: Path) -> None:
    """Print R2 twenty samples ahead of each output: `identify_outputs`, and an ARX model."""
    for name, (of_inputs, of_outputs) in SETS.items():
        path = folder / f"{name}.dat"
        if not path.exists():
            continue
        table = np.loadtxt(path)
        y = table[:, of_outputs]
        u = table[:-1, of_inputs]
        border = int(0.7 * len(y))
        found = identify_outputs(y[:border], u[: border - 1], dt=1.0)
        start = border + 5
        target = y[start + AHEAD :]
        both = found.predict(y, u, AHEAD)[start:], arx(y, u, border)[: len(target)]
        spread = np.sum((target - target.mean(axis=0)) ** 2, axis=0)
        own, other = (1 - np.sum((each - target) ** 2, axis=0) / spread for each in both)
        words = f"order {found.order}, {[*found.delays]}"
        print(f"{name} | {words} | {own.round(2)} | ARX {other.round(2)}", flush=True)


def arx(y: Array, u: Array, border: int, lags: int = 6) -> Array:
    """Return what an ARX model of the rows before a border predicts from there on."""
    late = range(1, lags + 1)
    rows = [each[lags - i : border - i] for each in (y, u) for i in late]
    weights = np.linalg.lstsq(
        np.hstack([*rows, np.ones((border - lags, 1))]), y[lags:border], rcond=None
    )[0]
    at = np.arange(border + lags - 1, len(y) - AHEAD)
    past = [y[at - i] for i in range(lags)]
    for step in range(AHEAD):
        played = [u[at + step - i] for i in range(lags)]
        past = [np.hstack([*past, *played, np.ones((len(at), 1))]) @ weights, *past[:-1]]
    return past[0]


class Hidden(TextbookEnv):
    """A plant that shows outputs ``C x``; a last state that no model knows is another in each run.

    Parameters
    ----------
    plant : TextbookPlant
    C : ndarray, shape (q, n)
        Of the model's states.
    last : tuple of float, optional
        Where that state lies. It is told in ``info["disturbance"]``.
    """

    def __init__(
        self, plant: TextbookPlant, C: Array, last: tuple[float, float] | None = None
    ) -> None:
        super().__init__(plant)
        self.C = C
        self.last = last
        free = np.full(len(C), np.inf)
        self.observation_space = spaces.Box(-free, free, dtype=np.float32)

    @property
    def outputs(self) -> Array:
        """What the sensors show."""
        return np.asarray(self.C @ self.state[: self.C.shape[1]])

    def reset(self, **kwargs: Any) -> tuple[Array, dict[str, Any]]:
        """Begin near where the model rests."""
        super().reset(**kwargs)
        if self.last is not None:
            self.state = np.append(self.state, self.np_random.uniform(*self.last))
        return self.outputs, {"disturbance": self.state[-1:]}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold the inputs for a sample."""
        super().step(action)
        return self.outputs, 0.0, False, False, {"disturbance": self.state[-1:]}


class Column(gym.Env[Array, Array]):
    """Methanol and water: purities (%) of top and bottom by reflux and steam (lb/min).

    Each minute. The feed rate steps at the start of an episode by up to ``feed`` lb/min, unseen.
    """

    rest = np.array([96.0, 0.5])
    u_rest = np.array([1.95, 1.71])
    # Of reflux, steam and feed rate on top and bottom.
    gains = np.array([[12.8, -18.9, 3.8], [6.6, -19.4, 4.9]])
    constants = np.array([[16.7, 21.0, 14.9], [10.9, 14.4, 13.2]])
    delays = ((1, 3, 8), (7, 3, 3))

    def __init__(self, C: Array, feed: float = 0.1, sensor: float = 0.0) -> None:
        self.C = C
        self.feed = feed
        self.sensor = sensor
        self.poles = np.exp(-1 / self.constants)
        free = np.full(2, np.inf)
        self.observation_space = spaces.Box(-free, free, dtype=np.float32)
        self.action_space = spaces.Box(self.u_rest - 0.5, self.u_rest + 0.5, dtype=np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin at rest, or near it."""
        super().reset(seed=seed)
        self.parts = np.zeros((2, 3))
        self.parts[:, 0] = self.np_random.uniform(-0.5, 0.5, 2)
        self.step_of_feed = self.np_random.uniform(-self.feed, self.feed)
        self.played = [np.zeros(3)] * 9
        return self.show(), {}

    def show(self) -> Array:
        """Read the sensors."""
        noise = self.sensor * self.np_random.normal(size=2)
        self.outputs = self.rest + self.parts.sum(axis=1) + noise
        return self.outputs.copy()

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold reflux and steam for a minute."""
        u = np.clip(action, self.action_space.low, self.action_space.high)  # type: ignore[attr-defined]
        self.played = [np.append(u - self.u_rest, self.step_of_feed), *self.played[:8]]
        acting = [[self.played[lag][j] for j, lag in enumerate(row)] for row in self.delays]
        self.parts = self.poles * self.parts + (1 - self.poles) * self.gains * acting
        return self.show(), 0.0, False, False, {}


@dataclass(frozen=True)
class Learner:
    """An MPC, the plant that shows outputs and set-points, and the estimator if there is one."""

    mpc: LinearMPC
    plant: Callable[[], Any]
    estimator: StateEstimator | None = None

    def make(self) -> Any:
        """Return the plant as a policy sees it."""
        d = self.mpc.disturbances
        if self.estimator is None:
            return self.plant()
        return EstimateState(self.plant(), self.estimator, d.d_min, d.d_max)

    def play(self, policy: Any, seed: int, push: float = 0.0) -> tuple[float, Array, Array, Array]:
        """Return what an episode costs, its outputs, inputs and thetas.

        ``push`` moves the inputs, every fifth sample anew, by half-widths of their range.
        """
        mpc = self.mpc
        env = self.make()
        rng = np.random.default_rng(seed)
        theta = env.reset(seed=seed)[0]
        over = False
        cost = 0.0
        C = env.unwrapped.C
        outputs = [env.unwrapped.outputs]
        inputs = []
        thetas = [theta]
        while not over:
            if len(inputs) % 5 == 0:
                moved = push * mpc.u_half * rng.uniform(-1, 1, len(mpc.R))
            u = np.clip(np.asarray(policy(theta), np.float64) + moved, mpc.u_min, mpc.u_max)
            true = theta.astype(np.float64)
            true[mpc.layout.state] += np.linalg.pinv(C) @ (outputs[-1] - C @ true[mpc.layout.state])
            cost += float(mpc.stage_cost(true, u))
            theta, _, _, over, _ = env.step(u)
            outputs.append(env.unwrapped.outputs)
            inputs.append(u)
            thetas.append(theta)
        return cost, np.array(outputs), np.array(inputs), np.array(thetas, np.float64)

    def costs(self, policy: Any) -> Array:
        """Return the costs of unseen episodes."""
        return np.array([self.play(policy, seed)[0] for seed in TESTS])


def of_outputs(
    plant: TextbookPlant, rows: list[int], d_max: list[float], last: Any = None
) -> Learner:
    """Return the offset-free MPC of a plant that shows some of its states."""
    C = np.eye(plant.model.n_states)[rows]
    model = LinearModel(**{**vars(plant.model), "C": C})
    mpc, estimator = offset_free(replace(plant, model=model).mpc(), d_max)
    return Learner(mpc, partial(_wrapped, plant, C, mpc, last), estimator)


def of_feed(extra: bool) -> Learner:
    """Return the reactor whose food in the feed is 3.2 to 4.8, with a policy that may see it."""
    plant = bioreactor()
    last = (3.2, 4.8)
    mpc = plant.mpc()
    return Learner(
        with_extra(mpc, *last) if extra else mpc,
        partial(_wrapped, plant, np.eye(2), mpc, last, extra),
    )


def of_column() -> Learner:
    """Return the offset-free MPC of the column, by its outputs in 1,500 minutes of steps."""
    plant = Column(np.eye(2), sensor=0.05)
    rng = np.random.default_rng(0)
    u = Column.u_rest + 0.15 * inputs(1500, 2, rng)
    y = np.array([plant.reset(seed=0)[0], *(plant.step(each)[0] for each in u)])
    model = identify_outputs(y, u, dt=1.0).model
    half = np.append([10.0, 10.0], np.full(model.n_states - 2, 50.0))
    mpc = LinearMPC(
        model,
        Q=model.shown.T @ model.shown,
        R=np.diag([1.0, 1.0]),
        horizon=10,
        gamma=0.95,
        tracking=Tracking(model.shown, [95.0, 0.5], [97.0, 2.0]),
        u_min=Column.u_rest - 0.5,
        u_max=Column.u_rest + 0.5,
        theta_min=model.x_ss - half,
        theta_max=model.x_ss + half,
    )
    mpc, estimator = offset_free(mpc, [1.0, 1.0])
    return Learner(mpc, partial(_column, mpc), estimator)


def _column(mpc: LinearMPC) -> Any:
    plant = SetPoint(Column(mpc.model.shown), mpc.tracking.r_min, mpc.tracking.r_max, hold=60)
    return TimeLimit(plant, 120)


def _wrapped(plant: TextbookPlant, C: Array, mpc: LinearMPC, last: Any, told: bool = False) -> Any:
    bounds = mpc.tracking.r_min, mpc.tracking.r_max
    env: Any = SetPoint(Hidden(plant, C, last), *bounds, hold=plant.hold)
    return TimeLimit(MeasuredDisturbance(env, *last) if told else env, plant.steps)


LEARNERS: dict[str, Callable[[], Learner]] = {
    "reactor": lambda: of_outputs(van_de_vusse(), [1, 2], [0.1, 3.0]),
    "column": of_column,
    "ph": lambda: of_outputs(ph(), [0], [1.0], (2e-5, 1.5e-4)),
    "feed": lambda: of_feed(True),
    "feed, unseen": lambda: of_feed(False),
}


def slower(case: Learner) -> Learner:
    """Return a case whose observer trusts its model ten times as much."""
    assert case.estimator is not None
    model = case.mpc.model
    C = case.estimator.C
    unit = case.mpc.theta_half[case.mpc.layout.state]
    shown = np.abs(C) @ unit
    noise = {"state_noise": unit / 10, "disturbance_noise": shown / 10, "measurement_noise": shown}
    return replace(case, estimator=DisturbanceObserver(model, C, **noise))


HELD = {"hold": 400, "steps": 400}
CONCENTRATION_OF_ONE = (1.53332, 1.0, 385.819, 384.534), 7.11539
SETTLERS: dict[str, Callable[[], Learner]] = {
    "reactor": lambda: of_outputs(replace(van_de_vusse(), **HELD), [1, 2], [0.1, 3.0]),
    "reactor, its model of another set-point": lambda: of_outputs(
        replace(van_de_vusse(*CONCENTRATION_OF_ONE), **HELD), [1, 2], [0.1, 3.0]
    ),
    "ph": lambda: of_outputs(replace(ph(), **HELD), [0], [1.0], (2e-5, 1.5e-4)),
    "ph, a slower observer": lambda: slower(SETTLERS["ph"]()),
}


def judge_settling() -> None:
    """Print how many set-points are reached: within .1 % of their range, moving by .2 % at most."""
    for name, make in SETTLERS.items():
        case = make()
        tracking = case.mpc.tracking
        law = case.mpc.law()
        settled = []
        for seed in TESTS:
            _, outputs, _, thetas = case.play(law.plant_input, seed)
            track = tracking.C @ np.linalg.pinv(case.make().unwrapped.C)
            shown = (outputs[-60:] @ track.T) / (tracking.r_max - tracking.r_min)
            wanted = thetas[0, case.mpc.layout.reference] / (tracking.r_max - tracking.r_min)
            reached = np.abs(shown.mean(axis=0) - wanted).max() < 1e-3
            settled.append(reached and np.ptp(shown, axis=0).max() < 2e-3)
        print(f"{name}: {sum(settled)} of {len(settled)}", flush=True)


def judge_learning(name: str, seed: int) -> None:
    """Print what is gained on one plant."""
    case = LEARNERS[name]()
    mpc = case.mpc
    law = case.mpc.law()
    base = case.costs(law.plant_input)
    settled = case.play(law.plant_input, TESTS[0])[3][-2]  # the last one has another set-point
    track = mpc.tracking.C
    layout = mpc.layout
    offset = np.abs(track @ settled[layout.state] - settled[layout.reference]).max()
    print(f"{name} | MPC {base.mean():.4g}, offset in the end {offset:.2g}", flush=True)

    def told(what: str, policy: Any, more: str) -> None:
        found = case.costs(policy) if policy is not None else base
        worst = 100 * (found - base).max() / base.mean()
        change = 100 * (found.mean() / base.mean() - 1)
        print(f"{name} | {what}: {change:+.1f} %, worst start {worst:+.1f} % | {more}", flush=True)

    began = time.process_time()
    found = improve(mpc, case.make, seed=seed)
    took = f"{found.steps:,} steps, {time.process_time() - began:.0f} s"
    told("simulator", lambda theta: found.model.predict(theta)[0], took)
    oracle = headroom(mpc, case.make, n_starts=len(TESTS), seed=TESTS[0])
    print(f"{name} | oracle: {-100 * oracle.total:.1f} %, {oracle.steps:,} steps", flush=True)
    log = [case.play(law.plant_input, each, 0.3 * (each % 2)) for each in LOGGED]
    if case.estimator is None:
        twin = PlantTwin.fit(mpc, [(thetas, inputs) for _, _, inputs, thetas in log])
    else:
        r = [thetas[:, layout.reference] for *_, thetas in log]
        pairs = [(outputs, inputs) for _, outputs, inputs, _ in log]
        twin = PlantTwin.fit(mpc, pairs, references=r, observer=case.estimator)
    if twin.trusted:
        learnt = improve(mpc, twin, seed=seed)
        told("log", lambda theta: learnt.model.predict(theta)[0], learnt.report())
    else:
        told("log", None, "; ".join(twin.trust.problems))


def main(arguments: list[str]) -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--sets", type=Path)
    parser.add_argument("--learn", nargs="+", choices=LEARNERS)
    parser.add_argument("--settle", action="store_true")
    parser.add_argument("--seed", type=int, default=0, help="of what `improve` draws")
    given = parser.parse_args(arguments)
    if given.learn:
        for name in given.learn:
            judge_learning(name, given.seed)
    elif given.settle:
        judge_settling()
    elif given.sets is not None:
        judge_sets(given.sets)
    else:
        judge_plants(range(given.first, given.first + given.count))


if __name__ == "__main__":
    main(sys.argv[1:])
