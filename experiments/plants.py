"""The plants of the learning tables, each with its linear MPC.

Nothing in the package was tuned to the textbook plants, which are in their own units. Their
equations and numbers: the pH of a stirred tank buffered by carbonic acid, with the constants of
M. Henson and D. Seborg (IEEE Trans. Control Syst. Technol. 2(3), 1994); van de Vusse's reactor with
the numbers of H. Chen, A. Kremling and F. Allgöwer (ECC 1995); a bioreactor with Haldane kinetics
(P. Agrawal and H. Lim, Adv. Biochem. Eng. 30, 1984); a conical tank. Weights and set-points are
chosen here, once, by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TimeLimit
from scipy.optimize import brentq

import own_plant
import quadruple_tank
from sb3_yann import LinearModel, LinearMPC, Tracking, offset_free
from sb3_yann._validation import Array
from sb3_yann.wrappers import ObserveDisturbance, SetPoint
from sb3_yann_envs import cstr, problems

Step = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class TextbookPlant:
    """A plant, and what its MPC is to do.

    Attributes
    ----------
    advance : callable
        From a state (n,) and an input (m,) to the state one sample later.
    model : LinearModel
        Linearized where it rests.
    low, high, u_low, u_high : tuple of float
        Boxes of the states and of the inputs, as the plant has them.
    spread : tuple of float
        How far from rest an episode begins, at most.
    weights : mapping
        Q, R and horizon of the MPC.
    tracked : tuple of int
        States with a set-point.
    wanted : pair of tuples of float
        The least and the greatest set-points.
    hold, steps : int
        Samples until the set-point changes, and in an episode.
    """

    advance: Step
    model: LinearModel
    low: tuple[float, ...]
    high: tuple[float, ...]
    u_low: tuple[float, ...]
    u_high: tuple[float, ...]
    spread: tuple[float, ...]
    weights: dict[str, Any]
    tracked: tuple[int, ...]
    wanted: tuple[tuple[float, ...], tuple[float, ...]]
    hold: int = 30
    steps: int = 60

    def mpc(self) -> LinearMPC:
        """Return the MPC."""
        return LinearMPC(
            self.model,
            **self.weights,
            gamma=0.95,
            tracking=Tracking([*self.tracked], *self.wanted),
            u_min=self.u_low,
            u_max=self.u_high,
            theta_min=self.low,
            theta_max=self.high,
        )

    def env(self, mpc: LinearMPC) -> gym.Env[Any, Any]:
        """Return the plant with set-points."""
        bounds = mpc.tracking.r_min, mpc.tracking.r_max
        env = SetPoint(TextbookEnv(self), *bounds, hold=self.hold)
        return TimeLimit(env, self.steps)


class TextbookEnv(gym.Env[Array, Array]):
    """A plant that shows its state and takes its inputs; it has no reward."""

    def __init__(self, plant: TextbookPlant) -> None:
        self.plant = plant
        # float32, as when the published runs were made
        self.observation_space = gym.spaces.Box(np.float32(plant.low), np.float32(plant.high))
        self.action_space = gym.spaces.Box(
            np.array(plant.u_low), np.array(plant.u_high), dtype=np.float64
        )
        self.state: Array = np.array(plant.model.x_ss)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin near where the plant rests."""
        super().reset(seed=seed)
        x = self.plant.model.x_ss
        spread = np.array(self.plant.spread)
        self.state = x + spread * self.np_random.uniform(-1, 1, len(x))
        return self.state.copy(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold the inputs for a sample."""
        u = np.clip(action, self.action_space.low, self.action_space.high)  # type: ignore[attr-defined]
        self.state = self.plant.advance(self.state, np.asarray(u, np.float64))
        return self.state.copy(), 0.0, False, False, {}


def _integrated(slope: Step, dt: float, substeps: int) -> Step:
    """Return the classical Runge-Kutta method over a sample."""

    def advance(x: Array, u: Array) -> Array:
        h = dt / substeps
        for _ in range(substeps):
            k1 = slope(x, u)
            k2 = slope(x + h / 2 * k1, u)
            k3 = slope(x + h / 2 * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3, u))
        return x

    return advance


CARBONATE = 5e-5  # mol/L
# mol/L, charge of what flows in
FEED = 3.0e-3
BASE = -3.05e-3


def _charge(ph: float, carbonate: float = CARBONATE) -> float:
    """Return the charge that makes a pH, in mol/L, beside so much of a buffer."""
    hydrogen = 10.0**-ph
    share = 1 + 2 * 5.62e-11 / hydrogen
    share /= 1 + hydrogen / 4.47e-7 + 5.62e-11 / hydrogen
    return hydrogen - 1e-14 / hydrogen - carbonate * share


def ph() -> TextbookPlant:
    """Return a litre of acid, neutralized by a flow of base: its gain changes a hundredfold.

    A second state, if there is one, is how much of the buffer there is.
    """
    # s, L/s
    dt = 10.0
    feed = 0.01

    def advance(x: Array, u: Array) -> Array:
        rate = feed + float(u[0])
        end = (feed * FEED + float(u[0]) * BASE) / rate
        buffer = x[1] if len(x) > 1 else CARBONATE
        charge = _charge(float(np.clip(x[0], 1.0, 13.0)), buffer)
        charge = end + (charge - end) * np.exp(-rate * dt)
        after = brentq(lambda each: _charge(each, buffer) - charge, 0.0, 14.0, xtol=1e-12)
        return np.append(after, x[1:])

    rest = np.array([7.0])
    u = np.array([feed * (FEED - _charge(7.0)) / (_charge(7.0) - BASE)])
    e_x = np.array([1e-3])
    e_u = np.array([1e-6])
    A = (advance(rest + e_x, u) - advance(rest - e_x, u)) / (2 * e_x)
    B = (advance(rest, u + e_u) - advance(rest, u - e_u)) / (2 * e_u)
    model = LinearModel([A], [B], dt, x_ss=rest, u_ss=u, state_names=["pH"])
    weights = {"Q": [[1.0]], "R": [[100.0]], "horizon": 5}
    boxes = (2.0,), (12.0,), (0.0,), (0.02,)
    return TextbookPlant(advance, model, *boxes, (1.0,), weights, (0,), ((5.0,), (9.0,)))


def van_de_vusse(
    x: Sequence[float] = (2.1402, 1.0903, 387.34, 386.06), flow: float = 14.19
) -> TextbookPlant:
    """Return a reactor whose product first falls when it is to rise.

    Its model is that of the state x, where it rests at a ``flow`` per hour: by default the peak of
    the product, where no input moves it for long.
    """

    def slope(x: Array, u: Array) -> Array:
        a, b, T, jacket = x.tolist()
        k1 = 1.287e12 * np.exp(-9758.3 / T)
        k3 = 9.043e9 * np.exp(-8560.0 / T)
        heat = 4.2 * k1 * a - 11.0 * k1 * b - 41.85 * k3 * a * a
        through = 4032.0 * 0.215 * (T - jacket)
        return np.array(
            [
                u[0] * (5.1 - a) - k1 * a - k3 * a * a,
                -u[0] * b + k1 * (a - b),
                u[0] * (378.05 - T) - (heat + through / 10) / (0.9342 * 3.01),
                (u[1] + through) / (5.0 * 2.0),
            ]
        )

    dt = 1 / 60  # h
    model = LinearModel.from_dynamics(slope, [*x], [flow, -1113.5], dt)
    weights = {"Q": np.diag([0, 100, 0, 0]), "R": np.diag([1e-3, 1e-7]), "horizon": 2}
    boxes = (0.5, 0.3, 370.0, 365.0), (4.5, 1.5, 405.0, 405.0), (3.0, -9000.0), (35.0, 0.0)
    spread = (0.2, 0.05, 1.0, 1.0)
    wanted = ((0.85,), (1.095,))
    return TextbookPlant(_integrated(slope, dt, 4), model, *boxes, spread, weights, (1,), wanted)


def bioreactor() -> TextbookPlant:
    """Return a culture that too much food slows down, and too much flow washes out.

    A third state, if there is one, is the food in the feed.
    """

    def slope(x: Array, u: Array) -> Array:
        cells, food, feed = (*x.tolist(), 4.0)[:3]
        growth = 0.53 * food / (0.12 + food + 0.4545 * food * food)
        moved = (growth - u[0]) * cells, (feed - food) * u[0] - growth * cells / 0.4, 0.0
        return np.array(moved[: len(x)])

    model = LinearModel.from_dynamics(slope, [1.52, 0.2], [np.nan], 0.5)
    weights = {"Q": np.diag([1, 0]), "R": [[0.1]], "horizon": 5}
    boxes = (0.3, 0.0), (2.0, 4.0), (0.0,), (0.6,)
    spread = (0.2, 0.1)
    wanted = ((1.0,), (1.55,))
    return TextbookPlant(
        _integrated(slope, 0.5, 10), model, *boxes, spread, weights, (0,), wanted, 40, 80
    )


def conical_tank() -> TextbookPlant:
    """Return a tank that is wider, and so slower, the fuller it is."""

    def slope(x: Array, u: Array) -> Array:
        h = np.maximum(x, 0.1)
        return np.asarray((u - 0.6 * np.sqrt(h)) / (np.pi * (0.5 * h) ** 2))

    model = LinearModel.from_dynamics(slope, [1.5], [np.nan], 0.2)
    weights = {"Q": [[1.0]], "R": [[0.02]], "horizon": 5}
    boxes = (0.2,), (4.0,), (0.0,), (2.0,)
    return TextbookPlant(
        _integrated(slope, 0.2, 4), model, *boxes, (0.5,), weights, (0,), ((0.6,), (2.8,))
    )


def true_reactor() -> LinearMPC:
    """Return the reactor's MPC with the model that its equations give, not the printed one."""
    found = LinearModel.from_dynamics(cstr.dynamics, cstr.X_SS, cstr.U_SS, cstr.DT)
    model = LinearModel(found.A, found.B, cstr.DT)  # in deviations, as the environment is
    return replace(problems.cstr(), model=model, terminal=None)


def printed_pendulum() -> LinearMPC:
    """Return the pendulum's MPC with the printed weight, Q = I: nine regions instead of seven."""
    return replace(problems.clipped_pendulum(), Q=np.eye(2), terminal=None)


@dataclass(frozen=True)
class Case:
    """An MPC, and what makes its plant."""

    mpc: LinearMPC
    make: Callable[[], gym.Env[Any, Any]]


def textbook(plant: Callable[[], TextbookPlant]) -> Case:
    """Return a textbook plant with its MPC."""
    made = plant()
    mpc = made.mpc()
    return Case(mpc, partial(made.env, mpc))


def of_paper(problem: Callable[[], LinearMPC], env_id: str) -> Case:
    """Return one of the paper's plants."""
    return Case(problem(), partial(gym.make, env_id))


def gymnasium_pendulum() -> Case:
    """Return Gymnasium's pendulum from its own starts, most of which hang; it shows its angle."""
    top = np.array([np.pi, 8.0])
    space = gym.spaces.Box(-top, top, dtype=np.float64)

    def angle(observation: Array) -> Array:
        cosine, sine, speed = np.asarray(observation, np.float64)
        return np.array([np.arctan2(sine, cosine), speed])

    def make() -> gym.Env[Any, Any]:
        return gym.wrappers.TransformObservation(gym.make("Pendulum-v1"), angle, space)

    limits = {"u_min": -2, "u_max": 2, "theta_min": -top, "theta_max": top}
    model = LinearModel.from_env(make, x_ss=[0, 0], u_ss=[0])
    weights = {"Q": np.diag([1.0, 0.1]), "R": [[0.001]], "horizon": 2}
    return Case(LinearMPC(model, **weights, **limits), make)


def worn_tank() -> Case:
    """Return a quadruple tank whose pumps lost a tenth since its model was made."""
    model = LinearModel.from_dynamics(
        quadruple_tank.derivative,
        [*quadruple_tank.LEVELS_SS[:2], np.nan, np.nan],
        [np.nan, np.nan],
        quadruple_tank.DT,
    )
    mpc = LinearMPC(
        model,
        Q=np.diag([1.0, 1.0, 0.0, 0.0]),
        R=0.1 * np.eye(2),
        horizon=2,
        u_min=0,
        u_max=quadruple_tank.MAX_VOLTAGE,
        theta_min=0,
        theta_max=quadruple_tank.FULL,
        tracking=Tracking([0, 1], model.x_ss[:2] - 4, model.x_ss[:2] + 4),
    )

    def make() -> gym.Env[Any, Any]:
        wanted = model.x_ss[:2] - 2, model.x_ss[:2] + 2
        env = SetPoint(quadruple_tank.QuadrupleTank(wear=0.1), *wanted, hold=20)
        return TimeLimit(env, 60)

    return Case(mpc, make)


def measured_tank() -> Case:
    """Return the tank of an example, with waves and a disturbance that is measured."""
    mpc = own_plant.design()
    return Case(mpc, partial(own_plant.make_env, mpc))


def with_observer(case: Callable[[], Case]) -> Case:
    """Return the same plant with the offset-free MPC, to which an observer shows d."""
    given = case()
    mpc, observer = offset_free(given.mpc)
    bounds = mpc.disturbances.d_min, mpc.disturbances.d_max
    return Case(mpc, lambda: ObserveDisturbance(given.make(), observer, *bounds))


CASES: dict[str, Callable[[], Case]] = {
    "reactor": partial(of_paper, problems.cstr, "CSTR-v0"),
    "reactor, true model": partial(of_paper, true_reactor, "CSTR-v0"),
    "pendulum, Q = diag(1, 0.1)": partial(
        of_paper, problems.clipped_pendulum, "ClippedPendulum-v0"
    ),
    "pendulum, Q = I": partial(of_paper, printed_pendulum, "ClippedPendulum-v0"),
    "Gymnasium's pendulum, any start": gymnasium_pendulum,
    "worn tank, set-points": worn_tank,
    "worn tank, an observer": partial(with_observer, worn_tank),
    "worn tank, waves, a measured flow": measured_tank,
    "pH": partial(textbook, ph),
    "van de Vusse's reactor": partial(textbook, van_de_vusse),
    "van de Vusse's reactor, an observer": partial(with_observer, partial(textbook, van_de_vusse)),
    "bioreactor": partial(textbook, bioreactor),
    "bioreactor, an observer": partial(with_observer, partial(textbook, bioreactor)),
    "conical tank": partial(textbook, conical_tank),
}
