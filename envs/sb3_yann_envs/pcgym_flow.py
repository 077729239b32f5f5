"""One sample of a plant's equations, by a Runge-Kutta method where that is accurate enough."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Flow = Callable[[ArrayLike, ArrayLike], Array]
Floats = tuple[float, ...]

STEPS = (8, 16, 32, 64, 128, 256)
"""Steps of the Runge-Kutta method in a sample, the fewest that are accurate."""
ACCURATE = 1e-7
"""Largest error after a sample, relative to the states' ranges; PC-Gym's own is about 1e-5."""
TRIED = 40  # samples of a trial, half of them with inputs on their bounds
TOLERANCES = {"reltol": 1e-11, "abstol": 1e-12}


def rate_of(model: Any, n: int, m: int) -> Any:
    """Return CasADi's function dx/dt = f(x, u) of a PC-Gym model with n states and m inputs."""
    import casadi

    x = casadi.SX.sym("x", n)
    u = casadi.SX.sym("u", m)
    return casadi.Function("rate", [x, u], [casadi.vertcat(*model(x, u))])


def flow_of(rate: Any, dt: float, x0: Array, low: Array, width: Array) -> Flow:
    """Return the map from x (n,) and u (m,) to the state one sample later, NaN for no value.

    It takes batches, x (batch, n) and u (batch, m), as well.

    Parameters
    ----------
    rate : casadi.Function
        Of :func:`rate_of`.
    dt : float
        The sample.
    x0 : ndarray, shape (n,)
        Where the trial starts in which the number of steps is chosen.
    low, width : ndarray, shape (n + m,)
        The ranges of states and inputs.
    """
    # Envs are made by the hundred, for each episode one, and the trial takes up to a second.
    return _chosen(rate.serialize(), dt, *(tuple(each.tolist()) for each in (x0, low, width)))


@lru_cache(maxsize=64)
def _chosen(equations: str, dt: float, x0: Floats, low: Floats, width: Floats) -> Flow:
    """Return the flow that the trial chooses."""
    import casadi

    rate = casadi.Function.deserialize(equations)
    n = len(x0)
    exact = _cvodes(rate, dt)
    ranges = np.array(width)
    inputs = np.array(low[n:]) + ranges[n:] * _trial(len(low) - n)
    states = [np.array(x0)]
    for each in inputs:
        states.append(exact(states[-1], each))
    for steps in STEPS:
        flow = _runge_kutta(rate, dt, steps)
        found = [flow(x, u) for x, u in zip(states[:-1], inputs, strict=True)]
        if np.all(np.abs(np.array(found) - states[1:]) <= ACCURATE * ranges[:n]):
            return flow
    return exact


def _cvodes(rate: Any, dt: float) -> Flow:
    """Return CasADi's adaptive integrator, made once."""
    import casadi

    x = casadi.SX.sym("x", rate.size1_in(0))
    u = casadi.SX.sym("u", rate.size1_in(1))
    ode = {"x": x, "p": u, "ode": rate(x, u)}
    sample = casadi.integrator("sample", "cvodes", ode, 0.0, dt, TOLERANCES)

    def flow(x: ArrayLike, u: ArrayLike) -> Array:
        if np.ndim(x) > 1:  # one by one, for one that has no value spoils no other
            rows = zip(np.asarray(x), np.asarray(u), strict=True)
            return np.array([flow(*row) for row in rows])
        try:
            return np.array(sample(x0=x, p=u)["xf"], np.float64).ravel()
        except RuntimeError:  # CVODES met no value
            return np.full(rate.size1_in(0), np.nan)

    return flow


def _trial(m: int) -> Array:
    """Return inputs of a trial (TRIED, m) between 0 and 1: random ones, and random corners."""
    drawn = np.random.default_rng(0).random((TRIED, m))
    drawn[::2] = drawn[::2].round()
    return drawn


def _runge_kutta(rate: Any, dt: float, steps: int) -> Flow:
    """Return the classical Runge-Kutta method of fourth order, as one compiled expression."""
    import casadi

    start = casadi.SX.sym("x", rate.size1_in(0))
    u = casadi.SX.sym("u", rate.size1_in(1))
    x = start
    h = dt / steps
    for _ in range(steps):
        k1 = rate(x, u)
        k2 = rate(x + h / 2 * k1, u)
        k3 = rate(x + h / 2 * k2, u)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, u))
    sample = casadi.Function("sample", [start, u], [x])

    def flow(x: ArrayLike, u: ArrayLike) -> Array:
        after = np.array(sample(np.transpose(x), np.transpose(u)), np.float64)
        return after.T.reshape(np.shape(x))

    return flow
