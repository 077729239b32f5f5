"""The safety-critical reactor of Braniff & Tian: keep an exothermic CSTR below 480 K."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann_envs._problem_env import (
    Array,
    Frame,
    ProblemEnv,
    ProblemVectorEnv,
    constant,
    new_figure,
    not_reset,
    pixels,
)
from sb3_yann_envs.spaces import ProblemBox

DT = 1 / 60  # h
SUBSTEPS = 2  # Runge-Kutta steps in a sample; from the random starts exact to about 2e-8 K
RICH = 0.5  # (mol/L)^2, product of C_A and C_B that no random start leads to below the limit
RICH_SUBSTEPS = 6  # with it the temperature is exact to 1e-6 K from any start that is allowed
TEMPERATURE_LIMIT = 480.0  # K
PENALTY = 1e5
"""Added once to the cost of the step that exceeds the temperature limit."""
MAX_INPUT = 55.0  # kJ/(h m2 K), largest deviation of the heat transfer coefficient

GAS_CONSTANT = 8.314462618  # J/(mol K)
LOG_FREQUENCY_1 = math.log(4e14)  # of L/(mol h)
LOG_FREQUENCY_2 = 84 * math.log(10)  # of 1/h
ACTIVATION_1 = 128e3  # J/mol
ACTIVATION_2 = 800e3  # J/mol
REACTION_HEAT_1 = 45.4e3  # J/mol, released
REACTION_HEAT_2 = 320e3  # J/mol, released
HEAT_CAPACITY = 3150.0  # J/(L K), density times specific heat of the mixture
VOLUME = 4000.0  # L
AREA = 5.3  # m2
COOLANT_TEMPERATURE = 373.0  # K
DILUTION = 0.0609  # 1/h, flow over volume
# mol/L
FEED_A = 4.3
FEED_B = 5.1
FEED_S = 3.0

_HEATING_1 = REACTION_HEAT_1 / HEAT_CAPACITY  # K L/mol
_HEATING_2 = REACTION_HEAT_2 / HEAT_CAPACITY  # K L/mol
_COOLING = 1000 * AREA / (HEAT_CAPACITY * VOLUME)  # m2 K/kJ


def _steady_state(temperature: float, transfer: float) -> tuple[float, float, float, float]:
    """Return C_A, C_B, C_S and the feed temperature that balance at the given T and U.

    The balances of A and B give ``C_B - C_A = FEED_B - FEED_A`` and a quadratic equation for C_A.
    """
    thermal = GAS_CONSTANT * temperature
    k1 = math.exp(LOG_FREQUENCY_1 - ACTIVATION_1 / thermal)
    k2 = math.exp(LOG_FREQUENCY_2 - ACTIVATION_2 / thermal)
    excess = FEED_B - FEED_A
    half = (k1 * excess + DILUTION) / 2
    c_a = (math.sqrt(half**2 + k1 * DILUTION * FEED_A) - half) / k1
    c_b = c_a + excess
    c_s = DILUTION * FEED_S / (DILUTION + k2)
    removed = _COOLING * transfer * (temperature - COOLANT_TEMPERATURE)
    released = _HEATING_1 * k1 * c_a * c_b + _HEATING_2 * k2 * c_s
    return c_a, c_b, c_s, temperature + (removed - released) / DILUTION


_T_SS = 475.0
_TRANSFER_SS = 55.0
_A_SS, _B_SS, _S_SS, FEED_TEMPERATURE = _steady_state(_T_SS, _TRANSFER_SS)

X_SS = constant([_A_SS, _B_SS, _S_SS, _T_SS])
"""Steady state: C_A, C_B, C_S in mol/L, T in K."""
U_SS = constant([_TRANSFER_SS])
"""Heat transfer coefficient at the steady state in kJ/(h m2 K)."""

Q = constant(0.1 * np.eye(4))
"""State weights of the stage cost, for deviations in mol/L and K."""
R = constant([[1e-4]])
"""Input weight of the stage cost, for the deviation in kJ/(h m2 K)."""

# Bounds that the paper puts on the deviations; no start may lie beyond them.
STATE_LOW = constant([-2.0, -2.0, -2.0, -70.0])
STATE_HIGH = constant([2.0, 2.0, 2.0, 5.0])
# Bounds of the random starts.
START_LOW = constant([-0.05, -0.4, -0.4, -7.5])
START_HIGH = constant([0.05, 0.4, 0.4, 4.0])

PRINTED_A = constant(
    [
        [0.9506, 0.0, 0.0, 0.0],
        [-0.0484, 0.9943, 0.0, 0.0],
        [0.0, 0.0, 0.9909, 0.0],
        [0.6970, 0.0678, 0.0, 1.0030],
    ]
)
"""State matrix as printed in the paper, for deviations and one sample."""
PRINTED_B = constant([[0.0], [0.0], [0.0], [-0.0007]])
"""Input matrix as printed in the paper, for deviations and one sample."""

_STATE = "UniTuple(float64, 4)"  # which numba returns without running Python code
F = TypeVar("F", bound=Callable[..., Any])


def compiled(signature: str) -> Callable[[F], F]:
    """Return a decorator that compiles a function for given types, and keeps the machine code.

    What it calls must be in this file: numba looks at no other to see whether the machine code is
    up to date. It returns numbers only: to return an array, numba runs Python code, in which a
    Ctrl-C becomes a SystemError.
    """

    def compile_it(function: F) -> F:
        try:
            result: Any = numba.njit(signature, cache=True, error_model="numpy")(function)
        except Exception:  # no folder to write to, a full disk, a damaged file
            result = numba.njit(signature, error_model="numpy")(function)
        return cast(F, result)

    return compile_it


def dynamics(x: ArrayLike, u: ArrayLike) -> Array:
    """Return the state's time derivative in mol/(L h) and K/h, by the balances of a stirred tank.

    `x` is (C_A, C_B, C_S) in mol/L and T in K, `u` the heat transfer coefficient in kJ/(h m2 K),
    shape (1,). Neither is a deviation.
    """
    c_a, c_b, c_s, temperature = np.asarray(x, dtype=np.float64).tolist()
    (transfer,) = np.asarray(u, dtype=np.float64).tolist()
    return np.array(_rates(c_a, c_b, c_s, temperature, transfer))


@compiled(f"{_STATE}(float64, float64, float64, float64, float64)")
def _rates(
    c_a: float, c_b: float, c_s: float, temperature: float, transfer: float
) -> tuple[float, float, float, float]:
    """Return `dynamics` on plain floats."""
    thermal = GAS_CONSTANT * temperature
    r1 = np.exp(LOG_FREQUENCY_1 - ACTIVATION_1 / thermal) * c_a * c_b
    r2 = np.exp(LOG_FREQUENCY_2 - ACTIVATION_2 / thermal) * c_s
    return (
        DILUTION * (FEED_A - c_a) - r1,
        DILUTION * (FEED_B - c_b) - r1,
        DILUTION * (FEED_S - c_s) - r2,
        DILUTION * (FEED_TEMPERATURE - temperature)
        + _HEATING_1 * r1
        + _HEATING_2 * r2
        - _COOLING * transfer * (temperature - COOLANT_TEMPERATURE),
    )


def stage_cost(a: Any, b: Any, s: Any, t: Any, u: Any) -> Any:
    """Return the stage cost of deviations and input, without the penalty.

    Parameters
    ----------
    a, b, s, t, u : float or ndarray, shape (num_envs,)
        Deviations of C_A, C_B and C_S in mol/L, of T in K and of U in kJ/(h m2 K).
    """
    return 0.1 * (a * a + b * b + s * s + t * t) + 1e-4 * u * u


@compiled("boolean(float64, float64)")
def is_rich(a: float, b: float) -> bool:
    """Tell whether deviations of C_A and C_B are so large that a step needs `RICH_SUBSTEPS`."""
    return (_A_SS + a) * (_B_SS + b) > RICH


@compiled(f"{_STATE}(float64, float64, float64, float64, float64)")
def advance(
    a: float, b: float, s: float, t: float, transfer: float
) -> tuple[float, float, float, float]:
    """Return the deviation one sample later (classical Runge-Kutta, equal steps).

    The equations are not stiff below the limit. Deviations are stored rather than absolute values,
    so that a state handed out by `step` restarts the same trajectory bit for bit.
    """
    substeps = RICH_SUBSTEPS if is_rich(a, b) else SUBSTEPS
    h = DT / substeps
    half = h / 2
    sixth = h / 6
    for _ in range(substeps):
        A = _A_SS + a
        B = _B_SS + b
        S = _S_SS + s
        T = _T_SS + t
        a1, b1, s1, t1 = _rates(A, B, S, T, transfer)
        a2, b2, s2, t2 = _rates(
            A + half * a1, B + half * b1, S + half * s1, T + half * t1, transfer
        )
        a3, b3, s3, t3 = _rates(
            A + half * a2, B + half * b2, S + half * s2, T + half * t2, transfer
        )
        a4, b4, s4, t4 = _rates(A + h * a3, B + h * b3, S + h * s3, T + h * t3, transfer)
        a = a + sixth * (a1 + 2 * (a2 + a3) + a4)
        b = b + sixth * (b1 + 2 * (b2 + b3) + b4)
        s = s + sixth * (s1 + 2 * (s2 + s3) + s4)
        t = t + sixth * (t1 + 2 * (t2 + t3) + t4)
    return a, b, s, t


@compiled("void(float64[:, ::1], float64[::1], float64[:, ::1])")
def advance_all(deviations: Array, transfer: Array, after: Array) -> None:
    """Write `advance` of many reactors: deviations of shape (4, n), transfer of shape (n,)."""
    for i in range(len(transfer)):
        a = deviations[0, i]
        b = deviations[1, i]
        s = deviations[2, i]
        t = deviations[3, i]
        after[0, i], after[1, i], after[2, i], after[3, i] = advance(a, b, s, t, transfer[i])


class CSTREnv(ProblemEnv):
    """Bring an exothermic reactor to its steady state without passing 480 K.

    ## Description

    A continuous stirred tank reactor in which two reactions release heat: the wanted one,
    A + B -> product, and the decomposition of the solvent S, which takes over within minutes once
    the tank is too hot. It is the reactor of the accident at T2 Laboratories, with the data of
    Fogler (*Elements of Chemical Reaction Engineering*, example 13-6). The only handle is the heat
    transfer coefficient U of the cooling jacket. The goal is to regulate concentrations and
    temperature to the steady state; the temperature must stay at or below 480 K.

    With time in h, *F* = 0.0609 1/h, *k1 = 4e14 exp(-128000 / (R T))* L/(mol h) and
    *k2 = 1e84 exp(-800000 / (R T))* 1/h:

    - *dC_A/dt = F (4.3 - C_A) - k1 C_A C_B*
    - *dC_B/dt = F (5.1 - C_B) - k1 C_A C_B*
    - *dC_S/dt = F (3.0 - C_S) - k2 C_S*
    - *dT/dt = F (452.483 - T) + (45400 k1 C_A C_B + 320000 k2 C_S) / 3150 - 4.20635e-4 U (T - 373)*

    The steady state is (0.08616063, 0.88616063, 2.99475999) mol/L and 475 K at U = 55. A step is
    one sample of 1/60 h, integrated with two Runge-Kutta steps of fourth order, or with six from
    starts with far more A and B than the random ones.

    ## Action Space

    An array of shape `(1,)`, float32, clipped to its bounds. A negative value cools less.

    | Num | Action                                            | Min   | Max  | Unit         |
    |-----|---------------------------------------------------|-------|------|--------------|
    | 0   | Heat transfer coefficient, deviation from U = 55   | -55.0 | 55.0 | kJ/(h m2 K)  |

    ## Observation Space

    An array of shape `(4,)`, float32, in a `ProblemBox`: deviations from the steady state.

    | Num | Observation                         | Min   | Max  | Unit  |
    |-----|-------------------------------------|-------|------|-------|
    | 0   | C_A, methylcyclopentadiene          | -3.0  | 3.0  | mol/L |
    | 1   | C_B, sodium                         | -3.0  | 3.0  | mol/L |
    | 2   | C_S, diglyme                        | -3.0  | 3.0  | mol/L |
    | 3   | Temperature T (the limit is at 5.0) | -70.0 | 25.0 | K     |

    The bounds hold for every observation, also the one beyond the limit that ends an episode, for
    any inputs and any start that `reset` accepts.

    ## Rewards

    *r = -(0.1 (dC_A<sup>2</sup> + dC_B<sup>2</sup> + dC_S<sup>2</sup> + dT<sup>2</sup>) +
    0.0001 u<sup>2</sup>)*, with the deviations before the step and the clipped action, computed
    from the state in float64. A step at whose end T > 480 K costs 1e5 more.

    The `info` of a step holds `cost` (minus the reward, with the penalty) and `violation` (whether
    this step passed 480 K). That of a step and of a reset holds `state`, the observation in
    float64; given back as `options["state"]` it continues the same trajectory exactly.

    ## Starting State

    Deviations uniform in [-0.05, 0.05] (C_A), [-0.4, 0.4] (C_B, C_S) and [-7.5, 4] (T).
    `reset(options={"state": [dC_A, dC_B, dC_S, dT]})` starts from any deviation within the bounds
    that the paper sets, [-2, 2] mol/L and [-70, 5] K, as long as no concentration is negative.

    ## Episode End

    - Termination: the temperature exceeds 480 K at the end of a step. A further step needs a reset,
      since the runaway beyond has no meaning for the controller and soon none numerically.
    - Truncation: after 400 steps (6 h 40 min) if made with `gymnasium.make`.

    ## Arguments

    - `render_mode`: None, or `"rgb_array"` for the history as a picture of shape (400, 600, 3).

    ```python
    >>> import gymnasium
    >>> import sb3_yann_envs
    >>> env = gymnasium.make("CSTR-v0", render_mode="rgb_array")

    ```

    `docs/environments.md` lists the paper's slips, and what was chosen here.

    ## Version History

    * v0: Initial version.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}
    state_names = ("C_A deviation", "C_B deviation", "C_S deviation", "T deviation")
    # A concentration cannot be negative, so the deviation cannot be below minus the steady one.
    lowest = constant(np.maximum(STATE_LOW, [*-X_SS[:3], -np.inf]))
    highest = STATE_HIGH
    start_low = START_LOW
    start_high = START_HIGH

    def __init__(self, render_mode: str | None = None) -> None:
        low, high = np.array([[-3, -3, -3, -70], [3, 3, 3, 25]], np.float32)
        states = ProblemBox(low, high, problem="sb3_yann_envs.problems:cstr")
        super().__init__(render_mode, states, MAX_INPUT)

    def _begin(self) -> None:
        self._terminated = False
        self._temperatures = [_T_SS + self._state[3]]  # longer only to be drawn
        self._inputs: list[float] = []

    def _advance(self, u: float) -> tuple[float, bool]:
        if self._terminated:
            raise not_reset("step", "the reactor passed its temperature limit")
        a, b, s, t = self._state
        cost = stage_cost(a, b, s, t, u)
        self._state = advance(a, b, s, t, _TRANSFER_SS + u)
        temperature = _T_SS + self._state[3]
        self._terminated = temperature > TEMPERATURE_LIMIT
        if self.render_mode is not None:
            self._temperatures.append(temperature)
            self._inputs.append(u)
        return cost + PENALTY * self._terminated, self._terminated

    def _frame(self) -> Frame:
        return reactor_frame(DT, self._temperatures, self._inputs, TEMPERATURE_LIMIT, MAX_INPUT)


