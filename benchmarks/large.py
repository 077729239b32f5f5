"""A law of some twenty thousand regions: solved, checked and ready; then beside the online law."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from benchmarks.records import Bench, timed
from benchmarks.timing import Task
from sb3_yann.control import LinearModel, LinearMPC

SECTION = "large law"
COLUMN = "6 states, 2 inputs, N = 5"
SOLVED = "ours, solved, checked and ready"
EACH = "ours, each of 256 points"
ONLINE = "ours, solved online, each of 256 new points"


def three_free_masses() -> LinearMPC:
    """Return three masses on springs from wall to wall, of which two are pushed; no state bound."""
    springs = linalg.toeplitz([-2.0, 1.0, 0.0])
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [springs, np.zeros((3, 3))]])
    B = np.vstack([np.zeros((3, 2)), np.eye(3)[:, :2]])
    return LinearMPC(
        LinearModel.from_continuous(A, B, 0.5), Q=np.eye(6), R=0.1 * np.eye(2), horizon=5,
        u_min=-1, u_max=1, theta_min=-4, theta_max=4,
    )  # fmt: skip


def large(bench: Bench) -> None:
    """Measure the solution once, and the law at points all over its box; not in the quick form."""
    if bench.quick:
        return
    mpc = three_free_masses()
    found = {SOLVED: bench.watch.once(lambda: mpc.explicit())}
    law = mpc.explicit()
    online = mpc.online()
    theta = np.random.default_rng(0).uniform(-4, 4, (16, 256, 6))
    tasks = {EACH: Task(law, [*theta]), ONLINE: Task(online.known.function, [*theta])}
    times = bench.watch.compare(tasks)
    found |= {name: seconds / 256 for name, seconds in times.items()}
    bench.figures.add(timed(SECTION, f"{COLUMN}: {law.n_regions:,} regions", found))
