"""Signals that a problem's theta holds and its law ignores: only networks learn from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, check_array, check_type
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc.groups import DisturbanceBounds, Terminal
from sb3_yann.control.mpc.linear_mpc import LinearMPC


def with_extra(mpc: LinearMPC, low: ArrayLike, high: ArrayLike) -> LinearMPC:
    """Return the same MPC with signals in theta that its law and its value ignore.

    An ambient temperature, an analyser, a feed that the model leaves out: networks see them, and
    twins and `improve` learn what they do. They are measured disturbances with a zero column of E,
    and come last of those: before estimated ones. They may lie beyond their bounds.

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
    old, known, k = mpc.model, mpc.disturbances, len(bottom)
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
    start, states = mpc.layout.disturbance.start + first, mpc.layout.state
    found = replace(
        mpc,
        model=LinearModel(**{**vars(old), **own}),
        disturbances=DisturbanceBounds(inserted(known.d_min, bottom), inserted(known.d_max, top)),
        terminal=Terminal(mpc.terminal.cost, (inserted(F, np.zeros(k), start), g)),
        theta_min=mpc.theta_min[states],
        theta_max=mpc.theta_max[states],
    )
    found.take_laws(mpc)
    return found