class CSTRVectorEnv(ProblemVectorEnv):
    """Many :class:`CSTREnv`."""

    single = CSTREnv

    def _advance(self, u: Array) -> tuple[Array, NDArray[np.bool_]]:
        a, b, s, t = self._state
        cost = stage_cost(a, b, s, t, u)
        after = np.empty_like(self._state)
        advance_all(self._state, U_SS[0] + u, after)
        self._state = after
        terminated = X_SS[3] + self._state[3] > TEMPERATURE_LIMIT
        return cost + PENALTY * terminated, terminated


def reactor_frame(
    sample_time: float,
    temperatures: Sequence[float],
    inputs: Sequence[float],
    limit: float,
    max_input: float,
) -> Frame:
    """Return the history of a reactor episode, shape (400, 600, 3).

    Parameters
    ----------
    sample_time : float
        Sample time in h.
    temperatures : sequence of float, length k + 1
        Temperature in K at the start and after each of k steps.
    inputs : sequence of float, length k
        Input deviation of each step in kJ/(h m2 K).
    limit, max_input : float
        Temperature limit in K, and largest input deviation.
    """
    figure = new_figure(6.0, 4.0)
    figure.set_layout_engine("constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    hours = sample_time * np.arange(len(temperatures))
    upper.plot(hours, temperatures, color="tab:red")
    upper.plot(hours[-1:], temperatures[-1:], "o", color="tab:red")
    upper.axhline(limit, color="0.25", linestyle="--")
    place = (0.01, limit), (0, 3), ("axes fraction", "data"), "offset points"
    upper.annotate(f"limit {limit:g} K", *place, color="0.25")
    # A fixed floor keeps the axis still while the temperature stays near its steady state.
    upper.set_ylim(min(465.0, min(temperatures) - 1.0), max(limit, *temperatures) + 2.5)
    upper.set_ylabel("temperature (K)")
    lower.stairs(inputs, hours, baseline=None, color="tab:blue")
    lower.set(ylim=(-1.1 * max_input, 1.1 * max_input), xlim=(0.0, max(1.0, hours[-1])))
    lower.set(ylabel="input deviation\n(kJ/(h m² K))", xlabel="time (h)")
    figure.align_ylabels()
    return pixels(figure)
