"""The groups of arguments of a problem. Each checks itself; `sized` gives its arrays full shape."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann import _validation as check
from sb3_yann._validation import (
    Array,
    Bounds,
    Given,
    ReadOnlyArrays,
    check_array,
    check_bounds,
    check_symmetric,
    to_float,
)

Outputs = ArrayLike | Sequence[int]
HalfSpaces = tuple[ArrayLike, ArrayLike]


def _loose(name: str, lower: Given, upper: Given) -> Bounds:
    """Return bounds that fit each other, of a size that is still open."""
    below, above = check.sides_of(name)
    low = to_float(below, -np.inf if lower is None else lower)
    high = to_float(above, np.inf if upper is None else upper)
    check_bounds(name, low, high, max(low.size, high.size))
    return low, high


def _bounds(name: str, lower: Given, upper: Given, size: int, missing: str) -> Bounds:
    """Return bounds of shape (size,); they must be infinite of what the problem does not have."""
    low, high = _loose(name, lower, upper)
    if size == 0 and np.any(np.isfinite(np.append(low, high))):
        raise ValueError(
            f"{' or '.join(check.sides_of(name))} is given, but there is no {missing}."
        )
    return check_bounds(name, low, high, size)


def _softness(name: str, given: Array, bounds: Bounds) -> Array:
    """Return the unit of violation (size,) of soft bounds; one number is for all that are there."""
    size = len(bounds[0])
    bounded = np.isfinite(bounds).any(axis=0)
    units = given
    if given.ndim == 0:
        units = np.where(bounded, given, 0.0) if np.any(bounded) else np.full(size, float(given))
    units = check_array(name, units, (size,))
    if np.any(given > 0) and not np.any(units[bounded] > 0):
        wanted = f"pass {name[-1]}_min or {name[-1]}_max"
        raise ValueError(f"{name} = {given.tolist()}, but there is no bound to soften: {wanted}.")
    if np.any(units[~bounded] > 0):
        i = int(np.argmax((units > 0) & ~bounded))
        raise ValueError(
            f"{name} = {given.tolist()} softens entry {i}, which has no bound: make it 0."
        )
    return units


def _preview(name: str, value: int) -> int:
    return check.check_int(f"{name}.preview", value, 0, "It counts samples ahead.")


def _outputs(name: str, C: Outputs, symbol: str, lower: Given, upper: Given) -> dict[str, Array]:
    """Return the fields of a group of outputs ``C x`` with bounds."""
    named = isinstance(C, list | tuple) and bool(C) and all(isinstance(each, str) for each in C)
    rows = np.array(C) if named else check.check_output_rows(name, C)
    low, high = _bounds(symbol, lower, upper, len(rows), f"output in {name}")
    return {"C": rows, f"{symbol}_min": low, f"{symbol}_max": high}


def _rows(name: str, C: Array, n_states: int, names: Sequence[str]) -> Array:
    """Return outputs as a matrix (q, n): they may be names of states, or indices."""
    if C.dtype.kind == "U":
        if missing := [each for each in C.tolist() if each not in names]:
            known = f"are {[*names]}" if names else "have no names: model.named([...]) gives some"
            raise ValueError(f"{name} has {missing}, but the model's states {known}.")
        C = np.array([names.index(each) for each in C.tolist()])
    return check.check_outputs(name, C, n_states)


@dataclass(frozen=True, eq=False, init=False)
class Tracking(ReadOnlyArrays):
    """The outputs ``C x`` that follow a reference r, and the box of r.

    Parameters
    ----------
    C : array_like, shape (p, n), or list of int or str
        The matrix of the tracked outputs, or the indices or the names of the tracked states.
    r_min, r_max : array_like, shape (p,), or float, optional
        The box of references. The explicit law needs it bounded, and takes a reference beyond it as
        at its end.
    preview : int, default 0
        How many samples ahead the reference is known. Theta holds it for the present sample and for
        each of these; the last one stays.

    Examples
    --------
    >>> Tracking([0, 2], r_min=-1, r_max=[1, 3]).r_min
    array([-1., -1.])
    """

    C: Array
    r_min: Array
    r_max: Array
    preview: int = 0

    def __init__(
        self, C: Outputs = (), r_min: Given = None, r_max: Given = None, preview: int = 0
    ) -> None:
        ahead = _preview("Tracking", preview)
        self._store(**_outputs("Tracking.C", C, "r", r_min, r_max), preview=ahead)

    def sized(self, n_states: int, names: Sequence[str] = ()) -> Tracking:
        """Return it with C as a matrix (p, n)."""
        C = _rows("Tracking.C", self.C, n_states, names)
        return Tracking(C, self.r_min, self.r_max, self.preview if len(C) else 0)


@dataclass(frozen=True, eq=False, init=False)
class OutputBounds(ReadOnlyArrays):
    """Bounds of outputs ``C x`` that the predictions keep.

    Parameters
    ----------
    C : array_like, shape (q, n), or list of int or str
        The matrix of the bounded outputs, or indices or names of states.
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

    def sized(self, n_states: int, names: Sequence[str] = ()) -> OutputBounds:
        """Return it with C as a matrix (q, n)."""
        C = _rows("OutputBounds.C", self.C, n_states, names)
        return OutputBounds(C, self.y_min, self.y_max)


