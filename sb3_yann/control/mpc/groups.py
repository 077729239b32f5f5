"""The groups of arguments of a problem. Each checks itself; `sized` gives its arrays full shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann import _validation as check
from sb3_yann._validation import (
    Array,
    ReadOnlyArrays,
    check_array,
    check_bounds,
    check_symmetric,
    to_float,
)
from sb3_yann.control.mpc._arguments import Bounds, Given, as_softness

Outputs = ArrayLike | Sequence[int]
HalfSpaces = tuple[ArrayLike, ArrayLike]


def _loose(name: str, lower: Given, upper: Given) -> Bounds:
    """Return bounds that fit each other, of a size that is still open."""
    low = _as_side(f"{name}_min", -np.inf if lower is None else lower)
    high = _as_side(f"{name}_max", np.inf if upper is None else upper)
    check_bounds(name, low, high, max(low.size, high.size))
    return low, high


def _as_side(name: str, value: ArrayLike) -> Array:
    """Return a bound; one that is stored somewhere is the same array."""
    return np.asarray(value) if check.is_kept(value) else to_float(name, value)


def _bounds(name: str, lower: Given, upper: Given, size: int, missing: str) -> Bounds:
    """Return bounds of shape (size,); they must be infinite of what the problem does not have."""
    low, high = _loose(name, lower, upper)
    if size == 0 and np.any(np.isfinite(np.append(low, high))):
        raise ValueError(f"{name}_min or {name}_max is given, but there is no {missing}.")
    return check_bounds(name, low, high, size)


def _outputs(name: str, C: Outputs, symbol: str, lower: Given, upper: Given) -> dict[str, Array]:
    """Return the fields of a group of outputs ``C x`` with bounds."""
    rows = check.check_output_rows(name, C)
    low, high = _bounds(symbol, lower, upper, len(rows), f"output in {name}")
    return {"C": rows, f"{symbol}_min": low, f"{symbol}_max": high}


@dataclass(frozen=True, eq=False, init=False)
class Tracking(ReadOnlyArrays):
    """The outputs ``C x`` that follow a reference r, and the box of r.

    Parameters
    ----------
    C : array_like, shape (p, n), or list of int
        The matrix of the tracked outputs, or the indices of the tracked states.
    r_min, r_max : array_like, shape (p,), or float, optional
        The box of references. The explicit law needs it bounded.

    Examples
    --------
    >>> Tracking([0, 2], r_min=-1, r_max=[1, 3]).r_min
    array([-1., -1.])
    """

    C: Array
    r_min: Array
    r_max: Array

    def __init__(self, C: Outputs = (), r_min: Given = None, r_max: Given = None) -> None:
        self._store(**_outputs("Tracking.C", C, "r", r_min, r_max))

    def sized(self, n_states: int) -> Tracking:
        """Return it with C as a matrix (p, n)."""
        return Tracking(check.check_outputs("Tracking.C", self.C, n_states), self.r_min, self.r_max)


@dataclass(frozen=True, eq=False, init=False)
class OutputBounds(ReadOnlyArrays):
    """Bounds of outputs ``C x`` that the predictions keep.

    Parameters
    ----------
    C : array_like, shape (q, n), or list of int
        The matrix of the bounded outputs, or indices of states.
    y_min, y_max : array_like, shape (q,), or float, optional
        Their bounds.

    Examples
    --------
    >>> OutputBounds([[1, 1]], y_max=5).y_max
    array([5.])
    """

    C: Array
    y_min: Array
    y_max: Array

    def __init__(self, C: Outputs = (), y_min: Given = None, y_max: Given = None) -> None:
        self._store(**_outputs("OutputBounds.C", C, "y", y_min, y_max))

    def sized(self, n_states: int) -> OutputBounds:
        """Return it with C as a matrix (q, n)."""
        C = check.check_outputs("OutputBounds.C", self.C, n_states)
        return OutputBounds(C, self.y_min, self.y_max)


@dataclass(frozen=True, eq=False, init=False)
class DisturbanceBounds(ReadOnlyArrays):
    """The box of the disturbance d of a model with a matrix E.

    Parameters
    ----------
    d_min, d_max : array_like, shape (d,), or float, optional
        The explicit law needs both finite.

    Examples
    --------
    >>> DisturbanceBounds(-1, 1).sized(2).d_max
    array([1., 1.])
    """

    d_min: Array
    d_max: Array

    def __init__(self, d_min: Given = None, d_max: Given = None) -> None:
        low, high = _loose("d", d_min, d_max)
        self._store(d_min=low, d_max=high)

    def sized(self, n_disturbances: int) -> DisturbanceBounds:
        """Return it with bounds of shape (d,)."""
        bounds = _bounds("d", self.d_min, self.d_max, n_disturbances, "E of the model")
        return DisturbanceBounds(*bounds)


@dataclass(frozen=True, eq=False, init=False)
class RateLimits(ReadOnlyArrays):
    """Bounds and weight of the change of the inputs from one sample to the next.

    Parameters
    ----------
    du_min, du_max : array_like, shape (m,), or float, optional
        Bounds of the change; 0 lies between them.
    R_du : array_like, shape (m, m), optional
        Its weight, symmetric positive semi-definite.

    Examples
    --------
    >>> RateLimits(-0.5, 0.5).sized(1).R_du
    array([[0.]])
    """

    du_min: Array
    du_max: Array
    R_du: Array

    def __init__(self, du_min: Given = None, du_max: Given = None, R_du: Given = None) -> None:
        low, high = _loose("du", du_min, du_max)
        for i in np.flatnonzero((low > 0) | (high < 0)):
            raise ValueError(
                f"du_min = {low.tolist()} and du_max = {high.tolist()} make u[{i}] change in every "
                "sample: du_min must be at most 0, and du_max at least 0."
            )
        weight = _square("R_du", np.zeros((0, 0)) if R_du is None else R_du)
        self._store(du_min=low, du_max=high, R_du=weight)

    @property
    def bounded(self) -> bool:
        """Whether the change of an input is bounded."""
        return bool(np.any(np.isfinite(np.append(self.du_min, self.du_max))))

    def sized(self, n_inputs: int) -> RateLimits:
        """Return it with bounds of shape (m,) and a weight of shape (m, m)."""
        weight = self.R_du if self.R_du.size else np.zeros((n_inputs, n_inputs))
        bounds = check_bounds("du", self.du_min, self.du_max, n_inputs)
        return RateLimits(*bounds, check_symmetric("R_du", weight, n_inputs))


@dataclass(frozen=True, eq=False, init=False)
class SoftBounds(ReadOnlyArrays):
    """Which bounds of states and outputs may be broken, and at what cost.

    The largest violation s, in units, costs ``penalty (s + s^2)``, an exact penalty. Soft bounds of
    the states share one slack over the horizon, those of the outputs another.

    Parameters
    ----------
    x, y : array_like, shapes (n,) and (q,), or float, default 0
        The violation of each bound that counts as one unit; 0 keeps the bound hard. A single number
        is for all that have a bound.
    penalty : float, optional
        The cost of one unit of violation. Above the largest sum of multipliers of the hard problem,
        the soft one breaks no bound without need. By default the problem chooses 100 times what it
        costs to come back from the bounds, and stores that number: far above the multipliers, save
        next to where the hard problem has no solution.

    Examples
    --------
    >>> SoftBounds(x=[0, 0.5], penalty=300).penalty
    300.0
    """

    x: Array
    y: Array
    penalty: float | None

    def __init__(
        self, x: ArrayLike = 0.0, y: ArrayLike = 0.0, penalty: float | None = None
    ) -> None:
        units = {"x": to_float("SoftBounds.x", x), "y": to_float("SoftBounds.y", y)}
        for name, unit in units.items():
            if np.any(unit < 0):
                raise ValueError(
                    f"SoftBounds.{name} = {unit.tolist()} holds the violations that count as one "
                    "unit, 0 where the bound is hard: no entry may be negative."
                )
        soft = any(np.any(unit) for unit in units.values())
        if penalty and not soft:
            raise ValueError(f"SoftBounds.penalty = {penalty!r}, but nothing is soft: pass x or y.")
        cost = 0.0 if not soft else None
        if soft and penalty is not None:
            cost = check.check_positive("SoftBounds.penalty", penalty)
        self._store(**units, penalty=cost)

    def sized(self, x: Bounds, y: Bounds) -> SoftBounds:
        """Return it with an entry for each bound of the states and of the outputs."""
        units = as_softness("SoftBounds.x", self.x, x), as_softness("SoftBounds.y", self.y, y)
        return SoftBounds(*units, self.penalty or None)


@dataclass(frozen=True, eq=False, init=False)
class Terminal(ReadOnlyArrays):
    """The cost and the set of the last predicted state.

    Parameters
    ----------
    cost : array_like, shape (n_z, n_z), optional
        P, symmetric positive semi-definite; n_z is n, or n + m with a weight on the rate. The
        default is the Riccati solution, with which the law is the LQR where no constraint acts.
    set : "invariant" or tuple of array_like, optional
        ``(F, g)`` of shapes (c, n) and (c,) for ``F x_N <= g``, or (c, n_theta) for
        ``F theta_N <= g`` (its u_prev is ``u_{N-1}``). "invariant" is the set in which the gain of
        the cost keeps all hard constraints for ever:
        :func:`~sb3_yann.control.mpc.terminal_set.invariant_set`.

    Examples
    --------
    >>> Terminal(set=([[1, 0], [-1, 0]], [2, 2])).set[1]
    array([2., 2.])
    """

    cost: Array
    set: tuple[Array, Array]

    def __init__(self, cost: Given = None, set: HalfSpaces | str | None = None) -> None:
        cost = None if cost is None else _square("Terminal.cost", cost)
        if set is not None and not (isinstance(set, str) and set == "invariant"):
            set = _half_spaces(set)
        self._store(cost=cost, set=set)


def _square(name: str, value: ArrayLike) -> Array:
    """Return a symmetric matrix of any size; one without entries says nothing."""
    matrix = to_float(name, value)
    return check_symmetric(name, matrix, len(np.atleast_1d(matrix))) if matrix.size else matrix


def _half_spaces(value: HalfSpaces | str) -> tuple[Array, Array]:
    try:
        F, g = () if isinstance(value, str) else value  # type: ignore[misc]
    except (TypeError, ValueError):
        got = repr(value) if isinstance(value, str) else type(value).__name__
        wanted = "Terminal.set must be a pair (F, g) of arrays for F x_N <= g, or 'invariant'"
        raise TypeError(f"{wanted}, got {got}.") from None
    rows = check_array("Terminal.set F", F, ("rows", "columns"))
    return rows, check_array("Terminal.set g", g, (len(rows),))
