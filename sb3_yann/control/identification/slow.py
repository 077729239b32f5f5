"""Outputs that are read now and then, as a laboratory's: what stands in for a first model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.log import Arrays, Episode, Log, as_matrices, cut_at_gaps

RARE = 0.8
"""Share of the samples below which isolated readings make an output a slow one."""
RIDGE = 1e-3
"""Of the number of readings: filtered signals depend on each other."""


def read_log(
    outputs: Arrays, inputs: Arrays, dt: float, disturbances: Arrays | None
) -> tuple[Log, list[Episode], tuple[int, ...]]:
    """Return a log in which stand-ins take the place of missing readings of slow outputs.

    Returns
    -------
    log : Log
        Cut where something else is missing.
    read : list of Episode
        The same with NaN for each stand-in.
    every : tuple of int, length q
        Each output is read every so many samples; 1 for those that are not slow.
    """
    y = as_matrices("outputs", outputs, gaps=True)
    q = y[0].shape[1]
    every = tuple(_period([each[:, i] for each in y]) for i in range(q))
    if max(every) == 1:
        log = cut_at_gaps(outputs, inputs, dt, disturbances)
        return log, list(log.episodes), every
    u = as_matrices("inputs", inputs, gaps=True)
    more = [] if disturbances is None else as_matrices("disturbances", disturbances, gaps=True)
    driven = [np.hstack([each, *more[i : i + 1]]) for i, each in enumerate(u)]
    filled = stand_ins(y, driven, np.array(every) > 1)
    marked = [np.hstack([a, np.isfinite(b)]) for a, b in zip(filled, y, strict=True)]
    log = cut_at_gaps(marked, inputs, dt, disturbances)
    whole = [replace(each, states=each.states[:, :q]) for each in log.episodes]
    read = [
        replace(each, states=np.where(each.states[:, q:] > 0, each.states[:, :q], np.nan))
        for each in log.episodes
    ]
    return replace(log, episodes=tuple(whole)), read, every


def _period(columns: Sequence[Array]) -> int:
    """Return the mean number of samples between readings, 1 if these are not isolated."""
    read = np.concatenate([np.append(np.isfinite(each), False) for each in columns])
    count = int(read.sum())
    rows = sum(map(len, columns))
    runs = int(np.sum(read[1:] & ~read[:-1])) + int(read[0])
    return round(rows / count) if 0 < count < RARE * rows and runs > count / 2 else 1


def stand_ins(y: Sequence[Array], driven: Sequence[Array], slow: NDArray[np.bool_]) -> list[Array]:
    """Return outputs (T + 1, q) whose slow ones have a value at each sample.

    That is a linear function of the other outputs and the inputs, filtered by several time
    constants, and what it leaves at the readings, drawn straight from one to the next.
    """
    gaps = max(np.mean(~np.isfinite(each[:, slow])) for each in y)
    longest = 8 / max(1 - gaps, 1e-3)
    constants = np.exp2(np.arange(max(3, int(np.log2(longest)) + 1), dtype=np.float64))
    parts = [_filtered(a[:, ~slow], b, constants) for a, b in zip(y, driven, strict=True)]
    rows = np.concatenate(parts)
    center, scale = rows.mean(axis=0), rows.std(axis=0)
    scale[scale == 0] = 1.0
    parts = [(each - center) / scale for each in parts]
    rows = np.concatenate(parts)
    filled = [each.copy() for each in y]
    for i in np.flatnonzero(slow):
        wanted = np.concatenate([each[:, i] for each in y])
        at = np.isfinite(wanted)
        mean = wanted[at].mean()
        gram = rows[at].T @ rows[at] + RIDGE * at.sum() * np.eye(rows.shape[1])
        weights = np.linalg.solve(gram, rows[at].T @ (wanted[at] - mean))
        for part, each in zip(parts, filled, strict=True):
            guess = mean + part @ weights
            seen = np.flatnonzero(np.isfinite(each[:, i]))
            left = each[seen, i] - guess[seen]
            rest = np.interp(np.arange(len(guess)), seen, left) if len(seen) else 0.0
            each[:, i] = guess + rest
    return filled


def _filtered(fast: Array, driven: Array, constants: Array) -> Array:
    """Return (T + 1, k): fast outputs now and filtered, and inputs of before, filtered."""
    fast, driven = _held(fast), _held(driven)
    before = np.vstack([driven[:1], driven])  # the first input acts from the second sample on
    signals = np.hstack([fast, before])
    found = [signals]
    for constant in constants:
        pole, now = np.exp(-1 / constant), signals[0]
        rows = np.empty_like(signals)
        for k, each in enumerate(signals):
            now = pole * now + (1 - pole) * each
            rows[k] = now
        found.append(rows)
    return np.hstack(found)


def _held(signals: Array) -> Array:
    """Return signals with the last value where one is missing; zero before the first."""
    found = signals.copy()
    for k in range(len(found)):
        before = found[k - 1] if k else np.zeros(found.shape[1])
        found[k] = np.where(np.isfinite(found[k]), found[k], before)
    return found
