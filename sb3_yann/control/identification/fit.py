"""The linear system that fits a plant's log, by least squares; sensors that stand still in one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, check_choice, check_range, check_vector, warn
from sb3_yann.control.identification.dead_time import (
    as_delays,
    early_note,
    exact_memory,
    found_delays,
    input_notes,
    longest_note,
    memory_labels,
    with_memory,
)
from sb3_yann.control.identification.least_squares import (
    EXTRAPOLATED,
    NOT_EXCITED,
    Regression,
    gains_of,
    operating_point,
    regress,
    regularized,
)
from sb3_yann.control.identification.outputs import feedback, missed
from sb3_yann.control.identification.residuals import (
    BIASED,
    LONG_PREDICTION,
    TIED,
    listed,
    project_out,
    quality_notes,
    within_rounding,
)
from sb3_yann.control.linear_system import LinearSystem, names
from sb3_yann.log import Episode, Log, split_episodes


def fit_log(
    log: Log,
    *,
    x_ss: ArrayLike | None = None,
    u_ss: ArrayLike | None = None,
    d_ss: ArrayLike | None = None,
    offset: bool = True,
    ridge: float | str = "auto",
    held_out: float = 0.2,
    delay: int | str | Sequence[int] = 0,
) -> tuple[LinearSystem, Regression, tuple[Array, Array], tuple[int, ...]]:
    """Return the system that fits a log, its regression, its fits, and the dead times.

    The fits (n,) are those one and ten steps ahead; the options are as of `identify`.
    """
    log = log.with_all_states()
    automatic = isinstance(ridge, str) and check_choice("ridge", ridge, ("auto",)) == "auto"
    require_moving(log.episodes)
    _, m, d = log.sizes
    delays = as_delays(delay, m)
    if delays is None:
        delays = found_delays([*log.episodes], m)
    if not (episodes := with_memory(log.episodes, delays)):
        raise ValueError(
            f"delay = {delay!r}, but no episode has more than {max(delays)} steps: record longer."
        )
    n = episodes[0].sizes[0]
    if x_ss is not None and any(delays):
        if u_ss is None:
            raise ValueError(
                "x_ss is given without u_ss, but with dead time the inputs on their way are states "
                "too: pass both, or neither."
            )
        x_ss = np.concatenate([np.ravel(x_ss), np.repeat(np.ravel(u_ss), delays)])
    if d_ss is not None and not d:
        raise ValueError("d_ss is given, but there are no disturbances: pass these as well.")
    point = {"x_ss": (x_ss, n), "u_ss": (u_ss, m), "d_ss": (d_ss, d)}
    given = [
        None if value is None and offset else check_vector(name, value, size)
        for name, (value, size) in point.items()
    ]
    fitted, tested = split_episodes(episodes, check_range("held_out", held_out, 0, 1, "[)"))
    weight = 0.0 if automatic else check_range("ridge", ridge, 0, np.inf)
    origin = None if offset else np.concatenate([part for part in given if part is not None])
    found = regress(fitted, origin, weight)
    if not weight:
        _require_excited(found, fitted, n, m)
        # Where an integral action ties inputs to earlier states the noise of the sensors biases
        # all gains, by more than they are, and the residuals may be white all the same.
        feedback(log.episodes)
    shrunk = list[str]()
    if automatic:
        found, weight, shrunk = regularized(found, fitted, tested, origin)
    fits = (_fit(found, tested, 1), _fit(found, tested, LONG_PREDICTION))
    system = replace(system_of(found, given, log.dt, delays), time_unit=log.time_unit)
    memory = list[str]()
    if any(delays):
        own = n - sum(delays)
        A, B = exact_memory(system.A, system.B, delays, own)
        E = system.E.copy()
        E[own:] = 0.0
        past = memory_labels(delays, names((0, m)))
        system = replace(system, A=A, B=B, E=E, state_names=(*names((own,)), *past))
        rest = ", ".join(f"{each:.6g}" for each in system.u_ss)
        memory.append(
            f"Dead time: inputs act for {delays} samples. The states from x[{own}] on are the "
            f"inputs on their way, {', '.join(past)}. Show them to a policy: "
            f"sb3_yann.wrappers.PastInputs(env, {delays}, initial=[{rest}])."
            f"{longest_note(delays)}"
        )
    late = [] if any(delays) else early_note(episodes) or input_notes(found, episodes)
    quality = quality_notes(found, fitted, tested, fits, 0.0 if shrunk else weight, sum(delays))
    if told := [*late, *(each for each in quality if each.startswith(BIASED))]:
        warn(log.in_names(" ".join(told)))
    notes = [*system.notes, *memory, *quality, *shrunk, *late]
    if log.lost_steps:
        notes.append(f"{log.lost_steps} steps at gaps, or of another time than dt, are left out.")
    system = replace(system, notes=tuple(map(log.in_names, notes)))
    return system, found, fits, tuple(delays)


def require_moving(episodes: Sequence[Episode]) -> None:
    """Raise where a sensor stands still though the plant moves."""
    states = [each.states for each in episodes]
    found = frozen_rows(states, [each.driven for each in episodes])
    if found:
        raise ValueError(" ".join(words_for(found, names(episodes[0].sizes), states)))


def _require_excited(found: Regression, episodes: list[Episode], n: int, m: int) -> None:
    """Raise where an input is a law of the states, and what its rounding adds tells nothing."""
    x, u, d = np.split(np.concatenate([each.regressors for each in episodes]), [n, n + m], axis=1)
    known = np.column_stack([np.ones(len(x)), x, d])
    share = np.mean(project_out(known, u) ** 2, axis=0) / np.maximum(np.var(u, axis=0), 1e-300)
    # Within three standard errors an effect may be none.
    unsure = np.abs(found.coefficients) < 3.0 * found.standard_errors
    tied = within_rounding(known, u) & (share < TIED) & np.all(unsure, axis=0)[n : n + m]
    if tied.any():
        raise ValueError(
            f"u[{np.argmax(tied)}] is a function of the states, to within their rounding, and what "
            f"rounding adds does not tell its effect: a feedback law alone sets it. {NOT_EXCITED}"
        )


def system_of(
    found: Regression, given: Sequence[Array | None], dt: float, delays: Sequence[int]
) -> LinearSystem:
    """Return the system about its operating point, with notes on drift and extrapolation."""
    n, m, _ = found.sizes
    point = operating_point(found, given, delays)
    A, B, E = np.split(found.coefficients, [n, n + m], axis=1)
    x, u, d = np.split(point, [n, n + m])
    notes = []
    drift = found.predict(point[None])[0] - x
    doubt = np.diag(found.covariance) / found.steps
    doubt = np.sqrt(doubt + found.standard_errors**2 @ (point - found.center) ** 2)
    drifts = bool(np.any(np.abs(drift) > 3 * doubt + 1e-9 * (1 + np.abs(x))))
    if drifts:
        words = f"moves by {listed(drift)} in one step. The model leaves that out."
        notes.append(f"At the operating point the fitted plant {words}")
    away = np.flatnonzero(np.abs(x - found.center[:n]) > EXTRAPOLATED * found.spread[:n])
    if away.size:
        notes.append(f"x_ss[{away[0]}] lies far outside the data: the model is extrapolated.")
    return LinearSystem(
        A, B, dt, x, u, E, d, tuple(notes), drift if drifts else None, gains_of(found)
    )


def _fit(found: Regression, episodes: list[Episode], steps: int) -> Array:
    """Return each state's fit (n,) in percent, predicted so many steps ahead."""
    guesses = []
    for episode in episodes:
        starts = max(len(episode) - steps + 1, 0)
        x = episode.states[:starts]
        for k in range(steps):
            x = found.predict(np.hstack([x, episode.driven[k : k + starts]]))
        guesses.append(x)
    return missed([each.states[steps:] for each in episodes], guesses, found.reached.size)[1]


