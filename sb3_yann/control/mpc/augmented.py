"""The same MPC with more in theta: estimated disturbances, or signals that its law ignores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import (
    Array,
    check_array,
    check_outputs,
    check_positive_vector,
    check_type,
)
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc.groups import DisturbanceBounds, Terminal
from sb3_yann.control.mpc.linear_mpc import LinearMPC
from sb3_yann.control.observer import DisturbanceObserver, StateEstimator

SHARE = 0.05
"""Of the half-widths of the box of states: what a disturbance moves in a sample, at most."""


def offset_free(
    mpc: LinearMPC,
    d_max: ArrayLike | None = None,
    measured: ArrayLike | Sequence[int] | None = None,
    every: int | Sequence[int] | None = None,
    estimator: StateEstimator | None = None,
) -> tuple[LinearMPC, DisturbanceObserver]:
    """Return the MPC with a disturbance of each measured state, and the observer that estimates it.

    Where the plant is not its model, the MPC settles beside its set-points. A constant disturbance
    in each state accounts for that: tracked outputs then settle without offset (Pannocchia and
    Rawlings, AIChE J. 49, 2003). They must be measured. The observer takes disturbances and errors
    of measurements for equally large, in half-widths of the box of states, but with ``estimator=``.

    Measured disturbances of the MPC stay, before the estimated ones: the observer takes them.

    Each estimate is one more entry of theta, and the explicit law has regions for all of its range:
    often a thousand with a large ``d_max``. Then :meth:`LinearMPC.law` and policies solve it
    online, with an :class:`OnlineLawWarning`: the same law, as fast to train on. Where it has to be
    explicit, call :meth:`LinearMPC.explicit` first, or shorten the horizon.

    Parameters
    ----------
    mpc : LinearMPC
        Without estimated disturbances of its own.
    d_max : array_like, shape (q,), optional
        Largest disturbance, in units of the measured states per sample. The default is 5 % of their
        half-widths in the box of states.
    measured : array_like, shape (q, n), or list of int, optional
        The measured outputs, or the indices of the measured states. The default is the model's C.
        The disturbances then act on these.
    every : int or sequence of int, optional
        Each output is read every so many samples, as of :class:`StateEstimator`. An ``estimator``
        has its own.
    estimator : StateEstimator, optional
        Such as ``found.estimator()`` of `identify_outputs`. Its noise, and its ``every``, are the
        observer's, and a disturbance drifts slowly beside it: smoother where outputs are noisy.

    Raises
    ------
    TypeError, ValueError
        If the MPC has estimated disturbances already, tracks what is not measured, the estimator is
        of another model, or the measurements do not tell the disturbances.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from sb3_yann.wrappers import ObserveDisturbance
    >>> mpc = gym.make("CSTR-v0").observation_space.problem
    >>> mpc, observer = offset_free(mpc)
    >>> bounds = mpc.disturbances.d_min, mpc.disturbances.d_max
    >>> env = ObserveDisturbance(gym.make("CSTR-v0"), observer, *bounds)
    >>> env.observation_space.shape
    (8,)
    """
    check_type("mpc", mpc, LinearMPC, "a LinearMPC")
    old = mpc.model
    if old.estimated:
        raise ValueError(
            f"The MPC has {len(old.estimated)} estimated disturbances already: their observer is "
            "DisturbanceObserver(mpc.model)."
        )
    C = old.shown if measured is None else check_outputs("measured", measured, old.n_states)
    q = len(C)
    tracked = mpc.tracking.C
    if np.any(np.abs(tracked - tracked @ np.linalg.pinv(C) @ C) > 1e-9 * (1 + np.abs(tracked))):
        raise ValueError(
            "A tracked output is no combination of the measured ones: its offset is not known. "
            "Measure what is tracked."
        )
    unit = mpc.theta_half[mpc.layout.state]
    shown = np.abs(C) @ unit
    largest = SHARE * shown if d_max is None else d_max
    bound = check_positive_vector("d_max", largest, q, "In units of the measured states.")
    known = mpc.disturbances
    of_both = old.n_disturbances + q
    own: dict[str, Any] = {
        "E": np.hstack([old.E, np.linalg.pinv(C)]),
        "d_ss": np.concatenate([old.d_ss, np.zeros(q)]),
        "estimated": range(old.n_disturbances, of_both),
        "drift": None,  # the disturbance makes up for it
    }
    F, g = mpc.terminal.set
    same = (np.insert(F, [mpc.layout.disturbance.stop] * q, 0.0, axis=-1), g) if len(g) else None
    anew = mpc.terminal.is_invariant and len(g)
    terminal = Terminal(mpc.terminal.cost, "invariant" if anew else same)
    both = np.append(known.d_min, -bound), np.append(known.d_max, bound)
    found = _changed(mpc, own, DisturbanceBounds(*both, known.preview), terminal)
    noise = {"state_noise": unit, "disturbance_noise": shown, "measurement_noise": shown}
    if estimator is not None:
        check_type("estimator", estimator, StateEstimator, "a StateEstimator: found.estimator()")
        estimator.require_model(old, ("A", "B", "x_ss", "u_ss"))
        if not np.array_equal(estimator.C, C):
            raise ValueError(f"estimator reads {estimator.C.tolist()} x, measured is {C.tolist()}.")
        rates = estimator.every.tolist()
        if every is not None:
            raise ValueError(f"every = {every}, but the estimator has {rates}: leave every out.")
        every = rates
        # 0.03: a disturbance's step from sample to sample, in the noise of its reading
        drifts = 0.03 * np.sqrt(np.diag(estimator.noise["measurement_noise"]))
        noise = {**estimator.noise, "disturbance_noise": drifts}
    return found, DisturbanceObserver(found.model, C, every=1 if every is None else every, **noise)


def _changed(
    mpc: LinearMPC, own: dict[str, Any], disturbances: DisturbanceBounds, terminal: Terminal
) -> LinearMPC:
    """Return the MPC with other disturbances, which its model has by its ``own`` arguments."""
    states = mpc.layout.state
    return replace(
        mpc,
        model=LinearModel(**{**vars(mpc.model), **own}),
        disturbances=disturbances,
        terminal=terminal,
        theta_min=mpc.theta_min[states],
        theta_max=mpc.theta_max[states],
    )


def with_extra(mpc: LinearMPC, low: ArrayLike, high: ArrayLike) -> LinearMPC:
    """Return the same MPC with signals in theta that its law and its value ignore.

    An ambient temperature, an analyser, a feed that the model leaves out: networks see them, and
    twins and `improve` learn what they do. They are measured disturbances with a zero column of E,
    and come last of those: before estimated ones. They may lie beyond their bounds, where an
    exported controller acts as ever and its status says OUTSIDE.

    Parameters
    ----------
    mpc : LinearMPC
        Without a preview of disturbances.
    low, high : array_like, shape (k,), or float
        Where the signals lie: networks take them in half-widths of it.

    Raises
    ------
    ValueError
        If a bound is not finite, ``low`` is not below ``high``, or disturbances have a preview.

    Examples
    --------
    >>> cart = LinearModel([[1, 1], [0, 1]], [[0], [1]], dt=1.0)
    >>> mpc = LinearMPC(cart, Q=np.eye(2), R=[[1]], horizon=2, x_min=-5, x_max=5, u_min=-1, u_max=1)
    >>> aware = with_extra(mpc, low=280, high=310)
    >>> aware.layout.names, aware.explicit().plant_input([-5.0, 0.0, 300.0])
    (('x[0]', 'x[1]', 'd[0]'), array([1.]))
    """
    check_type("mpc", mpc, LinearMPC, "a LinearMPC")
    bottom = check_array("low", np.atleast_1d(low), ("k",))
    top = check_array("high", np.atleast_1d(high), (len(bottom),))
    if not np.all(bottom < top):
        raise ValueError(f"low = {bottom.tolist()} must lie below high = {top.tolist()}.")
    old = mpc.model
    known = mpc.disturbances
    k = len(bottom)
    if known.preview:
        raise ValueError(
            f"Disturbances have a preview of {known.preview} samples, extra signals have none: "
            "pass those as disturbances of the model, with columns of zeros in E."
        )
    first = min(old.estimated, default=old.n_disturbances)

    def inserted(values: Array, more: Array, at: int = first) -> Array:
        return np.insert(values, [at] * k, more, axis=-1)

    own = {
        "E": inserted(old.E, np.zeros(k)),
        "d_ss": inserted(old.d_ss, (bottom + top) / 2),
        "estimated": [i + k for i in old.estimated],
    }
    F, g = mpc.terminal.set
    start = mpc.layout.disturbance.start + first
    disturbances = DisturbanceBounds(inserted(known.d_min, bottom), inserted(known.d_max, top))
    terminal = Terminal(mpc.terminal.cost, (inserted(F, np.zeros(k), start), g))
    vars(terminal)["is_invariant"] = mpc.terminal.is_invariant
    found = _changed(mpc, own, disturbances, terminal)
    found.take_laws(mpc)
    return found
