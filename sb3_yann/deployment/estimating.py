"""The estimator of an exported controller as plain arrays, in plant units."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC, StateEstimator
from sb3_yann.units import ActionUnits

Estimator = StateEstimator | str | None


def estimator_arrays(
    problem: LinearMPC,
    estimator: StateEstimator,
    seen: list[str],
    seen_rest: Array,
    units: ActionUnits,
) -> dict[str, Any]:
    """Return the arrays of an estimator, and where each entry of what the policy sees comes from.

    A step of the filter is ``[A B E c] [x; u; d; 1]``, and a correction by ``gain (y - C x)``, both
    in plant units. Of what the policy sees, x and estimated disturbances come from the filter, the
    previous input is the controller's own, and the rest are readings, behind the outputs.

    Parameters
    ----------
    problem : LinearMPC
        What the law is of.
    estimator : StateEstimator
        Of the problem's model.
    seen : list of str
        Names of what the policy sees: theta, and what else there is.
    seen_rest : ndarray, shape (n_obs,)
        That at the operating point.
    units : ActionUnits
        How the controller puts inputs out.

    Raises
    ------
    ValueError
        For an estimator of another model.
    """
    model, layout = problem.model, problem.layout
    _require_same(model, estimator)
    q, size, n_known = estimator.n_measured, len(estimator.A), estimator.n_known
    estimated = [*range(n_known, model.n_disturbances)]
    x = np.concatenate([model.x_ss, model.d_ss[estimated]])
    y = estimator.C_aug @ x
    driven = np.concatenate([model.u_ss, model.d_ss[:n_known]])
    step = np.hstack([estimator.A, estimator.B, estimator.E])
    smallest = np.zeros((size, q))
    smallest[: model.n_states] = np.linalg.pinv(estimator.C)

    entries = np.arange(len(seen))
    in_d = np.arange(layout.disturbance.start, layout.disturbance.stop)
    first = in_d[len(in_d) - len(estimated) :]
    from_filter = np.concatenate([entries[layout.state], first])
    previous = entries[layout.previous]
    read = np.delete(entries, np.concatenate([from_filter, previous]))
    n_read = q + len(read)
    source = np.empty(len(seen), np.int64)
    source[read] = q + np.arange(len(read))
    source[from_filter] = n_read + np.arange(size)
    source[previous] = n_read + size + np.arange(len(previous))
    limits = np.full(model.n_states, np.inf)
    d_min, d_max = (getattr(problem.disturbances, side)[n_known:] for side in ("d_min", "d_max"))
    names = [*_output_names(estimator, seen), *(seen[i] for i in read)]
    scale = 1 / units.scale
    return {
        "est_next": _affine(step, np.concatenate([x, driven]), x),
        "est_rest": _affine(estimator.resting, np.concatenate([y, driven]), x),
        "est_first": _affine(smallest, y, x),
        "est_C": estimator.C_aug,
        "est_gain": estimator.gain,
        "est_input": np.array([scale, model.u_ss - units.shift * scale]),
        "est_loads": source[in_d[:n_known]],
        "est_box": np.array([[*-limits, *d_min], [*limits, *d_max]]),
        "source": source,
        "obs_names": np.array(names),
        "obs_rest": np.concatenate([y, seen_rest[read]]),
        "watched": np.arange(n_read) < q,
    }


def _affine(matrix: Array, given_ss: Array, found_ss: Array) -> Array:
    """Return ``[matrix, c]``: a map of deviations, for what counts from these operating points."""
    return np.column_stack([matrix, found_ss - matrix @ given_ss])


def _output_names(estimator: StateEstimator, seen: list[str]) -> list[str]:
    """Return names of the measured outputs: those of states that are shown as they are."""
    found = []
    for i, row in enumerate(estimator.C):
        at = np.flatnonzero(row)
        as_is = len(at) == 1 and row[at[0]] == 1
        found.append(seen[at[0]] if as_is else f"y[{i}]")
    return found


def _require_same(model: Any, estimator: StateEstimator) -> None:
    """Raise unless an estimator's model is that of the problem."""
    own = estimator.model
    pairs = [(getattr(own, key), getattr(model, key)) for key in ("A", "B", "E", "x_ss", "u_ss")]
    same = all(a.shape == b.shape and np.allclose(a, b) for a, b in pairs)
    if not same or estimator.n_estimated != len(model.estimated):
        raise ValueError(
            "The estimator is of another model than the problem: take found.estimator() of the "
            "model that the MPC has, or the observer that offset_free(mpc) returned with it."
        )