REPEATED_SHARE = 0.05  # of all rows: so many repeated readings of one sensor are too many


@dataclass(frozen=True)
class Frozen:
    """Equal readings in a row of one state: from the row ``first`` to ``last`` of an episode."""

    episode: int
    state: int
    first: int
    last: int

    def __len__(self) -> int:
        return self.last - self.first + 1


def frozen_rows(states: Sequence[Array], driven: Sequence[Array]) -> list[Frozen]:
    """Return where states (T+1, n) read exactly the same for long though the plant moves.

    A sensor that counts in steps repeats itself often: runs count from ten times their median
    length on, and six times that of the longest twentieth. None is returned where they are less
    than 5 % of all rows. ``driven`` (T, k) are the inputs and disturbances between the rows.
    """
    rows = sum(map(len, states))
    found = list[Frozen]()
    for i in range(states[0].shape[1]):
        runs = list[Frozen]()
        for episode, x in enumerate(states):
            edges = np.flatnonzero(np.diff(x[:, i], prepend=np.nan, append=np.nan))
            runs += [Frozen(episode, i, int(a), int(b) - 1) for a, b in pairwise(edges)]
        usual, rare = np.quantile([*map(len, runs)], [0.5, 0.95])
        moves = np.abs(np.concatenate([np.diff(x[:, i]) for x in states]))
        steps = moves[moves > 0] / np.min(moves[moves > 0], initial=np.inf)
        # Readings that are off by more than 1e-3 of a sensor's step do not count in steps.
        on_grid = bool(np.all(np.abs(steps - np.round(steps)) < 1e-3))
        # A frozen sensor shows ten equal readings in a row, and ten times as many as usual.
        least = max(10, 10.0 * usual, 6 * rare if on_grid else 0.0)
        long = [each for each in runs if len(each) >= least]
        those = _unexplained(states, driven, i, runs, long) if long else []
        if sum(map(len, those)) > REPEATED_SHARE * rows:
            found += those
    return found


