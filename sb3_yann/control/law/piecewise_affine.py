"""Piecewise affine laws on polyhedral regions: locate, evaluate, save, load."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann import _validation as check
from sb3_yann._archive import write_arrays
from sb3_yann._validation import Array, check_array
from sb3_yann.control.law._files import read_law
from sb3_yann.control.law.on_plant import OnPlant, plant_arrays, with_plant
from sb3_yann.control.polyhedra import largest_ball

if TYPE_CHECKING:
    from sb3_yann.control.law.search_tree import SearchTree

# Compiled code is loaded at the first use of a law: not at an import.
INFEASIBLE = ("nearest_region", "zero_input")
SCAN, MOST_PARAMETERS = 4, 10
"""Few regions are asked one by one. With more parameters regions have too many vertices."""
FLAT = 3
"""With more parameters a tree takes longer to build than the law to solve; a walk needs none."""


def _ignore(count: int) -> None:
    """Take no notice of progress."""


def _none() -> NDArray[np.int64]:
    return np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class PiecewiseAffine(OnPlant):
    """The law ``u = gains[i] theta + offsets[i]`` for theta in region i, total and bounded.

    The region at theta is the one whose smallest slack ``b - A theta`` is largest, the first of
    them on a tie: a region that holds theta, or the one that theta violates least. Where the MPC
    has no solution, ``infeasible`` decides:

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
        That no two regions share an interior, which is not checked. The search then ends at the
        first region that holds theta.
    neighbors : ndarray of int, shape (q,), optional
        The region beyond each half-space, -1 where none is known. Disjoint regions that are many
        are then found by a walk along a line, without a tree. Empty where there is no region known.

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
    neighbors: NDArray[np.int64] = field(default_factory=_none, compare=False)

    # So far outside a point still counts as inside: facets of neighbors agree to rounding only.
    tolerance = 1e-8
    # Slacks that differ by less, relative to 1 + their size, tie. Outside the feasible set whole
    # areas violate two neighbors alike: rounding must not choose.
    tie_tolerance = 1e-12

    def __post_init__(self) -> None:
        """Check the arrays against each other and store them as read-only float64."""
        gains = check_array("gains", self.gains, ("p", "m", "n"))
        p, m, n = gains.shape
        A = check_array("A", self.A, ("q", n))
        values = {"gains": gains, "A": A, "b": check_array("b", self.b, (len(A),))}
        values["offsets"] = check_array("offsets", self.offsets, (p, m))
        for name, size in (("u", m), ("theta", n)):
            low, high = f"{name}_min", f"{name}_max"
            bounds = check.check_bounds(name, getattr(self, low), getattr(self, high), size)
            values[low], values[high] = bounds
        check.check_choice("infeasible", self.infeasible, INFEASIBLE)
        check.check_bool("disjoint", self.disjoint)
        rows = check_array("starts", self.starts, (p,))
        if p == 0 or rows[0] != 0 or np.any(np.diff([*rows, len(A)]) < 1) or np.any(rows % 1):
            raise ValueError(
                f"starts = {rows.tolist()} must be the first row of each region in A, which has "
                f"{len(A)} rows: whole numbers that increase from 0 on."
            )
        beyond = np.asarray(self.neighbors)
        if beyond.size and not (
            beyond.shape == (len(A),)
            and beyond.dtype.kind == "i"
            and np.all((beyond >= -1) & (beyond < p))
        ):
            raise ValueError(
                f"neighbors must be {len(A)} whole numbers, one for each row of A, from -1 to "
                f"{p - 1}, or none at all."
            )
        whole = {"starts": rows.astype(np.int64), "neighbors": beyond.astype(np.int64)}
        self._store(**values, **whole)

    @property
    def n_regions(self) -> int:
        """Number of regions p."""
        return len(self.starts)

    @property
    def n_halfspaces(self) -> int:
        """Number of half-spaces q of all regions together."""
        return len(self.b)

    @property
    def n_theta(self) -> int:
        """Number of parameters n."""
        return int(self.gains.shape[2])

    @property
    def n_inputs(self) -> int:
        """Number of inputs m."""
        return int(self.gains.shape[1])

    def __call__(self, theta: ArrayLike) -> Array:
        """Return the input: (m,) for theta of shape (n,), (batch, m) for (batch, n)."""
        # Real numbers, none of them masked, as compiled code takes them: see below for all else.
        if type(theta) is np.ndarray and _is_plain(theta):
            u = np.empty(len(self.u_min))
            if self._at(theta.astype(np.float64, copy=False), u):
                return u
        from sb3_yann.control.law._kernels import law_of_batch

        points, rows = self._as_theta(theta)
        inputs = np.empty((len(rows), self.n_inputs))
        law_of_batch(*self.packed, rows, inputs)
        return inputs if points.ndim == 2 else inputs[0]

    def locate(self, theta: ArrayLike) -> NDArray[np.int64]:
        """Return the index of the region in use at theta, one for each row of a batch."""
        return self._choose(theta)[0]

    def gain(self, theta: ArrayLike) -> Array:
        """Return the gain in use, (m, n) at theta (n,) or (batch, m, n), before bounds clip it."""
        return np.asarray(self.gains[self.locate(theta)])

    def in_domain(self, theta: ArrayLike) -> NDArray[np.bool_]:
        """Tell whether the MPC has a solution at theta, for each row of a batch."""
        return np.asarray(self._choose(theta)[1] >= -self.tolerance)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the law to ``path`` as an ``.npz`` file of plain arrays.

        Its search tree and its plant go along: operating point, dt, names and units.
        """
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        arrays |= plant_arrays(self)
        if self.tree is not None:
            arrays.update({f"tree_{name}": each for name, each in vars(self.tree).items()})
        write_arrays(path, arrays)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> PiecewiseAffine:
        """Read a law that :meth:`save` wrote, to the bit; nothing of the file is executed.

        OSError if the file cannot be read; ValueError if it holds no law, was changed since it was
        written, or is of before files had digests.
        """
        return read_law("a PiecewiseAffine", path, cls._from_arrays)

    @classmethod
    def _from_arrays(cls, data: dict[str, Any]) -> PiecewiseAffine:
        values = {field.name: data[field.name] for field in fields(cls)}
        for name, kind in (("infeasible", str), ("disjoint", bool)):
            values[name] = kind(values[name])
        tree = {name[5:]: each for name, each in data.items() if name.startswith("tree_")}
        law = cls(**values)
        if tree:
            from sb3_yann.control.law.search_tree import SearchTree

            law.__dict__["tree"] = SearchTree(**tree).checked(law.n_theta, law.n_regions)
        return with_plant(law, data)

    def __hash__(self) -> int:
        """Return a hash that equal laws share."""
        return hash((self.gains.tobytes(), self.b.tobytes(), self.infeasible))

    def __repr__(self) -> str:
        """Name the sizes."""
        law = f"regions={self.n_regions}, halfspaces={self.n_halfspaces}, theta={self.n_theta}"
        return f"PiecewiseAffine({law}, inputs={self.n_inputs}, infeasible={self.infeasible!r})"

    def _choose(self, theta: ArrayLike) -> tuple[NDArray[np.int64], Array]:
        """Return the region in use and how far inside it each point lies, negative outside."""
        from sb3_yann.control.law._kernels import locate_batch

        points, rows = self._as_theta(theta)
        region, inside = np.empty(len(rows), np.int64), np.empty(len(rows))
        locate_batch(*self.packed, rows, region, inside)
        return region.reshape(points.shape[:-1]), inside.reshape(points.shape[:-1])

    @cached_property
    def tree(self) -> SearchTree | None:
        """The tree that finds a region; None for so few that a scan is as fast, or for a walk."""
        return self._new_tree(_ignore)

    def grow_tree(self, advance: Callable[[int], None]) -> None:
        """Build the tree now, so that no call does; ``advance`` counts regions, or 0, now and then.

        What it raises ends the work.
        """
        vars(self)["tree"] = self._new_tree(advance)

    def _new_tree(self, advance: Callable[[int], None]) -> SearchTree | None:
        bounded = np.all(np.isfinite([self.theta_min, self.theta_max]))
        few, wide = self.n_regions <= SCAN, self.n_theta > MOST_PARAMETERS
        if few or wide or not bounded or self.walks:
            return None
        from sb3_yann.control.law.search_tree import build_tree

        box = self.theta_min, self.theta_max
        tree = build_tree(self.A, self.b, self.starts, *box, advance)
        return tree if len(tree.levels) else None  # regions that no hyperplane parts

    @property
    def walks(self) -> bool:
        """Whether a region is found by a walk from region to region."""
        large = self.n_regions > SCAN and self.n_theta > FLAT
        return large and self.disjoint and self.neighbors.size > 0

    @cached_property
    def packed(self) -> tuple[Array, NDArray[np.int64]]:
        """The law as two arrays for compiled code, see `_kernels.pack`."""
        from sb3_yann.control.law._kernels import pack

        rows, bounds = np.column_stack([self.A, self.b]), np.stack([self.u_min, self.u_max])
        tolerances = self.tolerance, self.tie_tolerance
        flags = self.infeasible == "zero_input", self.disjoint
        laws = self.gains, self.offsets, rows, self.starts, bounds, tolerances, flags
        if self.walks:
            return pack(*laws, walk=(self.neighbors, *self.start_of_walk()))
        return pack(*laws, tuple(vars(self.tree).values()) if self.tree else ())

    def start_of_walk(self) -> tuple[int, Array]:
        """Return the region at the middle of the box, and a point inside it."""
        middle, half = (self.theta_max + self.theta_min) / 2, (self.theta_max - self.theta_min) / 2
        first = int(np.argmax(np.minimum.reduceat(self.b - self.A @ middle, self.starts)))
        rows = slice(self.starts[first], [*self.starts, len(self.b)][first + 1])
        inside, _ = largest_ball(self.A[rows] * half, self.b[rows] - self.A[rows] @ middle)
        return first, middle + half * inside

    @cached_property
    def _at(self) -> Callable[[Any, Array], bool]:
        from sb3_yann.control.law._kernels import law_at

        return partial(law_at, *self.packed)

    def __deepcopy__(self, memo: object = None) -> PiecewiseAffine:
        """Return the law itself: nothing of it can change."""
        return self

    __copy__ = __deepcopy__

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what was compiled for this process; the tree goes along, as in :meth:`save`."""
        _ = self.tree
        return {name: each for name, each in vars(self).items() if name not in ("packed", "_at")}

    def _as_theta(self, theta: ArrayLike) -> tuple[Array, Array]:
        return as_points(theta, self.n_theta)


def _is_plain(theta: NDArray[Any]) -> bool:
    """Tell whether an array is of real numbers in one row that compiled code may write to."""
    return theta.ndim == 1 and theta.dtype.kind in "fiu" and theta.flags.carray


def as_points(theta: ArrayLike, n: int) -> tuple[Array, Array]:
    """Return theta as checked numbers (n,) or (batch, n), and as contiguous rows of a batch."""
    points = check.to_float("theta", theta)
    if points.ndim not in (1, 2) or points.shape[-1] != n:
        wanted = f"({n},) or (batch, {n})"
        raise ValueError(f"theta has shape {points.shape}, expected {wanted}.")
    rows = np.ascontiguousarray(np.atleast_2d(points))
    if not np.all(np.isfinite(rows)):
        bad = rows[~np.all(np.isfinite(rows), axis=1)][0]
        raise ValueError(
            f"theta holds NaN or infinite entries, {bad.tolist()}; the law is defined for numbers."
        )
    return points, rows
