"""Whether a plant was seen to rest beside its references, and what to do about it."""

from __future__ import annotations

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.audit.sample import Sample
from sb3_yann.control import LinearMPC

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
SURE = 3.0
"""Standard deviations within that part that an offset exceeds."""


def steady_offset(problem: LinearMPC, sample: Sample) -> str:
    """Return how far tracked outputs rest beside a reference that holds, and the cure, in words.

    It is empty where none does, where nothing came to rest, and where theta holds a disturbance.
    """
    layout = problem.layout
    if not layout.n_references or layout.n_disturbances:
        return ""
    errors = sample.theta[:, layout.state] @ problem.tracking.C.T
    errors = errors - sample.theta[:, layout.reference]
    found = [each for each in _rests(sample, layout.reference, errors) if each is not None]
    if len(found) < FEWEST:
        return ""
    offsets, unit = np.array(found), problem.theta_half[layout.reference]
    beside = np.abs(offsets).mean(axis=0)
    if not np.any(beside > LEAST * unit):
        return ""
    i = int(np.argmax(beside / unit))
    return (
        f"Where a reference held, {len(found)} times, the tracked output {i} came to rest "
        f"{beside[i]:.3g} beside r[{i}]: the plant is not its model. Without an offset, and before "
        f"any learning: {CURE}"
    )


def _rests(sample: Sample, reference: slice, errors: Array) -> list[Array | None]:
    """Return the mean errors (p,) at the end of each time that a reference held."""
    r = sample.theta[:, reference]
    changed = sample.begins | np.r_[True, np.any(r[1:] != r[:-1], axis=1)]
    parts = np.split(errors, np.flatnonzero(changed)[1:])
    return [_rest(part) for part in parts if len(part) >= SHORTEST]


def _rest(errors: Array) -> Array | None:
    """Return the mean (p,) of the last errors of some (steps, p), None where they still move."""
    last = errors[-int(LAST * len(errors)) :]
    mean, (early, late) = last.mean(axis=0), np.array_split(last, 2)
    moved = np.abs(late.mean(axis=0) - early.mean(axis=0))
    steady = moved <= AT_REST * np.abs(mean)
    sure = np.abs(mean) > SURE * last.std(axis=0)
    return np.where(steady & sure, mean, 0.0) if np.any(steady & sure) else None