def words_for(found: Sequence[Frozen], names: Sequence[str], values: Sequence[Array]) -> list[str]:
    """Return one sentence for each frozen state: which rows, what it reads, what to do."""
    notes = []
    for state in dict.fromkeys(each.state for each in found):
        those = [each for each in found if each.state == state]
        longest = max(those, key=len)
        read = values[longest.episode][longest.first, state]
        more = f", and in {len(those) - 1} more places" if len(those) > 1 else ""
        notes.append(
            f"{names[state]} reads exactly {read:.6g} in rows {longest.first} to {longest.last} of "
            f"episode {longest.episode}{more}, while the plant moves: its sensor is frozen. Cut "
            "the episode there, and leave these rows out."
        )
    return notes


def _unexplained(
    states: Sequence[Array], driven: Sequence[Array], i: int, runs: list[Frozen], long: list[Frozen]
) -> list[Frozen]:
    """Return the long runs of a state that nothing but a frozen sensor explains.

    A plant at rest repeats itself while nothing else moves. A state that rests by itself is found
    at rest by a linear model of the other rows. A clipped one rests at an end of its range.
    """
    moves = [np.diff(x[:, i]) for x in states]
    rows = [
        np.hstack([x[:-1], u, np.ones((len(u), 1))]) for x, u in zip(states, driven, strict=True)
    ]
    free = [np.ones(len(each), dtype=bool) for each in moves]
    for run in long:
        free[run.episode][max(run.first - 1, 0) : run.last + 1] = False
    target = np.concatenate([each[at] for each, at in zip(moves, free, strict=True)])
    if not np.any(target):
        return []
    used = np.concatenate([each[at] for each, at in zip(rows, free, strict=True)])
    weights = np.linalg.lstsq(used, target, rcond=None)[0]
    typical = float(np.median(np.abs(target[target != 0])))
    spread = np.std(np.delete(np.concatenate(rows), i, axis=1), axis=0)
    column = np.concatenate([x[:, i] for x in states])
    found = []
    for run in long:
        at = rows[run.episode][run.first : run.last]
        moving = np.std(np.delete(at, i, axis=1), axis=0)
        predicted = np.sqrt(np.mean((at @ weights) ** 2)) / typical
        value = states[run.episode][run.first, i]
        comes_back = any(
            each != run and len(each) > 2 and states[each.episode][each.first, i] == value
            for each in runs
        )
        clipped = value in (column.min(), column.max()) and (comes_back or run.first > 0)
        size = np.abs(moves[run.episode])
        beside = size[max(run.first - 5, 0) : run.first], size[run.last : run.last + 5]
        some = [each for each in beside if len(each)]
        alive = bool(some) and all(np.median(each) > 0.2 * typical for each in some)
        rests = clipped or (comes_back and predicted < 1)
        sure = predicted > 1 or (predicted > 1e-3 and alive)
        if np.any(moving > REPEATED_SHARE * spread) and sure and not rests:
            found.append(run)
    return found
