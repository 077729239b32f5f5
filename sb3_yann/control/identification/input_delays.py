"""Inputs without effect, and input delays, found in the residuals of a fit."""

from __future__ import annotations

import numpy as np
from scipy.special import fdtrc

from sb3_yann._validation import Array
from sb3_yann.control.identification.curvature import bent, features
from sb3_yann.control.identification.dead_time import GAIN, found_delays
from sb3_yann.control.identification.hidden_states import leftover
from sb3_yann.control.identification.least_squares import Regression
from sb3_yann.control.identification.logs import Episode
from sb3_yann.control.linear_system import names

LONGEST = 10  # longest input delay, in samples, that is looked for
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

    Parameters
    ----------
    found : Regression
        The fit.
    episodes : list of Episode
        Those it was fitted to.
    sizes : tuple of int
        Numbers of states, inputs and disturbances.
    log : list of Episode, optional
        All of them, in which ``delay="auto"`` looks for dead time.
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
    straight = np.sqrt(1 - bent(found, episodes)[0])  # curvature is no delay
    episodes = _first(episodes)
    for lag in range(1, LONGEST + 1):
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
    """Return each past input's largest weighted partial correlation with a residual.

    Parameters
    ----------
    known, residuals, past, weights : ndarray, shapes (k, q), (k, n), (k, m) and (n,)
        What is taken off first; what is correlated; the weight of each residual.
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
