"""Piecewise affine laws on polyhedral regions: locate, evaluate, save, load."""

from __future__ import annotations

from dataclasses import dataclass, fields
from os import PathLike, fspath, replace
from zipfile import BadZipFile

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann.control._validation import Array, same_fields

OUTSIDE = ("nearest", "zero")


@dataclass(frozen=True, eq=False)
class PiecewiseAffine:
    """The law ``u = gains[i] theta + offsets[i]`` for theta in region i, total and bounded.

    One region is chosen at every theta: the one whose smallest slack ``b - A theta`` over its own
    half-spaces is largest, the first of them on a tie. Inside the feasible set that is a region
    which holds theta (on a facet, one of its neighbours, where both laws agree); outside it is the
    region that theta violates least.

    Outside the feasible set, where the MPC has no solution, ``outside`` decides:

    - ``"nearest"``: the affine law of the chosen region, clipped to the input bounds.
    - ``"zero"``: no deviation of the input (clipped to the bounds), as in Braniff & Tian, where
      no indicator of a region is active. It jumps at the border of the feasible set.

    Attributes
    ----------
    gains : ndarray, shape (p, m, n)
    offsets : ndarray, shape (p, m)
    A : ndarray, shape (q, n)
        Half-spaces ``A theta <= b`` of all regions, region after region, rows of unit length.
    b : ndarray, shape (q,)
    starts : ndarray of int, shape (p,)
        The first row of each region in ``A``.
    u_min, u_max : ndarray, shape (m,)
        Bounds of the input, infinite where there is none.
    theta_min, theta_max : ndarray, shape (n,)
        The box for which the law was solved; a network scales its inputs by it.
    outside : {"nearest", "zero"}
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
    outside: str = "nearest"

    # How far outside every region a point may lie, in the units of theta, and still count as
    # inside: facets of neighbours agree to rounding only.
    tolerance = 1e-8

    def __post_init__(self) -> None:
        """Check the shapes against each other and make the arrays read-only."""
        p, m, n = self.gains.shape
        q = self.A.shape[0]
        expected = {
            **{"offsets": (p, m), "A": (q, n), "b": (q,), "starts": (p,)},
            **{"u_min": (m,), "u_max": (m,), "theta_min": (n,), "theta_max": (n,)},
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(
                    f"{name} has shape {getattr(self, name).shape}, expected {shape} "
                    f"for gains of shape {self.gains.shape}."
                )
        if self.outside not in OUTSIDE:
            raise ValueError(f"outside = {self.outside!r} must be one of {OUTSIDE}.")
        for field in fields(self):
            if field.name != "outside":
                getattr(self, field.name).setflags(write=False)

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
        """Return the input: (m,) for theta of shape (n,), (batch, m) for (batch, n).

        Raises
        ------
        ValueError
            If theta has another shape or holds NaN or infinite entries.
        """
        points = self._as_theta(theta)
        slack = self._smallest_slack(points)
        region = np.argmax(slack, axis=-1)
        u = np.einsum("...mn,...n->...m", self.gains[region], points) + self.offsets[region]
        if self.outside == "zero":
            inside = np.max(slack, axis=-1) >= -self.tolerance
            u = np.where(inside[..., None], u, 0.0)
        return np.asarray(np.clip(u, self.u_min, self.u_max))

    def locate(self, theta: ArrayLike) -> NDArray[np.int64]:
        """Return the index of the region in use at theta, one for each row of a batch."""
        return np.asarray(np.argmax(self._smallest_slack(self._as_theta(theta)), axis=-1))

    def in_domain(self, theta: ArrayLike) -> NDArray[np.bool_]:
        """Tell whether the MPC has a solution at theta, for each row of a batch."""
        slack = self._smallest_slack(self._as_theta(theta))
        return np.asarray(np.max(slack, axis=-1) >= -self.tolerance)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the law to ``path`` as an ``.npz`` file of plain arrays (no pickle)."""
        part = f"{fspath(path)}.part"
        with open(part, "wb") as file:
            np.savez(file, **{field.name: getattr(self, field.name) for field in fields(self)})
        replace(part, path)  # a reader never sees half a file

    @classmethod
    def load(cls, path: str | PathLike[str]) -> PiecewiseAffine:
        """Read a law that :meth:`save` wrote.

        Raises
        ------
        ValueError
            If the file is not such a law.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                values = {field.name: data[field.name] for field in fields(cls)}
        except (KeyError, ValueError, EOFError, BadZipFile) as error:
            raise ValueError(
                f"{path} does not hold a PiecewiseAffine: {error}. Write it with law.save(path)."
            ) from None
        return cls(**{**values, "outside": str(values["outside"])})

    def __eq__(self, other: object) -> bool:
        """Tell whether both laws have the same regions, gains and options."""
        if not isinstance(other, PiecewiseAffine):
            return NotImplemented
        return same_fields(self, other, [field.name for field in fields(self)])

    def __hash__(self) -> int:
        """Return a hash that equal laws share."""
        return hash((self.gains.tobytes(), self.b.tobytes(), self.outside))

    def __repr__(self) -> str:
        """Name the sizes."""
        return (
            f"PiecewiseAffine(regions={self.n_regions}, halfspaces={self.n_halfspaces}, "
            f"theta={self.n_theta}, inputs={self.n_inputs}, outside={self.outside!r})"
        )

    def _smallest_slack(self, points: Array) -> Array:
        """Return (..., p): how far each point lies inside each region, negative outside."""
        return np.minimum.reduceat(self.b - points @ self.A.T, self.starts, axis=-1)

    def _as_theta(self, theta: ArrayLike) -> Array:
        points = np.asarray(theta, dtype=np.float64)
        if points.ndim not in (1, 2) or points.shape[-1] != self.n_theta:
            raise ValueError(
                f"theta has shape {points.shape}, expected ({self.n_theta},) "
                f"or (batch, {self.n_theta})."
            )
        if not np.all(np.isfinite(points)):
            raise ValueError("theta holds NaN or infinite entries; the law is defined for numbers.")
        return points
