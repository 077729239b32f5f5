"""The matrices of a linear plant about an operating point, and their sampling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sb3_yann._validation import Array, ReadOnlyArrays

LARGEST_EXPONENT = 709.0
"""Beyond it the exponential function exceeds what numbers hold."""


@dataclass(frozen=True, eq=False)
class LinearSystem(ReadOnlyArrays):
    """``x[k+1] = A x[k] + B u[k] + E d[k]`` about ``(x_ss, u_ss, d_ss)``: data, not validated.

    Linearization and identification return it; `LinearModel` validates it.

    Attributes
    ----------
    A, B, E, dt : ndarray, shapes (n, n), (n, m) and (n, d), and float
        The matrices in discrete time, and the sampling time.
    x_ss, u_ss, d_ss : ndarray, shapes (n,), (m,) and (d,)
    notes, drift : tuple of str, and ndarray, shape (n,), optional
        Remarks, and the measured motion in one sample at the operating point.
    state_names, input_names, units : tuple of str, of n, m and n + m entries
        Empty where there are none.
    estimated : tuple of int
        Which disturbances an observer estimates.
    C : ndarray, shape (q, n), optional
        The outputs that sensors show, ``y = C x``. None where they show the states.
    time_unit : str
        Of ``dt``, for reports and plots.
    """

    A: Array
    B: Array
    dt: float
    x_ss: Array
    u_ss: Array
    E: Array
    d_ss: Array
    notes: tuple[str, ...] = ()
    drift: Array | None = None
    state_names: tuple[str, ...] = ()
    input_names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    estimated: tuple[int, ...] = ()
    C: Array | None = None
    time_unit: str = ""

    @property
    def step_length(self) -> str:
        """The sampling time in words."""
        return f"{self.dt:.4g} {self.time_unit}".rstrip()

    @property
    def shown(self) -> Array:
        """The matrix (q, n) of the outputs that sensors show: C, or the identity."""
        return np.eye(self.n_states) if self.C is None else self.C

    @property
    def n_states(self) -> int:
        """Number of states n."""
        return int(self.A.shape[0])

    @property
    def n_inputs(self) -> int:
        """Number of inputs m."""
        return int(self.B.shape[1])

    @property
    def n_disturbances(self) -> int:
        """Number of disturbances d, measured and estimated."""
        return int(self.E.shape[1])

    @property
    def measured(self) -> tuple[int, ...]:
        """Which disturbances are not said to be estimated."""
        return tuple(i for i in range(self.n_disturbances) if i not in self.estimated)


def names(sizes: Sequence[int]) -> list[str]:
    """Return ``x[0], ..., u[0], ..., d[0], ...`` for so many states, inputs and disturbances."""
    return [f"{k}[{i}]" for k, size in zip("xud", sizes, strict=False) for i in range(size)]


def combination(factors: Array, labels: Sequence[str], digits: int) -> str:
    """Return a linear combination in words, without the terms of factor 0."""
    kept = np.flatnonzero(factors)
    if kept.size == 1:
        return labels[int(kept[0])]
    return " ".join(f"{factors[i]:+.{digits}g} {labels[i]}" for i in kept).removeprefix("+")


def zero_order_hold(A: Array, B: Array, E: Array, dt: float) -> tuple[Array, Array, Array]:
    """Return A, B, E of ``dx/dt = A x + B u + E d`` in discrete time, u and d held for ``dt``."""
    import control  # imports matplotlib: only paid for where it is used

    m, driven = B.shape[1], np.hstack([B, E])
    plant = control.ss(A, driven, np.eye(len(A)), np.zeros(driven.shape))
    with np.errstate(all="ignore"):
        sampled = control.sample_system(plant, dt, method="zoh")
    if not np.all(np.isfinite(np.hstack([sampled.A, sampled.B]))):
        raise ValueError(_why_not_sampled(A, dt))
    return sampled.A, sampled.B[:, :m], sampled.B[:, m:]


def _why_not_sampled(A: Array, dt: float) -> str:
    """Return why ``exp(A dt)`` and what follows from it are no finite numbers."""
    poles = np.linalg.eigvals(A)
    pole = poles[np.argmax(poles.real)]
    if pole.real * dt < LARGEST_EXPONENT:
        pole = poles[np.argmax(np.abs(poles))]
    if abs(pole) * dt <= 1:
        return (
            f"Sampled every dt = {dt:g}, the continuous model has entries that are too large for "
            "numbers. Give its states, inputs and disturbances other units."
        )
    shown = pole if pole.imag else pole.real
    return (
        f"The continuous model {'grows' if pole.real > 0 else 'decays'} too far within dt = {dt:g} "
        f"to be sampled: its pole {shown:g} times dt is {shown * dt:g}. Look at the unit of time, "
        f"sample about every {1 / abs(pole):.2g}, or leave the mode out of the model."
    )
