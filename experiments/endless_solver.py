"""A law whose search does not come to an end, for docs/faults.md."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from experiments.faulty_plants import SHOWN, Alarm
from sb3_yann import LinearModel, LinearMPC
from sb3_yann_envs import problems

SECONDS = 2.0
"""Of the limit, and before Ctrl-C."""


def endless() -> LinearMPC:
    """Return a problem whose law has more regions than anyone waits for."""
    n = 6
    A = 0.95 * np.eye(n) + np.diag(np.full(n - 1, 0.1), 1)
    B = np.vstack([np.zeros((n - 2, 2)), np.eye(2)])
    bounds = {"x_min": -1, "x_max": 1, "u_min": -0.3, "u_max": 0.3}
    return LinearMPC(LinearModel(A, B, 1.0), Q=np.eye(n), R=0.1 * np.eye(2), horizon=12, **bounds)


def interrupted(mpc: LinearMPC) -> Any:
    """Solve it, and meet Ctrl-C."""
    with Alarm(SECONDS):
        return mpc.explicit()


ENDS: dict[str, Callable[[LinearMPC], Any]] = {
    f"`mpc.explicit(time_limit={SECONDS:g})`": lambda mpc: mpc.explicit(time_limit=SECONDS),
    "`mpc.explicit(region_limit=100)`": lambda mpc: mpc.explicit(region_limit=100),
    f"`mpc.explicit()`, Ctrl-C after {SECONDS:g} s": interrupted,
    "`mpc.law()`, as a policy takes it": lambda mpc: mpc.law(),
}


def ended(way: str) -> tuple[str, str]:
    """Return after how many seconds it ended, and what was said."""
    problems.cstr().explicit()  # what is read and compiled at first takes no limit
    mpc = endless()
    mpc.condensed()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        begun = time.monotonic()
        try:
            said = f"{type(ENDS[way](mpc)).__name__} acts"
        except (Exception, KeyboardInterrupt) as error:
            said = f"{type(error).__name__}: {error}"
        seconds = time.monotonic() - begun
    said = " / ".join([said, *(f"{each.category.__name__}: {each.message}" for each in told)])
    return f"{seconds:.1f}", said if len(said) < SHOWN else f"{said[:SHOWN]} ..."
