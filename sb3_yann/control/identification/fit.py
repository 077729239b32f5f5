"""The linear system that fits a plant's log, by least squares."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, as_between, as_positive, as_vector
from sb3_yann.control.identification.input_delays import input_notes
from sb3_yann.control.identification.least_squares import Regression, regress
from sb3_yann.control.identification.logs import Episode, Log, as_episodes, split, without_gaps
from sb3_yann.control.identification.operating_point import FAR, operating_point
from sb3_yann.control.linear_system import LinearSystem

AHEAD = 10  # steps of the longer prediction whose fit is stated
POOR = 50.0  # percent of the longer prediction's fit below which a model is called poor


@dataclass(frozen=True, eq=False)
class LogFit:
    """A system fitted to a log, its regression, and its fits (n,) one and ten steps ahead."""

    system: LinearSystem
    regression: Regression
    fits: tuple[Array, Array]


def fit_log(  # noqa: PLR0913 (those of `identify`)
    states: Log,
    actions: Log,
    dt: float,
    disturbances: Log | None = None,
    x_ss: ArrayLike | None = None,
    u_ss: ArrayLike | None = None,
    d_ss: ArrayLike | None = None,
    offset: bool = True,
    ridge: float = 0.0,
    held_out: float = 0.2,
    time: Log | None = None,
) -> LogFit:
    """Return the least-squares fit to measured episodes.

    Parameters
    ----------
    states, actions, disturbances, time : array_like, or sequence of such
        Episodes, of shapes (T+1, n), (T, m), (T, d) and (T+1,).
    dt, x_ss, u_ss, d_ss, offset, ridge, held_out : float, array_like, bool
        As of `identify`: sampling time, operating point (n,), (m,) and (d,), and options.
    """
    episodes, sizes = as_episodes(states, actions, disturbances)
    dt, lost = as_positive("dt", dt), 0
    if time is not None:
        episodes, lost = without_gaps(episodes, time, dt)
    n, m, d = sizes
    if d_ss is not None and disturbances is None:
        raise ValueError("d_ss is given, but there are no disturbances: pass these as well.")
    point = {"x_ss": (x_ss, n), "u_ss": (u_ss, m), "d_ss": (d_ss, d)}
    given = [
        None if value is None and offset else as_vector(name, value, size)
        for name, (value, size) in point.items()
    ]
    fitted, tested = split(episodes, as_between("held_out", held_out, 0, 1, "[)"))
    weight = as_between("ridge", ridge, 0, np.inf)
    origin = None if offset else np.concatenate([part for part in given if part is not None])
    found = regress(fitted, sizes, origin, weight)
    fits = (_fit(found, tested, 1), _fit(found, tested, AHEAD))
    system = _system(found, sizes, given, dt)
    late = input_notes(found, fitted, sizes)
    if late:
        warnings.warn(" ".join(late), stacklevel=3)
    notes = [*system.notes, *_quality(found, tested, fits, weight), *late]
    if lost:
        notes.append(f"{lost} steps that took another time than dt were left out.")
    return LogFit(replace(system, notes=tuple(notes)), found, fits)


def _system(
    found: Regression, sizes: tuple[int, int, int], given: Sequence[Array | None], dt: float
) -> LinearSystem:
    """Return the system about its operating point, with notes on drift and extrapolation."""
    n, m, _ = sizes
    point = operating_point(found, sizes, given)
    A, B, E = np.split(found.coefficients, [n, n + m], axis=1)
    x, u, d = np.split(point, [n, n + m])
    notes = []
    drift = found.predict(point[None])[0] - x
    doubt = np.diag(found.covariance) / found.steps
    doubt = np.sqrt(doubt + found.standard_errors**2 @ (point - found.center) ** 2)
    drifts = bool(np.any(np.abs(drift) > 3 * doubt + 1e-9 * (1 + np.abs(x))))
    if drifts:
        words = f"moves by {_list(drift)} in one step. The model leaves that out."
        notes.append(f"At the operating point the fitted plant {words}")
    away = np.flatnonzero(np.abs(x - found.center[:n]) > FAR * found.spread[:n])
    if away.size:
        notes.append(f"x_ss[{away[0]}] lies far outside the data: the model is extrapolated.")
    return LinearSystem(A, B, dt, x, u, E, d, tuple(notes), drift if drifts else None)


def _fit(found: Regression, episodes: list[Episode], steps: int) -> Array:
    """Return each state's fit (n,) in percent, predicted so many steps ahead."""
    errors, targets = [], []
    for episode in episodes:
        starts = max(len(episode) - steps + 1, 0)
        x = episode.states[:starts]
        for k in range(steps):
            x = found.predict(np.hstack([x, episode.driven[k : k + starts]]))
        errors.append(x - episode.states[steps:])
        targets.append(episode.states[steps:])
    target = np.concatenate([*targets, np.zeros((0, found.reached.size))])
    if not len(target):
        return np.full(found.reached.size, np.nan)
    moved = np.linalg.norm(target - np.mean(target, axis=0), axis=0)
    missed = np.linalg.norm(np.concatenate(errors), axis=0)
    return np.asarray(100 * (1 - missed / np.where(moved > 0, moved, np.nan)))


def _quality(
    found: Regression, tested: list[Episode], fits: tuple[Array, Array], ridge: float
) -> list[str]:
    """Return notes on residuals, fit, excitation and bias."""
    notes = [
        f"Fitted to {found.steps} steps; one step differs from the prediction by "
        f"{_list(np.sqrt(np.diag(found.covariance)))} (standard deviation of each state)."
    ]
    if tested:
        notes.append(_words_for(fits, sum(map(len, tested))))
    if found.excitation < 0.01:
        notes.append(
            f"Weakly excited: {found.weakest} moved {found.excitation:.1e} times as much as the "
            "most excited combination. Entries along it are uncertain."
        )
    if ridge > 0:
        notes.append(f"A ridge of {ridge:g} biases the entries towards zero.")
    colored = np.abs(found.autocorrelation) > 3 / np.sqrt(found.steps)
    if np.any(colored):
        notes.append(
            f"The residuals of neighboring steps are correlated ({_list(found.autocorrelation)}): "
            "there is sensor noise, which biases A towards zero, or an unmodeled state. The "
            "standard errors do not tell that."
        )
    return notes


def _words_for(fits: tuple[Array, Array], steps: int) -> str:
    """Return a note on the fits to held-out data."""
    words = [
        f"{_list(fit)} % {ahead} ahead"
        for fit, ahead in zip(fits, ("one step", f"{AHEAD} steps"), strict=True)
        if not np.all(np.isnan(fit))
    ]
    if not words:
        return f"The {steps} steps held out tell no fit: they are too few, or nothing moves."
    text = f"Fit over {steps} steps held out, 100 % is perfect: {', '.join(words)}."
    if len(words) < len(fits):
        text += f" No episode of them is {AHEAD} steps long."
    if np.any(fits[1] < POOR):
        text += f" Poor: {AHEAD} steps ahead the model says little of the plant."
    return text


def _list(values: Array) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
