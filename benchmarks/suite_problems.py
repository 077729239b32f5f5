"""More than 300 problems for the multi-parametric QP: published, hard ones, and random ones."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

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
from sb3_yann_envs import problems

Make = Callable[[], LinearMPC]
INVARIANT = Terminal(set="invariant")


def chain(dt: float, horizon: int, bound: float) -> LinearMPC:
    """Return two masses between walls, on three springs, without damping; a force on the first.

    One step ahead the second mass hardly feels the force: by ``dt^4 / 24``.
    """
    springs = np.array([[-2.0, 1.0], [1.0, -2.0]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [springs, np.zeros((2, 2))]])
    return LinearMPC(
        LinearModel.from_continuous(A, [[0], [0], [1], [0]], dt), Q=np.eye(4), R=[[0.1]],
        horizon=horizon, x_min=-bound, x_max=bound, u_min=-1, u_max=1,
    )  # fmt: skip


def cart_pole(horizon: int, bounds: tuple[float, ...], u_max: float, dt: float = 0.04) -> LinearMPC:
    """Return a cart of 10.5 kg with a pole of 5 kg and 0.6 m, upright, like MuJoCo's."""
    cart = 10.5
    pole = 5.0
    arm = 0.3
    g = 9.81
    gear = 100.0
    mass = np.array([[cart + pole, pole * arm], [pole * arm, 4 / 3 * pole * arm**2]])
    A = np.zeros((4, 4))
    B = np.zeros((4, 1))
    A[:2, 2:] = np.eye(2)
    A[2:, 1], B[2:, 0] = np.linalg.solve(mass, np.array([[0, gear], [pole * g * arm, 0]])).T
    return LinearMPC(
        LinearModel.from_continuous(A, B, dt), Q=np.diag([1, 10, 0.1, 0.1]), R=[[0.1]],
        horizon=horizon, x_min=-np.array(bounds), x_max=np.array(bounds), u_min=-u_max, u_max=u_max,
    )  # fmt: skip


def double_integrator(B: tuple[float, float], horizon: int, **changes: Any) -> LinearMPC:
    """Return the double integrator of many papers, in one of its forms."""
    model = LinearModel([[1, 1], [0, 1]], np.reshape(B, (2, 1)), 1.0)
    values: dict[str, Any] = {"Q": np.eye(2), "R": [[1]], "u_min": -1, "u_max": 1}
    values |= {"x_min": -5, "x_max": 5, "horizon": horizon}
    return LinearMPC(model, **{**values, **changes})


def second_order(horizon: int, low: float) -> LinearMPC:
    """Return the second-order plant of Bemporad et al. (2002), Section 7, states above a bound."""
    model = LinearModel([[0.7326, -0.0861], [0.1722, 0.9909]], [[0.0609], [0.0064]], 0.1)
    return LinearMPC(
        model, Q=np.eye(2), R=[[0.01]], horizon=horizon, u_min=-2, u_max=2,
        x_min=low, theta_min=-1.5, theta_max=1.5,
    )  # fmt: skip


def aircraft(horizon: int, **changes: Any) -> LinearMPC:
    """Return the AFTI-16 of Kapasouris et al. (1988): unstable, 4 states, 2 inputs, dt 0.05 s."""
    A = [[-0.0151, -60.5651, 0, -32.174], [-0.0001, -1.3411, 0.9929, 0],
         [0.00018, 43.2541, -0.86939, 0], [0, 0, 1, 0]]  # fmt: skip
    B = [[-2.516, -13.136], [-0.1689, -0.2514], [-17.251, -1.5766], [0, 0]]
    values: dict[str, Any] = {"theta_min": [-50, -0.5, -2, -2], "theta_max": [50, 0.5, 2, 2]}
    return LinearMPC(
        LinearModel.from_continuous(A, B, 0.05), Q=np.diag([1e-4, 100, 1e-3, 100]),
        R=1e-2 * np.eye(2), horizon=horizon, u_min=-0.44, u_max=0.44, **{**values, **changes},
    )  # fmt: skip


