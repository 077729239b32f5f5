"""Problems with references, disturbances, rates, soft bounds and invariant terminal sets."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from sb3_yann import LinearModel, LinearMPC

THERMAL = LinearModel([[0.9, 0.2], [0, 0.8]], [[0], [0.5]], 1.0)
LOADED = LinearModel(THERMAL.A, THERMAL.B, 1.0, E=[[0.3], [0.1]])
TWO_TANKS = LinearModel(
    [[0.9, 0.0], [0.1, 0.85]], [[0.5, 0.1], [0.0, 0.4]], 1.0, E=[[0.2, 0.0], [0.0, 0.2]]
)


def servo(model: LinearModel = THERMAL, **changes: Any) -> LinearMPC:
    """The first of two states follows a reference in [-1, 1]; asymmetric input bounds."""
    values: dict[str, Any] = {"Q": np.eye(2), "R": [[0.1]], "horizon": 2, "tracked": [0]}
    values |= {"u_min": -1, "u_max": 2, "x_min": -5, "x_max": 5, "r_min": -1, "r_max": 1}
    if model.n_disturbances:
        values |= {"d_min": -0.3, "d_max": 0.3}
    return LinearMPC(model, **{**values, **changes})


def two_tanks(**changes: Any) -> LinearMPC:
    """Two inputs, two tracked levels, two disturbances; eight parameters with rates."""
    values: dict[str, Any] = {"Q": np.eye(2), "R": 0.1 * np.eye(2), "horizon": 1}
    values |= {"tracked": [0, 1], "r_min": -0.5, "r_max": 0.5, "d_min": -0.2, "d_max": 0.2}
    values |= {"u_min": [-1, -0.8], "u_max": [1.2, 1.0], "x_min": -2, "x_max": 2}
    return LinearMPC(TWO_TANKS, **{**values, **changes})


RATES = {"du_min": -0.5, "du_max": 0.7}

PROBLEMS: dict[str, Callable[[], LinearMPC]] = {
    "servo": servo,
    "servo, discounted": lambda: servo(gamma=0.9),
    "servo with a disturbance": lambda: servo(LOADED, horizon=3),
    "servo with rates": lambda: servo(**RATES),
    "servo with a weight on the rate": lambda: servo(S=[[2.0]]),
    "servo with all of it": lambda: servo(LOADED, **RATES, S=[[2.0]]),
    "regulator with a disturbance": lambda: servo(
        LOADED, tracked=None, r_min=None, r_max=None, horizon=3
    ),
    "regulator with rates": lambda: servo(tracked=None, r_min=None, r_max=None, **RATES),
    "soft states": lambda: servo(
        x_min=-1.2, x_max=1.2, x_soft=[1, 0.5], soft_penalty=300, theta_min=-3, theta_max=3
    ),
    "one of two states soft, soft outputs": lambda: servo(
        x_soft=[0, 0.5], outputs=[[1, 1]], y_max=1, y_soft=1, soft_penalty=300
    ),
    "invariant": lambda: servo(terminal_set="invariant"),
    "invariant with all of it": lambda: servo(LOADED, **RATES, terminal_set="invariant"),
    "linear cost": lambda: servo(LOADED, linear_cost=([0.3, 0], [-0.2]), horizon=3),
    "linear cost and a weight on the rate": lambda: servo(
        linear_cost=([0.3, 0], [-0.2]), S=[[2.0]], gamma=0.95
    ),
    "two tanks": two_tanks,
    "two tanks, all parts": lambda: two_tanks(du_min=-0.8, du_max=0.9),
    "more inputs than outputs": lambda: two_tanks(
        tracked=[[1, 1]], r_min=-0.5, r_max=0.5, R=np.diag([0.1, 1])
    ),
}

QUADRATIC = [name for name in PROBLEMS if not name.startswith("linear cost")]


@cache
def solved(name: str) -> LinearMPC:
    """One of the problems, with its law; the same object for all tests."""
    mpc = PROBLEMS[name]()
    mpc.explicit()
    return mpc
