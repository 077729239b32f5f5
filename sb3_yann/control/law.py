"""Piecewise affine laws on polyhedral regions, and what every law knows of its plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from os import PathLike, fspath
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann._archive import read_arrays, write_arrays
from sb3_yann._validation import (
    Array,
    ReadOnlyArrays,
    check_array,
    check_bool,
    check_bounds,
    check_choice,
    half_widths,
    to_float,
)
from sb3_yann.control.linear_system import labels_of
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.polyhedra import largest_ball
from sb3_yann.units import Units

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from typing_extensions import Self

T = TypeVar("T")
INFEASIBLE_OPTIONS = ("nearest_region", "zero_input")


class PlantLaw(ReadOnlyArrays):
    """A law of theta with what it knows of its plant, which is saved with it.

    Equality ignores the plant.

    Attributes
    ----------
    model : LinearModel or None
        With operating point, dt, names and units. None for a law that was built by hand.
    theta_ss : ndarray, shape (n_theta,), or None
        Theta at the operating point, as the plant shows it: of a state its x_ss.
    rate : ndarray, shape (2, m), or None
        du_min and du_max, for a theta that ends with the previous input.
    moving : ndarray of int, shape (2, m), or None
        Which entries of theta are lower and upper bounds of the inputs, -1 for none.
    clamped : ndarray, shape (2, n_theta), or None
        Ends of the range of what is asked for, see `MPCProblem.clamped`: an entry of theta beyond
        counts as at its end.

    Inputs keep rate and bounds where the problem has no solution as well, see
    `MPCProblem.input_range`.
    """

    # The class is no dataclass: these are no fields of a law.
    model: LinearModel | None = None
    theta_ss: Array | None = None
    rate: Array | None = None
    moving: NDArray[np.intp] | None = None
    clamped: Array | None = None
    u_min: Array
    u_max: Array
    theta_min: Array
    theta_max: Array
    _kind: ClassVar[str]  # what a file should hold, for a message
    _derived: ClassVar[tuple[str, ...]]  # what follows from the rest, or is remembered

    @property
    def n_theta(self) -> int:
        """Number of parameters n."""
        return len(self.theta_min)

    @property
    def n_inputs(self) -> int:
        """Number of inputs m."""
        return len(self.u_min)

    def __call__(self, theta: ArrayLike) -> Array:
        """Return the input: (m,) for theta of shape (n,), (batch, m) for (batch, n)."""
        raise NotImplementedError

    def on_plant(
        self,
        model: LinearModel,
        theta_ss: ArrayLike,
        rate: ArrayLike | None = None,
        moving: ArrayLike | None = None,
        clamped: ArrayLike | None = None,
    ) -> Self:
        """Return the same law with its plant, see the attributes."""
        law = object.__new__(type(self))
        plant: dict[str, Any] = {"theta_ss": theta_ss, "rate": rate, "clamped": clamped}
        known = {k: np.array(v, np.float64) for k, v in plant.items() if v is not None}
        moves = None if moving is None else np.array(moving, np.intp)
        law.__setstate__({**self.__getstate__(), **known, "model": model, "moving": moves})
        return law

    def clamp(self, theta: Array) -> Array:
        """Return theta (..., n) with what is asked for within its range."""
        if self.clamped is not None:
            theta = np.minimum(np.maximum(theta, self.clamped[0]), self.clamped[1])
        return theta

    def _numbers(self, theta: ArrayLike) -> Array:
        """Return theta (n_theta,) or (batch, n_theta) as numbers."""
        given = to_float("theta", theta)
        n = self.n_theta
        if given.ndim not in (1, 2) or given.shape[-1] != n:
            states = [] if self.model is None else labels_of(self.model)[0]
            states += [f"then mpc.layout.names[{len(states)}:]"] * (0 < len(states) < n)
            of = f": {', '.join(states)}" if states else ""
            raise ValueError(f"theta has shape {given.shape}, expected ({n},) or (batch, {n}){of}.")
        return given

    def _points(self, theta: ArrayLike) -> tuple[Array, Array]:
        """Return theta as checked numbers, and as contiguous rows within what may be asked."""
        points = self._numbers(theta)
        rows = np.ascontiguousarray(np.atleast_2d(points))
        if not np.all(np.isfinite(rows)):
            bad = self.units.to_plant(rows[~np.all(np.isfinite(rows), axis=1)][0])
            plant = " (as the plant shows it)" if self.units.shifted else ""
            raise ValueError(
                f"theta holds NaN or infinite entries, {bad.tolist()}{plant}; the law is defined "
                "for numbers."
            )
        return points, self.clamp(rows)

    def _within_range(self, u: Array, theta: Array) -> Array:
        """Return inputs (batch, m) within what rate and bounds in theta leave."""
        if self.moving is not None:
            fixed = self.u_min, self.u_max
            low, high = (
                np.where(at >= 0, theta[:, at], side)
                for at, side in zip(self.moving, fixed, strict=True)
            )
            u = np.clip(np.clip(u, low, np.maximum(low, high)), *fixed)
        if self.rate is not None:
            before = theta[:, -u.shape[1] :]
            u = np.clip(u, *(np.clip(before + side, self.u_min, self.u_max) for side in self.rate))
        return u

    def plant_input(self, shown: ArrayLike) -> Array:
        """Return the input as the plant takes it, for theta as the plant shows it.

        Parameters
        ----------
        shown : array_like, shape (n_theta,) or (batch, n_theta)
            References, disturbances and the previous input count from the plant's zero too.

        Raises
        ------
        ValueError
            If the law knows no plant.

        Examples
        --------
        >>> from sb3_yann.control import LinearMPC
        >>> tank = LinearModel([[0.9]], [[0.5]], dt=1, x_ss=[12], u_ss=[3])
        >>> weights = {"Q": [[1]], "R": [[1]], "horizon": 3}
        >>> limits = {"x_min": 0, "x_max": 20, "u_min": 0, "u_max": 10}
        >>> law = LinearMPC(tank, **weights, **limits).explicit()
        >>> law.plant_input([12.0])
        array([3.])
        """
        if self.model is None or self.theta_ss is None:
            raise ValueError(
                "The law knows no operating point: it was built by hand. Take it from "
                "LinearMPC.explicit() or online(), or use u_ss + law(shown - theta_ss)."
            )
        units = self.units
        return units.input_to_plant(self(units.to_deviations(self._numbers(shown))))

    @property
    def units(self) -> Units:
        """The operating point of its plant; zero for a law that was built by hand."""
        if self.model is None or self.theta_ss is None:
            return Units(np.zeros(self.n_theta), np.zeros(self.n_inputs))
        return Units(self.theta_ss, self.model.u_ss)

    def plot(self, axes: Axes | None = None, **options: Any) -> Axes:
        """Draw the regions by :func:`~sb3_yann.control.law_plot.plot_law`; return the axes.

        Options are those of that function: ``entries``, ``at``, ``labels``, ``name``. A law that is
        solved online has no regions, and is a ValueError.
        """
        from sb3_yann.control.law_plot import plot_law

        return plot_law(self, axes, **options)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the law to ``path`` as an ``.npz`` file of plain arrays.

        Its plant goes along, but for the standard errors of its gains.
        """
        write_arrays(path, self._arrays())

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read a law that :meth:`save` wrote, to the bit; nothing of the file is executed.

        OSError if the file cannot be read; ValueError if it holds no law, or was changed since it
        was written.
        """
        return read_law(cls._kind, path, cls._from_arrays)

    def _arrays(self) -> dict[str, Any]:
        """Return the law and its plant as arrays by name."""
        arrays = {each.name: getattr(self, each.name) for each in fields(self)}  # type: ignore[arg-type]
        if self.model is not None:
            arrays["theta_ss"] = self.theta_ss
            own = {"rate": self.rate, "moving": self.moving, "clamped": self.clamped}
            arrays |= {name: value for name, value in own.items() if value is not None}
            every = vars(self.model).items()  # gains are no array
            model = {k: each for k, each in every if each is not None and k != "gains"}
            arrays |= {f"model_{name}": value for name, value in model.items()}
        return arrays

    @classmethod
    def _from_arrays(cls, data: dict[str, Any]) -> Self:
        """Return the law of such arrays; what is missing or damaged raises some error."""
        values = {each.name: data[each.name] for each in fields(cls)}  # type: ignore[arg-type]
        law = cls(**{name: each if each.ndim else each.item() for name, each in values.items()})
        if not any(name == "theta_ss" or name.startswith("model_") for name in data):
            return law
        given = {name[6:]: each for name, each in data.items() if name.startswith("model_")}
        words = [name for name in given if name.endswith("_names")]
        for name in ("notes", *words, "units", "estimated", "time_unit"):
            given[name] = given[name].tolist()
        model = LinearModel(**{**given, "dt": float(given["dt"])})
        if model.n_inputs != law.n_inputs or model.n_states > law.n_theta:
            raise ValueError(f"its model has {model.n_states} states and {model.n_inputs} inputs")
        theta_ss = check_array("theta_ss", data["theta_ss"], (law.n_theta,))
        rate, moving = (
            check_array(name, data[name], (2, law.n_inputs)) if name in data else None
            for name in ("rate", "moving")
        )
        ends = data.get("clamped")
        clamped = None if ends is None else check_bounds("clamped", ends[0], ends[1], law.n_theta)
        return law.on_plant(model, theta_ss, rate, moving, clamped)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy keeps."""
        return {name: each for name, each in vars(self).items() if name not in self._derived}

    def __deepcopy__(self, memo: object = None) -> Self:
        """Return the law itself: nothing of it can change."""
        return self

    __copy__ = __deepcopy__


