"""Linear models in discrete time, about an operating point."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import (
    Array,
    ReadOnlyArrays,
    as_array,
    as_positive,
    same_fields,
)

if TYPE_CHECKING:
    import gymnasium


@dataclass(frozen=True, eq=False, init=False)
class LinearModel(ReadOnlyArrays):
    """The plant near an operating point: ``x[k+1] = A x[k] + B u[k] + E d[k]``, every ``dt``.

    ``x``, ``u`` and the measured disturbances ``d`` are deviations from the operating point
    ``(x_ss, u_ss, d_ss)``. Arrays are stored as read-only float64. :meth:`report` says in words
    what the matrices mean.

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
        Disturbance matrix in discrete time; without it there are no disturbances, d = 0.
    d_ss : array_like, shape (d,), optional
        Disturbances at the operating point, zeros if left out.

    Attributes
    ----------
    notes : tuple of str
        What is to be known of how the model was made: what was found, dropped, or doubtful. They
        are no part of equality, and `dataclasses.replace` drops them with the old matrices.
    drift : ndarray, shape (n,)
        How far the plant was found to move in one sample at the operating point, by more than the
        doubt about it; the model leaves that out. Kept and dropped as the notes are.

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
    d_ss: Array
    notes: tuple[str, ...] = field(init=False, repr=False)
    drift: Array = field(init=False, repr=False)

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        dt: float,
        x_ss: ArrayLike | None = None,
        u_ss: ArrayLike | None = None,
        E: ArrayLike | None = None,
        d_ss: ArrayLike | None = None,
    ) -> None:
        state = as_array("A", A, ("n", "n"))
        n = state.shape[0]
        if n == 0 or state.shape[1] != n:
            raise ValueError(f"A has shape {state.shape}, expected a square matrix (n, n), n >= 1.")
        inputs = as_array("B", B, (n, "m"))
        m = inputs.shape[1]
        if m == 0:
            raise ValueError(f"B has shape {inputs.shape}: the model needs at least one input.")
        disturbances = as_array("E", np.zeros((n, 0)) if E is None else E, (n, "d"))
        d = disturbances.shape[1]
        if d_ss is not None and np.size(d_ss) and not d:
            raise ValueError(
                f"d_ss = {d_ss!r} is given, but there are no disturbances: pass E too."
            )
        values = {
            "A": state,
            "B": inputs,
            "dt": as_positive("dt", dt),
            "x_ss": as_array("x_ss", np.zeros(n) if x_ss is None else x_ss, (n,)),
            "u_ss": as_array("u_ss", np.zeros(m) if u_ss is None else u_ss, (m,)),
            "E": disturbances,
            "d_ss": as_array("d_ss", np.zeros(d) if d_ss is None else d_ss, (d,)),
            "notes": (),
            "drift": as_array("drift", np.zeros(n), (n,)),
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
        E: ArrayLike | None = None,
        d_ss: ArrayLike | None = None,
    ) -> LinearModel:
        """Sample ``dx/dt = A x + B u + E d`` every ``dt``, with u and d held constant in between.

        The discretization is exact (matrix exponential, `control.sample_system`).
        """
        import control  # brings matplotlib in: only paid for where it is used

        checked = cls(A, B, dt, x_ss, u_ss, E, d_ss)
        n, m = checked.B.shape
        driven = np.hstack([checked.B, checked.E])
        plant = control.ss(checked.A, driven, np.eye(n), np.zeros(driven.shape))
        sampled = control.sample_system(plant, checked.dt, method="zoh")
        return cls(sampled.A, sampled.B[:, :m], dt, x_ss, u_ss, sampled.B[:, m:], d_ss)

    @staticmethod
    def from_dynamics(
        f: Callable[..., ArrayLike],
        x_ss: ArrayLike,
        u_ss: ArrayLike,
        dt: float,
        d_ss: ArrayLike | None = None,
        scale: ArrayLike | None = None,
    ) -> LinearModel:
        """Linearize ``dx/dt = f(x, u)``, or ``f(x, u, d)``, at a steady state; sample it every dt.

        The Jacobian comes from central differences that check themselves, the sampling from
        :meth:`from_continuous`.

        Parameters
        ----------
        f : callable
            Takes x of shape (n,) and u of shape (m,), with ``d_ss`` also d of shape (d,); returns
            dx/dt of shape (n,).
        x_ss, u_ss : array_like, shapes (n,) and (m,)
            The operating point, a steady state of ``f``.
        dt : float
            Sampling time.
        d_ss : array_like, shape (d,), optional
            Measured disturbances at the operating point.
        scale : array_like, shape (n,) or (n + m + d,), optional
            How far each state moves in use, or each state, input and disturbance: sets the step
            sizes (1 % of it) and how far the operating point may move. The default is the size
            of each, at least 1: for trace concentrations give their own.

        Raises
        ------
        ValueError
            If ``f`` returns another shape or NaN at the operating point, has a kink or a jump
            there, or the operating point moves by more than 0.1 % of ``scale`` within one sample.
        """
        from sb3_yann.control.linearization.linearize import linearize_dynamics

        return linearize_dynamics(f, x_ss, u_ss, dt, d_ss, scale)

    @staticmethod
    def from_env(
        env: gymnasium.Env[Any, Any] | str | Callable[[], gymnasium.Env[Any, Any]],
        state: ArrayLike | None = None,
        action: ArrayLike | None = None,
        *,
        dt: float | None = None,
        set_state: Callable[[Any, Array], object] | None = None,
        get_state: Callable[[Any], ArrayLike] | None = None,
        scale: ArrayLike | None = None,
    ) -> LinearModel:
        """Linearize one step of a simulator, wrappers and all, by central differences.

        An id or a function makes an environment of its own, closed in the end. An environment is
        deep-copied and left as it is; one that cannot be copied is used itself, without a seed, and
        needs a reset afterwards, which the notes then say.

        Parameters
        ----------
        env : gymnasium.Env, str or callable
            A single environment with a one-dimensional Box of actions, its id, or its maker.
        state : array_like, shape (n,), optional
            The operating point, as the environment has it. NaN entries are solved for; all are if
            it is left out, from the state of a reset on.
        action : array_like, shape (m,), optional
            Likewise; the middle of the action space if both are left out.
        dt : float, optional
            Time of one step. The default is ``dt``, ``tau`` or ``DT`` of the unwrapped environment,
            or ``DT`` of its module, never ``render_fps``. Pass it if a wrapper repeats actions.
        set_state : callable, optional
            ``set_state(env, x)`` puts the environment into the state x. The default tries
            ``env.reset(options={"state": x})``, then ``env.unwrapped.state = x``, and takes the
            first that is seen to work.
        get_state : callable, optional
            ``get_state(env)`` returns the state, shape (n,). The default takes the first of
            ``info["state"]``, ``env.unwrapped.state`` and the observation that is what was set.
        scale : array_like, shape (n,), optional
            How far each state moves in use: sets the step sizes (at most 1 % of it, 5 % where
            states are float32) and how far off a given steady state may be (1 %). The default is
            half the width of the observation space, or the size of the state, at least 1.

        Raises
        ------
        TypeError
            For vectorized environments and other than Box actions.
        ValueError
            If ``dt`` is not found, the environment cannot be put into a state, a step is not
            repeatable (noise, hidden states), no steady state is found or the given one is none,
            the action lies on its bound, or the plant has a kink or a jump at the point.
        """
        from sb3_yann.control.linearization.linearize import linearize_env

        return linearize_env(env, state, action, dt, set_state, get_state, scale)

    @staticmethod
    def from_data(
        states: ArrayLike | Sequence[ArrayLike],
        actions: ArrayLike | Sequence[ArrayLike],
        *,
        dt: float,
        **options: Any,
    ) -> LinearModel:
        """Return the model that fits measured episodes best, by least squares.

        The short form of :func:`sb3_yann.control.identify`, which takes the same options and
        returns the standard errors and fits too. :meth:`report` tells the fit.
        """
        from sb3_yann.control.identification.identify import identify

        return identify(states, actions, dt=dt, **options).model

    @staticmethod
    def from_statespace(
        system: Any,
        dt: float | None = None,
        x_ss: ArrayLike | None = None,
        u_ss: ArrayLike | None = None,
        *,
        disturbances: Sequence[int | str] = (),
        d_ss: ArrayLike | None = None,
    ) -> LinearModel:
        """Take over a `control.StateSpace`: a discrete one as it is, a continuous one sampled.

        The states are kept, since they are what the law depends on; the outputs are not. Where
        they are not the states (C is not the identity, D not zero), the notes say so, and whether
        an observer could find the states from them.

        Parameters
        ----------
        system : control.StateSpace
            A, B, C, D, in deviations from the operating point.
        dt : float, optional
            Sampling time. Needed unless the system has one.
        x_ss, u_ss, d_ss : array_like, shapes (n,), (m,) and (d,), optional
            The operating point.
        disturbances : sequence of int or str, optional
            Inputs of the system, by number or label, that are measured disturbances: they make E.

        Raises
        ------
        TypeError, ValueError
            If it is no state space, its time base is not stated, ``dt`` is missing or not that
            of the system, or there is no such input.
        """
        from sb3_yann.control.model.statespace import take_statespace

        return take_statespace(system, dt, x_ss, u_ss, disturbances, d_ss)

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
        """Number of measured disturbances d."""
        return int(self.E.shape[1])

    def step(self, x: ArrayLike, u: ArrayLike, d: ArrayLike | None = None) -> Array:
        """Return ``A x + B u + E d``; each is a vector or a batch of them, (batch, size)."""
        moved = np.asarray(x) @ self.A.T + np.asarray(u) @ self.B.T
        return moved if d is None else moved + np.asarray(d) @ self.E.T

    def report(self) -> str:
        """Return a readable account: poles, reach of the inputs, scaling, sampling, notes."""
        from sb3_yann.control.model.report import describe

        return describe(self)

    def with_notes(self, *notes: str) -> LinearModel:
        """Return an equal model with these notes after its own."""
        noted = copy.copy(self)
        object.__setattr__(noted, "notes", (*self.notes, *notes))
        return noted

    def with_drift(self, drift: ArrayLike) -> LinearModel:
        """Return an equal model that is known to leave out this drift (n,)."""
        known = copy.copy(self)
        object.__setattr__(known, "drift", as_array("drift", drift, (self.n_states,)))
        return known

    def __eq__(self, other: object) -> bool:
        """Tell whether all matrices, the sampling time and the operating point are equal."""
        if not isinstance(other, LinearModel):
            return NotImplemented
        return same_fields(self, other, ("A", "B", "dt", "x_ss", "u_ss", "E", "d_ss"))

    def __hash__(self) -> int:
        """Return a hash that equal models share."""
        return hash((self.A.tobytes(), self.B.tobytes(), self.dt, self.E.tobytes()))