@dataclass(frozen=True, eq=False, init=False)
class DisturbanceBounds(ReadOnlyArrays):
    """The box of the disturbance d of a model with a matrix E.

    Parameters
    ----------
    d_min, d_max : array_like, shape (d,), or float, optional
        The explicit law needs both finite.
    preview : int, default 0
        How many samples ahead the measured disturbances are known, as of :class:`Tracking`.

    Examples
    --------
    >>> DisturbanceBounds(-1, 1).sized(2).d_max
    array([1., 1.])
    """

    d_min: Array
    d_max: Array
    preview: int = 0

    def __init__(self, d_min: Given = None, d_max: Given = None, preview: int = 0) -> None:
        low, high = _loose("d", d_min, d_max)
        self._store(d_min=low, d_max=high, preview=_preview("DisturbanceBounds", preview))

    def sized(self, n_disturbances: int) -> DisturbanceBounds:
        """Return it with bounds of shape (d,)."""
        bounds = _bounds("d", self.d_min, self.d_max, n_disturbances, "E of the model")
        return DisturbanceBounds(*bounds, self.preview if n_disturbances else 0)


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
        costs to come back from the bounds, or less where solvers would lose digits, and stores that
        number: far above the multipliers, save next to where the hard problem has no solution.

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
        if penalty is not None and (soft or penalty):
            penalty = check.check_positive("SoftBounds.penalty", penalty)
        elif not soft:
            penalty = 0.0
        self._store(**units, penalty=penalty)

    def sized(self, x: Bounds, y: Bounds, mixed: Array) -> SoftBounds:
        """Return it with an entry for each bound of the states and of the outputs.

        ``mixed`` are the units of :class:`MixedBounds`, which have the same penalty.
        """
        units = _softness("SoftBounds.x", self.x, x), _softness("SoftBounds.y", self.y, y)
        soft = any(np.any(unit) for unit in (*units, mixed))
        if self.penalty and not soft:
            raise ValueError(
                f"SoftBounds.penalty = {self.penalty!r}, but nothing is soft: x and y hold the "
                "violation that counts as one unit, 0 where a bound is hard. Or pass "
                "MixedBounds(soft=...)."
            )
        found = SoftBounds(*units, self.penalty or None)
        if soft and not self.penalty:
            found._store(penalty=None)  # the problem chooses it
        return found


@dataclass(frozen=True, eq=False, init=False)
class MixedBounds(ReadOnlyArrays):
    """Bounds of combinations, ``low <= F x + G u <= high``, each row at every sample.

    A row with inputs holds for x_k and u_k, k = 0 ... N-1; one of states alone for k = 1 ... N.

    Parameters
    ----------
    F, G : array_like, shapes (k, n) and (k, m), optional
        Zeros where left out.
    low, high : array_like, shape (k,), or float, optional
    soft : array_like, shape (k,), or float, default 0
        The violation that counts as one unit, 0 where the bound is hard. Soft ones share a slack
        over the horizon, at the penalty of :class:`SoftBounds`.

    Examples
    --------
    >>> MixedBounds(G=[[1, 1]], high=1.5).sized(3, 2).F
    array([[0., 0., 0.]])
    """

    F: Array
    G: Array
    low: Array
    high: Array
    soft: Array

    def __init__(
        self,
        F: Given = None,
        G: Given = None,
        low: Given = None,
        high: Given = None,
        soft: ArrayLike = 0.0,
    ) -> None:
        parts = {}
        for name, given in (("F", F), ("G", G)):
            value = to_float(f"MixedBounds.{name}", np.zeros((0, 0)) if given is None else given)
            parts[name] = check_array(f"MixedBounds.{name}", np.atleast_2d(value), ("k", "columns"))
        lower, upper = _loose("MixedBounds.", low, high)
        units = to_float("MixedBounds.soft", soft)
        if np.any(units < 0):
            raise ValueError(f"MixedBounds.soft = {units.tolist()}: no entry may be negative.")
        self._store(**parts, low=lower, high=upper, soft=units)

    def sized(self, n_states: int, n_inputs: int) -> MixedBounds:
        """Return it with F (k, n), G (k, m) and bounds and units of shape (k,)."""
        count = max(len(self.F), len(self.G))
        sides = zip(("F", "G"), (self.F, self.G), (n_states, n_inputs), strict=True)
        F, G = (
            check_array(f"MixedBounds.{name}", M, (count, size)) if len(M) else
            np.zeros((count, size)) for name, M, size in sides
        )  # fmt: skip
        low, high = _bounds("MixedBounds.", self.low, self.high, count, "row in F or G")
        for k in np.flatnonzero(~np.any(np.hstack([F, G]), axis=1)):
            raise ValueError(f"Row {k} of MixedBounds is zero in F and G: it bounds nothing.")
        for k in np.flatnonzero(np.isinf(low) & np.isinf(high)):
            raise ValueError(f"Row {k} of MixedBounds has no bound: pass low or high, or both.")
        units = _softness("MixedBounds.soft", self.soft, (low, high)) if count else self.soft
        return MixedBounds(F, G, low, high, np.ravel(units)[:count])