@dataclass(frozen=True, eq=False)
class PiecewiseAffine(PlantLaw):
    """The law ``u = gains[i] theta + offsets[i]`` for theta in region i, total and bounded.

    The region at theta is the one whose smallest slack ``b - A theta`` is largest, the first of
    them on a tie: a region that holds theta, or the one that theta violates least. Half-spaces of
    the box do not count, see `open_rows`. Beyond the box, and where the MPC has no solution,
    ``infeasible`` decides:

    - ``"nearest_region"``: the affine law of that region, clipped to the input bounds.
    - ``"zero_input"``: no deviation of the input, clipped to the bounds, as in Braniff & Tian. It
      jumps at the border of the feasible set.

    Attributes
    ----------
    gains : ndarray, shape (p, m, n)
    offsets : ndarray, shape (p, m)
    A : ndarray, shape (q, n)
        Half-spaces ``A theta <= b``, region after region. Slacks are in half-widths of the box.
    b : ndarray, shape (q,)
    starts : ndarray of int, shape (p,)
        The first row of each region in ``A``.
    u_min, u_max : ndarray, shape (m,)
        Bounds of the input, infinite where there is none.
    theta_min, theta_max : ndarray, shape (n,)
        The box for which the law was solved; a network scales its inputs by it.
    infeasible : {"nearest_region", "zero_input"}
    disjoint : bool, default False
        That no two regions share an interior in the box, which is not checked. There the search
        ends at the first region that holds theta.
    neighbors : ndarray of int, shape (q,), optional
        The region beyond each half-space, -1 where none is known. Disjoint regions that are many
        are then found by a walk along a line. Empty where there is no region known.

    Examples
    --------
    >>> law = PiecewiseAffine(
    ...     gains=[[[-2.0]]], offsets=[[0.0]], A=[[1.0], [-1.0]], b=[1.0, 1.0], starts=[0],
    ...     u_min=[-1.0], u_max=[1.0], theta_min=[-1.0], theta_max=[1.0],
    ... )
    >>> law([0.25]), law([3.0])
    (array([-0.5]), array([-1.]))
    """

    gains: Array
    offsets: Array
    A: Array
    b: Array
    starts: NDArray[np.int64]
    u_min: Array
    u_max: Array
    theta_min: Array
    theta_max: Array
    infeasible: str = "nearest_region"
    disjoint: bool = False
    neighbors: NDArray[np.int64] = field(
        default_factory=lambda: np.empty(0, np.int64), compare=False
    )

    # So far outside a point still counts as inside: facets of neighbors agree to rounding only.
    tolerance = 1e-8
    # Slacks that differ by less, relative to 1 + their size, tie. Outside the feasible set whole
    # areas violate two neighbors alike: rounding must not choose.
    tie_tolerance = 1e-12
    _kind = "a PiecewiseAffine"
    _derived = ("packed", "_at")

    def __post_init__(self) -> None:
        gains = check_array("gains", self.gains, ("p", "m", "n"))
        p, m, n = gains.shape
        A = check_array("A", self.A, ("q", n))
        values = {"gains": gains, "A": A, "b": check_array("b", self.b, (len(A),))}
        values["offsets"] = check_array("offsets", self.offsets, (p, m))
        values |= bounds_of(self, m, n)
        check_choice("infeasible", self.infeasible, INFEASIBLE_OPTIONS)
        check_bool("disjoint", self.disjoint)
        rows = check_array("starts", self.starts, (p,))
        if p == 0 or rows[0] != 0 or np.any(np.diff([*rows, len(A)]) < 1) or np.any(rows % 1):
            raise ValueError(
                f"starts = {rows.tolist()} must be the first row of each region in A, which has "
                f"{len(A)} rows: whole numbers that increase from 0 on."
            )
        beyond = np.asarray(self.neighbors)
        known = beyond.shape == (len(A),) and beyond.dtype.kind == "i"
        if beyond.size and not (known and np.all((beyond >= -1) & (beyond < p))):
            raise ValueError(
                f"neighbors must be {len(A)} whole numbers, one for each row of A, from -1 to "
                f"{p - 1}, or none at all."
            )
        self._store(**values, starts=rows.astype(np.int64), neighbors=beyond.astype(np.int64))

    @property
    def n_regions(self) -> int:
        """Number of regions p."""
        return len(self.starts)

    @property
    def n_halfspaces(self) -> int:
        """Number of half-spaces q of all regions together."""
        return len(self.b)

    def __call__(self, theta: ArrayLike) -> Array:
        """Return the input: (m,) for theta of shape (n,), (batch, m) for (batch, n)."""
        # The short way: real numbers, none masked, in one row as compiled code takes them.
        is_fixed = self.rate is None and self.moving is None
        if is_fixed and type(theta) is np.ndarray and theta.shape == self.theta_min.shape:
            if theta.dtype.kind in "fiu" and theta.flags.carray:
                u = np.empty(len(self.u_min))
                given = theta.astype(np.float64, copy=False)
                finite = self.clamped is None or np.isfinite(given.sum())  # clamping hides inf
                if finite and self._at(self.clamp(given), u):
                    return u
        from sb3_yann.control._kernels.law import law_of_batch

        points, rows = self._points(theta)
        inputs: Array = np.empty((len(rows), self.n_inputs))
        law_of_batch(*self.packed, rows, inputs)
        inputs = self._within_range(inputs, rows)
        return inputs if points.ndim == 2 else inputs[0]

    def widened(
        self, entries: NDArray[np.intp], theta_min: Array, theta_max: Array
    ) -> PiecewiseAffine:
        """Return the law of a theta that also holds ``entries``, which it ignores, and its box."""
        at = entries - np.arange(len(entries))
        return replace(
            self,
            gains=np.insert(self.gains, at, 0.0, axis=2),
            A=np.insert(self.A, at, 0.0, axis=1),
            theta_min=theta_min,
            theta_max=theta_max,
        )

    def locate(self, theta: ArrayLike) -> NDArray[np.int64]:
        """Return the index of the region in use at theta, one for each row of a batch."""
        return self._located(theta)[0]

    def gain(self, theta: ArrayLike) -> Array:
        """Return the gain in use, (m, n) at theta (n,) or (batch, m, n), before bounds clip it."""
        return np.asarray(self.gains[self.locate(theta)])

    def in_domain(self, theta: ArrayLike) -> NDArray[np.bool_]:
        """Tell whether the box holds theta, in deviations, and the MPC has a solution there.

        One answer for each row of a batch.
        """
        return np.asarray(self._located(theta)[1] >= -self.tolerance)

    def _located(self, theta: ArrayLike) -> tuple[NDArray[np.int64], Array]:
        """Return the region in use and how far inside it each point lies, negative outside."""
        from sb3_yann.control._kernels.law import locate_batch

        points, rows = self._points(theta)
        region = np.empty(len(rows), np.int64)
        inside = np.empty(len(rows))
        locate_batch(*self.packed, rows, region, inside)
        return region.reshape(points.shape[:-1]), inside.reshape(points.shape[:-1])

    @property
    def walks(self) -> bool:
        """Whether a region is found by a walk from region to region; others by a scan of all."""
        bounded = bool(np.all(np.isfinite([self.theta_min, self.theta_max])))
        return self.n_regions > 4 and self.disjoint and self.neighbors.size > 0 and bounded

    @property
    def open_rows(self) -> tuple[NDArray[np.bool_], Array, Array]:
        """Which half-spaces (q,) end a region beyond the box too, with A and b.

        The box is where regions are looked for. What is optimal inside is so beyond, up to the
        region's own half-spaces; those of the box do not tell which of two regions goes on. The
        first row of a region with no others is ``0 theta <= 1``.
        """
        q = np.arange(len(self.A))
        entry = np.argmax(np.abs(self.A), axis=1)
        factor = self.A[q, entry]
        end = np.where(factor > 0, self.theta_max[entry], self.theta_min[entry])
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.abs(self.b / factor - end)
        half = half_widths(self.theta_min, self.theta_max)[entry]
        own = (np.count_nonzero(self.A, axis=1) > 1) | ~(off < 1e-9 * half)
        endless = self.starts[~np.logical_or.reduceat(own, self.starts)]
        A = self.A.copy()
        b = self.b.copy()
        own[endless] = True
        A[endless] = 0.0
        b[endless] = 1.0
        return own, A, b

    @property
    def box(self) -> Array:
        """Middle and 1 / half-width of each entry of theta (2, n), 0 where it has no bound.

        ``1 - abs(theta - middle) / half-width`` says how far inside a theta lies.
        """
        bounded = np.isfinite(self.theta_min) & np.isfinite(self.theta_max)
        low, high = np.where(bounded, (self.theta_min, self.theta_max), [[0.0], [np.inf]])
        return np.stack([np.where(bounded, (low + high) / 2, 0.0), 2 / (high - low)])

    @property
    def open_regions(self) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
        """A, b, starts and neighbors of the regions, without what ends at the box alone."""
        own, A, b = self.open_rows
        starts: NDArray[np.int64] = np.cumsum(own)[self.starts] - own[self.starts]
        return A[own], b[own], starts, self.neighbors[own[: len(self.neighbors)]]

    @cached_property
    def packed(self) -> tuple[Array, NDArray[np.int64]]:
        """The law as two arrays for compiled code, see `_kernels.law.pack`."""
        from sb3_yann.control._kernels.law import pack

        A, b, starts, neighbors = self.open_regions
        return pack(
            self.gains,
            self.offsets,
            np.column_stack([A, b]),
            starts,
            np.stack([self.u_min, self.u_max]),
            self.box,
            (self.tolerance, self.tie_tolerance),
            (self.infeasible == "zero_input", self.disjoint),
            (neighbors, *self.start_of_walk()) if self.walks else None,
        )

    def start_of_walk(self) -> tuple[int, Array]:
        """Return the region at the middle of the box, and a point inside it."""
        middle = (self.theta_max + self.theta_min) / 2
        half = (self.theta_max - self.theta_min) / 2
        first = int(np.argmax(np.minimum.reduceat(self.b - self.A @ middle, self.starts)))
        rows = slice(self.starts[first], [*self.starts, len(self.b)][first + 1])
        inside, _ = largest_ball(self.A[rows] * half, self.b[rows] - self.A[rows] @ middle)
        return first, middle + half * inside

    @cached_property
    def _at(self) -> Callable[[Any, Array], bool]:
        from sb3_yann.control._kernels.law import law_at

        return partial(law_at, *self.packed)

    def __hash__(self) -> int:
        return hash((self.gains.tobytes(), self.b.tobytes(), self.infeasible))

    def __repr__(self) -> str:
        law = f"regions={self.n_regions}, halfspaces={self.n_halfspaces}, theta={self.n_theta}"
        return f"PiecewiseAffine({law}, inputs={self.n_inputs}, infeasible={self.infeasible!r})"


def read_law(kind: str, path: str | PathLike[str], build: Callable[[dict[str, Any]], T]) -> T:
    """Return what ``build`` makes of the arrays of a law's file, which should hold a ``kind``.

    OSError if it cannot be read; ValueError if nothing can be built from it, whatever is wrong.
    """
    try:
        return build(read_arrays(path))
    except OSError:
        raise
    except Exception as error:  # a stranger's arrays raise nearly anything
        what = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(
            f"{fspath(path)} does not hold {kind} ({what or type(error).__name__}). Write it with "
            "law.save(path)."
        ) from None


def bounds_of(law: Any, m: int, n: int) -> dict[str, Array]:
    """Return the checked bounds of a law's inputs (m,) and its box (n,) by name."""
    u_min, u_max = check_bounds("u", law.u_min, law.u_max, m)
    theta_min, theta_max = check_bounds("theta", law.theta_min, law.theta_max, n)
    return {"u_min": u_min, "u_max": u_max, "theta_min": theta_min, "theta_max": theta_max}
