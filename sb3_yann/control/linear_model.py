"""Linear models in discrete time, about an operating point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann.control._validation import (
    Array,
    ReadOnlyArrays,
    as_array,
    as_positive,
    same_fields,
)


@dataclass(frozen=True, eq=False, init=False)
class LinearModel(ReadOnlyArrays):
    """The plant near an operating point: ``x[k+1] = A x[k] + B u[k] + E d[k]``, every ``dt``.

    ``x`` and ``u`` are deviations from the operating point ``(x_ss, u_ss)``, the disturbance ``d``
    is one from its value there. Arrays are stored as read-only float64.

    Parameters
    ----------
    A : array_like, shape (n, n)
        State matrix in discrete time.
    B : array_like, shape (n, m)
        Input matrix in discrete time.
    dt : float
        Sampling time, in the time unit of the plant.
    x_ss : array_like, shape (n,), optional
        State at the operating point, zeros if left out.
    u_ss : array_like, shape (m,), optional
        Input at the operating point, zeros if left out.
    E : array_like, shape (n, d), optional
        Disturbance matrix in discrete time; no disturbance, shape (n, 0), if left out.

    Raises
    ------
    TypeError, ValueError
        If a matrix has the wrong shape or holds NaN, or ``dt`` is not above zero.
    """

    A: Array
    B: Array
    dt: float
    x_ss: Array
    u_ss: Array
    E: Array

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        dt: float,
        x_ss: ArrayLike | None = None,
        u_ss: ArrayLike | None = None,
        *,
        E: ArrayLike | None = None,
    ) -> None:
        state = as_array("A", A, ("n", "n"))
        n = state.shape[0]
        if n == 0 or state.shape[1] != n:
            raise ValueError(f"A has shape {state.shape}, expected a square matrix (n, n), n >= 1.")
        inputs = as_array("B", B, (n, "m"))
        m = inputs.shape[1]
        if m == 0:
            raise ValueError(f"B has shape {inputs.shape}: the model needs at least one input.")
        values = {
            "A": state,
            "B": inputs,
            "dt": as_positive("dt", dt),
            "x_ss": as_array("x_ss", np.zeros(n) if x_ss is None else x_ss, (n,)),
            "u_ss": as_array("u_ss", np.zeros(m) if u_ss is None else u_ss, (m,)),
            "E": as_array("E", np.zeros((n, 0)) if E is None else E, (n, "d")),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_continuous(
        cls,
        A: ArrayLike,
        B: ArrayLike,
        dt: float,
        x_ss: ArrayLike | None = None,
        u_ss: ArrayLike | None = None,
    ) -> LinearModel:
        """Sample ``dx/dt = A x + B u`` every ``dt`` under an input held constant in between.

        The discretisation is exact (matrix exponential, `control.sample_system`).
        """
        import control  # brings matplotlib in: only paid for where it is used

        checked = cls(A, B, dt, x_ss, u_ss)
        n, m = checked.B.shape
        plant = control.ss(checked.A, checked.B, np.eye(n), np.zeros((n, m)))
        sampled = control.sample_system(plant, checked.dt, method="zoh")
        return cls(sampled.A, sampled.B, dt, x_ss, u_ss)

    @classmethod
    def from_dynamics(
        cls,
        f: Callable[[Array, Array], ArrayLike],
        x_ss: ArrayLike,
        u_ss: ArrayLike,
        dt: float,
    ) -> LinearModel:
        """Linearise ``dx/dt = f(x, u)`` at a steady state and sample it every ``dt``.

        The Jacobian comes from `control.linearize`, the sampling from :meth:`from_continuous`.

        Parameters
        ----------
        f : callable
            Takes x of shape (n,) and u of shape (m,), returns dx/dt of shape (n,).
        x_ss, u_ss : array_like, shapes (n,) and (m,)
            The operating point, a steady state of ``f``.
        dt : float
            Sampling time.

        Raises
        ------
        ValueError
            If ``f`` returns another shape or NaN at the operating point, or the operating point
            moves by more than 0.1 % (of 1, where it is smaller) within one sample.
        """
        import control

        x = as_array("x_ss", x_ss, ("n",))
        u = as_array("u_ss", u_ss, ("m",))
        dt = as_positive("dt", dt)
        if not callable(f):
            raise TypeError(f"f = {f!r} must be a function (x, u) -> dx/dt.")
        drift = dt * np.abs(as_array("f(x_ss, u_ss)", f(x, u), (x.size,)))
        if np.any(drift > 1e-3 * np.maximum(np.abs(x), 1)):
            raise ValueError(
                f"x_ss = {x.tolist()}, u_ss = {u.tolist()} is no steady state: within one sample "
                f"of {dt:g} the state would move by {drift.tolist()}. Solve f(x, u) = 0 first, "
                "e.g. with scipy.optimize.root."
            )
        plant = control.nlsys(
            lambda t, x, u, params: np.asarray(f(x, u), dtype=np.float64),
            inputs=u.size,
            states=x.size,
            outputs=x.size,
        )
        jacobian = control.linearize(plant, x, u)
        return cls.from_continuous(jacobian.A, jacobian.B, dt, x, u)

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
        """Number of disturbances d."""
        return int(self.E.shape[1])

    def step(self, x: ArrayLike, u: ArrayLike, d: ArrayLike | None = None) -> Array:
        """Return ``A x + B u + E d``; each is a vector or a batch of rows, d zeros if left out."""
        following = np.asarray(x) @ self.A.T + np.asarray(u) @ self.B.T
        return following if d is None else following + np.asarray(d) @ self.E.T

    def __eq__(self, other: object) -> bool:
        """Tell whether all matrices, the sampling time and the operating point are equal."""
        if not isinstance(other, LinearModel):
            return NotImplemented
        return same_fields(self, other, ("A", "B", "dt", "x_ss", "u_ss", "E"))

    def __hash__(self) -> int:
        """Return a hash that equal models share."""
        return hash((self.A.tobytes(), self.B.tobytes(), self.E.tobytes(), self.dt))