@dataclass(frozen=True, eq=False, init=False)
class LinearCost(ReadOnlyArrays):
    """Prices in the stage cost, ``x' p + u' q`` of states and inputs as the plant shows them.

    With a price the law need not rest at the operating point, and costs may be negative. The
    terminal cost has none.

    Parameters
    ----------
    x, u : array_like, shapes (n,) and (m,), or float, default 0
        What a unit of each costs in a sample; negative where it earns.
    constant : float, default 0
        Added to each sample.

    Examples
    --------
    >>> LinearCost(u=[0.5, 0]).sized(3, 2).x
    array([0., 0., 0.])
    """

    x: Array
    u: Array
    constant: float

    def __init__(self, x: ArrayLike = 0.0, u: ArrayLike = 0.0, constant: float = 0.0) -> None:
        prices = {"x": to_float("LinearCost.x", x), "u": to_float("LinearCost.u", u)}
        self._store(**prices, constant=check.check_number("LinearCost.constant", constant))

    @property
    def counts(self) -> bool:
        """Whether anything has a price."""
        return bool(np.any(self.x) or np.any(self.u) or self.constant)

    def sized(self, n_states: int, n_inputs: int) -> LinearCost:
        """Return it with prices of shapes (n,) and (m,)."""
        x, u = (
            check_array(f"LinearCost.{name}", np.full(size, p) if p.ndim == 0 else p, (size,))
            for name, p, size in (("x", self.x, n_states), ("u", self.u, n_inputs))
        )
        return LinearCost(x, u, self.constant)


def parametric_names(names: Sequence[str], limits: Mapping[str, Bounds]) -> tuple[str, ...]:
    """Return a name such as "u_max[0]" for each bound that changes at run time.

    A name is "u_max" for all entries that are bounded, or "u_max[0]" for one; likewise x, y, du and
    "_min". Those of MixedBounds are "mixed_min" and "mixed_max". ``limits`` are by "x", "u", ...
    """
    if isinstance(names, str) or not all(isinstance(each, str) for each in names):
        raise TypeError(f"parametric_bounds = {names!r} must be a list such as ['u_max'].")
    found: dict[str, None] = {}  # each once
    for given in names:
        parts = re.fullmatch(r"(\w+)_(min|max)(?:\[(\d+)\])?", given)
        if parts is None or parts[1] not in limits:
            known = ", ".join(f"{each}_min, {each}_max" for each in limits)
            raise ValueError(
                f"parametric_bounds has {given!r}; known are {known}, and single entries such as "
                "'u_max[0]'."
            )
        values = limits[parts[1]][parts[2] == "max"]
        bounded = np.flatnonzero(np.isfinite(values)).tolist()
        chosen = bounded if parts[3] is None else [int(parts[3])]
        if any(i >= len(values) for i in chosen):
            raise ValueError(
                f"parametric_bounds has {given!r}, but the entries of {parts[1]} are "
                f"{[*range(len(values))]}."
            )
        if not chosen or not set(chosen) <= set(bounded):
            raise ValueError(
                f"parametric_bounds has {given!r}, but {parts[1]}_{parts[2]} = {values.tolist()} "
                "is no bound there: give it its widest value."
            )
        found |= {f"{parts[1]}_{parts[2]}[{i}]": None for i in chosen}
    return tuple(found)


def bound_entry(name: str) -> tuple[str, int, bool]:
    """Return the kind, the index, and whether it is an upper bound, of such as "u_max[0]"."""
    side, _, index = name[:-1].partition("[")
    kind, _, which = side.rpartition("_")
    return kind, int(index), which == "max"


def parametric_box(names: Sequence[str], limits: Mapping[str, Bounds]) -> Bounds:
    """Return how far each bound may move in: to the other side, a rate's to zero."""
    sides = []
    for name in names:
        kind, i, upper = bound_entry(name)
        other = 0.0 if kind == "du" else float(limits[kind][not upper][i])
        if not np.isfinite(other):
            wanted = check.sides_of("MixedBounds." if kind == "mixed" else kind)[not upper]
            raise ValueError(
                f"parametric_bounds has {name!r}, but nothing says how far it moves in: give "
                f"{wanted} a finite entry {i}."
            )
        sides.append(sorted((other, float(limits[kind][upper][i]))))
    low, high = np.array(sides, dtype=np.float64).reshape(-1, 2).T
    return low, high


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
        :func:`~sb3_yann.control.mpc.invariant_sets.invariant_set`.

    Examples
    --------
    >>> Terminal(set=([[1, 0], [-1, 0]], [2, 2])).set[1]
    array([2., 2.])
    """

    cost: Array
    set: tuple[Array, Array]
    # No field: whether the set was asked for as "invariant".
    is_invariant = False

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
