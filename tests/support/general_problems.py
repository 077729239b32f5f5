"""Problems with references, disturbances, rates, soft bounds and invariant terminal sets."""

from collections.abc import Callable
from typing import Any

import numpy as np

from sample_problems import kept
from sb3_yann import (
    DisturbanceBounds,
    LinearModel,
    LinearMPC,
    OutputBounds,
    RateLimits,
    SoftBounds,
    Terminal,
    Tracking,
)

THERMAL = LinearModel([[0.9, 0.2], [0, 0.8]], [[0], [0.5]], 1.0)
LOADED = LinearModel(THERMAL.A, THERMAL.B, 1.0, E=[[0.3], [0.1]])
TWO_TANKS = LinearModel(
    [[0.9, 0.0], [0.1, 0.85]], [[0.5, 0.1], [0.0, 0.4]], 1.0, E=[[0.2, 0.0], [0.0, 0.2]]
)


def servo(model: LinearModel = THERMAL, **changes: Any) -> LinearMPC:
    """The first of two states follows a reference in [-1, 1]; asymmetric input bounds."""
    values: dict[str, Any] = {"Q": np.eye(2), "R": [[0.1]], "horizon": 2}
    values |= {"u_min": -1, "u_max": 2, "x_min": -5, "x_max": 5}
    values["tracking"] = Tracking([0], r_min=-1, r_max=1)
    if model.n_disturbances:
        values["disturbances"] = DisturbanceBounds(-0.3, 0.3)
    return LinearMPC(model, **{**values, **changes})


def two_tanks(**changes: Any) -> LinearMPC:
    """Two inputs, two tracked levels, two disturbances; eight parameters with rates."""
    values: dict[str, Any] = {"Q": np.eye(2), "R": 0.1 * np.eye(2), "horizon": 1}
    values["tracking"] = Tracking([0, 1], r_min=-0.5, r_max=0.5)
    values["disturbances"] = DisturbanceBounds(-0.2, 0.2)
    values |= {"u_min": [-1, -0.8], "u_max": [1.2, 1.0], "x_min": -2, "x_max": 2}
    return LinearMPC(TWO_TANKS, **{**values, **changes})


PUMPS = np.array([1.0, 0.7])


def level() -> LinearMPC:
    """A level with two pumps, which rides its limit where it is to be higher."""
    values: dict[str, Any] = {"Q": [[1.0]], "R": 0.01 * np.eye(2), "horizon": 3}
    values |= {"u_min": -1, "u_max": 1, "x_min": -1, "x_max": 1, "tracking": Tracking([0], -2, 2)}
    return LinearMPC(LinearModel([[1.0]], [PUMPS], 1.0), **values)


RATES = {"du_min": -0.5, "du_max": 0.7}
RATED = {"rate": RateLimits(**RATES)}
INVARIANT_SET = {"terminal": Terminal(set="invariant")}

PROBLEMS: dict[str, Callable[[], LinearMPC]] = {
    "servo": servo,
    "servo, discounted": lambda: servo(gamma=0.9),
    "servo with a disturbance": lambda: servo(LOADED, horizon=3),
    "servo with rates": lambda: servo(**RATED),
    "servo with a weight on the rate": lambda: servo(rate=RateLimits(R_du=[[2.0]])),
    "servo with a weight on nothing but the rate": lambda: servo(
        R=[[0.0]], gamma=0.97, rate=RateLimits(R_du=[[0.4]])
    ),
    "two tanks with a weight on no input": lambda: two_tanks(R=np.zeros((2, 2)), horizon=2),
    "two tanks with a weight on one input and the other one's rate": lambda: two_tanks(
        R=np.diag([0.2, 0]), rate=RateLimits(R_du=np.diag([0, 0.3]))
    ),
    "servo with all of it": lambda: servo(LOADED, rate=RateLimits(**RATES, R_du=[[2.0]])),
    "regulator with a disturbance": lambda: servo(LOADED, tracking=None, horizon=3),
    "regulator with rates": lambda: servo(tracking=None, **RATED),
    "soft states": lambda: servo(
        x_min=-1.2, x_max=1.2, soft=SoftBounds([1, 0.5], penalty=300), theta_min=-3, theta_max=3
    ),
    "one of two states soft, soft outputs": lambda: servo(
        outputs=OutputBounds([[1, 1]], y_max=1), soft=SoftBounds([0, 0.5], 1, penalty=300)
    ),
    "invariant": lambda: servo(**INVARIANT_SET),
    "invariant with all of it": lambda: servo(LOADED, **RATED, **INVARIANT_SET),
    "two tanks": two_tanks,
    "two tanks, all parts": lambda: two_tanks(rate=RateLimits(-0.8, 0.9)),
    "more inputs than outputs": lambda: two_tanks(
        tracking=Tracking([[1, 1]], -0.5, 0.5), R=np.diag([0.1, 1])
    ),
    "level": level,
}
solved = kept(PROBLEMS)
