"""Residuals of the reactor's twin compared: `python -m experiments.twin_residuals`, half an hour.

Five logs of the MPC for each case, on none of which anything was tuned. The error is that of free
runs of 20 and 100 steps in ten episodes without noise that are in no log, in standard deviations of
the states. Prints the table of docs/twin.md.
"""

from __future__ import annotations

import time

import numpy as np

from experiments.twin import log
from sb3_yann import PlantTwin
from sb3_yann.evaluation import evaluate
from sb3_yann_envs import problems

HORIZONS = np.array([20, 100])
RUNS = 10
SEEDS = range(5)
CASES = [(5, 0.0), (5, 1.0), (10, 0.0), (10, 1.0)]
KINDS = ("linear", "quadratic", "cubic", "gaussian process", "network")


def errors(twin: PlantTwin) -> np.ndarray:
    """Return the errors of free runs, one for each horizon."""
    played, found = evaluate(problems.cstr().explicit(), "CSTR-v0", range(50_000, 50_010)), []
    for states, actions in zip(played.observations, played.actions, strict=True):
        first = np.linspace(0, len(actions) - HORIZONS[-1], RUNS).astype(int)
        free = [states[first]]
        for step in range(HORIZONS[-1]):
            free.append(twin.dynamics.step(free[-1][None], actions[first + step][None])[0])
        actual = states[first[:, None] + HORIZONS]
        wrong = np.swapaxes(np.array(free)[HORIZONS], 0, 1) - actual
        found.append(np.mean((wrong / twin.dynamics.coordinates.units) ** 2, axis=(0, 2)))
    return np.sqrt(np.mean(found, axis=0))


def main() -> None:
    """Print the table."""
    problem = problems.cstr()
    print("| episodes, noise | residual | error after 20 steps | after 100 | fit, s |")
    print("| --- | --- | ---: | ---: | ---: |")
    for episodes, noise in CASES:
        for kind in KINDS:
            found, seconds = [], []
            for seed in SEEDS:
                played, began = log(episodes, noise, seed), time.perf_counter()
                twin = PlantTwin.fit(problem, played, residuals=[kind], n_members=1, seed=seed)
                seconds.append(time.perf_counter() - began)
                found.append(errors(twin))
            middle, longest = np.median(found, axis=0)
            took = f"{np.median(seconds):.1f}"
            print(f"| {episodes}, {noise:g} | {kind} | {middle:.3f} | {longest:.3f} | {took} |")


if __name__ == "__main__":
    main()
