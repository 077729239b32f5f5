"""Dead time: inputs on their way as states of the model, and how many there are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array
from sb3_yann.control.identification.curvature import features, without
from sb3_yann.control.identification.hidden_states import leftover
from sb3_yann.control.identification.logs import Episode

LONGEST = 10  # longest dead time, in samples, that is looked for
CURVED = 0.05  # share of the linear fit's residual variance that is left to higher curvature
GAIN = 0.3  # share of a state's residual variance by which dead time must lower it


def as_delays(delay: int | str | Sequence[int], n_inputs: int) -> list[int] | None:
    """Return the dead time of each input in samples, None for "auto"."""
    if isinstance(delay, str):
        if delay != "auto":
            raise ValueError(f'delay = {delay!r} must be "auto" or a number of samples.')
        return None
    given = np.asarray(delay, dtype=object)
    values = given.ravel().tolist() * (n_inputs if given.ndim == 0 else 1)
    whole = [isinstance(v, (int, np.integer)) and not isinstance(v, bool) for v in values]
    if len(values) != n_inputs or not all(whole) or min(values) < 0:
        raise ValueError(
            f"delay = {delay!r} must be a whole number of samples, one for each of the {n_inputs} "
            'inputs, or "auto".'
        )
    return [int(v) for v in values]


def found_delays(episodes: list[Episode], n_inputs: int) -> list[int]:
    """Return the dead time of each input that explains the log best, by Schwarz's criterion.

    Squares and products of states and inputs stand beside: curvature is no dead time. The inputs
    take turns, each with the others' dead times as found so far.
    """
    best = [0] * n_inputs
    longer = [episode for episode in episodes if len(episode) > LONGEST + 1]
    steps = sum(len(episode) - LONGEST for episode in longer)
    n = episodes[0].states.shape[1]
    if steps <= 4 * (episodes[0].regressors.shape[1] + 1 + LONGEST * n_inputs):
        return best
    now = np.concatenate([episode.regressors[LONGEST:] for episode in longer])
    target = np.concatenate([episode.states[LONGEST + 1 :] for episode in longer])
    past = [
        np.concatenate([e.driven[LONGEST - lag : len(e) - lag, :n_inputs] for e in longer])
        for lag in range(1, LONGEST + 1)
    ]
    centered = now - np.mean(now, axis=0)
    plain = np.column_stack([np.ones(steps), centered])
    basis = np.column_stack([plain, features(centered)])
    whole = without(basis, np.hstack([target, *past]))  # lag after lag, input by input
    # Below it, all is rounding, or curvature of higher order.
    floor = 1e-10 * np.var(target, axis=0) + np.finfo(float).tiny
    floor += CURVED * np.mean(without(plain, target) ** 2, axis=0)
    gram = whole.T @ whole / steps
    for _ in range(2 if n_inputs > 1 else 1):
        for j in range(n_inputs):
            trials = [[*best[:j], lag, *best[j + 1 :]] for lag in range(LONGEST + 1)]
            left = np.array([_left(gram, trial, n) + floor for trial in trials])
            best = trials[_chosen(left, steps, n)]
    # A hidden state makes earlier inputs count too, but earlier states with them.
    return [0] * n_inputs if any(best) and leftover(longer, best).is_hidden else best


def _left(gram: Array, delays: list[int], n: int) -> Array:
    """Return the mean squares (n,) of what so many past inputs leave of the targets.

    The Gram matrix is that of the targets, followed by the inputs lag after lag.
    """
    m, total = len(delays), np.diag(gram)[:n]
    taps = [n + lag * m + j for j, delay in enumerate(delays) for lag in range(delay)]
    if not taps:
        return np.asarray(total)
    size = np.sqrt(np.diag(gram)[taps])
    size = np.where(size > 0, size, 1.0)
    inner, cross = gram[np.ix_(taps, taps)] / np.outer(size, size), gram[taps, :n] / size[:, None]
    told = np.sum(cross * (np.linalg.pinv(inner, rcond=1e-9, hermitian=True) @ cross), axis=0)
    return np.asarray(np.maximum(total - told, 0.0))


def _chosen(left: Array, steps: int, n: int) -> int:
    """Return the shortest dead time to which that of least criterion (k, n) adds little."""
    lags = np.arange(len(left))
    criterion = steps * np.sum(np.log(left), axis=1) + np.log(steps) * n * lags
    best = left[int(np.argmin(criterion))]
    return int(np.argmax(np.all(best > (1 - GAIN) * left, axis=1)))


def with_memory(episodes: list[Episode], delays: Sequence[int]) -> list[Episode]:
    """Return the episodes with the last inputs, newest first, appended to the states.

    Parameters
    ----------
    episodes : list of Episode
        Shorter ones than the longest dead time fall out.
    delays : sequence of int
        For each input, how many of its past values are appended.
    """
    longest, extended = max(delays), []
    for episode in episodes:
        rows = len(episode) + 1 - longest
        if rows < 2:
            continue
        past = [
            episode.driven[longest - lag : longest - lag + rows, j]
            for j, delay in enumerate(delays)
            for lag in range(1, delay + 1)
        ]
        states = np.column_stack([episode.states[longest:], *past])
        extended.append(Episode(states, episode.driven[longest:]))
    return extended


def memory_labels(delays: Sequence[int], inputs: Sequence[str]) -> list[str]:
    """Return the names of the states that hold past inputs: ``u[0](k-1), u[0](k-2), ...``."""
    return [
        f"{name}(k-{lag})"
        for name, delay in zip(inputs, delays, strict=True)
        for lag in range(1, delay + 1)
    ]


def with_memory_point(
    x_ss: ArrayLike | None, u_ss: ArrayLike | None, delays: Sequence[int]
) -> ArrayLike | None:
    """Return a given steady state (n,) with the inputs that rest there appended."""
    if x_ss is None or not any(delays):
        return x_ss
    if u_ss is None:
        raise ValueError(
            "x_ss is given without u_ss, but with dead time the inputs on their way are states "
            "too: pass both, or neither."
        )
    whole: Array = np.concatenate([np.ravel(x_ss), np.repeat(np.ravel(u_ss), delays)])
    return whole


def exact_memory(A: Array, B: Array, delays: Sequence[int], n: int) -> tuple[Array, Array]:
    """Return A and B with the rows of the past inputs, which shift, set to what they are.

    Parameters
    ----------
    A, B, delays, n : ndarray, shapes (n', n') and (n', m), list of int, and int
        The matrices as they were fitted, the dead times, and the number of states without memory.
    """
    A, B, row = A.copy(), B.copy(), n
    for j, delay in enumerate(delays):
        A[row : row + delay], B[row : row + delay] = 0.0, 0.0
        for lag in range(delay):
            if lag:
                A[row + lag, row + lag - 1] = 1.0
            else:
                B[row, j] = 1.0
        row += delay
    return A, B