def quadruple_tank(horizon: int, dt: float = 3.0, **changes: Any) -> LinearMPC:
    """Return Johansson's quadruple tank (2000), minimum phase, about its operating point."""
    T = np.array([62.0, 90.0, 23.0, 30.0])
    a = np.array([28.0, 32.0, 28.0, 32.0])
    A = np.diag(-1 / T)
    A[0, 2] = a[2] / (a[0] * T[2])
    A[1, 3] = a[3] / (a[1] * T[3])
    k = (3.33, 3.35)
    share = (0.70, 0.60)
    B = np.zeros((4, 2))
    B[0, 0] = share[0] * k[0] / a[0]
    B[1, 1] = share[1] * k[1] / a[1]
    B[2, 1] = (1 - share[1]) * k[1] / a[2]
    B[3, 0] = (1 - share[0]) * k[0] / a[3]
    values: dict[str, Any] = {"Q": np.eye(4), "R": 0.1 * np.eye(2), "u_min": -3, "u_max": 3}
    values |= {"theta_min": -8, "theta_max": 8}
    return LinearMPC(
        LinearModel.from_continuous(A, B, dt), horizon=horizon, **{**values, **changes}
    )


def off_center(low: float, high: float, bound: float, horizon: int) -> LinearMPC:
    """Return an integrator whose feasible states are a small part of the box, far from its center.

    With a box of -2 to 20 and a final state within 0.1, only those within 0.2 are feasible.
    """
    return LinearMPC(
        LinearModel([[1]], [[1]], 1.0), Q=[[1]], R=[[1]], horizon=horizon, u_min=-bound,
        u_max=bound, theta_min=low, theta_max=high, terminal=Terminal(set=([[1], [-1]], [0.1] * 2)),
    )  # fmt: skip


def _random_values(rng: np.random.Generator, n: int, m: int) -> dict[str, Any]:
    values: dict[str, Any] = {"Q": np.diag(rng.choice([0.1, 1.0, 10.0], n))}
    values |= {"R": np.diag(10 ** rng.uniform(-3, 0.5, m))}
    values |= {"u_min": -rng.uniform(0.3, 2, m), "u_max": rng.uniform(0.3, 2, m)}
    values |= {"theta_min": -rng.uniform(1, 5, n), "theta_max": rng.uniform(1, 5, n)}
    return values


def _random_model(rng: np.random.Generator, n: int, m: int, unstable: bool) -> LinearModel:
    A = rng.normal(size=(n, n))
    B = rng.normal(size=(n, m))
    E = 0.2 * rng.normal(size=(n, 1))
    A *= (rng.uniform(1.02, 1.3) if unstable else rng.uniform(0.4, 0.98)) / np.max(
        np.abs(np.linalg.eigvals(A))
    )
    return LinearModel(A, B, 1.0, E=E)


def random_regulator(seed: int, kind: str) -> LinearMPC:
    """Return a random problem of 1 to 5 states; ``kind`` says which constraints it has."""
    for attempt in itertools.count():
        rng = np.random.default_rng([seed, attempt])
        n = int(rng.integers(1, 6 if kind == "inputs" else 4 if kind == "parts" else 5))
        m = int(rng.integers(1, 3))
        model = _random_model(rng, n, m, unstable=bool(rng.random() < 0.4))
        values = _random_values(rng, n, m)
        values["horizon"] = int(rng.integers(1, 4 if n * m > 4 else 5))
        if kind != "inputs":
            values["x_min"] = values["theta_min"]
            values["x_max"] = values["theta_max"]
        values |= _random_parts(rng, n) if kind == "parts" else {}
        values |= {"terminal": INVARIANT} if kind == "invariant" else {}
        if kind == "soft":
            values["soft"] = SoftBounds(np.ones(n), penalty=100)
        if kind != "parts":
            model = LinearModel(model.A, model.B, 1.0)
        try:
            return LinearMPC(model, **values)
        except ValueError:  # no invariant set of less than 200 rows, or no steady state
            continue
    raise AssertionError


