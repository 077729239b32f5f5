"""Dead time: how many samples late each input acts, and its inputs on their way as states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import fdtrc

from sb3_yann._validation import Array
from sb3_yann.control.identification.least_squares import Regression
from sb3_yann.control.identification.residuals import (
    curvature_test,
    features,
    leftover,
    project_out,
)
from sb3_yann.control.linear_system import names
from sb3_yann.log import Episode

MAX_DELAY = 10  # longest dead time in samples that is looked for
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
    longer = [episode for episode in episodes if len(episode) > MAX_DELAY + 1]
    steps = sum(len(episode) - MAX_DELAY for episode in longer)
    n = episodes[0].states.shape[1]
    if steps <= 4 * (episodes[0].regressors.shape[1] + 1 + MAX_DELAY * n_inputs):
        return best
    now = np.concatenate([episode.regressors[MAX_DELAY:] for episode in longer])
    target = np.concatenate([episode.states[MAX_DELAY + 1 :] for episode in longer])
    past = [
        np.concatenate([e.driven[MAX_DELAY - lag : len(e) - lag, :n_inputs] for e in longer])
        for lag in range(1, MAX_DELAY + 1)
    ]
    centered = now - np.mean(now, axis=0)
    plain = np.column_stack([np.ones(steps), centered])
    basis = np.column_stack([plain, features(centered)])
    whole = project_out(basis, np.hstack([target, *past]))  # lag after lag, input by input
    # Below it, all is rounding, or curvature of higher order.
    floor = 1e-10 * np.var(target, axis=0) + np.finfo(float).tiny
    floor += CURVED * np.mean(project_out(plain, target) ** 2, axis=0)
    gram = whole.T @ whole / steps
    for _ in range(2 if n_inputs > 1 else 1):
        for j in range(n_inputs):
            trials = [[*best[:j], lag, *best[j + 1 :]] for lag in range(MAX_DELAY + 1)]
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

    ``delays`` says how many of each input. Episodes shorter than the longest dead time fall out.
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
        extended.append(Episode(states, episode.inputs[longest:], episode.disturbances[longest:]))
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

    They were fitted with the n states and, after these, the inputs on their way.
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


ENOUGH = 5000  # steps in which a delay is looked for
CHANCE = 0.01  # significance level of an input's effect
HIDDEN = "earlier states explain more than dead time does, so there is one that is not measured."
FOLLOWS = 0.25  # least correlation of residuals with an earlier input: sensor noise leaves some


def input_notes(
    found: Regression,
    episodes: list[Episode],
    sizes: tuple[int, int, int],
    log: list[Episode] | None = None,
) -> list[str]:
    """Return notes on inputs and disturbances without effect, or with a delay.

    ``episodes`` are what the fit was made of, and ``log`` all of them, in which ``delay="auto"``
    looks for dead time.
    """
    n, m, _ = sizes
    delays, notes = _delays(found, episodes, sizes), []
    automatic = found_delays(log or episodes, m) if any(lag for lag, _ in delays[:m]) else [0] * m
    hidden = not any(automatic) and leftover(log or episodes, automatic).is_hidden
    driven = zip(names(sizes)[n:], delays, strict=True)
    for column, (name, (lag, correlation)) in enumerate(driven, n):
        idle = _chance(found, n, column) > CHANCE
        late = (
            f"he residuals follow {name} of {lag} steps before (correlation {correlation:.2f}): "
            f"it acts {lag} samples late."
        )
        if hidden:
            late = late.replace(f"it acts {lag} samples late.", HIDDEN)
        if lag:
            start = f"{name} has no effect that can be told from 0, and t" if idle else "T"
            cure = f" Move its measurements {lag} samples down, in the log and on the plant."
            notes.append(start + late + (cure if column >= n + m else ""))
        elif idle:
            notes.append(
                f"{name} has no effect on the next state that can be told from 0. Is it delayed by "
                "more than the log shows, too small beside the noise, or not what the plant got?"
            )
    lags = [lag for lag, _ in delays[:m]]
    return [*notes, _advice(lags, automatic)] if any(lags) and not hidden else notes


def _advice(lags: list[int], automatic: list[int]) -> str:
    """Return what to pass as delay, by lags of the residuals and what "auto" finds."""
    if any(automatic):
        return f"Pass delay={_argument(automatic)}, or delay='auto'."
    return (
        f"Pass delay={_argument(lags)}, and keep it where the fit of held-out data becomes better. "
        f"delay='auto' takes none: the log is too short, or a delay explains less than "
        f"{100 * GAIN:.0f} % of what the fit leaves. A state that is not measured looks alike."
    )


def _argument(delays: list[int]) -> str:
    return str(delays if len(delays) > 1 else delays[0])


def _chance(found: Regression, n: int, column: int) -> float:
    """Return the p-value of Hotelling's T-squared test that a whole column is zero."""
    floor = np.diag((1e-10 * np.maximum(found.spread[:n], np.finfo(float).tiny)) ** 2)
    effect = found.coefficients[:, column] / max(found.factors[column], np.finfo(float).tiny)
    square = float(effect @ np.linalg.solve(found.covariance + floor, effect))
    freedom = found.degrees_of_freedom - n + 1
    if freedom < 1:  # too little is known for a verdict
        return 0.0
    return float(fdtrc(n, freedom, square * freedom / (n * found.degrees_of_freedom)))


