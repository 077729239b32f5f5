"""The same MPC with a model of what the plant is today."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import LinearModel, LinearMPC, Terminal
from sb3_yann.control.mpc.coordinates import steady_states
from sb3_yann.twin.dynamics import Coordinates
from sb3_yann.twin.log import Episode, pieces
from sb3_yann.twin.selection import FOLDS, candidates, held_out, ridge


def reidentified(
    problem: LinearMPC, coordinates: Coordinates, log: tuple[Episode, ...]
) -> LinearMPC:
    """Return the MPC of a model that is shrunk towards the given one; see `PlantTwin.reidentified`.

    Parameters
    ----------
    problem, coordinates, log : LinearMPC, Coordinates and tuple of Episode
        Of a twin; two episodes at least.
    """
    parts = pieces(log, FOLDS)
    choices = candidates(coordinates, parts, ["linear"])
    choice = choices[held_out(coordinates, parts, choices).choose()]
    if choice.setting is None:
        return problem
    (residual,) = ridge(coordinates, log, [choice.setting])
    middle, model = np.zeros((1, len(coordinates.scale))), problem.model
    n, m, d = model.n_states, model.n_inputs, len(middle[0]) - model.n_states - model.n_inputs
    slopes = residual.jacobian(middle)[0] / coordinates.scale
    A, E, B = np.split(slopes, [n, n + d], axis=1)
    A, B, E = model.A + A, model.B + B, model.E + (E if d else 0.0)
    x: Array = np.zeros(n)
    u: Array = np.zeros(m)
    if problem.layout.has_constants:  # else the residual has no constant term
        x, u = _rest(problem, A, B, residual.predict(middle)[0])
    note = f"Re-identified from {len(log)} episodes: {choice.name}."
    own = {"A": A, "B": B, "E": E, "x_ss": model.x_ss + x, "u_ss": model.u_ss + u}
    own |= {"notes": [*model.notes, note], "drift": None}
    found = LinearModel(**{**vars(model), **own})
    terminal = Terminal(set="invariant" if len(problem.terminal.set[1]) else None)
    return replace(problem, model=found, terminal=terminal)


def _rest(problem: LinearMPC, A: Array, B: Array, drift: Array) -> tuple[Array, Array]:
    """Return the state (n,) and the input (m,) that rest despite the drift (n,), with ``C x = 0``.

    The drift acts as a constant disturbance does.
    """
    drifting = LinearModel(A, B, problem.model.dt, E=drift[:, None])
    x_unit = problem.theta_half[problem.layout.state]
    weights = problem.Q, problem.R, x_unit, problem.u_half
    found = steady_states(drifting, problem.tracking.C, *weights)
    return found.x[:, -1], found.u[:, -1]