def _random_parts(rng: np.random.Generator, n: int) -> dict[str, Any]:
    """Return some of: a reference, rates, bounded outputs; and the disturbance."""
    parts: dict[str, Any] = {"disturbances": DisturbanceBounds(-0.2, 0.2), "horizon": 2}
    if rng.random() < 0.6:
        parts["tracking"] = Tracking([0], r_min=-0.5, r_max=0.5)
    if rng.random() < 0.5:
        parts["rate"] = RateLimits(-0.6, 0.5)
    if rng.random() < 0.4:
        parts["outputs"] = OutputBounds(rng.normal(size=(1, n)), y_min=-2, y_max=3)
    return parts


def _chains() -> dict[str, Make]:
    grid = itertools.product((0.1, 0.2, 0.3, 0.5), (3, 4, 5, 6), (2, 4))
    return {
        f"chain, dt {dt}, N {N}, states within {bound}": partial(chain, dt, N, bound)
        for dt, N, bound in grid
    }


def _cart_poles() -> dict[str, Make]:
    bounds = (((0.9, 0.2, 10, 10), 3.0), ((0.9, 0.2, 2, 2), 1.0), ((0.5, 0.1, 5, 5), 3.0))
    return {
        f"cart-pole, N {N}, states within {x}, u {u}": partial(cart_pole, N, x, u)
        for N, (x, u) in itertools.product((2, 3, 4, 5, 6, 7), bounds)
    }


def _published() -> dict[str, Make]:
    lqr = {"x_min": None, "x_max": None, "theta_min": -10, "theta_max": 10, "R": [[0.1]]}
    found: dict[str, Make] = {
        "the pendulum of Braniff and Tian": problems.clipped_pendulum,
        "the reactor of Braniff and Tian": problems.cstr,
    }
    for N in (1, 2, 3, 4, 5, 6, 8):
        found |= {
            f"double integrator, no state bounds, N {N}": partial(
                double_integrator, (0, 1), N, Q=np.diag([1, 0]), **lqr
            ),
            f"double integrator, states within 5, N {N}": partial(double_integrator, (1, 0.5), N),
            f"double integrator, invariant set, N {N}": partial(
                double_integrator, (1, 0.5), N, terminal=INVARIANT
            ),
            f"double integrator, soft, N {N}": partial(
                double_integrator, (0.5, 1), N, soft=SoftBounds([1, 1], penalty=50)
            ),
            f"second order, states above -0.5, N {N}": partial(second_order, N, -0.5),
            f"second order, states above 0, N {N}": partial(second_order, N, -0.05),
        }
    for N in (1, 2):
        found |= {
            f"aircraft, N {N}": partial(aircraft, N),
            f"aircraft, pitch bounded, N {N}": partial(
                aircraft, N, x_min=[-np.inf, -0.3, -np.inf, -2], x_max=[np.inf, 0.3, np.inf, 2]
            ),
            f"quadruple tank, N {N}": partial(quadruple_tank, N),
            f"quadruple tank, levels bounded, N {N}": partial(quadruple_tank, N, x_min=-8, x_max=8),
        }
    return found | {
        "quadruple tank, rates": partial(quadruple_tank, 1, rate=RateLimits(-1, 1)),
        "quadruple tank, levels and rates": partial(
            quadruple_tank, 1, x_min=-8, x_max=8, rate=RateLimits(-1, 1)
        ),
        "quadruple tank, two references": partial(
            quadruple_tank, 1, tracking=Tracking([0, 1], r_min=-2, r_max=2)
        ),
    }


def _off_centers() -> dict[str, Make]:
    grid = itertools.product(((-2, 20), (-20, 2), (-0.3, 100)), (0.1, 0.02), (1, 3))
    return {
        f"integrator, box {box}, u {u}, N {N}": partial(off_center, *box, u, N)
        for box, u, N in grid
    }


def _random() -> dict[str, Make]:
    counts = {"inputs": 40, "states": 60, "soft": 25, "invariant": 50, "parts": 40}
    return {
        f"random, {kind}, {seed}": partial(random_regulator, seed + 1000 * i, kind)
        for i, (kind, count) in enumerate(counts.items())
        for seed in range(count)
    }


def quietly(make: Make) -> LinearMPC:
    """Return a problem without the warnings that it may have, of drift and the like."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return make()


SUITE: Mapping[str, Make] = {
    **_published(), **_chains(), **_cart_poles(), **_off_centers(), **_random()
}  # fmt: skip