def _delays(
    found: Regression, episodes: list[Episode], sizes: tuple[int, int, int]
) -> list[tuple[int, float]]:
    """Return each input's lag of largest partial correlation with the residuals, 0 for none."""
    best = [(0, 0.0)] * (sizes[1] + sizes[2])
    straight = np.sqrt(1 - curvature_test(found, episodes)[0])  # curvature is no delay
    episodes = _first(episodes)
    for lag in range(1, MAX_DELAY + 1):
        longer = [episode for episode in episodes if len(episode) > lag]
        steps = sum(len(episode) - lag for episode in longer)
        if steps <= 4 * found.center.size:
            break
        now = np.concatenate([episode.regressors[lag:] for episode in longer])
        residuals = np.concatenate([episode.states[1 + lag :] for episode in longer])
        residuals = residuals - found.predict(now)
        if np.all(np.std(residuals, axis=0) <= 1e-9 * found.spread[: sizes[0]]):
            break  # nothing but rounding
        past = np.concatenate([episode.driven[:-lag] for episode in longer])
        centered = now - found.center
        known = np.column_stack([centered, features(centered)])
        for j, size in enumerate(_correlations(known, residuals, past, straight)):
            if size > max(best[j][1], FOLLOWS, 5 / np.sqrt(steps)):
                best[j] = (lag, float(size))
    return best


def _first(episodes: list[Episode]) -> list[Episode]:
    """Return the first `ENOUGH` steps: so many tell a delay, and more take long."""
    kept, room = [], ENOUGH
    for episode in episodes:
        if room > 0:
            kept.append(episode.part(0, min(room, len(episode))))
            room -= len(episode)
    return kept


def _correlations(known: Array, residuals: Array, past: Array, weights: Array) -> Array:
    """Return each past input's largest weighted partial correlation with a residual, (m,).

    What is known (k, q) is taken off residuals (k, n) and past inputs (k, m) before; weights (n,).
    """
    spread = np.std(known, axis=0)
    moving = spread > 0  # the others would make QR take off a direction of its own choice
    basis = np.column_stack([np.ones(len(known)), known[:, moving] / spread[moving]])
    orthonormal = np.linalg.qr(basis)[0]

    def rest(values: Array) -> Array:
        left = values - orthonormal @ (orthonormal.T @ values)
        size, before = np.linalg.norm(left, axis=0), np.linalg.norm(values, axis=0)
        return np.asarray(np.where(size > 1e-6 * before, left / np.where(size > 0, size, 1), 0.0))

    return np.asarray(np.max(weights[:, None] * np.abs(rest(residuals).T @ rest(past)), axis=0))
