"""Linear models in discrete time, about an operating point."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import (
    Array,
    check_array,
    check_indices,
    check_positive,
    check_vector,
    to_float,
    warn,
)
from sb3_yann.control.gains import Gains
from sb3_yann.control.identification.fit import fit_log
from sb3_yann.control.linear_system import (
    LinearSystem,
    Units,
    as_names,
    as_unit,
    as_units,
    completed,
    names,
    with_units,
    zero_order_hold,
)
from sb3_yann.control.linearization import linearize_dynamics, linearize_env
from sb3_yann.control.model.report import describe
from sb3_yann.log import Arrays, Log

if TYPE_CHECKING:
    import gymnasium
    from typing_extensions import Self


@dataclass(frozen=True, eq=False, init=False, repr=False)
class LinearModel(LinearSystem):
    """The plant near an operating point: ``x[k+1] = A x[k] + B u[k] + E d[k]``, every ``dt``.

    ``x``, ``u`` and the disturbances ``d`` are deviations from the operating point
    ``(x_ss, u_ss, d_ss)``. Arrays are stored as read-only float64.

    Parameters
    ----------
    A, B, E : array_like, shapes (n, n), (n, m) and (n, d)
        Matrices in discrete time. The default of E is no disturbance, d = 0.
    dt : float
        Sampling time, in the time unit of the plant.
    x_ss, u_ss, d_ss : array_like, shapes (n,), (m,) and (d,), optional
        The operating point, zeros by default. Of x_ss and u_ss give both, or none.
    notes : sequence of str, optional
        Remarks on how the model was made. Equality ignores them, `dataclasses.replace` drops them.
    drift : array_like, shape (n,), optional
        Measured motion in one sample at the operating point, which the model leaves out. Zeros
        where it is within its uncertainty. Ignored and dropped as the notes are.
    gains : Gains, optional
        What held inputs do in the end, with errors, for the report. Ignored and dropped as the
        notes are.
    state_names, input_names, disturbance_names : sequence of str, optional
        Names for reports, n, m and at most d of them. Equality ignores them.
    units : mapping from name to str, or sequence of n + m str, optional
        Units of states and inputs, and after them of named disturbances, for reports.
    estimated : sequence of int, optional
        Disturbances, by their index, that no sensor measures: a :class:`DisturbanceObserver`
        estimates them. Equality ignores it, `dataclasses.replace` keeps it.
    C : array_like, shape (q, n), optional
        The outputs that sensors show, ``y = C x``. The default, None, is all states.
    time_unit : str, optional
        Of ``dt``, for reports and plots. Equality ignores it.

    Examples
    --------
    >>> from sb3_yann.control import LinearModel
    >>> model = LinearModel([[1, 0.1], [0, 1]], [[0], [0.1]], dt=0.1)
    >>> model.step([1, 0], [2])
    array([1. , 0.2])
    """

    notes: tuple[str, ...] = field(init=False, repr=False, compare=False)
    drift: Array = field(init=False, repr=False, compare=False)
    gains: Gains | None = field(init=False, repr=False, compare=False)

    def __init__(  # noqa: PLR0913 (the matrices of a plant and its operating point)
        self,
        A: ArrayLike,
        B: ArrayLike,
        dt: float,
        x_ss: ArrayLike | None = None,
        u_ss: ArrayLike | None = None,
        E: ArrayLike | None = None,
        d_ss: ArrayLike | None = None,
        *,
        notes: Sequence[str] = (),
        drift: ArrayLike | None = None,
        gains: Gains | None = None,
        state_names: Sequence[str] = (),
        input_names: Sequence[str] = (),
        disturbance_names: Sequence[str] = (),
        units: Units = (),
        estimated: Sequence[int] = (),
        C: ArrayLike | None = None,
        time_unit: str = "",
    ) -> None:
        A = check_array("A", A, ("n", "n"))
        n = A.shape[0]
        if n == 0 or A.shape[1] != n:
            raise ValueError(f"A has shape {A.shape}, expected a square matrix (n, n), n >= 1.")
        B = check_array("B", B, (n, "m"))
        if B.shape[1] == 0:
            raise ValueError(f"B has shape {B.shape}: the model needs at least one input.")
        E = check_array("E", np.zeros((n, 0)) if E is None else E, (n, "d"))
        if d_ss is not None and to_float("d_ss", d_ss).size and not E.size:
            raise ValueError(f"d_ss = {d_ss!r} is given, but there are no disturbances: pass E.")
        x = check_vector("x_ss", x_ss, n)
        u = check_vector("u_ss", u_ss, B.shape[1])
        d = check_vector("d_ss", d_ss, E.shape[1])
        if (x_ss is None) != (u_ss is None) and (np.any(x) or np.any(u)):
            given, other = ("u_ss", "x_ss") if x_ss is None else ("x_ss", "u_ss")
            rest = f"rests at x_ss = {x.tolist()} with u_ss = {u.tolist()}. Pass {other} too."
            warn(f"{given} is given without {other}, which counts as zero: the model {rest}")
        moved = check_vector("drift", drift, n)
        if gains is not None:
            check_array("gains.values", gains.values, B.shape)
        states = as_names("state_names", state_names, n)
        inputs = as_names("input_names", input_names, u.size)
        count = min(len(disturbance_names), d.size)  # those that offset_free adds come after them
        loads = as_names("disturbance_names", disturbance_names, count)
        known = [*(states or names((n,))), *(inputs or names((0, u.size))), *loads]
        if both := sorted({each for each in known if known.count(each) > 1}):
            raise ValueError(f"{both} name two signals: each needs a name of its own.")
        point = check_positive("dt", dt), x, u, E, d
        super().__init__(
            A,
            B,
            *point,
            notes=tuple(notes),
            drift=moved,
            gains=gains,
            state_names=states,
            input_names=inputs,
            disturbance_names=loads,
            units=as_units(units, known, n + u.size),
            estimated=check_indices("estimated", estimated, E.shape[1]),
            C=None if C is None else check_array("C", C, ("q", n)),
            time_unit=as_unit("time_unit", time_unit),
        )

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
        *,
        C: ArrayLike | None = None,
    ) -> LinearModel:
        """Sample ``dx/dt = A x + B u + E d`` exactly every ``dt``, with a zero-order hold.

        Parameters
        ----------
        A, B, dt, x_ss, u_ss, E, d_ss, C
            As of :class:`LinearModel`, with A, B and E in continuous time.

        Examples
        --------
        >>> LinearModel.from_continuous([[0, 1], [0, 0]], [[0], [1]], dt=0.5).B.tolist()
        [[0.125], [0.5]]
        """
        given = cls(A, B, dt, x_ss, u_ss, E, d_ss)
        A, B, E = zero_order_hold(given.A, given.B, given.E, given.dt)
        return cls(A, B, dt, x_ss, u_ss, E, d_ss, C=C)

    @classmethod
    def from_dynamics(
        cls,
        f: Callable[..., ArrayLike],
        x_ss: ArrayLike,
        u_ss: ArrayLike,
        dt: float,
        d_ss: ArrayLike | None = None,
        scale: ArrayLike | None = None,
    ) -> LinearModel:
        """Linearize ``dx/dt = f(x, u)`` or ``f(x, u, d)`` at a steady state, and sample it.

        Parameters
        ----------
        f : callable
            Takes x (n,) and u (m,), with ``d_ss`` also d (d,); returns dx/dt (n,).
        x_ss, u_ss, d_ss : array_like, shapes (n,), (m,) and (d,)
            The operating point, a steady state of ``f``; d_ss is optional. Entries of x_ss and u_ss
            that are NaN are solved for; the notes name other solutions that were met.
        dt : float
            Sampling time.
        scale : array_like, shape (n,) or (n + m + d,), or float, optional
            Range in which each state, or each state, input and disturbance, moves in use; steps are
            1 % of it. The default is the size of each, at least 1: too much for a trace.

        Raises
        ------
        ValueError
            If ``f`` returns another shape or NaN at the operating point, has a kink or a jump
            there, or the state moves by more than 0.1 % of ``scale`` within one sample. Also if no
            steady state is found.

        Examples
        --------
        >>> tank = LinearModel.from_dynamics(lambda x, u: u - x**0.5, [4], [np.nan], dt=1)
        >>> tank.u_ss.round(6).tolist(), tank.A.round(3).tolist()  # e^(-1/4)
        ([2.0], [[0.779]])
        """
        return cls(**vars(linearize_dynamics(f, x_ss, u_ss, dt, d_ss, scale)))

    @classmethod
    def from_env(
        cls,
        env: gymnasium.Env[Any, Any] | str | Callable[[], gymnasium.Env[Any, Any]],
        x_ss: ArrayLike | None = None,
        u_ss: ArrayLike | None = None,
        *,
        dt: float | None = None,
        set_state: Callable[[Any, Array], object] | None = None,
        get_state: Callable[[Any], ArrayLike] | None = None,
        scale: ArrayLike | None = None,
    ) -> LinearModel:
        """Linearize one step of a simulator and its wrappers by central differences.

        An environment is deep-copied. One that cannot be copied is used itself and needs a reset
        afterwards; the notes then say so. Noise of an adaptive integrator lengthens the steps. An
        env that terminates at a time limit is warned of.

        Parameters
        ----------
        env : gymnasium.Env, str or callable
            A single environment with a one-dimensional Box of actions, its id, or its maker.
        x_ss : array_like, shape (n,), optional
            The operating point in the environment's units. NaN entries are solved for; the default
            solves for all of them, starting from a reset.
        u_ss : array_like, shape (m,), optional
            Likewise. The default is the middle of the action space if ``x_ss`` is left out too.
        dt : float, optional
            Time of one step. The default is ``dt``, ``tau`` or ``DT`` of the unwrapped environment,
            or ``DT`` of its module. Pass it if a wrapper repeats actions.
        set_state : callable, optional
            ``set_state(env, x)`` puts the environment into the state x. The default is the first of
            ``env.reset(options={"state": x})``, ``env.unwrapped.state = x`` and MuJoCo's
            ``env.unwrapped.set_state(qpos, qvel)`` that works.
        get_state : callable, optional
            ``get_state(env)`` returns the state, shape (n,). The default is the first that works of
            ``info["state"]``, ``env.unwrapped.state``, MuJoCo's ``[qpos, qvel]`` and the
            observation.
        scale : array_like, shape (n,), or float, optional
            Range in which each state moves in use. Steps are at most 1 % of it, 5 % for float32
            states; a given steady state may be 1 % off. The default is half the width of the
            observation space, or the size of the state, at least 1.

        Raises
        ------
        TypeError, ValueError
            For vectorized environments, unknown ``dt``, a state that cannot be set, steps that do
            not repeat (noise, hidden states), no steady state, actions on a bound, kinks and jumps.

        Examples
        --------
        >>> pendulum = LinearModel.from_env("ClippedPendulum-v0")
        >>> pendulum.dt, pendulum.A.shape, pendulum.B.shape
        (0.05, (2, 2), (2, 1))
        """
        return cls(**vars(linearize_env(env, x_ss, u_ss, dt, set_state, get_state, scale)))

    @classmethod
    def from_data(
        cls,
        states: Arrays,
        actions: Arrays,
        *,
        dt: float,
        disturbances: Arrays | None = None,
        time: Arrays | None = None,
        **options: Any,
    ) -> LinearModel:
        """Return the least-squares model of measured episodes; :meth:`report` states the fit.

        Parameters
        ----------
        states, actions, dt, disturbances, time
            As of :meth:`sb3_yann.Log.from_arrays`.
        **options
            As of :func:`sb3_yann.identify`, which also returns standard errors.
        """
        log = Log.from_arrays(states, actions, dt, disturbances=disturbances, time=time)
        return cls(**vars(fit_log(log, **options)[0]))

    def step(self, x: ArrayLike, u: ArrayLike, d: ArrayLike | None = None) -> Array:
        """Return ``A x + B u + E d``; each is a vector or a batch of them, (batch, size)."""
        moved = np.asarray(x) @ self.A.T + np.asarray(u) @ self.B.T
        return moved if d is None else moved + np.asarray(d) @ self.E.T

    def named(
        self,
        state_names: Sequence[str] = (),
        input_names: Sequence[str] = (),
        units: Units = (),
        time_unit: str | None = None,
        disturbance_names: Sequence[str] = (),
    ) -> Self:
        """Return the model with names and units; notes and drift stay, as does a unit of time.

        Inputs on their way, the last states of a model with dead time, are named after the inputs
        where names and units are given of the others only.

        Parameters
        ----------
        state_names, input_names, disturbance_names : sequence of str
            One for each, or none.
        units : mapping of name to unit, or sequence of str
            Of states and inputs, and of named disturbances.
        time_unit : str, optional
            Of ``dt``, where it has none yet: ValueError for another one.
        """
        if len(disturbance_names):
            loads = type(self)(**{**vars(self), "disturbance_names": disturbance_names})
            return loads.named(state_names, input_names, units, time_unit)
        state_names, units = completed(self, state_names, input_names, units)
        given = {"state_names": state_names, "input_names": input_names, "units": units}
        if time_unit is not None:
            given["time_unit"] = time_unit
        found = type(self)(**{**vars(self), **given})
        if self.time_unit not in ("", found.time_unit):
            raise ValueError(
                f"time_unit = {time_unit!r}, but dt is {self.step_length}: another unit would need "
                "another dt. Make the model, or the Log it is identified from, with both of them."
            )
        return found

    def about_zero(self) -> Self:
        """Return the model without an operating point: what it describes are deviations."""
        return type(self)(**{**vars(self), "x_ss": None, "u_ss": None, "d_ss": None})

    def report(self) -> str:
        """Return an account in words: poles, controllability, scaling, sampling and notes."""
        return describe(self)

    def __hash__(self) -> int:
        return hash((self.A.tobytes(), self.B.tobytes(), self.dt, self.E.tobytes()))

    def __repr__(self) -> str:
        states, inputs, _ = with_units(self)
        sizes = f"states={states}, inputs={inputs}, disturbances={self.n_disturbances}"
        if self.estimated:
            sizes += f", estimated={[*self.estimated]}"
        point = f"x_ss={self.x_ss.tolist()}, u_ss={self.u_ss.tolist()}"
        return f"LinearModel({sizes}, dt={self.step_length}, {point})"
