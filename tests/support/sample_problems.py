"""Small MPC problems that stress one thing each, and points to try their laws at."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann import LinearModel, LinearMPC, Terminal
from sb3_yann.control import PiecewiseAffine
from sb3_yann_envs import problems

Array = NDArray[np.float64]

DOUBLE_INTEGRATOR = LinearModel([[1, 1], [0, 1]], [[0], [1]], 1.0)
SAME_INPUTS = LinearModel([[1, 1], [0, 1]], [[0, 0], [1, 1]], 1.0)
IDLE_INPUT = LinearModel([[1, 1], [0, 1]], [[0, 0], [1, 0]], 1.0)
TWO_INPUTS = LinearModel([[1, 1], [0, 1]], [[0.5, 0.3], [1, -0.8]], 1.0)
UNSTABLE = LinearModel([[1.5, 1], [0, 1.3]], [[0], [1]], 1.0)
EYE_ROWS = np.vstack([np.eye(2), -np.eye(2)])


def small_mpc(model: LinearModel = DOUBLE_INTEGRATOR, **changes: Any) -> LinearMPC:
    """Unit weights, two steps, inputs in [-1, 1], predicted states in [-5, 5]."""
    n = model.n_states
    m = model.n_inputs
    values: dict[str, Any] = {"Q": np.eye(n), "R": np.eye(m), "horizon": 2}
    values |= {"u_min": -1, "u_max": 1, "x_min": -5, "x_max": 5}
    return LinearMPC(model, **{**values, **changes})


def input_bounds_only(model: LinearModel = DOUBLE_INTEGRATOR, **changes: Any) -> LinearMPC:
    """The same, but the box of 5 bounds the parameter only."""
    free = {"x_min": None, "x_max": None, "theta_min": -5, "theta_max": 5}
    return small_mpc(model, **{**free, **changes})


def braking(**changes: Any) -> LinearMPC:
    """A cart with a speed limit: 125 regions; a part of its box has no solution."""
    model = LinearModel([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], 0.1)
    limits = {"R": [[0.03]], "horizon": 6, "x_min": [-5, -2], "x_max": [5, 2]}
    return small_mpc(model, **{**limits, **changes})


def benchmark() -> LinearMPC:
    """The double integrator of Bemporad et al., The explicit linear quadratic regulator (2002)."""
    return input_bounds_only(Q=np.diag([1, 0]), R=[[0.1]], theta_min=-10, theta_max=10)


def in_units(units: Array, input_unit: float) -> LinearMPC:
    """The benchmark with other units for the states and the input: the same problem."""
    to = np.diag(units)
    back = np.diag(1 / units)
    model = LinearModel(
        to @ DOUBLE_INTEGRATOR.A @ back, to @ DOUBLE_INTEGRATOR.B / input_unit, dt=1.0
    )
    return LinearMPC(
        model,
        Q=back @ back,
        R=[[0.1 / input_unit**2]],
        horizon=3,
        u_min=-input_unit,
        u_max=input_unit,
        x_min=-5 * units,
        x_max=5 * units,
    )


def _random_plant() -> LinearMPC:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(4, 4))
    A *= 0.95 / np.max(np.abs(np.linalg.eigvals(A)))
    model = LinearModel(A, rng.normal(size=(4, 2)), 1.0)
    return input_bounds_only(model, horizon=3, theta_min=-3, theta_max=3)


def _reactor_states_bounded() -> LinearMPC:
    mpc = problems.cstr()
    return replace(mpc, x_min=mpc.theta_min, x_max=mpc.theta_max)


def _slow_modes(n: int) -> LinearModel:
    return LinearModel(np.eye(n), np.eye(n), 1.0)


def _never_at_rest() -> LinearMPC:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the one that says so
        return input_bounds_only(LinearModel([[0.9, 0.1], [0, 0.8]], [[0], [1]], 1.0), u_min=0.2)


PROBLEMS: dict[str, Callable[[], LinearMPC]] = {
    "pendulum": problems.clipped_pendulum,
    "reactor": problems.cstr,
    "reactor, predicted states bounded": _reactor_states_bounded,
    "benchmark": benchmark,
    "asymmetric input bounds": lambda: small_mpc(u_min=-0.2, u_max=1.5, x_min=[-5, -1]),
    "two inputs": lambda: small_mpc(TWO_INPUTS, u_min=[-1, -0.4], u_max=[0.5, 2]),
    "terminal set": lambda: small_mpc(terminal=Terminal(set=([[1, 1], [-1, -1]], [0.5, 0.7]))),
    "discounted": lambda: small_mpc(gamma=0.9),
    "one state": lambda: small_mpc(LinearModel([[1.2]], [[1]], 1.0), horizon=5, x_max=7),
    "one state, two inputs": lambda: small_mpc(LinearModel([[1.2]], [[1, 0.5]], 1.0), horizon=3),
    "one step": lambda: small_mpc(horizon=1),
    "eight steps": lambda: small_mpc(horizon=8, Q=np.diag([1, 0]), R=[[0.1]]),
    "four states, two inputs": _random_plant,
    "discounted integrators": lambda: small_mpc(_slow_modes(2), gamma=0.9, x_min=-3, x_max=3),
    "only one state bounded": lambda: input_bounds_only(x_min=[-np.inf, -2], x_max=[np.inf, 2]),
    "one-sided state bounds": lambda: input_bounds_only(x_min=[-np.inf, -2], x_max=[4, np.inf]),
    "a final state held to 1e-4": lambda: input_bounds_only(
        horizon=3, terminal=Terminal(set=([[1, 0], [-1, 0]], [1e-4, 1e-4]))
    ),
    "every state bound twice": lambda: small_mpc(terminal=Terminal(set=(2 * EYE_ROWS, [10] * 4))),
    "a constraint that only touches": lambda: small_mpc(terminal=Terminal(set=([[1, 1]], [10]))),
    "a constraint without a state": lambda: small_mpc(terminal=Terminal(set=([[0, 0]], [1]))),
    "inputs that do the same": lambda: small_mpc(SAME_INPUTS),
    "an input without effect": lambda: small_mpc(IDLE_INPUT),
    "coupled inputs": lambda: input_bounds_only(TWO_INPUTS, R=[[1, 0.999], [0.999, 1]]),
    "unstable, part of the box infeasible": lambda: small_mpc(UNSTABLE),
    "only predicted states bounded": lambda: small_mpc(u_min=None, u_max=None),
    "nothing bounded": lambda: input_bounds_only(u_min=None, u_max=None),
    "one of two inputs bounded": lambda: small_mpc(
        TWO_INPUTS, u_min=[-1, -np.inf], u_max=[1, np.inf]
    ),
    "inputs above zero": lambda: input_bounds_only(
        LinearModel([[0.9, 0.1], [0, 0.8]], [[0], [1]], 1.0), u_min=0
    ),
    "zero input not allowed": lambda: _never_at_rest(),
    "origin outside the box": lambda: small_mpc(theta_min=[2, -3], theta_max=[4, -1]),
    "states without weight": lambda: small_mpc(
        Q=np.zeros((2, 2)), terminal=Terminal(np.zeros((2, 2))), x_min=-3, x_max=3
    ),
    "cheap inputs": lambda: input_bounds_only(R=[[1e-8]]),
    "expensive inputs": lambda: input_bounds_only(R=[[1e8]]),
    "states of 1e-4 and 1e4, inputs of 1e6": lambda: in_units(np.array([1e-4, 1e4]), 1e6),
    "states of 1e-9 and 1e7, inputs of 1e6": lambda: in_units(np.array([1e-9, 1e7]), 1e6),
}


def kept(problems: dict[str, Callable[[], LinearMPC]]) -> Callable[[str], LinearMPC]:
    """Return a function of a name: that problem with its law, the same object each time."""

    @cache
    def solved(name: str) -> LinearMPC:
        mpc = problems[name]()
        mpc.explicit()
        return mpc

    return solved


solved = kept(PROBLEMS)


def box_points(mpc: LinearMPC, count: int, seed: int = 0) -> Array:
    """Points (count, n), uniform in the box of parameters."""
    rng = np.random.default_rng(seed)
    return rng.uniform(mpc.theta_min, mpc.theta_max, (count, mpc.n_theta))


def half_spaces(law: PiecewiseAffine, region: int) -> tuple[Array, Array]:
    """The half-spaces A theta <= b of one region."""
    ends = [*law.starts[1:], law.n_halfspaces]
    rows = slice(law.starts[region], ends[region])
    return law.A[rows], law.b[rows]


def strips(edges: Array) -> PiecewiseAffine:
    """A law with a region between every two edges of the first of two coordinates in [-2, 2]."""
    p = len(edges) - 1
    A = np.tile([[1.0, 0.0], [-1.0, 0.0]], (p, 1))
    b = np.column_stack([edges[1:], -edges[:-1]]).ravel()
    return PiecewiseAffine(
        np.ones((p, 1, 2)), np.zeros((p, 1)), A, b, 2 * np.arange(p), -np.ones(1), np.ones(1),
        np.full(2, -2.0), np.full(2, 2.0), disjoint=True,
    )  # fmt: skip
