"""Whether a plant was seen to rest beside its references, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.model.labels import with_units

CURE = (
    "mpc, observer = offset_free(mpc), and env = ObserveDisturbance(env, observer, "
    "mpc.disturbances.d_min, mpc.disturbances.d_max)."
)
SHORTEST, LAST = 15, 1 / 3
"""Steps that a reference must hold at least, and the part of them that counts, the last."""
FEWEST = 2
"""Times that it must have come to rest."""
LEAST = 0.01
"""An offset that counts, in half-widths of the references."""
AT_REST = 0.2
"""How far outputs may still move in that part, relative to their offset."""
WORSE = 0.005
"""Of the MPC's cost: an observer that costs so much more is not advised."""
SURE = 3.0
"""Standard deviations within that part that an offset exceeds."""


class Rests(NamedTuple):
    """Where outputs came to rest beside their references.

    Attributes
    ----------
    times : int
        How often.
    beside : ndarray, shape (p,)
        By how much on average, beyond `LEAST` for one of them at least.
    worst : int
        Which is farthest, in half-widths.
    """

    times: int
    beside: Array
    worst: int


def rests_beside(problem: LinearMPC, theta: Array, begins: NDArray[np.bool_]) -> Rests | None:
    """Return where outputs rest beside references that hold, None where none does.

    Without references these are the states that Q weighs, beside their operating point.

    Parameters
    ----------
    problem : LinearMPC
        Whose theta it is.
    theta : ndarray, shape (steps, n_theta)
        Episode after episode.
    begins : ndarray of bool, shape (steps,)
        Where one begins.
    """
    if problem.price.counts:  # it means to rest elsewhere
        return None
    C, unit = _outputs(problem), problem.theta_half
    references = problem.layout.now[: problem.layout.n_references]
    r = theta[:, references]
    errors = theta[:, problem.layout.state] @ C.T
    half = np.abs(C) @ unit[problem.layout.state]
    if r.shape[1]:
        errors = errors - r
        half = unit[references]
    changed = begins | np.r_[True, np.any(r[1:] != r[:-1], axis=1)]
    parts = np.split(errors, np.flatnonzero(changed)[1:])
    found = [_rest(part) for part in parts if len(part) >= SHORTEST]
    offsets = [each for each in found if each is not None]
    if len(offsets) < FEWEST:
        return None
    beside = np.abs(np.array(offsets)).mean(axis=0)
    far = beside / half
    return Rests(len(offsets), beside, int(np.argmax(far))) if np.any(far > LEAST) else None


def remaining_offset(
    problem: LinearMPC,
    runs: Sequence[Array],
    observed: Sequence[Array] | None,
    cost_increase: float = 0.0,
) -> str:
    """Return in words the offset that an MPC leaves though an observer gains nothing, and why.

    Parameters
    ----------
    problem : LinearMPC
        Whose stage cost says so.
    runs, observed : sequence of ndarray, shapes (T + 1, n_theta)
        Episodes of the MPC, and of the MPC with an observer; None where that was not tried.
    cost_increase : float, default 0
        By how much the latter cost more, relative to the former.
    """
    found = rests_beside(problem, *_joined(runs))
    if found is None:
        return ""
    i, wanted = found.worst, "set-point" if problem.layout.n_references else "operating point"
    said = (
        f"With the MPC, {_name(problem, i)} came to rest {found.beside[i]:.3g} beside its {wanted},"
        f" {found.times} times. "
    )
    if observed is None:
        why = "no inputs hold a disturbance of each state"
        if problem.layout.n_disturbances:
            why = "the MPC has disturbances already"
        return f"{said}An observer was not tried: {why}. Look whether an input is at its bound."
    with_observer = rests_beside(problem, *_joined(observed))
    left = 0.0 if with_observer is None else float(with_observer.beside[i])
    if left > found.beside[i] / 2:
        return (
            f"{said}An observer leaves {left:.3g}: look whether an input is at its bound, and "
            f"whether the {wanted} can be held, mpc.is_reachable(r)."
        )
    if cost_increase > WORSE:
        more = f"costs {100 * cost_increase:.3g} % more"
        return f"{said}An observer removes that, but {more}: leave it out."
    return (
        f"{said}An observer removes that, and gains next to nothing by the MPC's stage cost: R "
        f"punishes an input away from where the model has it at the {wanted}. If the offset "
        f"counts, take a smaller R, or RateLimits(R_du=) for it; then {CURE}"
    )


def _outputs(problem: LinearMPC) -> Array:
    """Return the tracked outputs (p, n), or the states that Q weighs."""
    if problem.layout.n_references:
        return problem.tracking.C
    return np.eye(problem.model.n_states)[np.diag(problem.Q) > 0]


def _name(problem: LinearMPC, i: int) -> str:
    """Return what an output is called, with its unit."""
    row = _outputs(problem)[i]
    if np.count_nonzero(row) == 1 and row.max() == 1:
        return with_units(problem.model)[0][int(np.argmax(row))]
    return f"the tracked output {i}"


def _joined(runs: Sequence[Array]) -> tuple[Array, NDArray[np.bool_]]:
    """Return episodes one after the other, and where each begins."""
    lengths = [len(each) for each in runs]
    begins = np.zeros(sum(lengths), dtype=bool)
    begins[np.cumsum([0, *lengths[:-1]])] = True
    return np.concatenate(runs), begins


def _rest(errors: Array) -> Array | None:
    """Return the mean (p,) of the last errors of some (steps, p), None where they still move."""
    last = errors[-int(LAST * len(errors)) :]
    mean, (early, late) = last.mean(axis=0), np.array_split(last, 2)
    moved = np.abs(late.mean(axis=0) - early.mean(axis=0))
    steady = moved <= AT_REST * np.abs(mean)
    sure = np.abs(mean) > SURE * last.std(axis=0)
    return np.where(steady & sure, mean, 0.0) if np.any(steady & sure) else None
