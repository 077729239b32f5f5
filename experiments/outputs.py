"""How well are plants that show outputs identified? `python -m experiments.outputs --count 200`.

Random linear plants of orders 1 to 8, some with an integrator or dead times of 0 to 10 samples, 1
to 3 inputs and outputs, 10 to 40 dB of signal to noise: 2,000 samples to fit, 1,000 others to
judge. The yardstick is the plant's own Kalman filter, twenty samples ahead. With ``--sets FOLDER``
of DaISy's files, ARX models of six lags on the last 30 % of each set instead.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import linalg

from sb3_yann import identify_outputs
from sb3_yann._validation import Array

AHEAD = 20
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
        A, C, noise = self.A, self.C, np.diag(self.sensor**2)
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
    n, m, q = int(rng.integers(1, 9)), int(rng.integers(1, 4)), int(rng.integers(1, 4))
    integrates = bool(rng.random() < 0.2)
    blocks = [np.ones((1, 1))] if integrates else []
    while (left := n - sum(map(len, blocks))) > 0:
        if left > 1 and rng.random() < 0.5:
            size, angle = rng.uniform(0.7, 0.97), rng.uniform(0.1, 1.5)
            cos, sin = np.cos(angle), np.sin(angle)
            blocks.append(size * np.array([[cos, sin], [-sin, cos]]))
        else:
            blocks.append(np.array([[rng.uniform(0.3, 0.97)]]))
    A, B, C = linalg.block_diag(*blocks), rng.normal(size=(n, m)), rng.normal(size=(q, n))
    B[0] *= 0.2 if integrates else 1.0
    delays = rng.integers(0, 11, m) if rng.random() < 0.5 else np.zeros(m, int)
    decibels, share = rng.uniform(10, 40), rng.random()
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
        hold, k = int(rng.integers(2, 15)), 0
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
        y, z = plant.record(u, rng), plant.record(fresh, rng)
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
        y, u = table[:, of_outputs], table[:-1, of_inputs]
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


def main(arguments: list[str]) -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--sets", type=Path)
    given = parser.parse_args(arguments)
    if given.sets is not None:
        judge_sets(given.sets)
    else:
        judge_plants(range(given.first, given.first + given.count))


if __name__ == "__main__":
    main(sys.argv[1:])
