"""The re-identified MPC as the weights of an actor: what the law of today adds to the given one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th

from sb3_yann._validation import Array
from sb3_yann.control import ExplicitLimitError, ExplicitSolutionError, LinearMPC, OnlineLaw
from sb3_yann.networks import RowAdam
from sb3_yann.networks.yann import LawLayer
from sb3_yann.twin.dynamics import law_of
from sb3_yann.twin.plant_twin import PlantTwin

LARGER = 10
"""How many times as many regions the law of today may have."""
STARTS, STEPS, BATCH, UPDATES, RATE = 60, 100, 512, 600, 1e-2


def law_today(twin: PlantTwin) -> Callable[[Array], Array] | None:
    """Return the law of the re-identified MPC, of theta and for inputs of the given problem.

    None where no linear model predicts better than the given one, or the new one has no MPC; nor
    with an observer, which would have to know the new model.
    """
    if twin.dynamics.row.observer is not None:
        return None
    try:
        today = twin.reidentified()
        if today is twin.problem:
            return None
        _choose_law(today, twin.problem)
    except (ValueError, ExplicitLimitError, ExplicitSolutionError):
        return None  # no steady state, no Riccati solution, too large, or too badly conditioned
    law, own, its = law_of(today), twin.problem.units, today.units

    def act(rows: Array) -> Array:
        u = law(its.to_deviations(own.to_plant(rows)))
        return own.input_to_deviations(its.input_to_plant(u))

    return act


def _choose_law(today: LinearMPC, before: LinearMPC) -> None:
    """Solve the law of today as that of before was; ExplicitLimitError if it is far larger."""
    law = before.law()
    if isinstance(law, OnlineLaw):
        today.law("online")
    else:
        today.explicit(region_limit=int(LARGER * law.n_regions))


def distill(layer: LawLayer, twin: PlantTwin, seed: int) -> bool:
    """Fit a layer to the re-identified MPC where that comes in the twin, if there is one.

    Return whether there is. Least squares on the inputs along its own runs, with Adam.
    """
    law = law_today(twin)
    if law is None:
        return False
    problem, rng = twin.problem, np.random.default_rng([seed, 3])
    members = len(twin.dynamics.members)
    starts = twin.starts.draw_anywhere(STARTS, rng)[None].repeat(members, axis=0)
    with np.errstate(all="ignore"):
        thetas, inputs = twin.dynamics.roll_out(law, starts, STEPS)
    rows = thetas[:-1].reshape(-1, problem.n_theta)
    fit_layer(layer, problem, rows, inputs.reshape(len(rows), -1), rng)
    return True


def fit_layer(
    layer: LawLayer,
    problem: LinearMPC,
    rows: Array,
    inputs: Array,
    rng: np.random.Generator,
    updates: int = UPDATES,
) -> None:
    """Fit a layer to inputs at theta: least squares on actions in [-1, 1], with Adam.

    Parameters
    ----------
    layer : LawLayer
        Its networks go on from where they are.
    problem : LinearMPC
        Whose theta and inputs they are.
    rows, inputs : ndarray, shapes (rows, n_theta) and (rows, m)
        Rows that are not finite are left out.
    rng : numpy.random.Generator
        Draws the batches.
    updates : int
        Steps of Adam.
    """
    wanted = (inputs - problem.deviations.u_min) / (
        problem.deviations.u_max - problem.deviations.u_min
    )
    wanted = np.clip(2 * wanted - 1, -1, 1)
    finite = np.isfinite(rows).all(axis=1) & np.isfinite(wanted).all(axis=1)
    at, to = th.as_tensor(rows[finite]), th.as_tensor(wanted[finite], dtype=th.float32)
    kind = RowAdam if layer.row_gradients else th.optim.Adam
    optimizer: Any = kind(layer.network.weights(), lr=RATE)
    for k in range(updates):
        optimizer.param_groups[0]["lr"] = RATE * (1 - k / updates)
        chosen = th.as_tensor(rng.integers(len(at), size=BATCH))
        optimizer.zero_grad()
        th.nn.functional.mse_loss(layer(at[chosen]), to[chosen]).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    optimizer.zero_grad()
