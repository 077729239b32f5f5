"""Matrices in discrete time from a state space of python-control."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_yann._validation import Array, check_array, check_positive
from sb3_yann.control.linear_system import LinearSystem, names, zero_order_hold
from sb3_yann.control.model.labels import labels_of


def from_control(
    system: Any, dt: float | None, disturbances: Sequence[int | str]
) -> tuple[Array, Array, Array, Array | None, float, list[str]]:
    """Return A, B, E, C, the sampling time and notes; see `LinearModel.from_statespace`."""
    import control

    if not isinstance(system, control.StateSpace):
        raise TypeError(
            f"system = {system!r} must be a control.StateSpace. Convert a transfer function with "
            "control.ss(...), but mind that its states then are no measured quantities."
        )
    step, continuous = _sample_time(system.dt, dt)
    chosen = [_input(system, each) for each in disturbances]
    inputs = [i for i in range(system.ninputs) if i not in chosen]
    A, both = check_array("A", system.A, ("n", "n")), check_array("B", system.B, ("n", "m"))
    B, E = both[:, inputs], both[:, chosen]
    if continuous:
        A, B, E = zero_order_hold(A, B, E, step)
    sampled = "sampled with a zero-order hold" if continuous else "taken as it is, discrete"
    notes = [f"From a control.StateSpace, {sampled}.", *_output_notes(system, A)]
    C = None if np.array_equal(system.C, np.eye(len(A))) else check_array("C", system.C, ("q", "n"))
    return A, B, E, C, step, notes


def to_control(model: LinearSystem) -> Any:
    """Return the `control.StateSpace` of `LinearModel.to_statespace`."""
    import control

    states, inputs = labels_of(model)
    driven = np.hstack([model.B, model.E])
    labels = [*inputs, *names((0, 0, model.n_disturbances))]
    plain = {
        "states": [_label(each) for each in states],
        "inputs": [_label(each) for each in labels],
    }
    C = model.shown
    if model.C is None:
        plain["outputs"] = plain["states"]
    D = np.zeros((len(C), driven.shape[1]))
    return control.ss(model.A, driven, C, D, model.dt, **plain)


def _label(name: str) -> str:
    """Return a name that python-control takes: it forbids dots."""
    return name.replace(".", "_")


def _sample_time(own: float | bool | None, dt: float | None) -> tuple[float, bool]:
    """Return the sampling time, and whether the system is continuous.

    python-control's 0 is continuous, True discrete without a sampling time, None not stated.
    """
    if own is None:
        raise ValueError(
            "system.dt is None: continuous or discrete? Make it with control.ss(A, B, C, D, 0) or "
            "control.ss(A, B, C, D, dt)."
        )
    given = None if dt is None else check_positive("dt", dt)
    if own is not True and own > 0:
        if given is not None and not np.isclose(given, own, rtol=1e-9, atol=0):
            raise ValueError(
                f"dt = {given:g}, but the system is discrete with dt = {own:g}, and is not sampled "
                "anew. Leave dt out, or pass the continuous system."
            )
        return float(own), False
    if given is None:
        kind = "discrete, without a sampling time" if own is True else "continuous"
        raise ValueError(f"dt is not given, and the system is {kind}. Pass dt=...")
    return given, own is not True


def _input(system: Any, name: int | str) -> int:
    """Return the number of an input."""
    labels = list(system.input_labels)
    if isinstance(name, str) and name in labels:
        return int(labels.index(name))
    if isinstance(name, (int, np.integer)) and 0 <= name < len(labels):
        return int(name)
    raise ValueError(f"disturbances: {name!r} is no input, neither number nor label, of {labels}.")


def _output_notes(system: Any, A: Array) -> list[str]:
    """Return notes on outputs that are not the states."""
    import control

    C, n = np.asarray(system.C), len(A)
    notes = []
    if np.any(system.D):
        notes.append("D is not zero and was dropped: the outputs it feeds are not used.")
    if np.array_equal(C, np.eye(n)):
        return notes
    rank = int(np.linalg.matrix_rank(control.obsv(A, C)))
    seen = f", which is not possible: the outputs show {rank} of {n} directions of the state"
    impossible = seen if rank < n else ""
    notes.append(
        "C is not the identity: the law depends on the states, not on the outputs y = C x. "
        f"Estimate them by a StateEstimator{impossible}."
    )
    return notes
